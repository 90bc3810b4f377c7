"""How far from the truth the places in metres are that a team states, and whether their covariances are honest.

Every stated place counts, also one whose name is wrong: it is compared with the drone whose name it bears.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from swarmtrack.messages import Array


class StatedPlace(NamedTuple):
    """Of one teammate: state (6,) m and m/s, its position and velocity less those of the own camera in team axes (NED),
    and its covariance (6, 6)."""

    drone_id: int
    state: Array
    cov: Array


@dataclass(frozen=True, slots=True)
class RelativeScore:
    """range_p50, range_p95: of the error of the range as a share of it; rmse_m of the position; nees6: the normalised
    estimation error squared over its six degrees of freedom, 1 where covariances are honest and less where they are too
    large (Bar-Shalom, Li & Kirubarajan 2001, section 5.4). NaN without samples."""

    samples: int
    rmse_m: float
    range_p50: float
    range_p95: float
    nees6_median: float
    nees6_mean: float


class RelativeScorer:
    """Takes stated places as they come."""

    def __init__(self) -> None:
        self._range_errors: list[float] = []
        self._squares: list[float] = []
        self._nees6: list[float] = []

    def add(self, stated: StatedPlace, truth: Array) -> None:
        """truth (6,): as in `StatedPlace`."""
        error = stated.state - truth
        far = float(np.linalg.norm(truth[:3]))
        self._range_errors.append(abs(float(np.linalg.norm(stated.state[:3])) / far - 1.0))
        self._squares.append(float(error[:3] @ error[:3]))
        self._nees6.append(float(error @ np.linalg.solve(stated.cov, error)) / 6.0)

    def score(self) -> RelativeScore:
        """Of everything so far."""
        if not self._nees6:
            return NO_PLACES
        p50, p95 = np.quantile(self._range_errors, [0.5, 0.95]).tolist()
        return RelativeScore(
            len(self._nees6),
            math.sqrt(float(np.mean(self._squares))),
            p50,
            p95,
            float(np.median(self._nees6)),
            float(np.mean(self._nees6)),
        )


NO_PLACES = RelativeScore(0, math.nan, math.nan, math.nan, math.nan, math.nan)
