"""The code of a drone: how it sways up and down so that its teammates know who it is, with nothing on the air.

Theory of operation. Each of a team of n has a frequency of its own, spread evenly from `SWAY_SLOWEST_HZ` to
`SWAY_FASTEST_HZ` in the order of their IDs. At a time that all know beforehand every drone sways by `SWAY_AMPLITUDE_M`
about its own height, for `SWAY_LASTS_S`. Vertical, because gravity is the one direction that all share and a height is
held best; a sine, because it stays a sine when a clock is off; upwards first, away from the ground. In a large team
neighbours in frequency would look alike for seconds, so every second one goes down first. It begins and ends without a
jump of the jerk.
"""

from __future__ import annotations

import math
from collections.abc import Collection

import numpy as np

from swarmtrack.messages import Array
from swarmtrack.motion.priors import (
    SWAY_AMPLITUDE_M,
    SWAY_BEGINS_EVERY_S,
    SWAY_EASE_S,
    SWAY_FASTEST_HZ,
    SWAY_LARGE_TEAM,
    SWAY_LASTS_S,
    SWAY_SLOWEST_HZ,
    SWAY_SWITCH_DELAY_S,
)
from swarmtrack.motion.smooth import DERIVATIVES, scaled, sinusoid, smooth_step


def next_begin(utc: float) -> float:
    """When a sway begins that was asked for at `utc` [s]: at the next full 10 s, by UTC."""
    return math.ceil(utc / SWAY_BEGINS_EVERY_S) * SWAY_BEGINS_EVERY_S


def possible_begins(utc: float) -> list[float]:
    """When others may begin to sway who saw the same switch thrown, give or take `SWAY_SWITCH_DELAY_S`."""
    return sorted({next_begin(utc - SWAY_SWITCH_DELAY_S), next_begin(utc + SWAY_SWITCH_DELAY_S)})


def frequency(drone_id: int, team: Collection[int]) -> float:
    """Hz. team: the IDs of all drones, including this one. Raises ValueError where it is not."""
    place = sorted(team).index(drone_id)
    return SWAY_SLOWEST_HZ + (SWAY_FASTEST_HZ - SWAY_SLOWEST_HZ) * place / max(len(team) - 1, 1)


def direction(drone_id: int, team: Collection[int]) -> float:
    """1.0: upwards first; -1.0: downwards, as every second drone of a large team."""
    return -1.0 if len(team) >= SWAY_LARGE_TEAM and sorted(team).index(drone_id) % 2 else 1.0


def sway(drone_id: int, team: Collection[int], t: float) -> Array:
    """Displacement from its own place t [s] after the beginning, and three derivatives: (4, 3) m, m/s, …, NED.

    Zero before the beginning and after the end. Raises ValueError where the drone is not of the team.
    """
    omega = 2.0 * math.pi * frequency(drone_id, team)
    if not 0.0 < t < SWAY_LASTS_S:
        return np.zeros((DERIVATIVES, 3))
    up = np.array([0.0, 0.0, -SWAY_AMPLITUDE_M * direction(drone_id, team)])
    rising = smooth_step(t / SWAY_EASE_S)
    falling = smooth_step((SWAY_LASTS_S - t) / SWAY_EASE_S) * (-1.0) ** np.arange(DERIVATIVES)
    # At most one of the two changes at a time.
    ease = (rising if t < 0.5 * SWAY_LASTS_S else falling) / SWAY_EASE_S ** np.arange(DERIVATIVES)
    return scaled(ease, sinusoid(up, np.full(3, omega), np.full(3, omega * t)))
