"""What all trackers have in common, whatever their mathematics (DESIGN.md, contract 1).

A `Tracker` keeps the time, refuses what is late or unusable, and hands the rest to its `Filter`, which believes
something about all targets at once: that is where the trackers differ.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import compress
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry.rotation import log as turned_by
from swarmtrack.messages import Array, Scan, Track
from swarmtrack.tracking.consistency import Consistency, InnovationWindow
from swarmtrack.tracking.hidden import HiddenTracks
from swarmtrack.tracking.lifecycle import Reach
from swarmtrack.tracking.motion_model import Course
from swarmtrack.tracking.noise import MeasuredNoise, SurePairs
from swarmtrack.tracking.parameters import CommonParameters
from swarmtrack.tracking.passage import Passage
from swarmtrack.tracking.population import is_gone
from swarmtrack.tracking.priors import STEADY_RATE_CHANGE_RAD_S
from swarmtrack.tracking.sensor_model import Measurements, SensorModel
from swarmtrack.tracking.smoothing import FixedLag
from swarmtrack.tracking.table import TrackColumns, TrackIds, TrackTable
from swarmtrack.tracking.target_motion import TURNS

NO_COUNTERS: Mapping[str, int] = MappingProxyType({})


class Explained(NamedTuple):
    """A filter's explanation of a scan.

    pairs: the detections that confirmed tracks surely made, as they fitted before the update; clutter: the expected
    number of detections that no target made.
    """

    pairs: SurePairs
    clutter: float


class Filter(Protocol):
    """Belief of one method about all targets, from exposure to exposure (docs/add_a_tracker.md)."""

    Parameters: ClassVar[type[CommonParameters]]
    counters: Mapping[str, int] = NO_COUNTERS
    """Events worth counting, for health."""

    def __init__(self, sensor: SensorModel, parameters: Any, ids: TrackIds) -> None: ...

    @property
    def table(self) -> TrackTable:
        """Its estimates, one row per track."""
        ...

    def initiate(self, t: float, points: Array) -> list[int]:
        """Start confirmed tracks at known places: points (n, 2) px. Returns their ids."""
        ...

    def predict(self, dt: float, rotation: Array | None, rotation_variance: float) -> None:
        """Carry the belief on by dt ≥ 0 s. rotation, rotation_variance: as in `Tracker.predict`."""
        ...

    def update(self, t: float, measured: Measurements) -> Explained:
        """Fold in what a scan at t, the time of the belief, measured."""
        ...

    def course(self) -> Course:
        """Prediction of the table's rows, valid until the belief changes."""
        ...

    # Between the cameras of one drone. The defaults are for filters whose table is all that they believe.

    def release(
        self, rows: NDArray[np.bool_], dt: float, rotation: Array | None, rotation_variance: float
    ) -> Passage:
        """Take these rows (n,) of the table out, carried on by dt, for another camera's filter."""
        mean, cov = self.course().at(dt, rotation, rotation_variance)
        leaving = replace(self.table.select(rows), mean=mean[rows], cov=cov[rows])
        self.table.keep(~rows)
        return Passage(leaving, None)

    def copied(self, rows: NDArray[np.bool_]) -> Passage:
        """What `adopt` would take, of these rows (n,) of the table as they stand; nothing is changed."""
        return Passage(self.table.select(rows), None)

    def adopt(self, arriving: Passage) -> None:
        """Rows that another filter of the same kind released, in this camera's pixels at the time of the belief."""
        self.table.append(arriving.table)


