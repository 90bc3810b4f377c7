"""Motion against the background as evidence for a drone: each frame is compared with one a tenth of a second
earlier.

Theory of operation. The earlier frame is seen through the turn that the gyro measured in between, so that what is far
away lies on itself. Within a candidate's box, by how much did pixels become darker, or brighter (95th percentile of the
grey levels, at least 0)? And around it, where noise, clutter and an imperfect turn change them in the same direction?
The odds of the candidate are multiplied by half the ratio of the two, where that is above one:

    odds' = odds · max(1, ½ (d_in + 2) / (d_around + 2))

Half, because what stands still changes a little, too: a ratio of 1.5 is nothing special for a fence post, and nineteen
drones in twenty have 3 or more. By direction, because a fast drone leaves its place next to its box as brighter as it
makes the new one darker. Odds are never lowered: a drone that hovers before one that hovers stands still, and is none
the less a drone. What the net alone would not have shown must have odds above one to be shown.

`docs/detector.md` says what it brought. The rule was chosen on the clips there, from several that did about as well.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from swarmtrack.detection.expectation import Expectation, PixelMapping
from swarmtrack.detection.heads import Candidates
from swarmtrack.messages import Array, Frame, Image

# Between the frames: long enough for a drone to move, short enough for the gyro.
MOTION_FRAMES_APART_S = 0.09
# After which the light, the clouds and our own place are others.
MOTION_LONGEST_GAP_S = 0.5
# Score from which on a candidate is looked at.
MOTION_LEAST_SCORE = 0.15
# Score that motion must have made of one which the net alone would not have shown.
MOTION_SURE_SCORE = 0.5
# Ratio up to which nothing has moved.
MOTION_STILL_RATIO = 2.0
# Grey levels: of change that is none.
MOTION_GREY_LEVELS = 2.0
# px: half of what is looked at around a candidate, at least and at most.
SIDES = (8, 60)
# px around a box that belong neither to it nor to what is around it.
RIM = 2.0
# px.
BLUR = 1.0
MESH_PX = 32.0
# px: outside of any image.
OUTSIDE_PICTURE_PX = -1e4
# A turn that moves no pixel further is none.
STANDS_PX = 0.05
# Frames: a camera of up to 700 Hz still finds one that is old enough.
MOST_KEPT = 64


class Comparison(NamedTuple):
    """An earlier image, and the positions in it of the directions of a frame's pixels."""

    grey: Image
    pixels_then: PixelMapping


class _Kept(NamedTuple):
    t: float
    grey: Image


class MotionCue:
    """Keeps the necessary part of the last frames."""

    def __init__(self) -> None:
        self._kept: deque[_Kept] = deque(maxlen=MOST_KEPT)

    def compare(self, t: float, expectation: Expectation) -> Comparison | None:
        """The comparison for a frame exposed at t; None where no frame is of the right age, or the rotation in
        between is unknown. Changes nothing.
        """
        earlier = None
        for kept in self._kept:
            if earlier is not None and kept.t > t - MOTION_FRAMES_APART_S:
                break
            earlier = kept
        if earlier is None or not MOTION_FRAMES_APART_S <= t - earlier.t <= MOTION_LONGEST_GAP_S:
            return None
        pixels_then = expectation.pixels_at(earlier.t, t)
        return None if pixels_then is None else Comparison(earlier.grey, pixels_then)

    def weigh(
        self, frame: Frame, found: Candidates, threshold: float | Array, comparison: Comparison | None
    ) -> tuple[NDArray[np.intp], Array]:
        """Which of the candidates score their threshold, one or (n,), or are made sure by motion, best first (rows
        (n,)); and their scores (n,) with the odds of motion. Without a comparison it is all of them, as they are. The
        frame is kept for those to come."""
        grey = _grey(frame.image)
        self._keep(frame.t, grey)
        if comparison is None:
            return np.arange(len(found.score)), found.score
        ratio = np.ones(len(found.score))
        if grey.shape == comparison.grey.shape:  # else the camera has changed its size just now
            then = _moved_into(comparison.grey, grey, comparison.pixels_then)
            changes = [np.asarray(cv2.subtract(*pair), np.uint8) for pair in ((grey, then), (then, grey))]
            boxes = zip(found.centre, found.size, strict=True)
            ratio = np.array([_ratio(changes, *box) for box in boxes])
        odds = found.score / np.maximum(1.0 - found.score, 1e-9) * ratio
        score = np.where(ratio > 1.0, odds / (1.0 + odds), found.score)
        shown = (found.score >= threshold) | (score >= np.maximum(threshold, MOTION_SURE_SCORE))
        order = np.argsort(-score, kind="stable")
        order = order[shown[order]]
        return order, score[order]

    def _keep(self, t: float, grey: Image) -> None:
        """For the frames to come. A clock that went back, or an image of another size, starts again."""
        if self._kept and (t <= self._kept[-1].t or self._kept[-1].grey.shape != grey.shape):
            self._kept.clear()
        self._kept.append(_Kept(t, grey))
        while len(self._kept) > 1 and self._kept[1].t <= t - MOTION_FRAMES_APART_S:
            self._kept.popleft()


