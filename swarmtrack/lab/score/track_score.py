"""How well tracks follow known targets: error, swaps, losses; and where nobody told the starts, what was found when.

Two judges. `score_named` is for tracks that were started on known targets: a track stays with the target that it
started on, so after a swap its error is the distance between two targets. `score_found` is for tracks that began by
themselves: they are matched to the targets scan by scan, pairs of the scan before first (Bernardin & Stiefelhagen,
"Evaluating multiple object tracking performance: the CLEAR MOT metrics", 2008).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from swarmtrack.messages import Array

FAR_TRACK_PX = 20.0
"""A track further than this from a target is not on it. The paper's drones hover 60 px apart at the end."""


class NamedScore(NamedTuple):
    """squared_error (k,) px²: mean over targets at each scan; swapped, lost (n,): at the end."""

    rmse_px: float
    squared_error: Array
    swapped: NDArray[np.bool_]
    lost: NDArray[np.bool_]


def score_named(truth: Array, estimate: Array) -> NamedScore:
    """truth, estimate (k, n, 2) px: of target i and of the track that was started on it, NaN where the track is gone.

    * RMSE: root of the mean over targets and scans of the squared 2-D error. A track that is gone is taken to stay
      where it was last: dropping a target must not be cheaper than following it badly.
    * swapped: at the end the track is further than FAR_TRACK_PX from its own target, and not from another.
    * lost: at the end the track is gone, or further than FAR_TRACK_PX from every target.
    """
    squared = ((_held(estimate) - truth) ** 2).sum(axis=2)
    distance = np.linalg.norm(estimate[-1][:, None] - truth[-1][None], axis=2)
    near = distance <= FAR_TRACK_PX  # NaN is not near
    own = near.diagonal()
    return NamedScore(
        math.sqrt(float(squared.mean())), squared.mean(axis=1), ~own & near.any(axis=1), ~near.any(axis=1)
    )


def _held(estimate: Array) -> Array:
    """With the last known position where there is none; the first must be known."""
    held = estimate.copy()
    for before, now in pairwise(held):
        gone = np.isnan(now[:, 0])
        now[gone] = before[gone]
    return held


class StatedTracks(NamedTuple):
    """The tracks of one scan that are not tentative. id (m,); position (m, 2) px; sure (m,): confirmed, not lost."""

    id: NDArray[np.int64]
    position: Array
    sure: NDArray[np.bool_]


class FoundScore(NamedTuple):
    """rmse_px: of the matched; tracked: share of (target, scan) that are matched; switches: a target is matched to
    another track than last time; false_tracks: once confirmed and never matched in their life; find_s: for each
    target from its first scan to its first match with a confirmed track, infinite where that never came; drop_s: for
    each target that left and was tracked in its last scan, from there to the first scan without that track,
    infinite where it outlived the recording; untracked_at_end: present targets without a track in the last scan;
    squared_error (k,) px²: mean over the matched of each scan, NaN where none is.
    """

    rmse_px: float
    tracked: float
    switches: int
    false_tracks: int
    find_s: tuple[float, ...]
    drop_s: tuple[float, ...]
    untracked_at_end: int
    squared_error: Array


def score_found(t: Array, truth: Array, claims: Sequence[StatedTracks]) -> FoundScore:
    """t (k,) s; truth (k, n, 2) px, NaN where a target is absent; claims: of each scan."""
    n = truth.shape[1]
    holder: dict[int, int] = {}  # target: the track matched last
    pairs: dict[int, int] = {}
    found_at = np.full(n, np.inf)
    matched_ever: set[int] = set()
    sure_ever: set[int] = set()
    squared_sum, hits, switches = 0.0, 0, 0
    per_scan = np.full(len(t), np.nan)
    in_scan: list[dict[int, int]] = []
    for k, claim in enumerate(claims):
        pairs, distance = _match(truth[k], claim, pairs)
        in_scan.append(pairs)
        sure = set(claim.id[claim.sure].tolist())
        sure_ever |= sure
        matched_ever |= set(pairs.values())
        for target, track in pairs.items():
            switches += holder.get(target, track) != track
            holder[target] = track
            if track in sure:
                found_at[target] = min(found_at[target], t[k])
        if distance:
            per_scan[k] = float(np.mean(np.square(distance)))
            squared_sum += float(np.sum(np.square(distance)))
            hits += len(distance)
    present = np.isfinite(truth[:, :, 0])
    seen = present.any(axis=0)
    first = present.argmax(axis=0)
    last = len(t) - 1 - present[::-1].argmax(axis=0)
    drop = [
        _drop_time(t, claims, int(last[i]), in_scan[last[i]][i])
        for i in np.flatnonzero(seen & (last < len(t) - 1))
        if i in in_scan[last[i]]
    ]
    return FoundScore(
        rmse_px=math.sqrt(squared_sum / hits) if hits else math.nan,
        tracked=hits / max(int(present.sum()), 1),
        switches=switches,
        false_tracks=len(sure_ever - matched_ever),
        find_s=tuple(float(found_at[i] - t[first[i]]) for i in np.flatnonzero(seen)),
        drop_s=tuple(drop),
        untracked_at_end=int(present[-1].sum()) - len(in_scan[-1]) if in_scan else 0,
        squared_error=per_scan,
    )


def _match(truth: Array, claim: StatedTracks, before: dict[int, int]) -> tuple[dict[int, int], list[float]]:
    """{target: track id} of one scan and their distances [px]: pairs of the scan before, then as many as possible."""
    distance = np.linalg.norm(truth[:, None] - claim.position[None], axis=2)
    allowed = distance <= FAR_TRACK_PX
    columns = {int(track): j for j, track in enumerate(claim.id)}
    chosen = {
        target: columns[track]
        for target, track in before.items()
        if track in columns and allowed[target, columns[track]]
    }
    rest = allowed.copy()
    rest[list(chosen)] = False
    rest[:, list(chosen.values())] = False
    # One pair outweighs any sum of distances, so that none is given up for a closer other one.
    rows, picks = linear_sum_assignment(np.where(rest, distance, FAR_TRACK_PX * (1 + len(truth))))
    chosen |= {int(i): int(j) for i, j in zip(rows, picks, strict=True) if rest[i, j]}
    pairs = {target: int(claim.id[column]) for target, column in chosen.items()}
    return pairs, [float(distance[target, column]) for target, column in chosen.items()]


def _drop_time(t: Array, claims: Sequence[StatedTracks], last: int, track: int) -> float:
    for k in range(last + 1, len(t)):
        if track not in claims[k].id:
            return float(t[k] - t[last])
    return math.inf
