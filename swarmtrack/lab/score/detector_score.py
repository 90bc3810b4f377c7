"""How well a detector's detections fit the labels of images.

A detection hits a drone if its centre lies within max(6 px, half the longer side of the label) of the label's centre:
people draw boxes 1.2 to 2 times as large as the drone they see, so overlap measures their habit. AP at IoU 0.5 is
reported beside it. Each label can be hit once, best score first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array, Detections

EMPTY = np.empty((0, 4))


class ScoredImage(NamedTuple):
    """What was found in one image, and what is there: drones (n, 4), distractors (m, 4): boxes (u, v, w, h) px; kinds:
    what each distractor is."""

    found: Detections
    drones: Array
    distractors: Array = EMPTY
    kinds: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Matches:
    """All detections of a set of images, best first. hit (n,) bool; error (n,) px of hits, NaN of others; side (n,) px:
    the longer one of the label that was hit, NaN of others; sides (drones,) px: of all labels."""

    score: Array
    hit: NDArray[np.bool_]
    error: Array
    side: Array
    sides: Array
    images: int

    @property
    def drones(self) -> int:
        return len(self.sides)

    def threshold_of(self, recall: float) -> float:
        """The highest score at which at least this share of the drones is found; 0 where it never is."""
        found = np.cumsum(self.hit) >= recall * self.drones
        return float(self.score[found.argmax()]) if found.any() else 0.0

    def recall_at(self, false_per_image: float) -> float:
        """Share of drones found at the threshold that lets through this many false detections per image."""
        allowed = np.cumsum(~self.hit) <= false_per_image * self.images
        return float((self.hit & allowed).sum() / max(self.drones, 1))

    def average_precision(self) -> float:
        """Area under the precision envelope, 101 recalls (COCO)."""
        if not self.hit.any():
            return 0.0
        recall = np.cumsum(self.hit) / self.drones
        precision = np.cumsum(self.hit) / np.arange(1, len(self.hit) + 1)
        envelope = np.maximum.accumulate(precision[::-1])[::-1]
        at = np.searchsorted(recall, np.linspace(0, 1, 101))
        return float(np.append(envelope, 0.0)[np.minimum(at, len(envelope))].mean())


Quality = Callable[[Array, Array], Array]
"""(one detection (4,), labels (m, 4)) → how well it fits each (m,), above zero where it hits."""


def by_centre(detection: Array, labels: Array) -> Array:
    distance = np.hypot(*(labels[:, :2] - detection[:2]).T)
    return np.asarray(1 - distance / np.maximum(6.0, labels[:, 2:].max(axis=1) / 2))


def by_overlap(detection: Array, labels: Array) -> Array:
    apart = np.abs(labels[:, :2] - detection[:2])
    small = np.minimum(labels[:, 2:], detection[2:])
    common = np.clip((labels[:, 2:] + detection[2:]) / 2 - apart, 0, small).prod(axis=1)
    return np.asarray(common / (labels[:, 2:].prod(axis=1) + detection[2:].prod() - common) - 0.5)


def match(looks: Sequence[ScoredImage], quality: Quality) -> Matches:
    """Give each detection, best first, the free label of its image that fits it best."""
    rows: list[tuple[float, bool, float, float]] = []
    for look in looks:
        found, free = look.found, look.drones.copy()
        for i in np.argsort(-found.score, kind="stable"):
            detection = np.concatenate([found.centre[i], found.size[i]])
            fit = quality(detection, free) if len(free) else np.zeros(0)
            hit = fit.size > 0 and bool(fit.max() > 0)
            error = side = np.nan
            if hit:
                best = int(fit.argmax())
                error = float(np.hypot(*(free[best, :2] - detection[:2])))
                side = float(free[best, 2:].max())
                free = np.delete(free, best, axis=0)
            rows.append((float(found.score[i]), hit, error, side))
    rows.sort(key=lambda row: -row[0])
    columns = np.array(rows, float).reshape(-1, 4).T
    sides = [look.drones[:, 2:].max(axis=1) for look in looks if len(look.drones)]
    return Matches(
        columns[0],
        columns[1].astype(np.bool_),
        columns[2],
        columns[3],
        np.concatenate(sides) if sides else np.empty(0),
        len(looks),
    )


def summary(looks: Sequence[ScoredImage], threshold: float) -> dict[str, Any]:
    """The numbers of one set of images, as JSON."""
    centre, overlap = match(looks, by_centre), match(looks, by_overlap)
    shown = centre.score >= threshold
    hits, false = int((centre.hit & shown).sum()), int((~centre.hit & shown).sum())
    errors = centre.error[centre.hit & shown]
    return {
        "images": centre.images,
        "drones": centre.drones,
        "centre_ap": round(centre.average_precision(), 4),
        "ap50": round(overlap.average_precision(), 4),
        "recall_1fppi": round(centre.recall_at(1.0), 4),
        "recall_01fppi": round(centre.recall_at(0.1), 4),
        "threshold": round(threshold, 4),
        "recall": round(hits / max(centre.drones, 1), 4),
        "precision": round(hits / max(hits + false, 1), 4),
        "false_per_image": round(false / max(centre.images, 1), 4),
        "centre_error_median_px": round(float(np.median(errors)), 3) if errors.size else None,
        "centre_error_p90_px": round(float(np.percentile(errors, 90)), 3) if errors.size else None,
    }


SIZES = (
    0.0,
    16.0,
    24.0,
    32.0,
    48.0,
    64.0,
    96.0,
    float("inf"),
)  # px, borders of the bins that recall is told for


class OfSize(NamedTuple):
    """Drones whose label's longer side is in [low, high) px."""

    low: float
    high: float
    drones: int
    recall: float


def by_size(matches: Matches, threshold: float) -> list[OfSize]:
    """Recall at a threshold for each of the bins that hold a drone."""
    hit = matches.side[matches.hit & (matches.score >= threshold)]
    bins = []
    for low, high in pairwise(SIZES):
        there = int(((matches.sides >= low) & (matches.sides < high)).sum())
        if there:
            bins.append(OfSize(low, high, there, float(((hit >= low) & (hit < high)).sum()) / there))
    return bins


def fired_on(looks: Sequence[ScoredImage], threshold: float) -> dict[str, tuple[int, int]]:
    """By kind of distractor: how many of them are taken for a drone, and how many there are. `anything`: images without
    a drone in which there is any detection, and such images."""
    fired: dict[str, tuple[int, int]] = {}

    def count(kind: str, yes: bool) -> None:
        before = fired.get(kind, (0, 0))
        fired[kind] = before[0] + yes, before[1] + 1

    for look in looks:
        shown = look.found.score >= threshold
        centre, size = look.found.centre[shown], look.found.size[shown]
        detections = np.concatenate([centre, size], axis=1)
        for box, kind in zip(look.distractors, look.kinds, strict=True):
            count(kind, any(by_centre(detection, box[None])[0] > 0 for detection in detections))
        if not len(look.drones):
            count("anything", bool(shown.any()))
    return fired
