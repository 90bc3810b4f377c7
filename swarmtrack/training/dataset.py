"""Training samples: real frames, real cut-outs on other backgrounds, and procedural pictures, mixed by a recipe.

Boxes are (u, v, w, h) with (u, v) the centre, pixel centres at integers.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from swarmtrack.training import render
from swarmtrack.training.labelled_images import Boxes, LabelledFrame
from swarmtrack.training.render import FloatImage, Rng, Sprite

STRIDE = 4  # px: of the cells in which the net answers


@dataclass(frozen=True, slots=True)
class Recipe:
    """What a batch is made of. Fractions are chances per sample; sizes are the longer side of what is visible, px.

    Few real frames on purpose: an earlier net with 40 % did worse on other scenes than one with none (single runs, of
    different lengths: a hint, not a measurement).
    """

    crop: int = 160  # px, side of a sample: a multiple of 32, the coarsest stride
    real_frame: float = 0.14  # a crop of a frame with its labelled drones
    real_background: float = 0.56  # a crop from anywhere, all in it kept, objects added
    drone_free: float = 0.75  # of the real backgrounds: from a frame without drones
    of_clips: float = 0.6  # of these, where there are clips: from one of their windows around a distractor
    real_cutout: float = 0.35  # of the drones added to a background: cut from a photograph instead of drawn
    size_min: float = 5.0
    size_max: float = 150.0
    empty: float = 0.3  # of the backgrounds: no drone is added
    canvas: int = render.CANVAS  # px, in which drones are drawn before they are scaled
    close_up: float = 0.15  # of the batches: fewer and larger crops, with drones as near as they come

    def of_close_ups(self) -> Recipe:
        """Crops of twice the side. Photographs here show no drone that near: what is drawn must teach it."""
        return replace(
            self,
            crop=2 * self.crop,
            size_min=self.size_max / 4,
            size_max=2 * self.size_max,
            canvas=2 * self.canvas,
            real_frame=0.0,
            real_cutout=0.1,
        )


def data_hash(frames: Sequence[LabelledFrame]) -> str:
    """SHA-256 over names, pixels and boxes: which data a model saw, to the bit."""
    digest = hashlib.sha256()
    for frame in sorted(frames, key=lambda frame: frame.name):
        digest.update(frame.name.encode())
        for part in (frame.image, frame.drones.round(3), frame.distractors.round(3)):
            digest.update(np.ascontiguousarray(part).tobytes())
    return digest.hexdigest()


class CutOut(NamedTuple):
    """A photographed object without its background. tight, label (4,): the box that is visible, and the one it had."""

    sprite: Sprite
    tight: NDArray[np.float64]
    label: NDArray[np.float64]


def cut_out(image: NDArray[np.uint8], box: NDArray[np.float64]) -> CutOut | None:
    """Separate an object from a smooth background (sky); None where the background is not smooth.

    The background is a quadratic surface fitted to the rim around the label. What differs from it is the object:
    with alpha = |difference| / contrast and the residue as its colour, pasting the sprite back gives the photograph.
    """
    u, v, w, h = box
    half = np.array([w, h]) * 0.75 + 4
    middle = np.array([u, v])
    x0, y0 = np.round(middle - half).astype(int)
    x1, y1 = np.round(middle + half).astype(int) + 1
    if x0 < 0 or y0 < 0 or x1 > image.shape[1] or y1 > image.shape[0]:
        return None
    patch = image[y0:y1, x0:x1].astype(np.float64)
    ys, xs = np.mgrid[0 : patch.shape[0], 0 : patch.shape[1]]
    xs, ys = (xs + x0 - u) / half[0], (ys + y0 - v) / half[1]
    rim = (np.abs(xs) > w / 2 / half[0]) | (np.abs(ys) > h / 2 / half[1])
    basis = np.stack([np.ones_like(xs), xs, ys, xs * xs, xs * ys, ys * ys], axis=-1)
    surface = np.linalg.lstsq(basis[rim], patch[rim], rcond=None)[0]
    sky = basis @ surface
    difference = np.linalg.norm(patch - sky, axis=2)
    noise, contrast = difference[rim].std() + difference[rim].mean(), np.percentile(difference[~rim], 98)
    if noise > 6 or contrast < 4 * noise or contrast < 15:
        return None
    alpha = np.clip((difference - 1.5 * noise) / (0.5 * contrast), 0, 1)
    colour = np.clip(patch - sky * (1 - alpha[..., None]), 0, 255 * alpha[..., None])
    sprite = Sprite(colour.astype(np.float32), alpha.astype(np.float32))
    solid = (alpha > 0.3) & ~rim
    rows, columns = np.flatnonzero(solid.any(axis=1)), np.flatnonzero(solid.any(axis=0))
    if rows.size < 2 or columns.size < 3:
        return None
    top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
    window = np.s_[top:bottom, left:right]
    tight = np.array([x0 + (left + right - 1) / 2, y0 + (top + bottom - 1) / 2, right - left, bottom - top])
    return CutOut(Sprite(sprite.colour[window], sprite.alpha[window]), tight, np.asarray(box))


class LabelMargin(NamedTuple):
    """How much looser a person's box is than the visible drone: label = factor · tight + pixels, per axis (w, h).

    The constant part fades below the sizes it was fitted on: a drone of 5 px has no box of 25 px.
    """

    factor: NDArray[np.float64]
    pixels: NDArray[np.float64]

    def apply(self, size: NDArray[np.float64]) -> NDArray[np.float64]:
        """size (2,) px of what is visible."""
        return self.factor * size + np.minimum(self.pixels, 1.2 * size)


def fit_margin(cutouts: Sequence[CutOut]) -> LabelMargin:
    """Least squares over the cut-outs; the identity where there are too few to say."""
    if len(cutouts) < 10:
        return LabelMargin(np.array([1.1, 1.1]), np.zeros(2))
    tight, label = (np.array([getattr(c, name)[2:] for c in cutouts]) for name in ("tight", "label"))
    lines = np.array([np.polyfit(tight[:, axis], label[:, axis], 1) for axis in (0, 1)])
    return LabelMargin(np.maximum(lines[:, 0], 1.0), np.clip(lines[:, 1], 0.0, 20.0))


class TrainingSample(NamedTuple):
    """image (crop, crop, 3) BGR uint8; drones (n, 4); doubtful (m, 4): drones one may miss; others (k, 4): what flies
    and is no drone."""

    image: NDArray[np.uint8]
    drones: Boxes
    doubtful: Boxes
    others: Boxes


class SampleSource:
    """Draws endless samples by a recipe. Without frames everything is procedural."""

    BANK = 240  # sprites kept at hand: drawing one takes longer than all the rest of a sample

    def __init__(self, frames: Sequence[LabelledFrame], recipe: Recipe, rng: Rng) -> None:
        self._recipe, self._rng = recipe, rng
        self._with_drones = [frame for frame in frames if len(frame.drones)]
        without = [frame for frame in frames if not len(frame.drones)]
        # Apart: a clip gives many windows that are nearly alike, and they show little but sky.
        self._windows = [frame for frame in without if frame.is_window]
        self._without = [frame for frame in without if not frame.is_window] or self._windows
        drones = [cut_out(frame.image, box) for frame in frames for box in frame.drones]
        others = [cut_out(frame.image, box) for frame in frames for box in frame.distractors]
        self._drones = [cut for cut in drones if cut is not None]
        self._others = [cut for cut in others if cut is not None]
        self.margin = fit_margin(self._drones)
        self._drawn = [render.multirotor(rng, recipe.canvas) for _ in range(self.BANK)]
        names = list(render.DISTRACTORS)
        self._mistaken = [self._draw_distractor(names[i % len(names)]) for i in range(self.BANK // 2)]

    def sample(self) -> TrainingSample:
        rng, recipe = self._rng, self._recipe
        self._refresh()
        kind = rng.random()
        boxes: list[NDArray[np.float64]] = []
        doubtful: list[NDArray[np.float64]] = []
        others: list[NDArray[np.float64]] = []
        if kind < recipe.real_frame and self._with_drones:
            image, boxes, others = self._crop_frame(self._with_drones, around_drones=0.9)
        else:
            if kind < recipe.real_frame + recipe.real_background and self._without:
                image, boxes, others = self._real_background()
            else:
                image = render.background(rng, recipe.crop, recipe.crop)
            for _ in range(int(rng.choice(4, p=[0.3, 0.35, 0.25, 0.1]))):
                self._add_distractor(image, boxes, others)
            if rng.random() >= recipe.empty:
                for _ in range(int(rng.choice([1, 2, 3, 4], p=[0.4, 0.3, 0.2, 0.1]))):
                    box, visible = self._add_drone(image, [*boxes, *doubtful])
                    if box is not None:
                        (boxes if visible else doubtful).append(box)
        labels = [np.array(some).reshape(-1, 4) for some in (boxes, doubtful, others)]
        if rng.random() < 0.5:
            image = np.ascontiguousarray(image[:, ::-1])
            for mirrored in labels:
                mirrored[:, 0] = recipe.crop - 1 - mirrored[:, 0]
        return TrainingSample(render.photograph(rng, image), *labels)

    def _real_background(self) -> tuple[FloatImage, list[NDArray[np.float64]], list[NDArray[np.float64]]]:
        rng, recipe = self._rng, self._recipe
        if self._with_drones and rng.random() >= recipe.drone_free:
            return self._crop_frame(self._with_drones)
        if self._windows and rng.random() < recipe.of_clips:
            return self._crop_frame(self._windows, around_distractors=0.9)
        return self._crop_frame(self._without, around_distractors=0.5)

    def _draw_distractor(self, name: str) -> tuple[Sprite, bool]:
        """One thing that is no drone, and whether it is an object rather than a part of the picture."""
        return render.DISTRACTORS[name](self._rng), name in render.FLYING_DISTRACTORS

    def _refresh(self) -> None:
        if self._rng.random() < 0.1:
            drawn = render.multirotor(self._rng, self._recipe.canvas)
            self._drawn[self._rng.integers(len(self._drawn))] = drawn
        if self._rng.random() < 0.04:
            name = list(render.DISTRACTORS)[self._rng.integers(len(render.DISTRACTORS))]
            self._mistaken[self._rng.integers(len(self._mistaken))] = self._draw_distractor(name)

    def _size(self) -> float:
        """Longer side, log-uniform px: as many halvings of distance between 5 and 10 px as between 75 and 150."""
        return float(np.exp(self._rng.uniform(np.log(self._recipe.size_min), np.log(self._recipe.size_max))))

    def _add_distractor(
        self,
        image: FloatImage,
        drones: Sequence[NDArray[np.float64]],
        others: list[NDArray[np.float64]],
    ) -> None:
        """Draw one thing that is no drone, clear of those that are; an object's box is added to `others`."""
        rng, side = self._rng, self._recipe.crop
        if self._others and rng.random() < 0.45:
            cut = self._others[rng.integers(len(self._others))]
            sprite, size = cut.sprite, float(max(cut.tight[2:]) * np.exp(rng.normal(0, 0.35)))
            flying = True
        else:
            (sprite, flying), size = self._mistaken[rng.integers(len(self._mistaken))], self._size()
        centre = rng.uniform(0, side, 2)
        if _crowded(centre, size, drones, 0.6):
            return
        before = image.copy() if flying else image
        box = render.paste_into(rng, image, sprite, centre, size)
        if flying and box is not None and (centre <= side - 1).all() and _conspicuous(before, image, box):
            box[2:] = self.margin.apply(box[2:])
            others.append(box)

    def _add_drone(
        self, image: FloatImage, present: Sequence[NDArray[np.float64]]
    ) -> tuple[NDArray[np.float64] | None, bool]:
        """Draw one drone, its centre inside, not quite on top of another.

        Returns its labelled box, or None if it did not fit, and whether one can see it.
        """
        rng, recipe = self._rng, self._recipe
        if self._drones and rng.random() < recipe.real_cutout:
            cut = self._drones[rng.integers(len(self._drones))]
            sprite = _repaint(rng, cut.sprite)
            size = float(max(cut.tight[2:]) * np.exp(rng.normal(-0.1, 0.4)))
        else:
            sprite, size = self._drawn[rng.integers(len(self._drawn))], self._size()
        centre = rng.uniform(0, recipe.crop - 1, 2)
        if _crowded(centre, size, present, 0.3):
            return None, False
        before = image.copy()
        box = render.paste_into(rng, image, sprite, centre, size)
        if box is None:
            return None, False
        visible = _conspicuous(before, image, box)
        box[2:] = self.margin.apply(box[2:])
        return box, visible

    def _crop_frame(
        self, frames: Sequence[LabelledFrame], *, around_drones: float = 0.0, around_distractors: float = 0.0
    ) -> tuple[FloatImage, list[NDArray[np.float64]], list[NDArray[np.float64]]]:
        """A crop of one of the frames, the drones and the distractors in it; with the given chance it holds one of
        what is named."""
        rng = self._rng
        frame = frames[int(rng.integers(len(frames)))]
        aims, chance = frame.distractors, around_distractors
        if around_drones:
            aims, chance = frame.drones, around_drones
        aim = aims[rng.integers(len(aims))] if len(aims) and rng.random() < chance else None
        image, zoom, corner = self._crop(frame.image, aim)

        def inside(boxes: Boxes) -> list[NDArray[np.float64]]:
            centre = (boxes[:, :2] - corner + 0.5) * zoom - 0.5
            kept = ((centre >= 0) & (centre <= self._recipe.crop - 1)).all(axis=1)
            return list(np.concatenate([centre, boxes[:, 2:] * zoom], axis=1)[kept])

        return image, inside(frame.drones), inside(frame.distractors)

    def _crop(
        self, image: NDArray[np.uint8], aim: NDArray[np.float64] | None
    ) -> tuple[FloatImage, float, NDArray[np.float64]]:
        """A square of the image, resized to the recipe's; it holds the centre of the box `aim`, if one is given.

        Returns the crop, its zoom, and its top left corner (2,) in the image.
        """
        rng, side = self._rng, self._recipe.crop
        limit = min(image.shape[:2])
        source = int(min(limit, side / np.exp(rng.uniform(np.log(0.5), np.log(1.7)))))
        room = np.array([image.shape[1] - source, image.shape[0] - source])

        def busy(corner: NDArray[np.int64]) -> float:
            """Most of a frame is sky, where drones are easy to see: half the crops are the busiest of four."""
            return float(image[corner[1] : corner[1] + source : 4, corner[0] : corner[0] + source : 4].std())

        if aim is not None:
            corner = np.clip(aim[:2] - rng.uniform(0.08, 0.92, 2) * source, 0, room).astype(int)
        else:
            corner = max((rng.integers(0, room + 1) for _ in range(int(rng.choice([1, 4])))), key=busy)
        x, y = int(corner[0]), int(corner[1])
        how = cv2.INTER_AREA if source > side else cv2.INTER_LINEAR
        crop = cv2.resize(image[y : y + source, x : x + source], (side, side), interpolation=how)
        return crop.astype(np.float32), side / source, np.array([x, y], float)


