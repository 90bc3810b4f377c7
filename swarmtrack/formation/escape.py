"""Vertical evasion: only for an imminent collision, and not into the heights of other drones' slots.

A drone to the side is out of sight, and only heights separate the two. So vertical evasion comes last: when less than
`COLLISION_WITHIN_S` is left. Then the drone climbs or sinks past the other, by `ESCAPE_MOST_M` at most, and stays half
a metre off every other slot's height of the plan.
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
    """Heights [m, down] between which a drone may evade, and that of its slot."""

    highest: float
    lowest: float
    slot: float


def room(own: float, others: Iterable[float]) -> FreeHeights:
    """Free heights around the own slot's; others: of the other slots; all m, down. A slot at the same height, or
    nearer than `ESCAPE_APART_M`, leaves none on its side.
    """
    highest, lowest = own - ESCAPE_MOST_M, own + ESCAPE_MOST_M
    for other in others:
        if other >= own:
            lowest = min(lowest, max(other - ESCAPE_APART_M, own))
        if other <= own:
            highest = max(highest, min(other + ESCAPE_APART_M, own))
    return FreeHeights(highest, lowest, own)


def who_collides(near: Sequence[Obstacle], flies: Velocity) -> Obstacle | None:
    """The track that will be within `COLLISION_CONTACT_M` in less than `COLLISION_WITHIN_S`; of several the first.
    flies [m/s]: this drone's command.
    """
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
    """Vertical velocity [m/s] past another drone, as fast as the limit allows, from a height [m, down]."""
    offset, begun = other.place[2], down - free.slot
    if abs(offset) >= ESCAPE_LEVEL_M:
        sinks = offset < 0.0
    elif abs(begun) >= ESCAPE_BEGUN_M:
        sinks = begun > 0.0
    else:
        sinks = free.lowest - free.slot >= free.slot - free.highest
    left = free.lowest - down if sinks else down - free.highest
    return (0.0, 0.0, climb if sinks else -climb) if left > 0.0 else (0.0, 0.0, 0.0)
