"""Evidence of one track's bearings for each teammate.

For each teammate the innovations of bearings (`deviation.py`) add up to a matrix M (`evidence.py`), to normalisers, and
to the predictive densities of a stranger (`strangers.py`).

A segment is the hypothesis that the track went over to its present target at some instant: it has sums of its own from
then on. Earlier bearings still count for the observer's errors, whichever target they were of.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.team.bearing_noise import without_noise
from swarmtrack.team.deviation import DeviationFilters
from swarmtrack.team.evidence import fading
from swarmtrack.team.pasts import COLUMN_OF_NOBODY, Past
from swarmtrack.team.priors import (
    ATTITUDE_LASTING_SIGMA_RAD,
    BEARING_SIGMA_RAD,
    HANDOVER_LEAST,
    HANDOVER_MET,
    HANDOVER_MISSED_PER_S,
    HANDOVER_MOST,
    HANDOVER_PER_S,
    LOG_WEAK,
    SEGMENT_AFTER_MISS_S,
    SEGMENT_LEAST_S,
    SEGMENT_MISSED_S,
    SEGMENTS_KEPT,
    TRACKS_MEET_PX,
    WEAK_FREE_S,
    WEAK_MOST,
    WEAK_PER_S,
)
from swarmtrack.team.strangers import KINDS, StrangerFilters
from swarmtrack.team.unheard import UnheardTrack

# Columns of a sum: M, the log normalisers, the stranger's log densities, distances and how many (`bearing_noise.py`),
# and what of a log ratio that was carried on is by a place.
_M = slice(0, 64)
_LOG = 64
_STRANGER = slice(65, 65 + KINDS)
_DISTANCE = slice(65 + KINDS, 73 + KINDS)
_COUNT = 73 + KINDS
_BY_PLACE = 74 + KINDS
_WIDTH = 75 + KINDS
# s: a bearing so soon after the last is none.
_LEAST_STEP_S = 0.02
BOX_DISTANCES = np.array([0.0, 1.0, 2.0, -1.0, -2.0])
"""Beside the one that a box says, in steps of its logarithm."""


class Bearing(NamedTuple):
    """A track in one scan: t [s]; camera (3,) m, team frame; pixel (2,), undistorted; direction (3,), unit vector in
    the axes of the own rays; variance rad²; distance [m] at which a box of `BOX_SPAN_M` looks as large; weak: of a
    track that is not confirmed yet; lasting rad: one sigma of the attitude's error that lasts."""

    t: float
    camera: Array
    pixel: Array
    direction: Array
    variance: float
    distance: float
    weak: bool = False
    lasting: float = ATTITUDE_LASTING_SIGMA_RAD

    def turned(self, direction: Array, left: float) -> Bearing:
        """With another direction (3,), of whose attitude's variance that share is left."""
        variance = self.variance - (1.0 - left) * BEARING_SIGMA_RAD**2
        return self._replace(direction=direction, variance=variance, lasting=math.sqrt(left) * self.lasting)


@dataclass(slots=True)
class TrackSegment:
    """since [s]; sum (n, …): of the bearings since then; deviation: of the teammates; log_handover: log prior that it
    began there; past: of all that was before, None for the first, as it was at past_t [s]."""

    since: float
    sum: Array
    deviation: DeviationFilters
    log_handover: float = 0.0
    past: Past | None = None
    past_t: float = -math.inf
    weight: float = 0.0

    def add(self, columns: NDArray[np.intp], said: Array) -> None:
        """A bearing says this of some teammates: `sums_of`."""
        self.sum[columns, :_BY_PLACE] += said


def sums_of(M: Array, log: Array, stranger: Array, distance: Array) -> Array:
    """(n, …), rows of a sum: M (n, 8, 8), log normalisers (n,), log densities of a stranger (n, KINDS), and the
    distance, of z, as a share of that at which errors are compared (n, 8)."""
    return np.concatenate([M.reshape(-1, 64), log[:, None], stranger, distance, np.ones((len(M), 1))], axis=1)


class ToldOfMany(NamedTuple):
    """M (c, m, 8, 8) and log weights (c, m): first, by distance, of the segment that began with the track, `whole` of
    them; then of the others. A distance that does not count for a teammate has −inf."""

    M: Array
    log: Array
    whole: int


