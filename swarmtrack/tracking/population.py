"""Population of a tracker: rows of a table from birth to deletion, by the rules that all trackers share."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.tracking import lifecycle
from swarmtrack.tracking.association import gate_threshold
from swarmtrack.tracking.gaussian import innovations, variances
from swarmtrack.tracking.motion_model import POSITION
from swarmtrack.tracking.parameters import CommonParameters
from swarmtrack.tracking.priors import (
    BOX_JUMP_S,
    BOX_SIZE_MEMORY,
    DETECTED_EXISTENCE,
    DOUBTFUL_COAST_SHARE,
    FADED_BIRTH_SHARE,
    FRAME_TIME_ROUNDING_S,
    HIDDEN_MOST_SIGMA_RAD,
    INDEPENDENT_LOOK_S,
    LIKENESS_MEMORY_LOOKS,
    LIKENESS_SIGMA_LOG_ODDS,
    LOST_BELOW_EXISTENCE,
    MAX_EXISTENCE,
    MIN_CONFIRMED_EXISTENCE,
    MOST_HIDDEN_SHARE,
    OUT_OF_VIEW_PROBABILITY,
    OUTLYING_GATES,
    REPEATED_LOOK_WEIGHT,
    UNDETECTED_DOUBT_GAIN,
    UNKNOWN_BOX_SIGMAS,
)
from swarmtrack.tracking.sensor_model import Measurements, SensorModel, Visibility, within
from swarmtrack.tracking.table import TrackIds, TrackTable


class Population:
    """A table, and where new rows get their numbers."""

    def __init__(self, sensor: SensorModel, parameters: CommonParameters, ids: TrackIds) -> None:
        self.table = TrackTable.empty()
        self._sensor = sensor
        self._parameters = parameters
        self._reach = lifecycle.Reach(sensor.camera)
        self._gate = gate_threshold(parameters.gate_probability)
        self._ids = ids
        self._excused_at = math.inf  # s: time of the last `excuse`
        self._judged_at = math.inf  # s: time of the last `update_status`

    def initiate(self, t: float, points: Array) -> list[int]:
        """Confirmed tracks at known places (n, 2) px. Returns their ids."""
        n = len(points)
        R, unknown = np.tile(self._sensor.R, (n, 1, 1)), np.full((n, 2), np.nan)
        surely = np.full(n, MAX_EXISTENCE)
        newcomers = self.born(t, Measurements(points, R, unknown, np.ones(n), np.full(n, np.inf)), surely)
        newcomers.confirmed[:] = True
        self.table.append(newcomers)
        self._judged_at = min(self._judged_at, t)
        return [int(id) for id in newcomers.id]

    def give_birth(self, t: float, measured: Measurements) -> None:
        """A tentative track for each of these detections."""
        self.table.append(self.born(t, measured, self._sensor.birth_existence(measured.odds)))

    def born(self, t: float, measured: Measurements, existence: Array) -> TrackTable:
        """New rows (k) at these detections, at rest give or take `birth_speed_sigma`; existence (k,)."""
        n = len(measured.z)
        mean, cov = np.zeros((n, 4)), np.zeros((n, 4, 4))
        mean[:, POSITION] = measured.z
        cov[:, POSITION, POSITION] = measured.R
        cov[:, [1, 3], [1, 3]] = self._parameters.birth_speed_sigma**2
        ids = self._ids.allocate(n)
        no, seen, never = np.zeros(n, np.bool_), np.full(n, t), np.full(n, np.nan)
        size, likeness = measured.size.copy(), measured.likeness.copy()
        return TrackTable(
            ids, mean, cov, existence, size, no, no.copy(), seen, never, likeness, np.ones(n), seen.copy()
        )

    def survive(self, dt: float) -> None:
        self.table.existence = lifecycle.survive(self.table.existence, dt, self._parameters.p_survival)

    def learn_looks(
        self, t: float, rows: NDArray[np.intp] | NDArray[np.bool_], measured: Measurements
    ) -> None:
        """Box size and likeness of these rows (k), from the detections (k) that they made at t."""
        self.table.size[rows] = blend_sizes(self.table.size[rows], measured.size)
        self.learn_likeness(t, rows, measured.likeness)

    def learn_likeness(
        self, t: float, rows: NDArray[np.intp] | NDArray[np.bool_] | slice, likeness: Array
    ) -> None:
        """Update the likeness of these rows (k) from that (k) of their detections at t."""
        table = self.table
        new = within((t - table.looked[rows]) / INDEPENDENT_LOOK_S, REPEATED_LOOK_WEIGHT, 1.0)
        looks = np.minimum(table.looks[rows], LIKENESS_MEMORY_LOOKS - new)
        table.likeness[rows] = (looks * table.likeness[rows] + new * likeness) / (looks + new)
        table.looks[rows], table.looked[rows] = looks + new, t

    def update_status(self, t: float, seen: NDArray[np.bool_], visibility: Visibility) -> None:
        """After a scan at t that saw these rows (n,) and has reweighed existence: who is confirmed, who is lost. Time
        out of view is not counted as time without detections."""
        table = self.table
        dt, self._judged_at = max(t - self._judged_at, 0.0), t
        is_drone = table.likeness >= LIKENESS_SIGMA_LOG_ODDS / np.sqrt(table.looks)
        table.confirmed |= is_drone & (table.existence >= self._parameters.confirm_probability)
        floor = np.where(table.confirmed, MIN_CONFIRMED_EXISTENCE, 0.0)
        table.existence = np.maximum(table.existence, floor)
        # A detection that leaves it open whether the track is there keeps it for a moment, to be detected once more.
        confident = np.where(
            table.existence >= DETECTED_EXISTENCE, t, t - DOUBTFUL_COAST_SHARE * self._parameters.max_coast_s
        )
        table.last_seen = np.where(seen, np.maximum(table.last_seen, confident), table.last_seen)
        table.missed_since = np.where(seen, np.nan, np.fmin(table.missed_since, t))
        unseeable = ~seen & (visibility.in_view < 0.5)
        table.lost = ~seen & (table.existence < LOST_BELOW_EXISTENCE) | unseeable
        table.last_seen = np.where(unseeable & table.confirmed, table.last_seen + dt, table.last_seen)

    def credit(self, t: float, made: Array) -> None:
        """Extend the life of confirmed tracks that very likely made a detection, after `update_status`.

        For trackers with deferred association, whose published hypothesis, or too few recent detections, leave such a
        track in doubt. made (n,): probability that each track made a detection of the scan at t.
        """
        table = self.table
        doubt = UNDETECTED_DOUBT_GAIN * (1.0 - made)
        credited = table.confirmed & (doubt < 1.0)
        last = t - DOUBTFUL_COAST_SHARE * self._parameters.max_coast_s * doubt
        table.last_seen = np.where(credited, np.maximum(table.last_seen, last), table.last_seen)

    def excuse(self, t: float, made: Array, visibility: Visibility) -> None:
        """Discount the time in which a confirmed track was occluded by another, after `update_status`. made: as in
        `credit`."""
        dt, self._excused_at = max(t - self._excused_at, 0.0), t
        if visibility.overlap is not None:
            table = self.table
            last = np.minimum(table.last_seen + self._excused(made, visibility.overlap, visibility) * dt, t)
            table.last_seen = np.where(table.confirmed, last, table.last_seen)

    def _excused(self, made: Array, overlap: Array, visibility: Visibility) -> Array:
        """(n,) how surely a miss was because another, which was seen, hid the track, and not the detector's."""
        p_detection = self._parameters.p_detection
        clear = visibility.p_detection / (
            p_detection * np.maximum(visibility.in_view, OUT_OF_VIEW_PROBABILITY)
        )
        seen = (
            overlap @ made / np.maximum(overlap.sum(axis=1), OUT_OF_VIEW_PROBABILITY)
        )  # of those that may hide it
        hidden = within((1.0 - clear) * seen, 0.0, 1.0)
        return np.minimum(hidden / (1.0 - p_detection * (1.0 - hidden)), MOST_HIDDEN_SHARE)

    def drop(self, t: float) -> NDArray[np.bool_] | None:
        """End the tracks that were not seen for too long although they should be in view, that have faded, whose
        direction is no longer known, or that the image plane cannot hold; returns which (n,) stay, None if all do."""
        table, longest = self.table, self._parameters.max_coast_s - FRAME_TIME_ROUNDING_S
        # What was scanned all the time and is likely there lives on: at 3 Hz, two misses in a second say little.
        scanned, most = t - self._judged_at < longest, longest / (1.0 - MOST_HIDDEN_SHARE)
        faded = FADED_BIRTH_SHARE * self._sensor.usual_birth
        # Lists: of a few tracks, an array costs more for each question than for all answers.
        alive = [
            existence >= faded
            and (
                t - seen < longest
                or (scanned and existence >= LOST_BELOW_EXISTENCE and not t - missed >= most)
            )
            for seen, missed, existence in zip(
                table.last_seen.tolist(), table.missed_since.tolist(), table.existence.tolist(), strict=True
            )
        ]
        vague = self._vague(t) if table.lost.any() else None
        if vague is None and all(alive) and self._reach.surely_holds_all(table.mean, table.cov):
            return None
        stay = np.array(alive, dtype=np.bool_) & self._reach.holds(table.mean, table.cov)
        if vague is not None:
            stay &= ~vague
        if stay.all():
            return None
        table.keep(stay)
        return stay

    def holds(self, mean: Array, cov: Array) -> NDArray[np.bool_]:
        """(n,) whether the image plane holds targets with means (n, 4) and covariances (n, 4, 4)."""
        return self._reach.holds(mean, cov)

    def _vague(self, t: float) -> NDArray[np.bool_]:
        """(n,) tracks that are out of view for longer than `max_coast_s`, and in no known direction."""
        table, camera = self.table, self._sensor.camera
        focal = camera.per_radian(table.mean[:, POSITION])
        sigma = np.sqrt(variances(table.cov)[:, POSITION]) / focal
        return np.asarray(
            is_gone(table)
            & (t - table.missed_since >= self._parameters.max_coast_s)
            & (sigma.max(axis=1) > HIDDEN_MOST_SIGMA_RAD)
        )

    def release(self, rows: NDArray[np.bool_], dt: float) -> TrackTable:
        """These rows (n,), which go to another table, dt seconds later, or earlier: what they have survived of that
        time they will survive once more."""
        leaving = self.table.select(rows)
        self.table.keep(~rows)
        there = lifecycle.survive(leaving.existence, dt, self._parameters.p_survival)
        leaving.existence = np.minimum(there, MAX_EXISTENCE)
        return leaving

    def shadowed(self, t: float, measured: Measurements, seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(m,) detections of the scan just judged that are no births: those inside the box of a confirmed track that
        was seen elsewhere in it, its doubles; and those not far beyond the gate of one that was seen until now, its
        outliers, for the noise may be larger than was told. The next scan will tell."""
        table, z = self.table, measured.z
        startled = table.confirmed & (table.missed_since == t)
        outlying: NDArray[np.bool_] = np.zeros(len(z), np.bool_)
        if startled.any():
            distance, _ = innovations(table.mean[startled], table.cov[startled], z, measured.R)
            outlying = np.asarray((distance < OUTLYING_GATES * self._gate).any(axis=0))
        # Also of a track that was just lost: a box that jumps within itself is around a part of the drone.
        lost_at = np.fmin(table.last_seen, table.missed_since)  # the former goes on while it is out of view
        jumped = table.confirmed & ~seen & (t - lost_at < BOX_JUMP_S)
        unknown = UNKNOWN_BOX_SIGMAS * self._parameters.measurement_sigma
        side = np.where(np.isnan(table.size), np.where(jumped, 0.0, unknown)[:, None], table.size)
        near = np.flatnonzero((seen & table.confirmed) | jumped)
        inside = np.abs(z[None] - table.mean[near][:, None, POSITION]) < 0.5 * side[near][:, None]
        return np.asarray(outlying | inside.all(axis=2).any(axis=0))


def is_gone(table: TrackTable) -> NDArray[np.bool_]:
    """(n,) confirmed tracks that are lost because they are out of the picture."""
    return np.asarray(table.lost & table.confirmed & (table.existence >= LOST_BELOW_EXISTENCE))


def blend_sizes(old: Array, new: Array, believed: float | Array = 1.0) -> Array:
    """Box sizes (k, 2) px after new ones were seen, which are believed, one or (k, 1); NaN is unknown."""
    share = (1.0 - BOX_SIZE_MEMORY) * believed
    mixed = (1.0 - share) * old + share * new
    return np.where(np.isnan(old), new, np.where(np.isnan(new), old, mixed))
