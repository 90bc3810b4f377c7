"""Whether a drone has lost its place, by how well it says that it knows it.

An autopilot that reboots, or whose receiver sees no sky, goes on from where the drone was last. Until it knows a place
again its sigma grows. The place that it finds then may be as far from the true one: its frame is another, and stays so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from swarmtrack.messages import Array
from swarmtrack.team.priors import ADRIFT_LEAST_S, ADRIFT_M, DOUBTS_M


@dataclass(slots=True)
class Adrift:
    """Takes every sigma [m per axis] that a drone states. first: at first, of its start."""

    first: float
    stated: float = math.inf
    """m per axis, last; and when, s."""
    stated_t: float = -math.inf
    lost_t: float = math.inf
    """When its place was lost, s."""
    lost: float = 0.0
    """m per axis: how uncertain its place has become; 0 while it has one."""
    found: bool = False
    """Whether it has a place again, in a frame that has not begun yet."""

    def is_at(self, t: float, sigma: float) -> bool:
        """Whether it has no place at t [s], where it states this. A sigma that is large, and does not grow, is one of a
        place. What is said of an earlier time changes nothing."""
        if sigma > DOUBTS_M:
            return False
        if t <= self.stated_t:
            return self.lost > 0.0
        grows, self.stated, self.stated_t = sigma > self.stated, sigma, t
        beside = math.sqrt(max(sigma**2 - self.first**2, 0.0))
        if grows and beside > ADRIFT_M:
            self.lose(t, beside)
            return True
        self.found = t - self.lost_t >= ADRIFT_LEAST_S
        return self.lost > 0.0 and not self.found

    def lose(self, t: float, sigma: float) -> None:
        """From t on its place is as uncertain as sigma [m per axis], at least."""
        self.lost_t = min(self.lost_t, t)
        self.lost, self.found = max(self.lost, sigma), False

    def begin_frame(self) -> float:
        """From now on it has a place. Returns how uncertain that is, m per axis, its start included."""
        sigma = math.hypot(self.first, self.lost)
        self.first = max(self.first, self.stated)
        self.lost_t, self.lost, self.found = math.inf, 0.0, False
        return sigma


def sigma_per_axis(cov: Array) -> float:
    """m, of a covariance (3, 3) m²."""
    return math.sqrt(max(float(np.trace(cov)), 0.0) / 3.0)