class Told(NamedTuple):
    """By segment and teammate: M (s, n, 8, 8), log normalisers less the stranger's density (s, n), what of these is by
    a place of before (s, n), and whether there was any bearing (n,). size, size_log: `TrackEvidence.size`; distance
    (s, n, 8), number (s, n): `bearing_noise.without_noise`."""

    M: Array
    log: Array
    by_place: Array
    known: NDArray[np.bool_]
    size: Array
    size_log: Array
    distance: Array
    number: Array

    def of_segment(self, segment: int, column: int) -> Array:
        """M (8, 8) of one segment, without what the box's size says."""
        M, _ = self._without_noise(np.array([column]), segment)
        return np.asarray(M[0, 0])

    def of(self, column: int) -> tuple[Array, Array, int]:
        """For one teammate, M (c, 8, 8) and log weights (c,): first, by distance, of the segment that began with the
        track, as many as the last value says; then of the others."""
        M, log, whole = self.of_many(np.array([column]))
        near = np.isfinite(log[:, 0])
        near[whole:] = True
        return M[near, 0], log[near, 0], int(near[:whole].sum())

    def of_many(self, columns: NDArray[np.intp]) -> ToldOfMany:
        """For some teammates."""
        M, log = self._without_noise(columns)
        first_M, first_log = self._by_distance(M[0], log[0], columns)
        return ToldOfMany(
            np.concatenate([first_M, M[1:]]), np.concatenate([first_log, log[1:]]), len(first_log)
        )

    def since(self, segment: int, column: int) -> tuple[Array, Array]:
        """As `of`, of one segment."""
        M, log = self._of_segment(segment, np.array([column]))
        near = np.isfinite(log[:, 0])
        return M[near, 0], log[near, 0]

    def by_motion(self, segment: int, columns: NDArray[np.intp]) -> tuple[Array, Array]:
        """The same for one segment and some teammates, without what a place said: M (c, m, 8, 8) and log weights
        (c, m)."""
        M, log = self._of_segment(segment, columns)
        return M, log - self.by_place[segment, columns]

    def _of_segment(self, segment: int, columns: NDArray[np.intp]) -> tuple[Array, Array]:
        M, log = self._without_noise(columns, segment)
        return (M, log) if segment else self._by_distance(M[0], log[0], columns)

    def _by_distance(self, M: Array, log: Array, columns: NDArray[np.intp]) -> tuple[Array, Array]:
        """By distance, with what the box's size says: (r, m, 8, 8) and (r, m)."""
        near = np.isfinite(self.size_log[:, columns]).any(axis=1)
        return M + self.size[near][:, columns], log + self.size_log[near][:, columns]

    def _without_noise(self, columns: NDArray[np.intp], segment: int | None = None) -> tuple[Array, Array]:
        """For some teammates, M (s, m, 8, 8) and log weights (s, m); of one segment, or of all."""
        of = slice(None) if segment is None else slice(segment, segment + 1)
        M, log = without_noise(
            self.M[of][:, columns], self.distance[of][:, columns], self.number[of][:, columns]
        )
        return M, self.log[of][:, columns] + log


def _no_size(n: int) -> tuple[Array, Array]:
    """`TrackEvidence.size` and `size_log` before any box."""
    log = np.full((len(BOX_DISTANCES), n), -np.inf)
    log[0] = 0.0
    return np.zeros((len(BOX_DISTANCES), n, 8, 8)), log