def _crowded(
    centre: NDArray[np.float64], size: float, present: Sequence[NDArray[np.float64]], share: float
) -> bool:
    """Whether something of `size` px at `centre` would be nearer to a box than `share` of both sizes."""
    return any(np.hypot(*(box[:2] - centre)) < share * (size + max(box[2:])) for box in present)


def _conspicuous(before: FloatImage, after: FloatImage, box: NDArray[np.float64]) -> bool:
    """Whether a drone stands out: by 20 grey levels if it is 20 px large, by more if it is smaller.

    Taught to fire on what cannot be seen, a net fires on faint clouds.
    """
    x0, y0 = np.maximum(box[:2] - box[2:] / 2, 0).astype(int)
    x1, y1 = (box[:2] + box[2:] / 2).astype(int) + 1
    change = np.abs(after[y0:y1, x0:x1] - before[y0:y1, x0:x1]).mean(axis=2)
    return bool(np.percentile(change, 90) * min(max(box[2:]), 20.0) / 20.0 > 20.0)


def _repaint(rng: Rng, sprite: Sprite) -> Sprite:
    """A photographed drone in other light."""
    colour = np.clip(sprite.colour * np.float32(rng.uniform(0.5, 1.5)), 0, 255 * sprite.alpha[..., None])
    return Sprite(colour, sprite.alpha)


