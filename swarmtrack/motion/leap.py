"""Whether the own place has leapt, as a receiver's does that loses its satellites and finds them again."""

from __future__ import annotations

import math

from swarmtrack.messages import Array

# m/s, and m: a place that moves farther from one look to the next has leapt; where the velocity is known, one that is
# farther from where that leads.
FASTEST_M_S, LEAPT_M = 8.0, 0.5


def has_leapt(before: Array, after: Array, dt: float) -> bool:
    """Places (3,) m that are dt [s] apart, in whichever order."""
    return math.dist(before, after) > FASTEST_M_S * abs(dt) + LEAPT_M
