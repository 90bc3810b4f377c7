"""What the bearings of one track say of every teammate that it may be.

For each teammate the bearings add up to a matrix M (`evidence.py`), to normalisers, and to the predictive densities of a
stranger (`strangers.py`). All sums fade alike, so what was said since some instant is the sum now less the faded sum of
then: a segment of a track is nothing but the sum at its begin.

A segment is the hypothesis that the track went over to its present target at that instant. What the track said before
speaks for the own errors in any case, whoever it was then.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.team.evidence import design
from swarmtrack.team.priors import (
    BEARINGS_LAST_S,
    BOX_SIZE_SIGMA_LN,
    ROUND_S,
    SEGMENTS_KEPT,
    STRANGER_DISTANCE_RANGE_LN,
)
from swarmtrack.team.strangers import KINDS, StrangerFilters

# Columns of a sum: M, the log normalisers, the stranger's log densities, and how many whole bearings.
_M = slice(0, 64)
_LOG = 64
_STRANGER = slice(65, 65 + KINDS)
_COUNT = 65 + KINDS
_WIDTH = _COUNT + 1
# A bearing so soon after the last is none.
_LEAST_WEIGHT = 0.05


class Bearing(NamedTuple):
    """Of a track in one scan: t [s]; camera (3,) m, team frame; direction (3,), unit vector in the axes of the own
    rays; variance rad²; distance [m] at which a box of `BOX_SPAN_M` looks as large; weak: of a track that is not
    confirmed yet."""

    t: float
    camera: Array
    direction: Array
    variance: float
    distance: float
    weak: bool = False


@dataclass(slots=True)
class Segment:
    """since [s]; before (n, …): the sums then, None for the first; log_handover: log prior that it began there; base
    (k,): log evidence of all that was before, by component."""

    since: float
    before: Array | None = None
    log_handover: float = 0.0
    base: Array | None = None
    weight: float = 1.0


class Told(NamedTuple):
    """By segment and teammate: M (s, n, 8, 8), log normalisers less the stranger's density (s, n), and whether there
    was any bearing (n,)."""

    M: Array
    log: Array
    known: Array


def fading(dt: float) -> float:
    """What is left after dt [s] of what bearings said."""
    return math.exp(-dt / BEARINGS_LAST_S)


@dataclass(slots=True, eq=False)
class TrackEvidence:
    """n teammates are compared with the track; more of them may be added at any time."""

    n: int
    camera: int
    segments: list[Segment] = field(default_factory=lambda: [Segment(-math.inf)])
    t: float = -math.inf
    sum: Array = field(init=False)
    size: Array = field(init=False)
    """(n, 8, 8): of the last box's size."""
    size_log: Array = field(init=False)
    strangers: StrangerFilters = field(init=False)
    begun: float = math.nan
    weak: bool = False
    """Whether the tracker has not confirmed it yet."""
    hazard: float = 0.0
    """The probability that it went over to another target and no segment began."""
    _at: Array = field(init=False)
    """(n,) s: the last bearing of each."""
    _camera_at: Array = field(init=False)

    def __post_init__(self) -> None:
        n, self.n = self.n, 0
        self.sum = np.zeros((0, _WIDTH))
        self.size, self.size_log = np.zeros((0, 8, 8)), np.zeros(0)
        self.strangers = StrangerFilters(0)
        self._at, self._camera_at = np.zeros(0), np.zeros((0, 3))
        self.grow(n)

    @property
    def compared(self) -> NDArray[np.bool_]:
        """(n,): the teammates that it was compared with at least once."""
        return np.isfinite(self._at)

    def grow(self, n: int) -> None:
        """Compare n teammates from now on."""
        more = n - self.n
        if more <= 0:
            return
        self.sum = np.concatenate([self.sum, np.zeros((more, _WIDTH))])
        self.size = np.concatenate([self.size, np.zeros((more, 8, 8))])
        self.size_log = np.concatenate([self.size_log, np.zeros(more)])
        self._at = np.concatenate([self._at, np.full(more, -math.inf)])
        self._camera_at = np.concatenate([self._camera_at, np.zeros((more, 3))])
        for segment in self.segments:
            if segment.before is not None:
                segment.before = np.concatenate([segment.before, np.zeros((more, _WIDTH))])
        self.strangers.grow(n)
        self.n = n

    def forget(self, column: int) -> None:
        """What was said of a teammate counts no more: it is another life."""
        self.sum[column] = 0.0
        self.size[column], self.size_log[column] = 0.0, 0.0
        self._at[column] = -math.inf
        self.strangers.restart(column)
        for segment in self.segments:
            if segment.before is not None:
                segment.before[column] = 0.0

    def remove(self, column: int) -> None:
        """A teammate is compared no more."""
        self.sum, self.size = np.delete(self.sum, column, 0), np.delete(self.size, column, 0)
        self.size_log, self._at = np.delete(self.size_log, column), np.delete(self._at, column)
        self._camera_at = np.delete(self._camera_at, column, 0)
        for segment in self.segments:
            if segment.before is not None:
                segment.before = np.delete(segment.before, column, 0)
        self.strangers.remove(column)
        self.n -= 1

    def turn(self, to_old: Array, rotation: Array) -> None:
        """The axes of the own rays have turned: rotation (3, 3) takes directions along, to_old (8, 8) z back."""
        for sums in (self.sum, *(s.before for s in self.segments if s.before is not None)):
            M = sums[:, _M].reshape(-1, 8, 8)
            sums[:, _M] = (to_old.T @ M @ to_old).reshape(-1, 64)
        self.size = to_old.T @ self.size @ to_old
        self.strangers.turn(rotation)

    def fade(self, t: float) -> None:
        """On to t [s], where that is later."""
        if t > self.t:
            self.sum *= fading(t - self.t) if math.isfinite(self.t) else 1.0
            self.t = t

    def add(
        self,
        bearing: Bearing,
        columns: NDArray[np.intp],
        place: Array,
        own_way: Array,
        place_sigma: Array,
        log_span: Array,
        span_variance: Array,
    ) -> None:
        """Compare a bearing with some teammates; it may be a second or two old.

        place (m, 3) m: of each then, from where it says it started; own_way (3,) m: of the camera, from the own start;
        place_sigma (m,) m; log_span, span_variance (m,): its size as a share of `BOX_SPAN_M`, ln, and its variance.
        """
        self.fade(bearing.t)
        j = columns
        dt = bearing.t - self._at[j]
        weight = np.clip(dt / ROUND_S, 0.0, 1.0)
        counts = weight > _LEAST_WEIGHT
        if not counts.any():
            return
        j, dt, weight, place = j[counts], dt[counts], weight[counts], place[counts]
        place_sigma, log_span = place_sigma[counts], log_span[counts]
        rho = np.full(len(j), bearing.distance)
        across = bearing.variance * rho**2 + place_sigma**2
        G = design(place, own_way)
        along = bearing.direction @ G
        M = (G.swapaxes(1, 2) @ G - along[:, :, None] * along[:, None, :]) / across[:, None, None]
        said = np.empty((len(j), _WIDTH))
        said[:, _M] = M.reshape(-1, 64)
        said[:, _LOG] = 2.0 * np.log(rho) - np.log(2.0 * math.pi * across)
        said[:, _COUNT] = 1.0
        first = ~np.isfinite(dt)
        moved = np.where(first[:, None], 0.0, bearing.camera - self._camera_at[j])
        parallax = -(moved - (moved @ bearing.direction)[:, None] * bearing.direction) / rho[:, None]
        said[:, _STRANGER] = self.strangers.predict_and_update(
            j, bearing.direction, np.where(first, 0.0, dt), parallax, across / rho**2, rho, weight
        )
        said *= weight[:, None]
        self.sum[j] += said
        for segment in self.segments:
            if segment.before is not None and bearing.t < segment.since:
                segment.before[j] += said
        self._at[j], self._camera_at[j] = bearing.t, bearing.camera
        self._add_size(j, along, bearing.distance * np.exp(log_span), span_variance[counts] + BOX_SIZE_SIGMA_LN**2)
        if math.isnan(self.begun):
            self.begun = bearing.t

    def _add_size(self, j: Array, along: Array, rho: Array, variance: Array) -> None:
        """A box says how far its drone is, once it has settled; of many, all err alike, and one counts."""
        settled = (self.sum[j, _COUNT] > 0.9) & (self.size_log[j] == 0.0)
        j, along, rho, variance = j[settled], along[settled], rho[settled], variance[settled]
        residual = along.copy()
        residual[:, 4] -= rho
        self.size[j] = residual[:, :, None] * residual[:, None, :] / (variance * rho**2)[:, None, None]
        self.size_log[j] = math.log(STRANGER_DISTANCE_RANGE_LN) - 0.5 * np.log(2.0 * math.pi * variance)

    def begin_segment(self, t: float, log_handover: float, base: Array) -> None:
        """From t on it may be another; base (k,): log evidence of all until then."""
        self.fade(t)
        self.segments.append(Segment(t, self.sum.copy(), log_handover, base))
        later = range(len(self.segments) - 1)
        if len(self.segments) > SEGMENTS_KEPT + 1:
            dropped = min(later, key=lambda s: self.segments[s].weight)
            del self.segments[dropped]

    def told(self, t: float) -> Told:
        """What bearings say at t of each segment and teammate."""
        self.fade(t)
        since = [
            self.sum if s.before is None else self.sum - fading(t - s.since) * s.before for s in self.segments
        ]
        sums = np.array(since)
        M = sums[..., _M].reshape(*sums.shape[:2], 8, 8) + self.size
        stranger = np.logaddexp.reduce(sums[..., _STRANGER], axis=-1) - math.log(KINDS)
        whole = np.array([s.before is None for s in self.segments])[:, None]
        log = sums[..., _LOG] + whole * self.size_log - stranger
        return Told(M, log, self.compared)

    def base(self, segment: Segment, k: int, t: float) -> Array:
        """(k,) log evidence of all before a segment, with its prior."""
        if segment.base is None:
            return np.full(k, segment.log_handover)
        return np.asarray(segment.log_handover + fading(t - segment.since) * segment.base)