class Tracker:
    """Multi-target tracking in the image plane, clocked by the exposures of the scans."""

    def __init__(
        self,
        sensor: SensorModel,
        filter: Filter,
        camera_index: int = 0,
        hidden: HiddenTracks | None = None,
    ) -> None:
        """camera_index: which of a drone's cameras it is; hidden: keeps what has turned out of the image plane."""
        camera = sensor.camera
        self._camera_index = camera_index
        self._hidden = hidden
        self._sensor = sensor
        self.filter = filter
        self._innovations = InnovationWindow(sensor.parameters.gate_probability)
        self._reach = Reach(camera)
        self._smoother = FixedLag(sensor.parameters.lag_s, camera, TURNS[sensor.parameters.profile])
        self._rate, self._steady = [0.0, 0.0, 0.0], False
        self._t: float | None = None
        self._last_scan: float | None = None
        self._late_scans = 0
        self._last: tuple[SurePairs, Measurements] | None = None
        """Who made what in the last scan."""
        # Of the state as it stands, once somebody asked.
        self._shown: TrackColumns | None = None
        self._course: Course | None = None

    @property
    def t(self) -> float | None:
        """Time of the state: that of the last scan; None before the first."""
        return self._t

    @property
    def tracks(self) -> tuple[Track, ...]:
        if self._t is None:
            return ()
        table = self.filter.table
        # copies: filters write into theirs
        mean, cov = table.mean.copy(), table.cov.copy()
        self._sensor.add_lasting_error(cov)
        return self._show().tracks(self._t, mean, cov)

    def _show(self) -> TrackColumns:
        if self._shown is None:
            self._shown = self.filter.table.shown(self._camera_index)
        return self._shown

    def _changes(self) -> None:
        """What was worked out of the state holds no longer."""
        self._shown = self._course = None

    @property
    def smoothed(self) -> tuple[Track, ...]:
        """The tracks at a scan `lag_s` ago, knowing all since; each Track's t is its own. Empty before, and if off."""
        return self._smoother.smoothed()

    @property
    def counters(self) -> Mapping[str, int]:
        """Rejected and lost scans and tracks, by name, for health."""
        return {"late_scans": self._late_scans, **self._sensor.counters, **self.filter.counters}

    @property
    def consistency(self) -> Consistency | None:
        """Consistency of the filter with its configured noise; None with too few detections. It reports a
        configured noise that is too small even where `learn_noise` corrects it.
        """
        return self._innovations.consistency()

    @property
    def measured_noise(self) -> MeasuredNoise | None:
        """Estimated noise; None with too few data, or where it is not learned both ways, below and above the
        configured value.
        """
        return self._sensor.noise.measured

    def measurement_noise(self, size: Array, score: Array | None) -> Array:
        """R (m, 2, 2) px² that it gives to detections without; size (m, 2) px, score (m,)."""
        return self._sensor.measurement_noise(size, score)

    def initiate(self, t: float, points: Array) -> list[int]:
        """Start confirmed tracks at known places: points (n, 2) px. Returns their ids."""
        self.predict(t)
        self._smoother.expect(self.filter.table)
        self._changes()
        ids = self.filter.initiate(t, np.asarray(points, dtype=float).reshape(-1, 2))
        self._smoother.note(t, self.filter.table)
        return ids

    def predict(self, t: float, rotation: Array | None = None, rotation_variance: float = 0.0) -> None:
        """Carry the state to the next exposure. rotation (3, 3): camera axes now from camera axes then; None: still.

        rotation_variance rad² per axis: of the rotation's error.
        """
        if not math.isfinite(t) or (self._t is not None and t < self._t):
            return  # to the time of a late scan, which `update` will refuse: the rotation leads away from our state
        dt = 0.0 if self._t is None else t - self._t
        self._note_turn(dt, rotation)
        self._smoother.move(self.filter.table, dt, rotation)
        self._changes()
        back = None
        if self._hidden is not None and rotation is not None:
            back = self._hidden.carry(self.filter, dt, rotation, rotation_variance)
        self.filter.predict(dt, rotation, rotation_variance)
        if back is not None:
            self.filter.adopt(back)
        self._t = t

    def refuses(self, t: float) -> bool:
        """Whether `update` would refuse a scan of time t."""
        behind = self._t is not None and t < self._t
        return behind or t == self._last_scan or not math.isfinite(t)

    def _note_turn(self, dt: float, rotation: Array | None) -> None:
        """Whether the camera goes on turning as it did."""
        if dt <= 0.0:
            return
        turn = [0.0, 0.0, 0.0] if rotation is None else turned_by(rotation).tolist()
        rate = [angle / dt for angle in turn]
        self._steady = all(
            abs(new - old) < STEADY_RATE_CHANGE_RAD_S for new, old in zip(rate, self._rate, strict=True)
        )
        self._rate = rate

    def update(self, scan: Scan) -> bool:
        """Fold in a scan. One that is older than the last, or the same again, is refused (False) and counted."""
        if self.refuses(scan.t):
            self._late_scans += 1
            return False
        if scan.t != self._t:
            self.predict(scan.t)
        self._last_scan = scan.t
        self._smoother.expect(self.filter.table)
        self._changes()
        measured = self._sensor.usable(scan)
        explained = self.filter.update(scan.t, measured)
        self._smoother.note(scan.t, self.filter.table)
        self._last = explained.pairs, measured
        # The window judges what was told, unless all was learned.
        nis = explained.pairs.nis
        self._innovations.add((nis * self._sensor.noise_scale).tolist())
        self._sensor.learn_clutter(explained.clutter, scan.coverage)
        self._sensor.learn_noise(explained.pairs, measured.size, steady=self._steady)
        return True

    @property
    def surely_detected(self) -> Iterator[tuple[int, Array, Array]]:
        """Certain associations of confirmed tracks in the last scan: track number, the detection (2,) px and its R
        (2, 2).
        """
        if self._last is None:
            return
        pairs, measured = self._last
        for track_id, row in zip(pairs.track.tolist(), pairs.detection.tolist(), strict=True):
            yield track_id, measured.z[row], measured.R[row]

    @property
    def estimates(self) -> tuple[NDArray[np.int64], Array, Array]:
        """Numbers (n,), means (n, 4) and covariances (n, 4, 4) of all tracks at the time of the state."""
        table = self.filter.table
        return table.id, table.mean, table.cov

    @property
    def sizes(self) -> Array:
        """(n, 2) px, width and height of all tracks, NaN while unknown."""
        return self.filter.table.size

    def extrapolated(self, t: float, rotation: Array | None, rotation_variance: float) -> tuple[Array, Array]:
        """Means (n, 4) and covariances (n, 4, 4) of all tracks carried on to t; the tracker itself is unchanged."""
        if self._course is None:
            self._course = self.filter.course()
        return self._course.at(0.0 if self._t is None else t - self._t, rotation, rotation_variance)

    def release(
        self, rows: NDArray[np.bool_], t: float, rotation: Array, rotation_variance: float
    ) -> Passage:
        """Take these rows (n,) of the `tracks` out, carried on to t and turned, for another camera's tracker."""
        assert self._t is not None
        self._changes()
        return self.filter.release(rows, t - self._t, rotation, rotation_variance)

    def copied(self, rows: NDArray[np.bool_]) -> Passage:
        """These rows (n,) of the `tracks` as they stand, to be adopted again where they have gone meanwhile."""
        return self.filter.copied(rows)

    @property
    def missed(self) -> NDArray[np.bool_]:
        """(n,) that a track was not detected in the last scan."""
        return np.isfinite(self.filter.table.missed_since)

    @property
    def gone_since(self) -> Array:
        """(n,) s, of tracks that are lost because they are out of the picture: the first scan that missed them; NaN of
        all others."""
        table = self.filter.table
        return np.where(is_gone(table), table.missed_since, np.nan)

    def not_lost(self, rows: NDArray[np.bool_]) -> None:
        """These rows (n,) are out of this picture, but not out of sight of the drone."""
        self._changes()
        self.filter.table.lost[rows] = False

    def adopt(self, arriving: Passage) -> None:
        """Tracks that another one released, in pixels of this camera at the time of the state."""
        self._changes()
        self.filter.adopt(arriving)

    def end_unseen(self, t: float) -> None:
        """By t no scan has come for a while: who was not detected for `max_coast_s` has ended all the same. Nothing is
        learned of it, and a scan that comes after all is not late."""
        if self._t is None:
            return
        table, most = self.filter.table, self._sensor.parameters.max_coast_s
        unseen = t - table.last_seen >= most
        if unseen.any():
            self.release(unseen, self._t, np.eye(3), 0.0)

    def vouch(self, track_id: int) -> None:
        """Something else than its looks says that a weak look-alike is a target: it may be confirmed."""
        table = self.filter.table
        table.likeness[table.id == track_id] = np.inf

    def at(
        self, t: float, rotation: Array | None = None, rotation_variance: float = 0.0
    ) -> tuple[Track, ...]:
        """The tracks carried on to t, without those behind the camera then; the tracker itself is unchanged."""
        if self._t is None:
            return ()
        mean, cov = self.extrapolated(t, rotation, rotation_variance)
        self._sensor.add_lasting_error(cov)
        tracks = self._show().tracks(t, mean, cov)
        if self._reach.surely_holds_all(mean, cov):
            return tracks
        return tuple(compress(tracks, self._reach.holds(mean, cov)))
