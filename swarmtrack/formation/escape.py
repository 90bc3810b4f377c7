"""Height as a way out: only where somebody is about to collide, and not into the heights of other drones' slots.

Who flies beside this drone is out of its sight, and heights are all that keeps the two apart. So up and down a drone
gives way last: when less than `SOON_S` is left. Then it climbs or sinks past whoever comes, by `MOST_M` at most, and
stays half a metre off every other slot's height of the plan.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from swarmtrack.formation.barrier import COMES_M_S
from swarmtrack.formation.obstacles import Obstacle
from swarmtrack.formation.setpoint import Velocity

# s until a collision.
SOON_S = 1.0
# m: so near two drones touch, with what a camera does not know of a distance; and who passes farther off than this does
# not collide.
CONTACT_M, MISSES_M = 1.0, 1.5
# m: of its own slot's height it leaves so much, and to other slots' heights it keeps so far.
MOST_M, APART_M = 1.5, 0.5
# m: somebody this much higher or lower is given way to on the other side; else the side with more room counts.
LEVEL_M = 0.3
# m off its slot's height: whoever has begun to give way goes on.
BEGUN_M = 0.05


class FreeHeights(NamedTuple):
    """Heights [m, down] between which a drone may give way, and that of its slot."""

    highest: float
    lowest: float
    slot: float


def room(own: float, others: Iterable[float]) -> FreeHeights:
    """Around the own slot's height; others: of the other slots; all m, down. Whose slot is as high as the own one, or
    nearer than `APART_M`, leaves none on its side."""
    highest, lowest = own - MOST_M, own + MOST_M
    for other in others:
        if other >= own:
            lowest = min(lowest, max(other - APART_M, own))
        if other <= own:
            highest = max(highest, min(other + APART_M, own))
    return FreeHeights(highest, lowest, own)


def who_collides(near: Sequence[Obstacle], flies: Velocity) -> Obstacle | None:
    """Who, as it flies, is within `CONTACT_M` in less than `SOON_S`; of several the first to be. flies [m/s]: this
    drone, as it is told to."""
    soonest, first = SOON_S, None
    for other in near:
        motion = [theirs - ours for theirs, ours in zip(other.velocity, flies, strict=True)]
        speed, distance = math.hypot(*motion), math.hypot(*other.place)
        if speed < COMES_M_S or distance <= 0.0:
            continue
        ahead = -sum(p * v for p, v in zip(other.place, motion, strict=True)) / speed
        miss = math.sqrt(max(distance * distance - ahead * ahead, 0.0))
        left = (ahead - CONTACT_M) / speed
        if ahead > 0.0 and miss < MISSES_M and left < soonest:
            soonest, first = left, other
    return first


def way_out(other: Obstacle, down: float, free: FreeHeights, climb: float) -> Velocity:
    """m/s, up or down as fast as it may climb: past somebody, from a height [m, down]."""
    offset, begun = other.place[2], down - free.slot
    if abs(offset) >= LEVEL_M:
        sinks = offset < 0.0
    elif abs(begun) >= BEGUN_M:
        sinks = begun > 0.0
    else:
        sinks = free.lowest - free.slot >= free.slot - free.highest
    left = free.lowest - down if sinks else down - free.highest
    return (0.0, 0.0, climb if sinks else -climb) if left > 0.0 else (0.0, 0.0, 0.0)
