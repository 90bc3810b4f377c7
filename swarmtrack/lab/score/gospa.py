"""Distances between two sets of points: errors of place and of number in one figure.

Both take truth (n, d) and estimate (m, d) in any one unit, a cut-off c in that unit and an order p ≥ 1. Neither
knows identities: two tracks that swap cost nothing here.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from swarmtrack.messages import Array


class Gospa(NamedTuple):
    """`distance` in the unit of the points; the other three, to the power p, add up to distance**p."""

    distance: float
    localisation: float
    missed: float
    false: float


def gospa(truth: Array, estimate: Array, c: float = 20.0, p: float = 2.0) -> Gospa:
    """Generalised OSPA with α = 2: each missed and each false target costs cᵖ / 2.

    Rahmathullah, García-Fernández & Svensson, "Generalized optimal sub-pattern assignment metric" (2017),
    proposition 1.
    """
    distance = _cut_distances(truth, estimate, c)
    rows, columns = linear_sum_assignment(distance**p)
    paired = distance[rows, columns]
    paired = paired[paired < c]  # at c a pair costs as much as one missed and one false target: it is no pair
    localisation = float((paired**p).sum())
    missed = 0.5 * c**p * (distance.shape[0] - len(paired))
    false = 0.5 * c**p * (distance.shape[1] - len(paired))
    return Gospa((localisation + missed + false) ** (1.0 / p), localisation, missed, false)


def ospa(truth: Array, estimate: Array, c: float = 20.0, p: float = 2.0) -> float:
    """Optimal sub-pattern assignment: the mean over the larger set, c where the smaller one has nothing.

    Schuhmacher, Vo & Vo, "A consistent metric for performance evaluation of multi-object filters" (2008).
    """
    distance = _cut_distances(truth, estimate, c)
    larger, smaller = max(distance.shape), min(distance.shape)
    if larger == 0:
        return 0.0
    rows, columns = linear_sum_assignment(distance**p)
    total = float((distance[rows, columns] ** p).sum()) + c**p * (larger - smaller)
    return float((total / larger) ** (1.0 / p))


def _cut_distances(truth: Array, estimate: Array, c: float) -> Array:
    """(n, m) Euclidean distances, at most c."""
    if not c > 0.0:
        raise ValueError(f"gospa.c: found {c!r}, expected a distance above 0")
    difference = truth[:, None] - estimate[None]
    return np.asarray(np.minimum(np.sqrt((difference**2).sum(axis=2)), c))
