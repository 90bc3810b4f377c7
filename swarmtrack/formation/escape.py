"""Height as a way out: only where somebody is about to collide, and not into the heights of other drones' slots.

Who flies beside this drone is out of its sight, and heights are all that keeps the two apart. So up and down a drone
gives way last: when less than `COLLISION_WITHIN_S` is left. Then it climbs or sinks past whoever comes, by
`ESCAPE_MOST_M` at most, and stays half a metre off every other slot's height of the plan.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from swarmtrack.formation.margins import (
    COLLISION_CONTACT_M,
    COLLISION_MISSES_M,
    COLLISION_WITHIN_S,
    COMING_SPEED_M_S,
    ESCAPE_APART_M,
    ESCAPE_BEGUN_M,
    ESCAPE_LEVEL_M,
    ESCAPE_MOST_M,
)
from swarmtrack.formation.obstacles import Obstacle
from swarmtrack.formation.setpoint import Velocity


class FreeHeights(NamedTuple):
    """Heights [m, down] between which a drone may give way, and that of its slot."""

    highest: float
    lowest: float
    slot: float


def room(own: float, others: Iterable[float]) -> FreeHeights:
    """Around the own slot's height; others: of the other slots; all m, down. Whose slot is as high as the own one, or
    nearer than `ESCAPE_APART_M`, leaves none on its side."""
    highest, lowest = own - ESCAPE_MOST_M, own + ESCAPE_MOST_M
    for other in others:
        if other >= own:
            lowest = min(lowest, max(other - ESCAPE_APART_M, own))
        if other <= own:
            highest = max(highest, min(other + ESCAPE_APART_M, own))
    return FreeHeights(highest, lowest, own)


def who_collides(near: Sequence[Obstacle], flies: Velocity) -> Obstacle | None:
    """Who, as it flies, is within `COLLISION_CONTACT_M` in less than `COLLISION_WITHIN_S`; of several the first to be.
    flies [m/s]: this drone, as it is told to."""
    soonest, first = COLLISION_WITHIN_S, None
    for other in near:
        motion = [theirs - ours for theirs, ours in zip(other.velocity, flies, strict=True)]
        speed, distance = math.hypot(*motion), math.hypot(*other.place)
        if speed < COMING_SPEED_M_S or distance <= 0.0:
            continue
        ahead = -sum(p * v for p, v in zip(other.place, motion, strict=True)) / speed
        miss = math.sqrt(max(distance * distance - ahead * ahead, 0.0))
        left = (ahead - COLLISION_CONTACT_M) / speed
        if ahead > 0.0 and miss < COLLISION_MISSES_M and left < soonest:
            soonest, first = left, other
    return first


def way_out(other: Obstacle, down: float, free: FreeHeights, climb: float) -> Velocity:
    """m/s, up or down as fast as it may climb: past somebody, from a height [m, down]."""
    offset, begun = other.place[2], down - free.slot
    if abs(offset) >= ESCAPE_LEVEL_M:
        sinks = offset < 0.0
    elif abs(begun) >= ESCAPE_BEGUN_M:
        sinks = begun > 0.0
    else:
        sinks = free.lowest - free.slot >= free.slot - free.highest
    left = free.lowest - down if sinks else down - free.highest
    return (0.0, 0.0, climb if sinks else -climb) if left > 0.0 else (0.0, 0.0, 0.0)
