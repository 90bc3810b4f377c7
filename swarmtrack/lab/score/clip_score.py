"""How well confirmed tracks follow the labelled boxes of a video.

In each frame truths and tracks are matched one to one: as many hits as possible, then the smallest sum of
distances. A *hit* is a track whose position lies within max(6 px, half the longer side of the box) of the box's
centre: the tolerance follows the box because labels are looser than drones, and stops at 6 px because labels of
small drones jitter.

* recall: hits over labelled boxes; precision: hits over confirmed tracks, each counted once a frame.
* identity switch: a labelled object is hit by another track than the one that hit it last. Being found again by the
  same track after a miss is none; Bernardin & Stiefelhagen, "Evaluating multiple object tracking performance: the
  CLEAR MOT metrics" (2008), without their preference for the pairs of the frame before.
* centre RMSE: root of the mean squared distance of the hits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.tracking.association import most_likely_matching

MIN_CLIP_HIT_RADIUS_PX = 6.0  # px


class TruthBoxes(NamedTuple):
    """What is labelled in one frame: id (n,); centre (n, 2) [u, v] px; size (n, 2) [w, h] px."""

    id: NDArray[np.int64]
    centre: Array
    size: Array


class TrackPoints(NamedTuple):
    """What is claimed in one frame, confirmed tracks only: id (m,); centre (m, 2) [u, v] px."""

    id: NDArray[np.int64]
    centre: Array


NO_TRUTH = TruthBoxes(np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2)))
NO_TRACKS = TrackPoints(np.empty(0, np.int64), np.empty((0, 2)))


@dataclass(frozen=True, slots=True)
class ClipScore:
    """Counts, so that the score of several clips is their sum. What divides by zero is NaN."""

    frames: int = 0
    boxes: int = 0
    tracks: int = 0
    hits: int = 0
    switches: int = 0
    squared_error_px2: float = 0.0

    @property
    def recall(self) -> float:
        return self.hits / self.boxes if self.boxes else math.nan

    @property
    def precision(self) -> float:
        return self.hits / self.tracks if self.tracks else math.nan

    @property
    def centre_rmse_px(self) -> float:
        return math.sqrt(self.squared_error_px2 / self.hits) if self.hits else math.nan

    def __add__(self, other: ClipScore) -> ClipScore:
        return ClipScore(
            self.frames + other.frames,
            self.boxes + other.boxes,
            self.tracks + other.tracks,
            self.hits + other.hits,
            self.switches + other.switches,
            self.squared_error_px2 + other.squared_error_px2,
        )


def score_clip(
    truth: Mapping[int, TruthBoxes], tracks: Mapping[int, TrackPoints], frames: range
) -> ClipScore:
    """Score the given frames of a clip. One that is missing in `truth` shows nothing, in `tracks` claims nothing."""
    boxes = claimed = hits = switches = 0
    squared_error = 0.0
    followed_by: dict[int, int] = {}
    for frame in frames:
        labelled, found = truth.get(frame, NO_TRUTH), tracks.get(frame, NO_TRACKS)
        boxes += len(labelled.id)
        claimed += len(found.id)
        rows, columns, distance = match_hits(labelled, found)
        hits += len(rows)
        squared_error += float((distance**2).sum())
        for row, column in zip(rows, columns, strict=True):
            object_id, track_id = int(labelled.id[row]), int(found.id[column])
            switches += followed_by.get(object_id, track_id) != track_id
            followed_by[object_id] = track_id
    return ClipScore(len(frames), boxes, claimed, hits, switches, squared_error)


def match_hits(
    truth: TruthBoxes, tracks: TrackPoints, min_radius: float = MIN_CLIP_HIT_RADIUS_PX
) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """The hits of one frame: rows (k,) of truth, columns (k,) of tracks, distance (k,) px. min_radius: px."""
    distance = np.linalg.norm(truth.centre[:, None] - tracks.centre[None], axis=2)
    radius = np.maximum(min_radius, 0.5 * truth.size.max(axis=1, initial=0.0))
    return match_distances(distance, np.broadcast_to(radius[:, None], distance.shape))


def match_distances(distance: Array, radius: Array) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """As `match_hits`, from the distance of each truth to each track and the radius of a hit, both (n, m) px; inf
    where a track cannot be compared with a truth."""
    allowed = distance <= radius
    # One hit must outweigh any sum of distances, so that a second hit is never given up for a closer first one.
    hit = 1.0 + float(radius.max(axis=1, initial=0.0).sum())
    rows, columns = most_likely_matching(np.where(allowed, hit - distance, -np.inf))
    return rows, columns, distance[rows, columns]
