"""How far from the truth the places in metres are that a team states, and whether their covariances are honest.

Every stated place counts, also one whose name is wrong: it is compared with the drone whose name it bears.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
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


class PlaceError(NamedTuple):
    """Of one stated place: range as a share of it, squared distance of the position [m²], and NEES of all six."""

    range: float
    squared: float
    nees: float


def error_of(state: Array, cov: Array, truth: Array) -> PlaceError:
    """state, truth (6,) and cov (6, 6): as in `StatedPlace`."""
    error = state - truth
    far = float(np.linalg.norm(truth[:3]))
    return PlaceError(
        abs(float(np.linalg.norm(state[:3])) / far - 1.0),
        float(error[:3] @ error[:3]),
        float(error @ np.linalg.solve(cov, error)),
    )


def relative_score(errors: Sequence[PlaceError]) -> RelativeScore:
    """Of all places that were stated."""
    if not errors:
        return NO_PLACES
    ranges, squares, nees = np.array(errors).T
    p50, p95 = np.quantile(ranges, [0.5, 0.95]).tolist()
    nees6 = nees / 6.0
    return RelativeScore(
        len(errors), math.sqrt(float(squares.mean())), p50, p95, float(np.median(nees6)), float(nees6.mean())
    )


NO_PLACES = RelativeScore(0, math.nan, math.nan, math.nan, math.nan, math.nan)
