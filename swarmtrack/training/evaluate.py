"""Accuracy of a detector on labelled images and clips.

A detection hits a drone if its centre lies within max(6 px, half the longer side of the label) of the label's centre:
people draw boxes 1.2 to 2 times as large as the drone they see, so overlap measures their habit. AP at IoU 0.5 is
reported beside it. Each label can be hit once, best score first.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from swarmtrack.detection.detector import Detector
from swarmtrack.messages import Array, Detections, Frame, StampKind
from swarmtrack.training.dataset import Boxes, DataError, held_out, load_frames

LOWEST = 0.02  # score from which on detections count for AP


class Looked(NamedTuple):
    """What was found in one image, and what is there: (n, 4) boxes (u, v, w, h) px."""

    found: Detections
    drones: Boxes


@dataclass(frozen=True, slots=True)
class Matches:
    """All detections of a set of images, best first. hit (n,) bool; error (n,) px of hits, NaN of others."""

    score: Array
    hit: NDArray[np.bool_]
    error: Array
    drones: int
    images: int

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


Quality = Callable[[Array, Boxes], Array]
"""(one detection (4,), labels (m, 4)) → how well it fits each (m,), above zero where it hits."""


def by_centre(detection: Array, labels: Boxes) -> Array:
    distance = np.hypot(*(labels[:, :2] - detection[:2]).T)
    return np.asarray(1 - distance / np.maximum(6.0, labels[:, 2:].max(axis=1) / 2))


def by_overlap(detection: Array, labels: Boxes) -> Array:
    apart = np.abs(labels[:, :2] - detection[:2])
    small = np.minimum(labels[:, 2:], detection[2:])
    common = np.clip((labels[:, 2:] + detection[2:]) / 2 - apart, 0, small).prod(axis=1)
    return np.asarray(common / (labels[:, 2:].prod(axis=1) + detection[2:].prod() - common) - 0.5)


def match(looks: Sequence[Looked], quality: Quality) -> Matches:
    """Give each detection, best first, the free label of its image that fits it best."""
    rows: list[tuple[float, bool, float]] = []
    for found, drones in looks:
        free = drones.copy()
        for i in np.argsort(-found.score, kind="stable"):
            detection = np.concatenate([found.centre[i], found.size[i]])
            fit = quality(detection, free) if len(free) else np.zeros(0)
            hit = fit.size > 0 and bool(fit.max() > 0)
            error = np.nan
            if hit:
                best = int(fit.argmax())
                error = float(np.hypot(*(free[best, :2] - detection[:2])))
                free = np.delete(free, best, axis=0)
            rows.append((float(found.score[i]), hit, error))
    rows.sort(key=lambda row: -row[0])
    score, hit_, error_ = (
        (np.array(column) for column in zip(*rows, strict=True)) if rows else [np.zeros(0)] * 3
    )
    return Matches(score, hit_.astype(bool), error_, sum(len(look.drones) for look in looks), len(looks))


def summary(looks: Sequence[Looked], threshold: float) -> dict[str, Any]:
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


def evaluate(
    model: str | Path,
    data: Path,
    *,
    scenes: Sequence[str] = (),
    held_out_negatives: bool = False,
    threshold: float | None = None,
    input_scale: float = 1.0,
    every: int = 1,
) -> dict[str, Any]:
    """Look at all images and clips under `data`; numbers by scene, by clip and in all."""
    detector = Detector(model, score_threshold=LOWEST, input_scale=input_scale)
    threshold = detector.description.score_threshold if threshold is None else threshold
    report: dict[str, Any] = {"model": str(model), "threshold": threshold, "input_scale": input_scale}
    if (data / "images.csv").is_file():
        by_scene: dict[str, list[Looked]] = {}
        for frame in load_frames(data):
            wanted = not scenes or frame.scene in scenes
            if frame.drones.size == 0 and held_out_negatives:
                wanted = held_out(frame)
            if wanted:
                look = Looked(_detect(detector, frame.image), frame.drones)
                by_scene.setdefault(frame.scene, []).append(look)
        report["images"] = _summaries(by_scene, threshold)
    clips = {
        clip.stem: list(look_at_clip(detector, clip, every)) for clip in sorted(data.glob("tracks/*.mp4"))
    }
    if clips:
        report["clips"] = _summaries(clips, threshold)
    if len(report) == 3:
        raise DataError(f"{data}: neither images.csv nor tracks/*.mp4 is there")
    report["infer_p50_ms"] = round(1e3 * detector.latency.infer.p50, 2)
    return report


def _summaries(sets: dict[str, list[Looked]], threshold: float) -> dict[str, Any]:
    everything = [look for looks in sets.values() for look in looks]
    return {name: summary(looks, threshold) for name, looks in {**sets, "all": everything}.items()}


def _detect(detector: Detector, image: NDArray[np.uint8]) -> Detections:
    seen = detector.detect(Frame(0.0, 0.0, 0, image, StampKind.MEDIA))
    if seen is None:
        raise DataError(detector.status().text)
    return seen


def look_at_clip(detector: Detector, clip: Path, every: int) -> Iterator[Looked]:
    """Frames of NAME.mp4 with the labels of NAME_gt.csv (frame, id, x, y, w, h)."""
    labels: dict[int, list[list[float]]] = {}
    table = clip.with_name(f"{clip.stem}_gt.csv")
    if not table.is_file():
        raise DataError(f"{table}: no such file, expected the labels of {clip.name}")
    with table.open(newline="") as file:
        for row in csv.DictReader(file):
            x, y, w, h = (float(row[key]) for key in ("x", "y", "w", "h"))
            labels.setdefault(int(row["frame"]), []).append([x + w / 2, y + h / 2, w, h])
    video = cv2.VideoCapture(str(clip))
    index = 0
    while True:
        alive, image = video.read()
        if not alive:
            break
        if index % every == 0:
            drones = np.array(labels.get(index, []), float).reshape(-1, 4)
            yield Looked(_detect(detector, np.asarray(image, np.uint8)), drones)
        index += 1
    if index == 0:
        raise DataError(f"{clip}: holds no frame that OpenCV can read")
