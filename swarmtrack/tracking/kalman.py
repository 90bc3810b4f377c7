"""A Kalman filter for each target, and the single most likely one-to-one association (the paper's baseline, soundly).

A scan is explained in one piece: each track takes the detection, or none, that makes the whole scan most likely.
What no track explains starts a tentative one; a track lives by its probability of existence (see lifecycle.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import compress
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array, Scan, Track
from swarmtrack.tracking import lifecycle
from swarmtrack.tracking.association import gate_threshold, most_likely_matching
from swarmtrack.tracking.base import CommonParameters
from swarmtrack.tracking.gaussian import innovations, update
from swarmtrack.tracking.motion_model import POSITION, propagate, turn_by_flow, turn_exactly
from swarmtrack.tracking.table import TrackTable

TURNS = {"default": turn_exactly, "paper": turn_by_flow}
SIZE_MEMORY = 0.8  # share of the old box size that a new detection leaves: boxes jitter, drones grow slowly
SIZE_GATE = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class KalmanParameters(CommonParameters):
    """Beside the common ones: how tracks begin and end."""

    profile: str = "default"
    """`paper`: its motion model (optical flow instead of the exact rotation) and no use of detection scores."""
    birth_per_scan: float = 0.02
    """Expected new targets in one image."""
    birth_speed_sigma: float = 100.0
    """px/s, per axis, of a target just found."""
    confirm_probability: float = 0.99
    """Existence above which a tentative track is confirmed."""
    max_coast_s: float = 1.0
    """s: a confirmed track is dropped when it has not been detected for so long."""
    birth_score: float = 0.55
    """A detection of a lower score carries a track on but starts none: keep low, give birth high."""
    size_sigma: float = 0.2
    """Relative, of a box's sides from scan to scan: of two drones in one place the size tells the nearer one."""
    score_weight: float = 1.0
    """How far a detection's score is believed: its clutter intensity is scaled by ((1 − s) / s) to this power."""

    def __post_init__(self) -> None:
        # Not super(): dataclass(slots=True) makes a new class, and zero-argument super() would look for the old one.
        CommonParameters.__post_init__(self)
        if self.profile not in TURNS:
            raise ValueError(f"tracker.profile: found {self.profile!r}, expected one of {', '.join(TURNS)}")
        if not 0.0 <= self.birth_score <= 1.0:
            raise ValueError(f"tracker.birth_score: found {self.birth_score!r}, expected a score in 0…1")


class Measurements(NamedTuple):
    """What can be used of a scan: z (m, 2), R (m, 2, 2), size (m, 2), odds (m,) of being no clutter, fit (m,) to
    start a track."""

    z: Array
    R: Array
    size: Array
    odds: Array
    fit: NDArray[np.bool_]

    def select(self, rows: NDArray[np.bool_]) -> Measurements:
        return Measurements(self.z[rows], self.R[rows], self.size[rows], self.odds[rows], self.fit[rows])


