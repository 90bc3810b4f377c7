"""Relaxation for conflicting half-spaces: minimises the largest closing speed.

The half-spaces of the barrier then have an empty intersection, and Hildreth's sweeps end at a compromise without a
floor: it may fly into one of two drones. Here each half-space of a drone is relaxed by the same t [m/s], and the
answer is the velocity of the least t; of those the nearest to `goal`. The limits (fence, height, speed) are not
relaxed.

It is again a projection onto half-spaces, of (goal, -SQUEEZE_REACH_M_S) in the space of (v, t), and there they always
meet. The ball of speeds has a correction of its own, as in Boyle & Dykstra (1986).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from swarmtrack.formation.barrier import HalfSpace, excess
from swarmtrack.formation.law import dot, saturated
from swarmtrack.formation.margins import SQUEEZE_REACH_M_S, SQUEEZE_SWEEPS, SQUEEZE_TOLERANCE_M_S
from swarmtrack.formation.setpoint import STANDSTILL, Velocity


def least_closing(
    goal: Velocity, near: Sequence[HalfSpace], limits: Sequence[HalfSpace], fastest: float
) -> Velocity:
    """Velocity with the least largest `excess` over `near`, within `limits`, all of which contain zero, and no
    faster than `fastest` [m/s].
    """
    north, east, down = goal
    t = -SQUEEZE_REACH_M_S
    rows = [(*space.normal, space.bound) for space in near]
    # At most so fast no other limit is met.
    fixed = [(*space.normal, space.bound) for space in limits if space.bound < fastest]
    pushed, held = [0.0] * len(rows), [0.0] * len(fixed)
    back = STANDSTILL
    for _ in range(SQUEEZE_SWEEPS):
        most = 0.0
        # Spelled out as in `nearest_velocity`, and for the same reason.
        for k, (x, y, z, bound) in enumerate(rows):
            step = 0.5 * (x * north + y * east + z * down - t - bound)
            if step < -pushed[k]:  # noqa: PLR1730
                step = -pushed[k]
            if step:
                pushed[k] += step
                north, east, down, t = north - step * x, east - step * y, down - step * z, t + step
                if not abs(step) <= most:
                    most = abs(step)
        for k, (x, y, z, bound) in enumerate(fixed):
            step = max(x * north + y * east + z * down - bound, -held[k])
            held[k] += step
            north, east, down = north - step * x, east - step * y, down - step * z
        beyond = north + back[0], east + back[1], down + back[2]
        north, east, down = saturated(beyond, fastest)
        now = beyond[0] - north, beyond[1] - east, beyond[2] - down
        most = max(most, math.dist(now, back))
        back = now
        if most < SQUEEZE_TOLERANCE_M_S:
            break
    return north, east, down


def no_faster_than_asked(velocity: Velocity, asked: Sequence[HalfSpace]) -> Velocity:
    """The velocity, scaled down where it retreats faster than the half-spaces require. asked: by the barrier."""
    retreats = [(dot(space.normal, velocity), space.bound) for space in asked]
    share = max((min(bound / speed, 1.0) for speed, bound in retreats if speed < 0.0 > bound), default=0.0)
    return velocity[0] * share, velocity[1] * share, velocity[2] * share


def best_of(candidates: Sequence[Velocity], near: Sequence[HalfSpace]) -> Velocity:
    """The velocity with the least closing speed; of equal ones the first."""
    return min(candidates, key=lambda velocity: max(excess(velocity, near), 0.0))
