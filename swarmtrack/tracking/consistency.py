"""Consistency of the filter: normalised innovations squared of the last detections, with their band.

What the filter expects of a detection of its target is N(H x, S); then νᵀ S⁻¹ ν has the χ² distribution with two
degrees of freedom, cut off at the gate, and the mean of n of them lies in a band about its expectation. Above the band
the filter is too sure of itself (R or the motion model too small, a camera's clock that is off), below it too careful.
Bar-Shalom, Li & Kirubarajan (2001), section 5.4.2.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.tracking.priors import (
    LONE_DETECTION_EXISTENCE,
    NIS_LEAST_DETECTIONS,
    NIS_WINDOW_DETECTIONS,
    NORMAL_QUANTILE_995,
)


class Consistency(NamedTuple):
    """nis: mean over the window, 2 less what the gate cuts off if the filter is right; low, high: where it then lies
    with 99 %."""

    nis: float
    low: float
    high: float


def sure_pairs(log_ratio: Array, existence: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows (k,) and columns (k,) of the n tracks and m detections that are alone in each other's gates.

    log_ratio (n, m), −inf beyond the gate; existence (n,) before the scan. Only what was known before the scan picks
    them: a choice by how well they fit would make every filter look better than it is.
    """
    gated = log_ratio > -np.inf
    alone = gated & (gated.sum(axis=1, keepdims=True) == 1) & (gated.sum(axis=0) == 1)
    rows, columns = np.nonzero(alone & (existence > LONE_DETECTION_EXISTENCE)[:, None])
    return rows, columns


class InnovationWindow:
    """The last `NIS_WINDOW_DETECTIONS` normalised innovations squared, of detections that passed a gate of this
    probability."""

    def __init__(self, gate_probability: float = 1.0) -> None:
        self._nis: deque[float] = deque(maxlen=NIS_WINDOW_DETECTIONS)
        self._mean, self._variance = _moments_within(gate_probability)

    def add(self, nis: list[float]) -> None:
        self._nis.extend(nis)

    def consistency(self) -> Consistency | None:
        """None until there are enough to tell."""
        n = len(self._nis)
        if n < NIS_LEAST_DETECTIONS:
            return None
        # The sum's distribution is nearly that multiple of a χ² which has its mean and variance.
        scale, degrees = self._variance / (2.0 * self._mean), 2.0 * n * self._mean**2 / self._variance
        low, high = (scale * _chi2_quantile(sign * NORMAL_QUANTILE_995, degrees) / n for sign in (-1.0, 1.0))
        return Consistency(math.fsum(self._nis) / n, low, high)


def _moments_within(probability: float) -> tuple[float, float]:
    """Mean and variance of χ² with two degrees of freedom, given that it lies below this quantile."""
    beyond = 1.0 - probability
    if beyond <= 0.0:
        return 2.0, 4.0
    gate = -2.0 * math.log(beyond)
    mean = 2.0 - gate * beyond / probability
    square = (8.0 - (gate**2 + 4.0 * gate + 8.0) * beyond) / probability
    return mean, square - mean**2


def _chi2_quantile(standard_score: float, degrees: float) -> float:
    """Wilson & Hilferty (1931): to a few parts in ten thousand from thirty degrees of freedom on."""
    spread = 2.0 / (9.0 * degrees)
    return degrees * (1.0 - spread + standard_score * math.sqrt(spread)) ** 3
