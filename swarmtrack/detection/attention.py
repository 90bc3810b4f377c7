"""Attention windows: the parts of the next frame that the detector looks at, chosen for pixels on target.

A net that sees the whole frame shrunk sees a far drone as a few pixels, and misses it; one that sees it at full
resolution is slow. So: small windows around what is tracked, at the frame's own resolution or enlarged, in every
frame; the whole frame now and then; and one tile of it after the other at full resolution, for what is new and far.
Every track lies in a window of every frame, so not to be detected means the same as with whole frames.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array

# Times a box: its surroundings belong to what a net knows drones by.
ATTENTION_MARGIN = 1.5
# px, of a box not known yet.
UNKNOWN_SIZE = 24.0
# px: a box nearer to a window's edge, where the image goes on, is that of half a drone.
CUT = 2.0
# px: sides of a window's input are multiples of this, so that few different ones occur.
FOVEA_STEP = 32


class Window(NamedTuple):
    """A part of the image, px, and the input px per image px."""

    x: int
    y: int
    width: int
    height: int
    scale: float

    @property
    def area(self) -> int:
        return self.width * self.height

    def cuts(self, centre: Array, size: Array, image: tuple[int, int]) -> NDArray[np.bool_]:
        """Whether boxes (n, 2), (n, 2) px of the image touch an edge of the window that is not the image's: (n,)."""
        low, high = centre - size / 2, centre + size / 2
        edges = np.array([self.x, self.y]), np.array([self.x + self.width, self.y + self.height]) - 1
        inner = np.array([self.x > 0, self.y > 0]), edges[1] < np.array(image) - 1
        before = inner[0] & (low < edges[0] + CUT)
        behind = inner[1] & (high > edges[1] - CUT)
        return np.asarray((before | behind).any(axis=1))


@dataclass(frozen=True, slots=True, kw_only=True)
class AttentionParameters:
    """whole_every: frames, from one that is seen as a whole to the next; target_px: side of a drone in the net's input
    that windows are enlarged for, by up to most_enlarged; fovea_px: least side of a window's input; most_windows: in
    one frame, around tracks; tiles: whether to look through the frame in tiles of tile_px."""

    whole_every: int = 5
    target_px: float = 48.0
    most_enlarged: float = 3.0
    fovea_px: int = 128
    largest_px: int = 320
    most_windows: int = 6
    tiles: bool = True
    tile_px: int = 256


class TimeShare:
    """Keeps looking within a share of the time: what a look took is paid back before there is time for more.

    The time is the camera's, so a frame that was skipped is no loss; what is saved beyond a second is not kept.
    """

    MOST_S = 1.0

    def __init__(self, share: float) -> None:
        self._share = share
        self._saved = 0.0
        self._t: float | None = None

    def comes_to(self, t: float) -> bool:
        """A frame was exposed at t [s]: whether there is time for more than what has to be."""
        if self._t is not None:
            earned = self._share * max(t - self._t, 0.0)
            self._saved = min(self._saved + earned, self._share * self.MOST_S)
        self._t = t
        return self._share >= 1.0 or self._saved > 0.0

    def spend(self, seconds: float) -> None:
        """What a look took, as far as it can be paid back within a second."""
        self._saved = max(self._saved - seconds, -self._share * self.MOST_S)


