"""Detection of jumps of the own position, as when a receiver loses its satellites and finds them again."""

from __future__ import annotations

import math

from swarmtrack.messages import Array
from swarmtrack.motion.priors import LEAP_DISTANCE_M, LEAP_SPEED_M_S


def has_leapt(before: Array, after: Array, dt: float) -> bool:
    """Places (3,) m that are dt [s] apart, in whichever order."""
    return math.dist(before, after) > LEAP_SPEED_M_S * abs(dt) + LEAP_DISTANCE_M
