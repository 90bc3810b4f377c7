"""Which detection belongs to which track: gates and one-to-one assignment."""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import linear_sum_assignment

from swarmtrack.messages import Array


def gate_threshold(probability: float) -> float:
    """The χ² quantile with two degrees of freedom: squared distance that a true detection stays below."""
    return -2.0 * math.log1p(-probability)


def most_likely_matching(log_ratio: Array) -> tuple[Array, Array]:
    """The one-to-one matching with the largest sum of log_ratio (n, m); pairs that do not gain are left out.

    log_ratio is the log-likelihood of "i made j" over "i made nothing and j is something else"; −inf forbids a pair.
    Returns (rows, columns).
    """
    cost = np.where(log_ratio > 0.0, -log_ratio, 0.0)  # no infinities: the solver would give up on them
    rows, columns = linear_sum_assignment(cost)
    gains = cost[rows, columns] < 0.0
    return rows[gains], columns[gains]
