"""Is what was said to be so with probability p so a share p of the time?"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.lab.score.intervals import Interval, fraction_interval
from swarmtrack.messages import Array

EDGES = (0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.998, 0.999, 0.9995, 0.9999, 1.0)
RELIABILITY_THRESHOLDS = (0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.999)


@dataclass(frozen=True, slots=True, eq=False)
class Stated:
    """Statements, each with its probability. All (n,): p; right, whether it was so; group, the independent run that
    it was made in, by any number."""

    p: Array
    right: NDArray[np.bool_]
    group: NDArray[np.int64]

    @classmethod
    def joined(cls, parts: Iterable[Stated]) -> Stated:
        """All statements; groups of different parts are different, whatever their numbers."""
        p, right, group, before = [np.empty(0)], [np.empty(0, bool)], [np.empty(0, np.int64)], 0
        for part in parts:
            numbers, renumbered = np.unique(part.group, return_inverse=True)
            p.append(part.p)
            right.append(part.right)
            group.append(before + renumbered)
            before += len(numbers)
        return cls(np.concatenate(p), np.concatenate(right), np.concatenate(group))

    def where(self, chosen: NDArray[np.bool_]) -> Stated:
        """Some of the statements."""
        return Stated(self.p[chosen], self.right[chosen], self.group[chosen])


class ReliabilityBin(NamedTuple):
    """Statements of low ≤ p < high: how many, their mean p, and the share of them that is right."""

    low: float
    high: float
    statements: int
    stated: float
    right: Interval


class Reliability(NamedTuple):
    """All statements; those of each bin of p; and those at or above each threshold. expected_error: the mean over all
    statements of how far stated and right are apart in their bin (Naeini et al., AAAI 2015)."""

    overall: ReliabilityBin
    expected_error: float
    bins: list[ReliabilityBin]
    thresholds: list[ReliabilityBin]


def reliability_of(stated: Stated) -> Reliability:
    """Of statements with p ≥ 0.5; intervals over groups."""
    bins = [_between(stated, low, high) for low, high in pairwise(EDGES)]
    filled = [found for found in bins if found.statements]
    gaps = [found.statements * abs(found.stated - found.right.value) for found in filled]
    overall = _between(stated, EDGES[0], 1.0)
    return Reliability(
        overall,
        sum(gaps) / max(overall.statements, 1),
        filled,
        [_between(stated, threshold, 1.0) for threshold in RELIABILITY_THRESHOLDS],
    )


def _between(stated: Stated, low: float, high: float) -> ReliabilityBin:
    chosen = stated.where((stated.p >= low) & ((stated.p < high) | (high == 1.0)))
    _, group = np.unique(chosen.group, return_inverse=True)
    trials: Array = np.bincount(group).astype(np.float64)
    hits: Array = np.bincount(group, weights=chosen.right).astype(np.float64)
    mean = float(chosen.p.mean()) if len(chosen.p) else float("nan")
    return ReliabilityBin(low, high, len(chosen.p), mean, fraction_interval(hits, trials))