def _grey(image: Image) -> Image:
    if image.ndim == 3:
        colour = image.shape[2] > 1
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8) if colour else image[..., 0]
    return np.asarray(cv2.GaussianBlur(image, (0, 0), BLUR), np.uint8)


def _moved_into(then: Image, now: Image, pixels_then: PixelMapping) -> Image:
    """The earlier picture as the camera would have taken it from where it looks now; what it did not see is as now."""
    height, width = now.shape
    # Lens and turn are smooth: a mesh of shifts will do, which OpenCV makes finer.
    columns, rows = np.meshgrid(_mesh(width), _mesh(height))
    mesh = np.stack([columns.ravel(), rows.ravel()], axis=1)
    shifts = pixels_then(mesh) - mesh
    if np.abs(shifts).max() < STANDS_PX:
        return then
    shifts = np.nan_to_num(shifts, nan=OUTSIDE_PICTURE_PX).astype(np.float32)
    u, v = (
        cv2.resize(shift.reshape(columns.shape), (width, height), interpolation=cv2.INTER_LINEAR)
        for shift in shifts.T.copy()
    )
    u += np.arange(width, dtype=np.float32)
    v += np.arange(height, dtype=np.float32)[:, None]
    seen = cv2.remap(then, u, v, cv2.INTER_LINEAR, dst=now.copy(), borderMode=cv2.BORDER_TRANSPARENT)
    return np.asarray(seen, np.uint8)


def _mesh(length: int) -> Array:
    """Pixels that `cv2.resize` makes 0 … length − 1 of: of n cells it takes the middles."""
    n = max(2, round(length / MESH_PX))
    return (np.arange(n) + 0.5) * length / n - 0.5


def _ratio(changes: Sequence[Image], centre: Array, size: Array) -> float:
    """What a candidate's odds are multiplied by. changes [grey levels]: by how much pixels became brighter, and darker;
    none below 0."""
    half = float(np.clip(np.ceil(size.max()), *SIDES))
    best = 1.0
    for change in changes:
        inside = change[_slices(centre, *(size / 2))]
        around = change[_slices(centre, half, half)]
        if not 0 < inside.size < around.size:
            break
        within = _upper(inside, inside.size)
        if (within + MOTION_GREY_LEVELS) / MOTION_GREY_LEVELS / MOTION_STILL_RATIO <= best:
            continue  # whatever happened around it
        around = around.copy()
        corner = np.maximum(np.rint(centre - half), 0.0)
        around[_slices(centre - corner, *(size / 2 + RIM))] = 0
        beside = _upper(around, around.size - inside.size)
        best = max(best, (within + MOTION_GREY_LEVELS) / (beside + MOTION_GREY_LEVELS) / MOTION_STILL_RATIO)
    return best


def _slices(centre: Array, half_width: float, half_height: float) -> tuple[slice, slice]:
    """Rows and columns of an image within so many pixels of a point."""
    (x0, y0), (x1, y1) = (
        np.maximum(np.rint(centre + sign * np.array([half_width, half_height])), 0.0).astype(int)
        for sign in (-1, 1)
    )
    return slice(y0, y1 + 1), slice(x0, x1 + 1)


def _upper(values: Image, count: int) -> int:
    """The 95th percentile of `count` numbers, none below 0, to which zeros were added that make them `values`."""
    rank = max(1, round(0.05 * count))
    return int(np.partition(values, values.size - rank, axis=None)[values.size - rank])
