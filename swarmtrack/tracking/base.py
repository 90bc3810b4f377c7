"""What every tracker is, whatever its mathematics (DESIGN.md, contract 1).

A `Tracker` keeps the time, refuses what is late or unusable, and hands the rest to its `Filter`, which believes
something about all targets at once: that is where the trackers differ.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import compress
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np

from swarmtrack.messages import Array, Scan, Track
from swarmtrack.tracking import lifecycle
from swarmtrack.tracking.consistency import Consistency, InnovationWindow
from swarmtrack.tracking.parameters import CommonParameters
from swarmtrack.tracking.sensor_model import Measurements, SensorModel
from swarmtrack.tracking.smoothing import FixedLag
from swarmtrack.tracking.table import TrackColumns, TrackTable
from swarmtrack.tracking.target_motion import TURNS


class Explained(NamedTuple):
    """What a filter makes of a scan.

    nis (k,): squared Mahalanobis distances of detections from the confirmed tracks that surely made them, before the
    update; clutter: the expected number of detections that no target made.
    """

    nis: Array
    clutter: float


class Filter(Protocol):
    """What one method believes of all targets, from exposure to exposure."""

    Parameters: ClassVar[type[CommonParameters]]

    def __init__(self, sensor: SensorModel, parameters: Any) -> None: ...

    @property
    def table(self) -> TrackTable:
        """Its estimates, a row a track."""
        ...

    @property
    def counters(self) -> Mapping[str, int]: ...

    def initiate(self, t: float, points: Array) -> list[int]:
        """Start confirmed tracks at known places: points (n, 2) px. Returns their ids."""
        ...

    def predict(self, dt: float, rotation: Array | None, rotation_variance: float) -> None:
        """Carry the belief on by dt ≥ 0 s. rotation, rotation_variance: as in `Tracker.predict`."""
        ...

    def update(self, t: float, measured: Measurements) -> Explained:
        """Fold in what a scan at t, the time of the belief, measured."""
        ...

    def extrapolated(
        self, dt: float, rotation: Array | None, rotation_variance: float
    ) -> tuple[Array, Array]:
        """Means (n, 4) and covariances (n, 4, 4) of the table's rows, carried on by dt; nothing is changed."""
        ...


class Tracker:
    """Multi-target tracking in the image plane, clocked by the exposures of the scans."""

    def __init__(self, sensor: SensorModel, filter: Filter) -> None:
        camera = sensor.camera
        self._sensor = sensor
        self._filter = filter
        self._innovations = InnovationWindow(sensor.parameters.gate_probability)
        self._surely_before = lifecycle.MAX_SLANT * min(camera.fx, camera.fy) / 2.0 - max(
            camera.cx, camera.cy
        )
        self._surely_placed = lifecycle.largest_variance(camera)
        self._smoother = FixedLag(sensor.parameters.lag_s, camera, TURNS[sensor.parameters.profile])
        self._t: float | None = None
        self._last_scan: float | None = None
        self._late_scans = 0
        self._shown: TrackColumns | None = None  # of the state as it stands, once somebody asked

    @property
    def t(self) -> float | None:
        """Time of the state: that of the last scan; None before the first."""
        return self._t

    @property
    def tracks(self) -> tuple[Track, ...]:
        if self._t is None:
            return ()
        table = self._filter.table
        return self._show().tracks(self._t, table.mean.copy(), table.cov.copy())  # filters write into theirs

    def _show(self) -> TrackColumns:
        if self._shown is None:
            self._shown = self._filter.table.shown()
        return self._shown

    @property
    def smoothed(self) -> tuple[Track, ...]:
        """The tracks at a scan `lag_s` ago, knowing all since; each Track's t is its own. Empty before, and if off."""
        return self._smoother.smoothed()

    @property
    def counters(self) -> Mapping[str, int]:
        """What was refused or lost, by name, for health."""
        return {"late_scans": self._late_scans, **self._sensor.counters, **self._filter.counters}

    @property
    def consistency(self) -> Consistency | None:
        """Whether the filter, with the numbers that it was told, is as good as it thinks; None while too little was
        detected. Of a noise that was told too small it says so, although `learn_noise` mends it."""
        return self._innovations.consistency()

    def measurement_noise(self, size: Array, score: Array | None) -> Array:
        """R (m, 2, 2) px² that it gives to detections without; size (m, 2) px, score (m,)."""
        return self._sensor.measurement_noise(size, score)

    def initiate(self, t: float, points: Array) -> list[int]:
        """Start confirmed tracks at known places: points (n, 2) px. Returns their ids."""
        self.predict(t)
        self._smoother.expect(self._filter.table)
        self._shown = None
        ids = self._filter.initiate(t, np.asarray(points, dtype=float).reshape(-1, 2))
        self._smoother.note(t, self._filter.table)
        return ids

    def predict(self, t: float, rotation: Array | None = None, rotation_variance: float = 0.0) -> None:
        """Carry the state to the next exposure. rotation (3, 3): camera axes now from camera axes then; None: still.

        rotation_variance rad² per axis: of the rotation's error.
        """
        if not np.isfinite(t) or (self._t is not None and t < self._t):
            return  # to the time of a late scan, which `update` will refuse: the rotation leads away from our state
        dt = 0.0 if self._t is None else t - self._t
        self._smoother.move(self._filter.table, dt, rotation)
        self._shown = None
        self._filter.predict(dt, rotation, rotation_variance)
        self._t = t

    def update(self, scan: Scan) -> bool:
        """Fold in a scan. One that is older than the last, or the same again, is refused (False) and counted."""
        behind = self._t is not None and scan.t < self._t
        if behind or scan.t == self._last_scan or not np.isfinite(scan.t):
            self._late_scans += 1
            return False
        if scan.t != self._t:
            self.predict(scan.t)
        self._last_scan = scan.t
        self._smoother.expect(self._filter.table)
        self._shown = None
        explained = self._filter.update(scan.t, self._sensor.usable(scan))
        self._smoother.note(scan.t, self._filter.table)
        # The window judges what was told, not what was learned.
        self._innovations.add((explained.nis * self._sensor.noise_scale).tolist())
        self._sensor.learn_clutter(explained.clutter, scan.coverage)
        self._sensor.learn_noise(explained.nis.tolist())
        return True

    def at(
        self, t: float, rotation: Array | None = None, rotation_variance: float = 0.0
    ) -> tuple[Track, ...]:
        """The tracks carried on to t, without those behind the camera then; the tracker itself is unchanged."""
        if self._t is None:
            return ()
        mean, cov = self._filter.extrapolated(t - self._t, rotation, rotation_variance)
        tracks = self._show().tracks(t, mean, cov)
        if np.abs(mean).max(initial=0.0) < self._surely_before and cov.max(initial=0.0) < self._surely_placed:
            return tracks
        camera = self._sensor.camera
        return tuple(
            compress(tracks, lifecycle.is_placed(cov, camera) & lifecycle.within_reach(mean, camera))
        )
