"""A Kalman filter for each target, and the single most likely one-to-one association (the paper's baseline, soundly).

A scan is explained in one piece: each track takes the detection, or none, that makes the whole scan most likely.
What no track explains starts a tentative one; a track lives by its probability of existence (see lifecycle.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.tracking import lifecycle
from swarmtrack.tracking.association import most_likely_matching
from swarmtrack.tracking.base import Explained
from swarmtrack.tracking.consistency import sure_pairs
from swarmtrack.tracking.gaussian import update
from swarmtrack.tracking.gaussian_tracks import GaussianTracks
from swarmtrack.tracking.noise import Rows, pairs_of
from swarmtrack.tracking.parameters import CommonParameters
from swarmtrack.tracking.sensor_model import Measurements


@dataclass(frozen=True, slots=True, kw_only=True)
class KalmanParameters(CommonParameters):
    """The common parameters only."""


class Kalman(GaussianTracks):
    """Maximum-likelihood association, gated, one-to-one; Kalman updates in Joseph form."""

    Parameters: ClassVar[type[CommonParameters]] = KalmanParameters

    def update(self, t: float, measured: Measurements) -> Explained:
        # Before the association: after a long silence a track could take whatever comes next, and its name with it.
        self._population.drop(t)
        taken, explained = self._associate(t, measured)
        self._population.drop(t)
        if not taken.all():
            self._population.give_birth(t, measured.select(~taken))
        return explained

    def _associate(self, t: float, measured: Measurements) -> tuple[NDArray[np.bool_], Explained]:
        """Give each track its detection or none, and update; returns which detections (m,) were taken or shadowed."""
        table, z, R = self.table, measured.z, measured.R
        visibility = self._sensor.visibility(table.mean, table.cov, table.size, table.existence)
        p_detection = visibility.p_detection
        boxes = self._sensor.box_likelihoods(table.size, measured)
        log_ratio = self._sensor.likelihoods(table.mean, table.cov, boxes, measured).log_ratio
        sure = sure_pairs(log_ratio, table.existence)
        pairs = pairs_of(table.id, (table.mean, table.cov), (measured.z, measured.R), sure)
        with np.errstate(divide="ignore"):
            odds_of_detection = np.log(p_detection / (1.0 - p_detection))
        rows, columns = self._match(log_ratio + odds_of_detection[:, None], sure)

        likelihood = 1.0 - p_detection
        likelihood[rows] += p_detection[rows] * np.exp(log_ratio[rows, columns])
        table.existence = lifecycle.reweigh(table.existence, likelihood)
        table.mean[rows], table.cov[rows] = update(
            table.mean.take(rows, axis=0), table.cov.take(rows, axis=0), z[columns], R[columns]
        )
        self._population.learn_looks(t, rows, measured.select(columns))
        seen, taken = np.zeros(len(table), np.bool_), np.zeros(len(z), np.bool_)
        seen[rows], taken[columns] = True, True
        self._population.update_status(t, seen, visibility)
        clutter = len(z) - float(table.existence[rows].sum())
        if not taken.all():
            taken |= self._population.shadowed(t, measured, seen)
        return taken, Explained(pairs, clutter)

    def _match(self, log_ratio: Array, alone: Rows) -> Rows:
        """Confirmed tracks choose first, weighed by their existence; tentative ones share what is left. alone: rows and
        columns that are alone in each other's gates, before the choice."""
        confirmed = self.table.confirmed
        n, m = log_ratio.shape
        if len(alone[0]) == n == m and confirmed.all():
            # Each can only take its own.
            gain = log_ratio[alone] + np.log(self.table.existence)
            if gain.min(initial=1.0) > 0.0:
                return alone
        sure, free = np.flatnonzero(confirmed), np.flatnonzero(~confirmed)
        rows, columns = most_likely_matching(log_ratio[sure] + np.log(self.table.existence[sure])[:, None])
        if not len(free):
            return sure[rows], columns
        unclaimed = np.ones(log_ratio.shape[1], np.bool_)
        unclaimed[columns] = False
        left = np.flatnonzero(unclaimed)
        more_rows, more_columns = most_likely_matching(log_ratio[np.ix_(free, left)])
        return np.concatenate([sure[rows], free[more_rows]]), np.concatenate([columns, left[more_columns]])
