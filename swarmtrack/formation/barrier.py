"""Keeping clear: the velocity nearest to the wanted one that takes this drone too near to nobody it sees.

For everyone seen, with d the direction there, ρ⁻ the least that the distance may be, and w the other's velocity,

    d · v ≤ γ (ρ⁻ − D) + min(d · w, 0) + 0.8 max(d · w, 0),    never asking for a retreat faster than the speed limit.

Each is a half-space of velocities. The nearest point of all of them together is found by Hildreth's sweeps (Hildreth,
1957), one closed form after another: no solver is needed, and the same input gives the same output to the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from swarmtrack.formation.setpoint import Velocity

# 1/s: how fast the distance left may be used up. Of 0.5, 0.8 and 1.2 only the first kept 1.5 m from one that came at
# 1.5 m/s, 150 ms late, in 60 of 60 runs.
GAMMA = 0.5
# Of the other's speed away from us: as much is relied on.
TRUSTED_AWAY = 0.8
SWEEPS = 12
# m/s: so little a sweep changes when it has found the nearest point.
SETTLED = 1e-6


class HalfSpace(NamedTuple):
    """All v with normal · v ≤ bound [m/s]; normal: of length 1. track: whom it keeps clear of, None where nobody."""

    normal: Velocity
    bound: float
    track: int | None = None


def keep_clear(
    track: int, direction: Velocity, nearest: float, velocity: Velocity, *, clearance: float, fastest: float
) -> HalfSpace:
    """direction: of length 1, to the other; nearest [m]: the least that its distance may be; velocity [m/s]: its own.

    fastest [m/s]: so fast it is asked to retreat at most. A cap below the others' speed breaks it.
    """
    away = _dot(direction, velocity)
    bound = GAMMA * (nearest - clearance) + min(away, 0.0) + TRUSTED_AWAY * max(away, 0.0)
    return HalfSpace(direction, max(bound, -fastest), track)


def nearest_velocity(wanted: Velocity, spaces: Sequence[HalfSpace]) -> Velocity:
    """The velocity nearest to `wanted` within all half-spaces; a compromise where they have nothing in common."""
    north, east, down = wanted
    pushed = [0.0] * len(spaces)
    for _ in range(SWEEPS):
        most = 0.0
        for k, ((x, y, z), bound, _) in enumerate(spaces):
            step = max(x * north + y * east + z * down - bound, -pushed[k])
            if step:
                pushed[k] += step
                north, east, down = north - step * x, east - step * y, down - step * z
                most = max(most, abs(step))
        if most < SETTLED:
            break
    return north, east, down


def binding(velocity: Velocity, spaces: Sequence[HalfSpace]) -> tuple[int, ...]:
    """The tracks that a velocity would come too near to."""
    return tuple(
        space.track
        for space in spaces
        if space.track is not None and _dot(space.normal, velocity) > space.bound + SETTLED
    )


def fence(
    position: Velocity, engaged: Velocity, *, radius: float, lowest: float, highest: float, pull: float
) -> list[HalfSpace]:
    """Half-spaces that keep a drone within `radius` [m] of where it was engaged, level, and between two heights [m,
    down]. pull [m/s]: so fast it is brought back at most where it is beyond."""
    north, east = position[0] - engaged[0], position[1] - engaged[1]
    away = math.hypot(north, east)
    spaces = [
        HalfSpace((0.0, 0.0, 1.0), max(GAMMA * (lowest - position[2]), -pull)),
        HalfSpace((0.0, 0.0, -1.0), max(GAMMA * (position[2] - highest), -pull)),
    ]
    if away > 1e-3:
        outward = (north / away, east / away, 0.0)
        spaces.append(HalfSpace(outward, max(GAMMA * (radius - away), -pull)))
    return spaces


def _dot(a: Velocity, b: Velocity) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
