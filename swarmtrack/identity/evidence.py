"""Residuals between tracks and predicted drones, averaged over a short window.

Most of what is wrong with a reprojection (the announced position, the autopilot's drift, the camera's mounting) stays
the same from scan to scan, so a second look adds little: the mean residual is kept, and its covariance is that of a
single one. What the window removes is the jitter, and scans in which two drones hide each other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from swarmtrack.identity.posterior import ReprojectionResiduals

Key = tuple[object, ...]


class Evidence:
    """Grows scan by scan; pairs that are not seen in a scan are forgotten."""

    def __init__(self, window_s: float) -> None:
        self._window_s = window_s
        self._t = 0.0
        self.forget()

    def forget(self) -> None:
        """In a scan without any track to weigh."""
        self._rows: list[int] = []
        self._columns: list[Key] = []
        self.residuals = ReprojectionResiduals(
            np.zeros((0, 0, 2)), np.zeros((1, 0, 0, 2, 2)), np.zeros((1, 0))
        )
        self.scans: NDArray[np.int64] = np.zeros((0, 0), dtype=int)
        """(n, k): how many scans each pair was seen in."""
        self._looks: NDArray[np.int64] = np.zeros(0, dtype=int)

    def seen_in(self, row: int) -> int:
        """How many scans there are of a row, with whichever column."""
        return int(self._looks[row])

    def add(
        self, t: float, rows: Sequence[int], columns: Sequence[Key], found: ReprojectionResiduals
    ) -> None:
        """The residuals of one scan: rows are track IDs, columns the keys of predictions."""
        mean, cov = found.mean.copy(), found.cov.copy()
        scans = np.ones(mean.shape[:2], dtype=int)
        looks = np.ones(len(rows), dtype=int)
        i, was_i = _matched(rows, self._rows)
        looks[i] += self._looks[was_i]
        j, was_j = _matched(columns, self._columns)
        if i.size and j.size and len(cov) == len(self.residuals.cov):
            i, was_i = i[:, None], was_i[:, None]
            scans[i, j] += self.scans[was_i, was_j]
            # A plain mean at first, exponential once the window is full.
            new = np.maximum(1.0 / scans[i, j], 1.0 - math.exp(-(t - self._t) / self._window_s))[..., None]
            mean[i, j] += (1.0 - new) * (self.residuals.mean[was_i, was_j] - mean[i, j])
            cov[:, i, j] += (1.0 - new[..., None]) * (self.residuals.cov[:, was_i, was_j] - cov[:, i, j])
        self._t, self._rows, self._columns, self.scans = t, list(rows), list(columns), scans
        self._looks = looks
        self.residuals = ReprojectionResiduals(mean, cov, found.share)


def _matched(now: Sequence[object], before: Sequence[object]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Where those that are in both sequences stand in each."""
    place = {key: index for index, key in enumerate(before)}
    pairs = [(index, place[key]) for index, key in enumerate(now) if key in place]
    both = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    return both[:, 0], both[:, 1]