class AttentionWindows:
    """The parts of each frame that are shown to the net.

    whole_scale: of the whole frame in the net's input; fixed: (width, height) px of the only input the net takes, in
    which case every window has its proportions.
    """

    def __init__(self, parameters: AttentionParameters, fixed: tuple[int, int] | None = None) -> None:
        self._parameters = parameters
        self._fixed = fixed
        self._frame = itertools.count()
        self._tiles: Iterator[Window] = iter(())
        self._tiled: tuple[int, int] = (0, 0)

    def next(
        self, image: tuple[int, int], whole_scale: float, boxes: Array, *, has_time: bool = True
    ) -> list[Window]:
        """image (width, height) px; boxes (n, 6) px of the tracks in it: centre, half of what their centres' place is
        uncertain by (3σ), size (NaN: unknown). The first frame, and any without tracks, is seen as a whole. has_time:
        for a tile."""
        whole = Window(0, 0, *image, whole_scale)
        due = next(self._frame) % self._parameters.whole_every == 0
        near = self._around(image, boxes)
        crowded = len(near) > self._parameters.most_windows
        if crowded or (whole_scale >= 1.0 and sum(_cost(window) for window in near) >= _cost(whole)):
            return [whole, *near[: self._parameters.most_windows]]
        windows = [whole, *near] if due or not near else near
        if self._parameters.tiles and whole_scale < 1.0 and has_time:
            windows.append(self._next_tile(image))
        return windows

    def _around(self, image: tuple[int, int], boxes: Array) -> list[Window]:
        """Windows for tracks, those that would overlap most made one."""
        parameters = self._parameters
        size = np.where(np.isfinite(boxes[:, 4:6]), boxes[:, 4:6], UNKNOWN_SIZE)
        half = ATTENTION_MARGIN * size / 2 + boxes[:, 2:4]
        regions = np.concatenate([boxes[:, :2] - half, boxes[:, :2] + half], axis=1)
        scale = np.clip(parameters.target_px / size.max(axis=1, initial=1.0), 1.0, parameters.most_enlarged)
        inside = ((regions[:, 2:] > 0) & (regions[:, :2] < np.array(image) - 1)).all(axis=1)
        pairs = list(zip(regions[inside].tolist(), scale[inside].tolist(), strict=True))
        return [self._window(image, region, s) for region, s in _joined(pairs, self._least_side())]

    def _least_side(self) -> float:
        return float(self._parameters.fovea_px if self._fixed is None else min(self._fixed))

    def _window(self, image: tuple[int, int], region: Sequence[float], scale: float) -> Window:
        """Around a region [left, top, right, bottom], moved into the image where it would stand out of it."""
        parameters = self._parameters
        needed = [region[2] - region[0], region[3] - region[1]]
        if self._fixed is not None:
            scale = min(scale, *(side / need for side, need in zip(self._fixed, needed, strict=True)))
            sides = [math.ceil(side / scale) for side in self._fixed]
        else:
            scale = min(scale, parameters.largest_px / max(needed))
            inputs = [
                max(parameters.fovea_px, FOVEA_STEP * math.ceil(need * scale / FOVEA_STEP)) for need in needed
            ]
            sides = [math.ceil(side / scale) for side in inputs]
        placed = []
        for axis in (0, 1):
            side = min(sides[axis], image[axis])
            middle = (region[axis] + region[axis + 2]) / 2
            placed.append((min(max(round(middle - side / 2), 0), image[axis] - side), side))
        (x, width), (y, height) = placed
        return Window(x, y, width, height, scale)

    def _next_tile(self, image: tuple[int, int]) -> Window:
        if image != self._tiled:
            self._tiles, self._tiled = itertools.cycle(tiles(image, self._tile())), image
        return next(self._tiles)

    def _tile(self) -> tuple[int, int]:
        return (self._parameters.tile_px, self._parameters.tile_px) if self._fixed is None else self._fixed


def tiles(image: tuple[int, int], tile: tuple[int, int]) -> list[Window]:
    """The image in windows of full resolution that overlap by an eighth at least, rows from above."""
    starts = []
    for side, part in zip(image, tile, strict=True):
        count = max(1, math.ceil((side - part / 8) / (part * 7 / 8)))
        last = max(side - part, 0)
        starts.append([round(last * i / max(count - 1, 1)) for i in range(count)])
    width, height = (min(side, part) for side, part in zip(image, tile, strict=True))
    return [Window(x, y, width, height, 1.0) for y in starts[1] for x in starts[0]]


def coverage(windows: Sequence[Window], image: tuple[int, int]) -> float:
    """Share of the image that they show, by counting cells of 8 px."""
    shown = np.zeros((math.ceil(image[1] / 8), math.ceil(image[0] / 8)), np.bool_)
    for window in windows:
        rows = slice(window.y // 8, math.ceil((window.y + window.height) / 8))
        shown[rows, window.x // 8 : math.ceil((window.x + window.width) / 8)] = True
    return float(shown.mean())


def _cost(window: Window) -> float:
    return window.area * window.scale**2


def _joined(pairs: list[tuple[list[float], float]], least: float) -> list[tuple[list[float], float]]:
    """Regions with their scales; two become one while that costs no more pixels of input than both."""

    def cost(region: Sequence[float], scale: float) -> float:
        sides = (max((region[axis + 2] - region[axis]) * scale, least) for axis in (0, 1))
        return math.prod(sides)

    merged = True
    while merged:
        merged = False
        for (i, (a, s)), (j, (b, t)) in itertools.combinations(enumerate(pairs), 2):
            both = [min(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), max(a[3], b[3])]
            if cost(both, max(s, t)) <= cost(a, s) + cost(b, t):
                pairs = [pair for k, pair in enumerate(pairs) if k not in (i, j)] + [(both, max(s, t))]
                merged = True
                break
    return pairs