class Targets(NamedTuple):
    """What the net should answer, on cells of `stride` px. Cell i looks at pixel i · stride.

    heat (2, h, w) 0…1: of drones, and of what flies and is none; offset (2, h, w): from the cell to the centre, in
    cells; log_size (2, h, w): natural logarithm of width and height in cells; weight (1, h, w): where offset and size
    are defined, in all one per drone.
    """

    heat: FloatImage
    offset: FloatImage
    log_size: FloatImage
    weight: FloatImage


DOUBTFUL_HEAT = (
    0.95  # heat of a doubtful drone: no peak, and by (1 − heat)^4 in the loss hardly punished either
)


def targets(
    boxes: Boxes, side: int, stride: int, doubtful: Boxes | None = None, others: Boxes | None = None
) -> Targets:
    """CenterNet's targets (Zhou, Wang & Krähenbühl 2019, section 3); offset and size are taught around peaks too."""
    n = side // stride
    heat, weight = np.zeros((2, n, n), np.float32), np.zeros((n, n), np.float32)
    offset, log_size = np.zeros((2, n, n), np.float32), np.zeros((2, n, n), np.float32)
    rows, columns = np.mgrid[0:n, 0:n].astype(np.float32)

    def nearest_cell(u: float, v: float) -> tuple[int, int]:
        column, row = np.clip(np.round([u / stride, v / stride]).astype(int), 0, n - 1)
        return int(column), int(row)

    def peak_at(column: float, row: float, sigma: NDArray[np.float64]) -> FloatImage:
        around = ((columns - column) / sigma[0]) ** 2 + ((rows - row) / sigma[1]) ** 2
        return np.asarray(np.exp(-around / 2), np.float32)

    def sharp(w: float, h: float) -> NDArray[np.float64]:
        return np.maximum(0.12 * np.array([w, h]) / stride, 0.55)

    for u, v, w, h in boxes:
        # Around the nearest cell, not the centre itself: the peak must reach exactly one. The widths follow the box.
        column, row = nearest_cell(u, v)
        peak = peak_at(column, row, sharp(w, h))
        around = (np.abs(columns - column) <= 1) & (np.abs(rows - row) <= 1)
        near = around & (peak > np.maximum(heat[0], 0.3)) | ((rows == row) & (columns == column))
        weight[near] = peak[near] / peak[near].sum()
        offset[:, near] = np.stack([u / stride - columns, v / stride - rows])[:, near]
        log_size[:, near] = np.log(np.maximum([w, h], 1) / stride)[:, None]
        heat[0] = np.maximum(heat[0], peak)
    for u, v, w, h in [] if doubtful is None else doubtful:
        bump = peak_at(u / stride, v / stride, np.maximum(0.25 * np.array([w, h]) / stride, 1.0))
        heat[0] = np.maximum(heat[0], np.float32(DOUBTFUL_HEAT) * bump)
    for u, v, w, h in [] if others is None else others:
        heat[1] = np.maximum(heat[1], peak_at(*nearest_cell(u, v), sharp(w, h)))
    return Targets(heat, offset, log_size, weight[None])
