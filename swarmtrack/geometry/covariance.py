"""One number for a covariance, where one must do."""

from __future__ import annotations

import math

from swarmtrack.messages import Array


def worst_sigma(cov: Array) -> float:
    """Standard deviation of the worst axis of a covariance (n, n), in the unit of its axes."""
    return math.sqrt(float(cov.diagonal().max()))
