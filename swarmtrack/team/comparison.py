"""One scan's bearings compared with where teammates say that they are: all tracks and teammates at once.

Each pair adds to its track's sums (`track_evidence.py`) the innovation of its bearing (`deviation.py`), by segment, and
the density that a stranger's would have had (`strangers.py`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.team.deviation import Deviation, DeviationFilters
from swarmtrack.team.priors import (
    BOX_SIZE_SIGMA_LN,
    DISTANCE_SHARE,
    DISTANCE_STEP_LN,
    STRANGER_DISTANCE_RANGE_LN,
)
from swarmtrack.team.rows import runs
from swarmtrack.team.strangers import StrangerFilters
from swarmtrack.team.track_evidence import BOX_DISTANCES, Bearing, TrackEvidence, TrackSegment, sums_of

# ln: distances beside the one that a box says; and of a target whose place is known.
_DISTANCES = DISTANCE_STEP_LN * BOX_DISTANCES
_DISTANCES_OF_NEAR = np.where(_DISTANCES < 0.0, math.nan, _DISTANCES)


class Compared(NamedTuple):
    """m teammates at the time of a scan.

    columns (m,): where they stand; design (m, 3, 8): `evidence.design` of where each says that it was; deviation: how
    far it may be from there; log_span, span_variance (m,): size as a share of `BOX_SPAN_M`, ln, and its variance;
    log_there (m,): log prior that it is about there at all; farthest (m,) m: beyond that it can hardly be, by what it
    says; within [m]: the least and the largest distance at which one of them says that it is; team_span: size of the
    team's drones as a share of `BOX_SPAN_M`, as learned so far.
    """

    columns: NDArray[np.intp]
    design: Array
    deviation: Deviation
    log_span: Array
    span_variance: Array
    is_near: NDArray[np.bool_]
    log_there: Array
    farthest: Array
    within: tuple[float, float]
    team_span: float

    def only(self, chosen: NDArray[np.intp]) -> Compared:
        """Some of them."""
        return Compared(
            self.columns[chosen],
            self.design[chosen],
            Deviation(*(of[chosen] for of in self.deviation)),
            self.log_span[chosen],
            self.span_variance[chosen],
            self.is_near[chosen],
            self.log_there[chosen],
            self.farthest[chosen],
            self.within,
            self.team_span,
        )


class ComparedTrack(NamedTuple):
    """A track, its bearing, and the teammates, by their indices, that it is to be compared with."""

    track: TrackEvidence
    bearing: Bearing
    mates: NDArray[np.intp]


class _Pairs(NamedTuple):
    """All pairs of some tracks' bearings and teammates, one track after the other.

    by_track: by track, its pairs; columns: by track, where its teammates stand; direction (n, 3): of bearings; rho (n,)
    m: the distance at which errors are compared; deviation: all white errors of the bearing included.
    """

    by_track: Sequence[slice]
    columns: Sequence[NDArray[np.intp]]
    mates: Compared
    direction: Array
    rho: Array
    deviation: Deviation

    @classmethod
    def of_all(cls, due: Sequence[ComparedTrack], mates: Compared) -> _Pairs:
        """Every track with its own of the teammates."""
        counts = [len(one.mates) for one in due]
        by_track, of = runs(counts), np.repeat(np.arange(len(due)), counts)
        mates = mates.only(np.concatenate([one.mates for one in due]))
        bearings = [one.bearing for one in due]
        box, variance, lasting = np.array([(b.distance, b.variance, b.lasting) for b in bearings])[of].T
        # All errors are compared at one distance, the box's, within those at which teammates are stated to be; of one
        # that can hardly be so far away, at its farthest.
        rho = np.minimum(np.clip(mates.team_span * box, *mates.within), mates.farthest)
        white = variance * rho**2 + mates.deviation.white
        return cls(
            by_track,
            [mates.columns[rows] for rows in by_track],
            mates,
            np.array([bearing.direction for bearing in bearings])[of],
            rho,
            Deviation(np.hypot(mates.deviation.sigma, lasting * rho), mates.deviation.bandwidth, white),
        )

    def of_tracks(self, tracks: Iterable[int]) -> NDArray[np.intp]:
        """The pairs of some tracks, one after the other."""
        return np.concatenate([np.arange(self.by_track[i].start, self.by_track[i].stop) for i in tracks])


def compare(pairs: Sequence[ComparedTrack], mates: Compared) -> None:
    """Compare bearings of one scan, which may be a second or two old, with teammates."""
    due = [
        one._replace(mates=one.mates[one.track.is_due(one.bearing, mates.columns[one.mates])])
        for one in pairs
    ]
    due = [one for one in due if one.mates.size]
    if not due:
        return
    for track, bearing, _ in due:
        track.fade_to(bearing.t)
    these, t = _Pairs.of_all(due, mates), due[0].bearing.t
    G = these.mates.design
    along = (these.direction[:, None] @ G)[:, 0]
    across = G - these.direction[:, :, None] * along[:, None]
    segments = [
        (i, segment) for i, one in enumerate(due) for segment in one.track.segments if t >= segment.since
    ]
    at = these.of_tracks(i for i, _ in segments)
    left, S = _innovations(segments, at, these, across, t)
    # What the whole track says of a pair: its first segment comes last here, and stays.
    least = np.empty(len(these.rho))
    least[at[::-1]] = S[::-1]
    density = _stranger_densities(due, these, least / these.rho**2)
    M = left.swapaxes(1, 2) @ left / S[:, None, None]
    log = (these.mates.log_there + 2.0 * np.log(these.rho))[at] - np.log(2.0 * math.pi * S)
    said = sums_of(M, log, density[at], (along / these.rho[:, None])[at])
    for (i, segment), rows in zip(segments, runs(len(these.columns[i]) for i, _ in segments), strict=True):
        segment.add(these.columns[i], said[rows])
    for (track, bearing, _), columns, rows in zip(due, these.columns, these.by_track, strict=True):
        track.has_compared(bearing, columns)
        fresh = rows.start + np.flatnonzero(track.is_unsized(columns))
        if fresh.size:
            of_fresh = these.mates.only(fresh)
            track.add_size(
                of_fresh.columns, *_by_size(of_fresh, along[fresh], bearing.distance, these.rho[fresh])
            )


def _innovations(
    segments: Sequence[tuple[int, TrackSegment]],
    at: NDArray[np.intp],
    pairs: _Pairs,
    across: Array,
    t: float,
) -> tuple[Array, Array]:
    """`DeviationFilters.innovations` of segments, each with its track's index; at: their pairs, one segment after the
    other."""
    parts = [(segment.deviation, pairs.columns[i]) for i, segment in segments]
    filters = DeviationFilters.joined(parts)
    deviation = Deviation(*(each[at] for each in pairs.deviation))
    found = filters.innovations(across[at], pairs.direction[at], t, deviation)
    filters.return_to(parts)
    return found


def _stranger_densities(due: Sequence[ComparedTrack], pairs: _Pairs, least: Array) -> Array:
    """(n, KINDS): log predictive densities of the bearings, if they are of strangers. least (n,) rad²: of any."""
    t, camera = due[0].bearing.t, due[0].bearing.camera
    before = [one.track.last_compared(columns) for one, columns in zip(due, pairs.columns, strict=True)]
    last_t, last_camera = np.concatenate([t for t, _ in before]), np.concatenate([at for _, at in before])
    first = ~np.isfinite(last_t)
    moved = np.where(first[:, None], 0.0, camera - last_camera)
    across = moved - (moved * pairs.direction).sum(axis=1)[:, None] * pairs.direction
    parts = [(one.track.strangers, columns) for one, columns in zip(due, pairs.columns, strict=True)]
    filters = StrangerFilters.joined(parts)
    found = filters.predict_and_update(
        pairs.direction,
        dt=np.where(first, 0.0, t - last_t),
        parallax=-across / pairs.rho[:, None],
        variance=pairs.deviation.white / pairs.rho**2,
        least=least,
        distance=pairs.rho,
    )
    filters.return_to(parts)
    return found


def _by_size(mates: Compared, along: Array, box: float, compared_at: Array) -> tuple[Array, Array]:
    """A box says how far its drone is: matrices (r, m, 8, 8), by distance, and log weights (r, m). along (m, 8):
    distances, of z; box [m]: the distance that it says. Its error is one of the distance's logarithm: a mixture of
    Gaussians of the distance."""
    variance = mates.span_variance + BOX_SIZE_SIGMA_LN**2
    # A place that is known at least within metres is at no small share of what the box says.
    steps = np.where(mates.is_near, _DISTANCES_OF_NEAR[:, None], _DISTANCES[:, None])
    distance = box * np.exp(mates.log_span + steps)
    residual = np.repeat(along[None], len(steps), axis=0)
    residual[..., 4] -= distance
    size = residual[..., :, None] * residual[..., None, :]
    size /= ((DISTANCE_SHARE * distance) ** 2)[..., None, None]
    weight = np.exp(-0.5 * steps**2 / variance)
    log = np.log(weight / np.nansum(weight, axis=0))
    log += math.log(STRANGER_DISTANCE_RANGE_LN / (DISTANCE_SHARE * math.sqrt(2.0 * math.pi)))
    # The first bearing's density, per sr, was worked out at one distance for all.
    log += 2.0 * np.log(np.minimum(np.clip(distance, *mates.within), mates.farthest) / compared_at)
    return np.nan_to_num(size), np.where(np.isnan(steps), -np.inf, log)
