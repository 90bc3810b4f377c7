"""Collision avoidance: the velocity nearest to the wanted one that keeps the clearance from every track in view.

For every track, with d the direction to it, ρ⁻ the lower bound of its range, and w the other's velocity,

    d · v ≤ γ (ρ⁻ − D) + min(a, 0) + 0.8 max(a, 0),    a = d · w − σ(d · w),

never asking for a retreat faster than the speed limit. σ is there because the closing speed is what a camera measures
worst. A retreat alone is a chase: a drone that comes straight on is sidestepped as well (`sidestep`).

Each is a half-space of velocities. The nearest point of all of them together is found by Hildreth's sweeps (Hildreth,
1957), one closed form after another: no solver is needed, and the same input gives the same output to the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from swarmtrack.formation.law import dot, towards
from swarmtrack.formation.margins import (
    BARRIER_GAMMA_PER_S,
    BARRIER_SWEEPS,
    BARRIER_TOLERANCE_M_S,
    BARRIER_TRUSTED_AWAY,
    COMING_SPEED_M_S,
    COMING_WITHIN_S,
    PASSING_M,
    SIDESTEP_SPEED_M_S,
    STRAIGHT_ON_M,
)
from swarmtrack.formation.setpoint import STANDSTILL, Velocity


class HalfSpace(NamedTuple):
    """All v with normal · v ≤ bound [m/s]; normal: of length 1. track: the one that it keeps clear of, None without
    one.
    """

    normal: Velocity
    bound: float
    track: int | None = None


def keep_clear(
    track: int, direction: Velocity, nearest: float, away: float, *, clearance: float, fastest: float
) -> HalfSpace:
    """Half-space that keeps the clearance. direction: of length 1, to the other; nearest [m]: lower bound of its
    range; away [m/s]: lower bound of its speed along that, below 0 while it approaches.

    fastest [m/s]: upper limit of the retreat. A limit below the others' speed breaks it.
    """
    bound = (
        BARRIER_GAMMA_PER_S * (nearest - clearance) + min(away, 0.0) + BARRIER_TRUSTED_AWAY * max(away, 0.0)
    )
    return HalfSpace(direction, max(bound, -fastest), track)


def not_closing(
    track: int, direction: Velocity, nearest: float, leaves: float, *, clearance: float
) -> HalfSpace:
    """Relaxation of `keep_clear` where not all can be met: no approach to a track within the clearance, and beyond
    it the remaining distance is used up no faster. leaves [m/s]: expected speed of the other along the
    direction.
    """
    return HalfSpace(direction, BARRIER_GAMMA_PER_S * max(nearest - clearance, 0.0) + leaves, track)


def sidestep(place: Velocity, motion: Velocity, lasts: float = COMING_WITHIN_S) -> Velocity:
    """Level velocity [m/s] that evades a drone at `place` [m, from here] which passes soon and near. motion [m/s]:
    its velocity less the wanted one, and lasts [s]: for how long. A drone that comes straight on is passed on
    its left: both step to their right.
    """
    north, east, _ = place
    vn, ve, _ = motion
    square = vn * vn + ve * ve
    if square < COMING_SPEED_M_S**2:
        return STANDSTILL
    soon = -(north * vn + east * ve) / square
    if not 0.0 < soon < COMING_WITHIN_S:
        return STANDSTILL
    soon = min(soon, lasts)
    pn, pe = north + soon * vn, east + soon * ve
    miss = math.hypot(pn, pe)
    if miss >= PASSING_M:
        return STANDSTILL
    speed = SIDESTEP_SPEED_M_S * (1.0 - miss / PASSING_M)
    if miss < STRAIGHT_ON_M:
        # Its left is a quarter turn back from its course; we stand on it when we go there.
        length = math.sqrt(square)
        return speed * ve / length, -speed * vn / length, 0.0
    return -speed * pn / miss, -speed * pe / miss, 0.0


def nearest_velocity(wanted: Velocity, spaces: Sequence[HalfSpace], sweeps: int = BARRIER_SWEEPS) -> Velocity:
    """Velocity nearest to `wanted` within all half-spaces; a compromise where their intersection is empty."""
    north, east, down = wanted
    rows = [(*space.normal, space.bound) for space in spaces]
    pushed = [0.0] * len(rows)
    for _ in range(sweeps):
        most = 0.0
        for k, (x, y, z, bound) in enumerate(rows):
            # Spelled out: this loop is most of what a command costs.
            step = x * north + y * east + z * down - bound
            if step < -pushed[k]:  # noqa: PLR1730
                step = -pushed[k]
            if step:
                pushed[k] += step
                north, east, down = north - step * x, east - step * y, down - step * z
                if not abs(step) <= most:
                    most = abs(step)
        if most < BARRIER_TOLERANCE_M_S:
            break
    return north, east, down


def binding(velocity: Velocity, spaces: Sequence[HalfSpace]) -> tuple[int, ...]:
    """Tracks whose half-space a velocity violates."""
    return tuple(
        space.track
        for space in spaces
        if space.track is not None and dot(space.normal, velocity) > space.bound + BARRIER_TOLERANCE_M_S
    )


def excess(velocity: Velocity, spaces: Sequence[HalfSpace]) -> float:
    """Largest violation [m/s] of the half-spaces by a velocity; negative within all of them."""
    return max((dot(space.normal, velocity) - space.bound for space in spaces), default=-math.inf)


def stepped(now: Velocity, wanted: Velocity, most: float, spaces: Sequence[HalfSpace]) -> Velocity:
    """Step from one velocity towards another, which is within `spaces`, by no more than `most` [m/s]. Entering them
    comes first.
    """
    if math.dist(now, wanted) <= most:
        return wanted
    within = nearest_velocity(now, spaces)
    # From there on straight to what is wanted, which stays within: as far as |off + share * way| = most.
    off = [there - here for there, here in zip(within, now, strict=True)]
    way = [there - here for there, here in zip(wanted, within, strict=True)]
    left = most * most - sum(x * x for x in off)
    if left <= 0.0:
        return towards(now, within, most)
    square, along = sum(x * x for x in way), sum(a * b for a, b in zip(off, way, strict=True))
    share = (math.sqrt(along * along + square * left) - along) / square
    north, east, down = (here + share * x for here, x in zip(within, way, strict=True))
    return north, east, down


def fence(
    position: Velocity, engaged: Velocity, *, radius: float, lowest: float, highest: float, pull: float
) -> list[HalfSpace]:
    """Half-spaces that keep a drone within `radius` [m] of where it was engaged, level, and between two heights [m,
    down]. pull [m/s]: upper limit of the speed back from beyond it.
    """
    north, east = position[0] - engaged[0], position[1] - engaged[1]
    away = math.hypot(north, east)
    spaces = [
        HalfSpace((0.0, 0.0, 1.0), max(BARRIER_GAMMA_PER_S * (lowest - position[2]), -pull)),
        HalfSpace((0.0, 0.0, -1.0), max(BARRIER_GAMMA_PER_S * (position[2] - highest), -pull)),
    ]
    if away > 1e-3:
        outward = (north / away, east / away, 0.0)
        spaces.append(HalfSpace(outward, max(BARRIER_GAMMA_PER_S * (radius - away), -pull)))
    return spaces


def leash(position: Velocity, place: Velocity, velocity: Velocity, most: float) -> list[HalfSpace]:
    """Half-space that keeps a drone within `most` [m], level, of a position that moves [m/s]. It never pulls: zero
    velocity stays allowed.
    """
    north, east = position[0] - place[0], position[1] - place[1]
    away = math.hypot(north, east)
    if away < 1e-3:
        return []
    outward = (north / away, east / away, 0.0)
    return [HalfSpace(outward, max(BARRIER_GAMMA_PER_S * (most - away) + dot(outward, velocity), 0.0))]


def layer(down: float, least: float, most: float, *, speed: float, gain: float) -> list[HalfSpace]:
    """Half-spaces that keep a drone at `down` [m] between two heights [m, down] that move [m/s, down]. gain [1/s]:
    how fast the remaining distance may be used up. They never pull, either.
    """
    return [
        HalfSpace((0.0, 0.0, 1.0), max(gain * (most - down) + speed, 0.0)),
        HalfSpace((0.0, 0.0, -1.0), max(gain * (down - least) - speed, 0.0)),
    ]
