"""Fixed-lag smoother behind any filter: past states given the scans that came later.

Theory of operation. At each scan the estimates are noted twice, as predicted and as updated, with the Jacobian F of
the motion from the scan before, the camera's turn included. To look back is the backward pass of Rauch, Tung & Striebel
(AIAA Journal 3(8), 1965) over what is noted, linearised where the filter was. Tracks are followed by their ids, so the
filter behind need not know of it. Of one that keeps several hypotheses, what it published is smoothed: a name that it
corrects later is not corrected in the past.
"""

from __future__ import annotations

from collections import deque
from dataclasses import fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array, Track
from swarmtrack.tracking.motion_model import Turn
from swarmtrack.tracking.priors import SMOOTHER_LEAST_COV, SMOOTHER_MOST_SCANS, SMOOTHER_SAME_INSTANT_S
from swarmtrack.tracking.table import TrackTable


class PredictedTracks(NamedTuple):
    """Prediction of tracks id (n,) for a scan. mean (n, 4), cov (n, 4, 4); F (n, 4, 4): transition from the scan
    before.
    """

    id: NDArray[np.int64]
    mean: Array
    cov: Array
    F: Array

    def select(self, rows: NDArray[np.intp]) -> PredictedTracks:
        return PredictedTracks(self.id[rows], self.mean[rows], self.cov[rows], self.F[rows])


class Note(NamedTuple):
    """One scan: what was expected of it, and the tracks after it."""

    t: float
    expected: PredictedTracks
    table: TrackTable


class FixedLag:
    """The last scans of a filter, as many as the lag needs: none if it is 0."""

    def __init__(self, lag_s: float, camera: PinholeCamera, turn: Turn) -> None:
        self._lag_s = lag_s
        self._camera = camera
        self._turn = turn
        self._notes: deque[Note] = deque(maxlen=SMOOTHER_MOST_SCANS)
        self._id = np.empty(0, np.int64)
        self._F = np.empty((0, 4, 4))
        self._expected = PredictedTracks(self._id, np.empty((0, 4)), self._F, self._F)

    def move(self, table: TrackTable, dt: float, rotation: Array | None) -> None:
        """The tracks, as in the table, are about to move by dt [s] and the camera's turn."""
        if not self._lag_s:
            return
        F = transition(table.mean, dt, rotation, self._camera, self._turn)
        new, old = _common(table.id, self._id)
        F[new] = F[new] @ self._F[old]
        self._id, self._F = table.id.copy(), F

    def expect(self, table: TrackTable) -> None:
        """This is what is known before a scan is folded in."""
        if self._lag_s:
            rows, moved = _common(table.id, self._id)
            self._expected = PredictedTracks(
                table.id[rows], table.mean[rows], table.cov[rows], self._F[moved]
            )

    def note(self, t: float, table: TrackTable) -> None:
        """These are the tracks at t, after a scan was folded in."""
        if not self._lag_s:
            return
        self._notes.append(Note(t, self._expected, _copy(table)))
        while len(self._notes) > 1 and self._notes[1].t <= t - self._lag_s + SMOOTHER_SAME_INSTANT_S:
            self._notes.popleft()
        self._id, self._F = table.id.copy(), np.tile(np.eye(4), (len(table), 1, 1))

    def smoothed(self) -> tuple[Track, ...]:
        """The tracks at the newest scan that is at least the lag older than the last; none before there is one.

        A track that ended meanwhile is among them; one that was confirmed meanwhile counts as confirmed.
        """
        notes = list(self._notes)
        full = len(notes) == SMOOTHER_MOST_SCANS
        if not notes or (notes[0].t > notes[-1].t - self._lag_s + SMOOTHER_SAME_INSTANT_S and not full):
            return ()
        later = notes[-1].table
        for note, following in zip(notes[-2::-1], notes[:0:-1], strict=True):
            later = _looked_back(note.table, following.expected, later)
        return later.tracks(notes[0].t, later.mean, later.cov)


def transition(mean: Array, dt: float, rotation: Array | None, camera: PinholeCamera, turn: Turn) -> Array:
    """(n, 4, 4) the Jacobian of `motion_model.propagate` at means (n, 4)."""
    drift = np.eye(4)
    drift[0, 1] = drift[2, 3] = dt
    if rotation is None:
        return np.tile(drift, (len(mean), 1, 1))
    return np.asarray(turn(mean @ drift.T, rotation, camera)[1] @ drift)


def _looked_back(table: TrackTable, expected: PredictedTracks, later: TrackTable) -> TrackTable:
    """The table of a scan, knowing that of the next one, `later`, and what was expected of that one."""
    looked = _copy(table)
    here, there = _common(looked.id, later.id)
    looked.confirmed[here] |= later.confirmed[there]
    looked.existence[here] = np.maximum(looked.existence[here], later.existence[there])
    known, foreseen = _common(looked.id[here], expected.id)
    here, there = here[known], there[known]
    if not here.size:
        return looked
    looked.mean[here], looked.cov[here] = rts_step(
        looked.mean[here],
        looked.cov[here],
        expected.select(foreseen),
        later.mean[there],
        later.cov[there],
    )
    return looked


def rts_step(
    mean: Array, cov: Array, expected: PredictedTracks, later_mean: Array, later_cov: Array
) -> tuple[Array, Array]:
    """Means (n, 4) and covariances (n, 4, 4) of one scan, given those of the next one and what was expected of it.

    With C = P Fᵀ P⁻⁻¹, where P⁻ = F P Fᵀ + Q was expected, x + C (x̂ − x⁻) and (I − C F) P (I − C F)ᵀ + C (Q + P̂) Cᵀ: a
    sum of squares like Joseph's, of the covariance that is P + C (P̂ − P⁻) Cᵀ. Q is what of P⁻ the motion does not
    explain; where a turn bends a wide distribution that is no covariance, and only its positive part is taken.
    """
    F = expected.F
    C = np.linalg.solve(expected.cov + SMOOTHER_LEAST_COV, F @ cov).swapaxes(1, 2)
    moved = mean + (C @ (later_mean - expected.mean)[:, :, None])[:, :, 0]
    value, axes = np.linalg.eigh(expected.cov - F @ cov @ F.swapaxes(1, 2))
    Q = (axes * np.maximum(value, 0.0)[:, None]) @ axes.swapaxes(1, 2)
    A = np.eye(4) - C @ F
    P = A @ cov @ A.swapaxes(1, 2) + C @ (Q + later_cov) @ C.swapaxes(1, 2)
    return moved, 0.5 * (P + P.swapaxes(1, 2))


def _common(a: NDArray[np.int64], b: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Where in a and where in b the ids stand that both hold."""
    if len(a) == len(b) and (a == b).all():
        return np.arange(len(a)), np.arange(len(a))
    _, in_a, in_b = np.intersect1d(a, b, assume_unique=True, return_indices=True)
    return in_a, in_b


def _copy(table: TrackTable) -> TrackTable:
    return TrackTable(*(getattr(table, column.name).copy() for column in fields(TrackTable)))