class KalmanTracker:
    """Maximum-likelihood association, gated, one-to-one; Kalman updates in Joseph form."""

    Parameters: ClassVar[type[CommonParameters]] = KalmanParameters

    def __init__(self, camera: PinholeCamera, parameters: KalmanParameters) -> None:
        self._camera = camera
        self._parameters = parameters
        self._turn = TURNS[parameters.profile]
        self._gate = gate_threshold(parameters.gate_probability)
        self._surely_before = lifecycle.MAX_SLANT * min(camera.fx, camera.fy) / 2.0 - max(
            camera.cx, camera.cy
        )
        self._R = parameters.measurement_sigma**2 * np.eye(2)
        self._table = TrackTable.empty()
        self._t: float | None = None
        self._last_scan: float | None = None
        self._next_id = 1
        self.counters = {"late_scans": 0, "unusable_detections": 0}

    @property
    def t(self) -> float | None:
        return self._t

    @property
    def tracks(self) -> tuple[Track, ...]:
        if self._t is None:
            return ()
        return self._table.tracks(self._t, self._table.mean, self._table.cov)

    def initiate(self, t: float, points: Array) -> list[int]:
        self.predict(t)
        points = np.asarray(points, dtype=float).reshape(-1, 2)
        born = self._born(t, points, np.tile(self._R, (len(points), 1, 1)), np.full_like(points, np.nan))
        born.existence[:] = lifecycle.MAX_EXISTENCE
        born.confirmed[:] = True
        self._table.append(born)
        return [int(id) for id in born.id]

    def predict(self, t: float, rotation: Array | None = None, rotation_variance: float = 0.0) -> None:
        if not np.isfinite(t) or (self._t is not None and t < self._t):
            return  # to the time of a late scan, which `update` will refuse: the rotation leads away from our state
        if self._t is None:
            self._t = t
        table, dt = self._table, t - self._t
        table.mean, table.cov = self._carried(dt, rotation, rotation_variance)
        table.existence = lifecycle.survive(table.existence, dt, self._parameters.p_survival)
        self._t = t

    def update(self, scan: Scan) -> bool:
        behind = self._t is not None and scan.t < self._t
        if behind or scan.t == self._last_scan or not np.isfinite(scan.t):
            self.counters["late_scans"] += 1
            return False
        self.predict(scan.t)
        self._last_scan = scan.t
        measured = self._usable(scan)
        # Before the association: after a long silence a track could take whatever comes next, and its name with it.
        self._drop(scan.t)
        taken = self._associate(scan.t, measured)
        self._drop(scan.t)
        self._give_birth(scan.t, measured.select(measured.fit & ~taken))
        return True

    def at(
        self, t: float, rotation: Array | None = None, rotation_variance: float = 0.0
    ) -> tuple[Track, ...]:
        if self._t is None:
            return ()
        mean, cov = self._carried(t - self._t, rotation, rotation_variance)
        tracks = self._table.tracks(t, mean, cov)
        if np.abs(mean[:, POSITION]).max(initial=0.0) < self._surely_before:
            return tracks
        return tuple(compress(tracks, lifecycle.within_reach(mean, self._camera)))

    def _carried(self, dt: float, rotation: Array | None, rotation_variance: float) -> tuple[Array, Array]:
        return propagate(
            self._table.mean,
            self._table.cov,
            dt,
            psd=self._parameters.acceleration_psd,
            camera=self._camera,
            rotation=rotation,
            rotation_variance=rotation_variance,
            turn=self._turn,
        )

    def _usable(self, scan: Scan) -> Measurements:
        """Those that are finite and near the image."""
        m = len(scan.z)
        R = np.tile(self._R, (m, 1, 1)) if scan.R is None else np.asarray(scan.R, dtype=float)
        size = np.full((m, 2), np.nan) if scan.size is None else np.asarray(scan.size, dtype=float)
        odds, fit = np.ones(m), np.ones(m, np.bool_)
        if scan.score is not None and self._parameters.profile != "paper":
            score = np.clip(scan.score, 0.01, 0.99)
            odds = (score / (1.0 - score)) ** self._parameters.score_weight
            fit = scan.score >= self._parameters.birth_score
        low, high = self._camera.ideal_bounds
        near = (np.abs(scan.z - 0.5 * (low + high)) < high - low).all(axis=1)  # NaN compares as False
        determinant = R[:, 0, 0] * R[:, 1, 1] - R[:, 0, 1] * R[:, 1, 0]
        sound = np.isfinite(R).all(axis=(1, 2)) & (R[:, 0, 0] > 0.0) & (determinant > 0.0) & np.isfinite(odds)
        good = near & sound
        self.counters["unusable_detections"] += m - int(good.sum())
        return Measurements(scan.z, R, size, odds, fit).select(good)

    def _associate(self, t: float, measured: Measurements) -> NDArray[np.bool_]:
        """Give each track its detection or none, and update; returns which detections (m,) were taken or shadowed."""
        table, parameters = self._table, self._parameters
        z, R = measured.z, measured.R
        in_view = lifecycle.probability_in_view(table.mean, table.cov, self._camera)
        p_detection = parameters.p_detection * in_view
        distance, log_density = innovations(table.mean, table.cov, z, R)
        ratio = np.exp(log_density) / self._clutter_intensity(measured.odds)
        with np.errstate(divide="ignore"):
            log_ratio = np.log(p_detection[:, None] * ratio / (1.0 - p_detection[:, None]))
        log_ratio += _log_likelihood_of_sizes(table.size, measured.size, parameters.size_sigma)
        log_ratio[distance > self._gate] = -np.inf
        rows, columns = self._match(log_ratio)

        likelihood = 1.0 - p_detection
        likelihood[rows] += p_detection[rows] * ratio[rows, columns]
        table.existence = lifecycle.reweigh(table.existence, likelihood)
        table.confirmed |= table.existence >= parameters.confirm_probability
        floor = np.where(table.confirmed, lifecycle.MIN_CONFIRMED_EXISTENCE, 0.0)
        table.existence = np.maximum(table.existence, floor)
        table.mean[rows], table.cov[rows] = update(table.mean[rows], table.cov[rows], z[columns], R[columns])
        table.size[rows] = _blend(table.size[rows], measured.size[columns])
        table.last_seen[rows] = t
        missed = np.ones(len(table), np.bool_)
        missed[rows] = False
        table.missed_since = np.where(missed, np.fmin(table.missed_since, t), np.nan)
        table.lost = missed & ((table.existence < lifecycle.LOST_BELOW) | (in_view < 0.5))

        taken = np.zeros(len(z), np.bool_)
        taken[columns] = True
        return taken | self._shadowed(z, rows)

    def _match(self, log_ratio: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Confirmed tracks choose first, weighed by their existence; tentative ones share what is left."""
        confirmed = self._table.confirmed
        sure, free = np.flatnonzero(confirmed), np.flatnonzero(~confirmed)
        rows, columns = most_likely_matching(log_ratio[sure] + np.log(self._table.existence[sure])[:, None])
        left = np.setdiff1d(np.arange(log_ratio.shape[1]), columns)
        more_rows, more_columns = most_likely_matching(log_ratio[np.ix_(free, left)])
        return np.concatenate([sure[rows], free[more_rows]]), np.concatenate([columns, left[more_columns]])

    def _shadowed(self, z: Array, found: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(m,) detections inside the box of a confirmed track that was found elsewhere in it: doubles, not births."""
        table = self._table
        found = found[table.confirmed[found]]
        half = 0.5 * np.where(
            np.isnan(table.size[found]), 6.0 * self._parameters.measurement_sigma, table.size[found]
        )
        inside = np.abs(z[None] - table.mean[found][:, None, POSITION]) < half[:, None]
        return np.asarray(inside.all(axis=2).any(axis=0))

    def _drop(self, t: float) -> None:
        table, parameters = self._table, self._parameters
        coasted = t - table.last_seen > parameters.max_coast_s
        faded = table.existence < 0.05 * self._birth_existence(np.ones(1))
        table.keep(~(coasted | faded) & lifecycle.within_reach(table.mean, self._camera))

    def _give_birth(self, t: float, measured: Measurements) -> None:
        born = self._born(t, measured.z, measured.R, measured.size)
        born.existence = self._birth_existence(measured.odds)
        self._table.append(born)

    def _birth_existence(self, odds: Array) -> Array:
        birth = self._parameters.birth_per_scan * odds
        return np.minimum(
            birth / (birth + self._parameters.clutter_per_scan), self._parameters.confirm_probability
        )

    def _clutter_intensity(self, odds: Array) -> Array:
        """κ (m,) per px²: uniform over the image, less for what the detector is sure of."""
        area = self._camera.width * self._camera.height
        return self._parameters.clutter_per_scan / area / odds

    def _born(self, t: float, z: Array, R: Array, size: Array) -> TrackTable:
        n = len(z)
        mean, cov = np.zeros((n, 4)), np.zeros((n, 4, 4))
        mean[:, POSITION] = z
        cov[:, POSITION, POSITION] = R
        cov[:, [1, 3], [1, 3]] = self._parameters.birth_speed_sigma**2
        ids = np.arange(self._next_id, self._next_id + n)
        self._next_id += n
        no, seen, never = np.zeros(n, np.bool_), np.full(n, t), np.full(n, np.nan)
        return TrackTable(ids, mean, cov, np.zeros(n), size, no, no.copy(), seen, never)


def _log_likelihood_of_sizes(tracks: Array, measured: Array, sigma: float) -> Array:
    """(n, m) of boxes (m, 2) px, known to have the sizes (n, 2) px up to a relative sigma per side, over a typical
    one.

    A side that differs by more than `SIZE_GATE` sigma is that of a box around two drones: it speaks against, but no
    louder.
    """
    deviation = np.abs(np.log(measured[None] / tracks[:, None])) / sigma
    likelihood = 0.5 * (1.0 - np.minimum(deviation, SIZE_GATE) ** 2)
    return np.asarray(np.nan_to_num(likelihood, nan=0.0).sum(axis=2))


def _blend(old: Array, new: Array) -> Array:
    """Box sizes (k, 2) px after new ones were seen; NaN is unknown."""
    mixed = SIZE_MEMORY * old + (1.0 - SIZE_MEMORY) * new
    return np.where(np.isnan(old), new, np.where(np.isnan(new), old, mixed))
