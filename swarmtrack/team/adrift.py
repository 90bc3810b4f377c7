"""Whether a drone has lost its place, by how well it says that it knows it.

An autopilot that reboots, or whose receiver sees no sky, goes on from where the drone was last. Until it knows a place
again its sigma grows. The place that it finds then may be as far from the true one: its frame is another, and stays so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from swarmtrack.messages import Array
from swarmtrack.team.priors import ADRIFT_M, DOUBTS_M


@dataclass(slots=True)
class Adrift:
    """Takes every sigma [m per axis] that a drone states. first: at first, of its start."""

    first: float
    stated: float = math.inf
    """m per axis, last."""
    lost: float = 0.0
    """m per axis: how uncertain its place has become; 0 while it has one."""
    found: bool = False
    """Whether it has a place again, in a frame that has not begun yet."""

    def is_at(self, sigma: float) -> bool:
        """Whether it has no place while it states this: who knows little of it, but no less than before, has one."""
        if sigma > DOUBTS_M:
            return False
        grows, self.stated = sigma > self.stated, sigma
        beside = math.sqrt(max(sigma**2 - self.first**2, 0.0))
        if grows and beside > ADRIFT_M:
            self.lost, self.found = max(self.lost, beside), False
            return True
        self.found = self.lost > 0.0
        return False

    def begin_frame(self) -> float:
        """From now on it has a place. Returns how uncertain that is, m per axis, its start included."""
        sigma = math.hypot(self.first, self.lost)
        self.first = max(self.first, self.stated)
        self.lost, self.found = 0.0, False
        return sigma


def sigma_per_axis(cov: Array) -> float:
    """m, of a covariance (3, 3) m²."""
    return math.sqrt(max(float(np.trace(cov)), 0.0) / 3.0)
