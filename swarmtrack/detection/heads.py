"""Decoding: from a network's outputs to candidates in pixels of its input.

A head is a function; to add one, write it, its line in `READ`, and how it is recognised (`readings.py`). Boxes of
YOLO and DETR count from the edge of the first pixel, ours from its centre: half a pixel lies between.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from swarmtrack.detection.description import Description
from swarmtrack.detection.readings import class_count
from swarmtrack.errors import ModelError
from swarmtrack.messages import Array

Output = NDArray[Any]

LARGEST_BOX_PX = 2000.0  # px: a size beyond this is nonsense, and its exponential may overflow
MOST_HEAD_BOXES = 1000  # candidates that are looked at further: the best
HALF_A_PIXEL = 0.5
SAME_DRONE = 0.5  # of its longer side: centres in two looks at one drone that are nearer


class Candidates(NamedTuple):
    """Candidates, best first. centre (n, 2) and size (n, 2) in pixels of the network's input, score (n,) in 0…1,
    label (n,): class.
    """

    centre: Array
    size: Array
    score: Array
    label: NDArray[np.intp]

    def select(self, rows: NDArray[np.intp] | NDArray[np.bool_] | list[int] | slice) -> Candidates:
        return Candidates(self.centre[rows], self.size[rows], self.score[rows], self.label[rows])


InputSize = tuple[int, int]
Head = Callable[[Sequence[Output], Description, float, InputSize], Candidates]
"""(outputs of the net for one image, its description, least score, (width, height) px of its input) → candidates,
which may still overlap."""


def centernet(outputs: Sequence[Output], net: Description, threshold: float, _: InputSize) -> Candidates:
    """Peaks of a heat map (1, 1, h, w), with offset and log size (1, 2, h, w) read at the peak.

    Zhou, Wang & Krähenbühl, Objects as Points (2019), section 4.1. Cell i looks at pixel i · stride, the offset is in
    cells from there, the size is the natural logarithm of cells.
    """
    heat = np.ascontiguousarray(outputs[0][0, 0], np.float32)
    offset, log_size = outputs[1][0], outputs[2][0]
    is_peak = (heat >= cv2.dilate(heat, np.ones((3, 3), np.uint8))) & (heat >= threshold)
    rows, columns = np.nonzero(is_peak)
    cells = np.stack([columns, rows], axis=1) + offset[:, rows, columns].T
    log_largest = np.log(LARGEST_BOX_PX / net.stride)
    size = np.exp(np.clip(log_size[:, rows, columns].T, -log_largest, log_largest)) * net.stride
    only = np.zeros(len(rows), np.intp)
    return _best_first(cells * net.stride, size, heat[rows, columns], only)


def yolo_v5(outputs: Sequence[Output], _: Description, threshold: float, __: InputSize) -> Candidates:
    """(1, n, 5 + classes): centre, size [px], that there is something, and what it is if so."""
    rows = outputs[0][0]
    rows = rows[rows[:, 4] >= threshold]
    return _of_classes(rows[:, :4], rows[:, 5:] * rows[:, 4:5], threshold)


def yolo_v8(outputs: Sequence[Output], _: Description, threshold: float, __: InputSize) -> Candidates:
    """(1, 4 + classes, n): centre, size [px], and how likely each class is."""
    columns = outputs[0][0]
    rows = columns[:, columns[4:].max(axis=0) >= threshold].T
    return _of_classes(rows[:, :4], rows[:, 4:], threshold)


def end_to_end(outputs: Sequence[Output], _: Description, threshold: float, __: InputSize) -> Candidates:
    """(1, n, 6): two corners [px], score, class; what overlaps is suppressed already."""
    rows = outputs[0][0]
    rows = rows[rows[:, 4] >= threshold]
    low, high = rows[:, :2], rows[:, 2:4]
    return _best_first(0.5 * (low + high) - HALF_A_PIXEL, high - low, rows[:, 4], rows[:, 5].astype(np.intp))


def detr(outputs: Sequence[Output], net: Description, threshold: float, input_size: InputSize) -> Candidates:
    """Boxes (1, n, 4), centre and size as shares of the input, and classes (1, n, c); or both in one (1, n, 4 + c).

    Carion et al. (2020). One class more than the net has names: the last is "nothing" and they exclude each other; else
    each is a matter of its own. What lies within 0…1 already are probabilities, anything else their logits.
    """
    if len(outputs) == 1:
        boxes, told = outputs[0][0, :, :4], outputs[0][0, :, 4:]
    else:
        first, second = outputs[0][0], outputs[1][0]
        boxes, told = (first, second) if first.shape[1] == 4 else (second, first)
    told = told.astype(float)
    if not (told.min(initial=0.0) >= 0.0 and told.max(initial=0.0) <= 1.0):
        if told.shape[1] == len(net.names) + 1:
            told = np.exp(told - told.max(axis=1, keepdims=True))
            told = told[:, :-1] / told.sum(axis=1, keepdims=True)
        else:
            told = 1.0 / (1.0 + np.exp(-np.clip(told, -50.0, 50.0)))
    return _of_classes(boxes * np.tile(np.asarray(input_size, float), 2), told, threshold)


def labelled_boxes(outputs: Sequence[Output], _: Description, threshold: float, __: InputSize) -> Candidates:
    """Corners (1, n, 4) [px], scores (1, n) and classes (1, n); what overlaps is suppressed already."""
    corners, scores, labels = (output[0] for output in outputs)
    kept = scores >= threshold
    low, high = corners[kept, :2], corners[kept, 2:]
    return _best_first(
        0.5 * (low + high) - HALF_A_PIXEL, high - low, scores[kept], labels[kept].astype(np.intp)
    )


READ: dict[str, Head] = {
    "centernet": centernet,
    "yolo_v5": yolo_v5,
    "yolo_v8": yolo_v8,
    "end_to_end": end_to_end,
    "detr": detr,
    "labelled_boxes": labelled_boxes,
}


def read(outputs: Sequence[Output], net: Description, threshold: float, input_size: InputSize) -> Candidates:
    """Candidates that score at least `threshold`, best first; `ModelError` where the outputs are not of the net's
    head.
    """
    outputs = [outputs[i] for i in net.outputs] if net.outputs else outputs
    shapes = [output.shape for output in outputs]
    if class_count(net.head, shapes) is None:
        raise ModelError(f"head {net.head}: outputs have shapes {shapes}, which are not such a net's")
    return READ[net.head](outputs, net, threshold, input_size)


def _of_classes(boxes: Output, scores: Output, threshold: float) -> Candidates:
    """boxes (n, 4) centre and size [px from the edge], scores (n, classes): each box as its likeliest class."""
    label = scores.argmax(axis=1)
    score = scores[np.arange(len(scores)), label]
    kept = score >= threshold
    return _best_first(boxes[kept, :2] - HALF_A_PIXEL, boxes[kept, 2:4], score[kept], label[kept])


def _best_first(centre: Output, size: Output, score: Output, label: NDArray[np.intp]) -> Candidates:
    order = np.argsort(-score, kind="stable")[:MOST_HEAD_BOXES]
    clipped = np.clip(size[order], 0.0, LARGEST_BOX_PX)
    return Candidates(
        centre[order].astype(float), clipped.astype(float), score[order].astype(float), label[order]
    )


def distinct(candidates: Candidates, *, limit: int, iou: float = 0.55, distance: float = 0.3) -> list[int]:
    """Rows of the best of each group of duplicates, at most `limit`.

    Two do if their boxes overlap by more than `iou`, or if their centres are closer than `distance` times the longer
    side of the smaller: boxes of small drones rarely overlap enough when a peak splits in two.
    """
    kept: list[int] = []
    centre, size = candidates.centre, candidates.size
    for i in range(len(candidates.score)):
        if len(kept) == limit:
            break
        apart = np.abs(centre[kept] - centre[i])
        overlap = np.clip((size[kept] + size[i]) / 2 - apart, 0, np.minimum(size[kept], size[i])).prod(axis=1)
        union = size[kept].prod(axis=1) + size[i].prod() - overlap
        near = np.hypot(*apart.T) < distance * np.minimum(size[kept].max(axis=1), size[i].max())
        if not (near | (overlap > iou * union)).any():
            kept.append(i)
    return kept


def suppress(candidates: Candidates, *, limit: int) -> Candidates:
    """Candidates of one look without duplicates."""
    return candidates.select(distinct(candidates, limit=limit))


def together(looks: Sequence[Candidates]) -> Candidates:
    """Candidates of several looks at one image, best first; a drone may appear once per look."""
    columns = (np.concatenate(column) for column in zip(*looks, strict=True))
    found = Candidates(*columns)
    return found.select(np.argsort(-found.score, kind="stable"))


def of_several_looks(found: Candidates, *, limit: int) -> list[int]:
    """Rows of the merged candidates of several looks, each drone once: by the distance of centres rather than by
    boxes, which another resolution makes larger or smaller.
    """
    return distinct(found, limit=limit, distance=SAME_DRONE)