@dataclass(slots=True, eq=False)
class TrackEvidence:
    """n teammates are compared with the track; more of them may be added at any time."""

    n: int
    camera: int
    segments: list[TrackSegment] = field(init=False)
    t: float = -math.inf
    size: Array = field(init=False)
    """(r, n, 8, 8): of the box's size, by distance; and log weights (r, n)."""
    size_log: Array = field(init=False)
    strangers: StrangerFilters = field(init=False)
    whole: Array | None = None
    """(k,) by component: log evidence of all bearings, whoever it is."""
    weak: bool = False
    """Whether the tracker has not confirmed it yet."""
    held: int = 0
    """The drone that it was last rather than not; 0: it was none yet."""
    unheard: UnheardTrack | None = None
    """While the teammate that it was last says nothing."""
    _learned: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, int))
    """The components by which it was worked out last."""
    _returned: set[int] = field(default_factory=set)
    """The drones of which was asked whether this track is theirs come back."""
    _hazard: float = 0.0
    """The probability that it went over to another target and no segment began."""
    _begun_t: float = math.nan
    _at: Array = field(init=False)
    """(n,) s: the last bearing of each."""
    _camera_at: Array = field(init=False)
    faint: Array = field(init=False)
    """(n,): the log ratio of each teammate that is far from what this track is; NaN of one that is to be looked at."""
    _expected: NDArray[np.bool_] = field(init=False)
    """(n,): compared with where it was last seen only."""
    _sized: NDArray[np.bool_] = field(init=False)
    """(n,): its box has been counted."""

    def __post_init__(self) -> None:
        n, self.n = self.n, 0
        self.segments = [TrackSegment(-math.inf, np.zeros((0, _WIDTH)), DeviationFilters(0), weight=1.0)]
        self.size, self.size_log = _no_size(0)
        self.strangers = StrangerFilters(0)
        self._at, self._camera_at = np.zeros(0), np.zeros((0, 3))
        self._expected, self._sized = np.zeros(0, bool), np.zeros(0, bool)
        self.faint = np.zeros(0)
        self.grow(n)

    @property
    def compared(self) -> NDArray[np.bool_]:
        """(n,): the teammates that it was compared with at least once."""
        return np.isfinite(self._at)

    def log_weak(self, t: float) -> float:
        """Log prior that a teammate, and no stranger, has such a track at t: the longer unconfirmed, the less."""
        if not self.weak or math.isnan(self._begun_t):
            return 0.0
        return LOG_WEAK - min(max(t - self._begun_t - WEAK_FREE_S, 0.0) * WEAK_PER_S, WEAK_MOST)

    def grow(self, n: int) -> None:
        """Compare n teammates from now on."""
        more = n - self.n
        if more <= 0:
            return
        size, size_log = _no_size(more)
        self.size = np.concatenate([self.size, size], axis=1)
        self.size_log = np.concatenate([self.size_log, size_log], axis=1)
        self._at = np.concatenate([self._at, np.full(more, -math.inf)])
        self._camera_at = np.concatenate([self._camera_at, np.zeros((more, 3))])
        self._expected = np.concatenate([self._expected, np.zeros(more, bool)])
        self._sized = np.concatenate([self._sized, np.zeros(more, bool)])
        self.faint = np.append(self.faint, np.full(more, math.nan))
        for segment in self.segments:
            segment.sum = np.concatenate([segment.sum, np.zeros((more, _WIDTH))])
            segment.deviation.grow(n)
        self.strangers.grow(n)
        self.n = n

    def forget(self, column: int) -> None:
        """What was said of a teammate counts no more: it is another life."""
        self.size[:, [column]], self.size_log[:, [column]] = _no_size(1)
        self._at[column], self._expected[column], self._sized[column] = -math.inf, False, False
        self.faint[column] = math.nan
        self.strangers.restart(column)
        for segment in self.segments:
            segment.sum[column] = 0.0
            segment.deviation.restart(column)

    def carry(self, column: int, log_ratio: float, t: float, *, by_place: float) -> None:
        """What was said of a teammate until t is a log ratio, whatever its frame; by_place: how much of it motion does
        not say. Of the segments the likeliest is left: in what was before the others, the old frame speaks."""
        now = self.segments[self.likeliest_segment]
        now.since, now.log_handover, now.past, now.weight = -math.inf, 0.0, None, 1.0
        self.segments, self.whole = [now], None
        self.forget(column)
        self.fade_to(t)
        self.segments[0].sum[column, [_LOG, _BY_PLACE]] = log_ratio, by_place
        self._at[column], self._sized[column] = t, True

    def may_return(self, drone_id: int, since: float) -> bool:
        """Whether this track begins after `since` [s], when one was seen last that may have been that drone; only the
        first time."""
        is_first = drone_id not in self._returned
        self._returned.add(drone_id)
        return is_first and self._begun_t > since

    def remove(self, column: int) -> None:
        """A teammate is compared no more."""
        self.unheard, self.faint = None, np.delete(self.faint, column)
        self.size, self.size_log = np.delete(self.size, column, 1), np.delete(self.size_log, column, 1)
        self._at, self._camera_at = np.delete(self._at, column), np.delete(self._camera_at, column, 0)
        self._expected, self._sized = np.delete(self._expected, column), np.delete(self._sized, column)
        for segment in self.segments:
            segment.sum = np.delete(segment.sum, column, 0)
            segment.deviation.remove(column)
            if segment.past is not None:
                of, was = segment.past.column, segment.past.column == column
                segment.past = segment.past._replace(
                    column=np.where(was, COLUMN_OF_NOBODY, of - (of > column))
                )
        self.strangers.remove(column)
        self.n -= 1

    def turn(self, to_old: Array, rotation: Array) -> None:
        """The axes of the own rays have turned: rotation (3, 3) takes directions along, to_old (8, 8) z back."""
        for segment in self.segments:
            M = segment.sum[:, _M].reshape(-1, 8, 8)
            segment.sum[:, _M] = (to_old.T @ M @ to_old).reshape(-1, 64)
            segment.sum[:, _DISTANCE] = segment.sum[:, _DISTANCE] @ to_old
            segment.deviation.turn(to_old, rotation)
        self.size = to_old.T @ self.size @ to_old
        self.strangers.turn(rotation)

    def fade_to(self, t: float) -> None:
        """On to a bearing at t [s]: what was said fades as more is said."""
        if t > self.t:
            for segment in self.segments:
                segment.sum *= fading(t - self.t) if math.isfinite(self.t) else 1.0
            self.t = t

    # --- bearings ---

    def is_due(self, bearing: Bearing, columns: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Which teammates a bearing is to be compared with. What one says itself of where it was replaces where it was
        last seen."""
        for column in columns[self._expected[columns]].tolist():
            self.forget(column)
        return np.asarray(bearing.t - self._at[columns] > _LEAST_STEP_S)

    def last_compared(self, columns: NDArray[np.intp]) -> tuple[Array, Array]:
        """When each of some teammates was compared with last [s], and where the camera (n, 3) was then, m."""
        return self._at[columns], self._camera_at[columns]

    def has_compared(self, bearing: Bearing, columns: NDArray[np.intp]) -> None:
        """It was compared with some teammates."""
        self._at[columns], self._camera_at[columns] = bearing.t, bearing.camera
        if math.isnan(self._begun_t):
            self._begun_t = bearing.t

    def wake(self, columns: NDArray[np.intp]) -> None:
        """Look at these teammates again, however far they were."""
        self.faint[columns] = math.nan

    def is_unsized(self, columns: NDArray[np.intp]) -> NDArray[np.bool_]:
        """With which teammates no box has been compared yet: of many, all err alike, and the first counts."""
        return np.asarray(~self._sized[columns])

    def add_size(self, columns: NDArray[np.intp], size: Array, log: Array) -> None:
        """A box was compared with some teammates: matrices (r, m, 8, 8) by distance, and log weights (r, m)."""
        self.size[:, columns], self.size_log[:, columns] = size, log
        self._sized[columns] = True

    def expect(self, bearing: Bearing, column: int, log_density: float) -> None:
        """Compare the first bearing with where a teammate was seen that says nothing: its log density, per sr."""
        self.fade_to(bearing.t)
        seen = [(self.strangers, np.array([column]))]
        filters = StrangerFilters.joined(seen)
        filters.predict_and_update(
            bearing.direction[None],
            dt=np.zeros(1),
            parallax=np.zeros((1, 3)),
            variance=np.array([bearing.variance]),
            least=np.zeros(1),
            distance=np.array([bearing.distance]),
        )
        filters.return_to(seen)
        self.segments[0].sum[column, _LOG] += log_density
        self.has_compared(bearing, np.array([column]))
        self._expected[column] = True

    def hold_back(self, columns: Sequence[int], log_ratio: Array | float) -> None:
        """Take a log ratio from what speaks for each of some teammates."""
        for segment in self.segments:
            segment.sum[columns, _LOG] -= log_ratio

    # --- segments ---

    @property
    def likeliest_segment(self) -> int:
        """Its index."""
        return max(range(len(self.segments)), key=lambda s: self.segments[s].weight)

    def watch(self, t: float, passed: float, missed: float, gap_px: float) -> bool:
        """It was detected at t, so many s after the last scan, `missed` s after it was missed first, and gap_px from
        the next track. Returns whether it was missed for so long that a segment has begun."""
        if self.whole is None:
            return False
        self._hazard += HANDOVER_PER_S * passed + HANDOVER_MISSED_PER_S * missed
        self._hazard += HANDOVER_MET if gap_px < TRACKS_MEET_PX else 0.0
        is_back = missed > SEGMENT_MISSED_S and t - self._newest_since > SEGMENT_AFTER_MISS_S
        if is_back:
            self._go_over(t)
        return is_back

    def begin_due_segment(self) -> None:
        """After some time it may be another, from the last compared bearing on: all that is compared is its past."""
        if self.whole is not None and self.t - self._newest_since >= SEGMENT_LEAST_S:
            self._go_over(math.nextafter(self.t, math.inf))

    @property
    def since(self) -> Array:
        """(s,) s: when its segments began."""
        return np.array([self._begun_t, *(segment.since for segment in self.segments[1:])])

    @property
    def _newest_since(self) -> float:
        newest = self.segments[-1].since
        return newest if math.isfinite(newest) else self._begun_t

    def _go_over(self, t: float) -> None:
        """From t on it may be another, by all that has happened to it since the last such time."""
        assert self.whole is not None
        log_handover = math.log(min(max(self._hazard, HANDOVER_LEAST), HANDOVER_MOST))
        self._hazard = 0.0
        # What sleeping components would make of it is not known, so they gain nothing by it.
        log = np.zeros(len(self.whole))
        log[self._learned] = self.whole[self._learned]
        self.begin_segment(t, log_handover, log)

    def begin_segment(self, t: float, log_handover: float, log: Array) -> None:
        """From t on it may be another; log (k,): evidence of all until then. Of too many segments the least likely is
        dropped."""
        if len(self.segments) > SEGMENTS_KEPT:
            del self.segments[min(range(1, len(self.segments)), key=lambda s: self.segments[s].weight)]
        self.segments.append(
            TrackSegment(
                t,
                np.zeros((self.n, _WIDTH)),
                DeviationFilters(self.n),
                log_handover,
                Past.unknown(log),
                self.t,
            )
        )

    @property
    def waits(self) -> bool:
        """Whether no bearing of the newest segment has been compared yet: only what was before it."""
        return self.segments[-1].past is not None and self.t < self.segments[-1].since

    def begin_waiting_on(self, past: Past, used: NDArray[np.intp]) -> Past:
        """past: of all before the newest segment, by the components used. Returns the same with its prior."""
        newest = self.segments[-1]
        assert newest.past is not None
        for every, value in zip(newest.past, past, strict=True):
            every[used] = value
        newest.past_t = self.t
        return past._replace(
            log=newest.log_handover + past.log, log_other=newest.log_handover + past.log_other
        )

    def weigh_segments(self, weight: Array) -> None:
        """weight (s,): how likely it is that the present target is that since then."""
        for segment, one in zip(self.segments, weight.tolist(), strict=True):
            segment.weight = one

    # --- what is said ---

    def told(self) -> Told:
        """What bearings say of each segment and teammate."""
        sums = np.array([segment.sum for segment in self.segments])
        M = sums[..., _M].reshape(*sums.shape[:2], 8, 8)
        stranger = np.logaddexp.reduce(sums[..., _STRANGER], axis=-1) - math.log(KINDS)
        return Told(
            M,
            sums[..., _LOG] - stranger,
            sums[..., _BY_PLACE],
            self.compared,
            self.size,
            self.size_log,
            sums[..., _DISTANCE],
            sums[..., _COUNT],
        )

    def pasts(self, k: int) -> Past:
        """(s, k): of all before each segment, with its prior."""
        found = []
        for segment in self.segments:
            log, column, other = segment.past or Past.unknown(np.zeros(k))
            faded = 0.0 if segment.past is None else fading(self.t - segment.past_t)
            found.append(
                Past(segment.log_handover + faded * log, column, segment.log_handover + faded * other)
            )
        return Past(*map(np.array, zip(*found, strict=True)))

    def learn(self, whole: Array, used: NDArray[np.intp], k: int) -> None:
        """whole (len(used),): log evidence of all bearings by the components used, of k."""
        if self.whole is None:
            self.whole = np.zeros(k)
        self.whole[used], self._learned = whole, used

    def map_components(self, mapped: Callable[[NDArray[Any]], NDArray[Any]]) -> None:
        """The components are others now: mapped takes (k,) of theirs to (k',)."""
        self.unheard = None
        self.faint[:] = math.nan
        if self.whole is not None:
            self.whole, self._learned = mapped(self.whole), np.zeros(0, int)
        for segment in self.segments:
            if segment.past is not None:
                segment.past = Past(*map(mapped, segment.past))
