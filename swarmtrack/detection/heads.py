"""Decoding: from a network's outputs to candidates in pixels of its input.

A head is a function; to add one, write it and its line in `HEADS`. Models name theirs in their metadata.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from swarmtrack.detection.model import Metadata
from swarmtrack.errors import ModelError
from swarmtrack.messages import Array

Output = NDArray[Any]

LARGEST = 2000.0  # px: a size beyond this is nonsense, and its exponential may overflow


class Candidates(NamedTuple):
    """Best first. centre (n, 2) and size (n, 2) in pixels of the network's input, score (n,) in 0…1."""

    centre: Array
    size: Array
    score: Array


Head = Callable[[Sequence[Output], Metadata, float], Candidates]
"""(outputs of the net for one image, its metadata, least score) → candidates, which may still overlap."""


def centernet(outputs: Sequence[Output], metadata: Metadata, threshold: float) -> Candidates:
    """Peaks of a heat map (1, 1, h, w), with offset and log size (1, 2, h, w) read at the peak.

    Zhou, Wang & Krähenbühl, Objects as Points (2019), section 4.1. Cell i looks at pixel i · stride, the offset is in
    cells from there, the size is the natural logarithm of cells.
    """
    shapes = [output.shape for output in outputs]
    h, w = shapes[0][-2:] if shapes and len(shapes[0]) == 4 else (0, 0)
    if shapes != [(1, 1, h, w), (1, 2, h, w), (1, 2, h, w)]:
        raise ModelError(
            f"head centernet: outputs have shapes {shapes}, expected heat (1, 1, h, w), offset and size (1, 2, h, w)"
        )
    heat = np.ascontiguousarray(outputs[0][0, 0], np.float32)
    offset, log_size = outputs[1][0], outputs[2][0]
    is_peak = (heat >= cv2.dilate(heat, np.ones((3, 3), np.uint8))) & (heat >= threshold)
    rows, columns = np.nonzero(is_peak)
    best_first = np.argsort(-heat[rows, columns], kind="stable")
    rows, columns = rows[best_first], columns[best_first]
    cells = np.stack([columns, rows], axis=1) + offset[:, rows, columns].T
    log_largest = np.log(LARGEST / metadata.stride)
    size = np.exp(np.clip(log_size[:, rows, columns].T, -log_largest, log_largest)) * metadata.stride
    return Candidates(
        np.asarray(cells * metadata.stride, float), np.asarray(size, float), heat[rows, columns].astype(float)
    )


HEADS: dict[str, Head] = {
    "centernet": centernet,
}


def suppress(candidates: Candidates, *, limit: int, iou: float = 0.55, distance: float = 0.3) -> Candidates:
    """Keep the best of those that mean the same drone, and at most `limit`.

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
    return Candidates(centre[kept], size[kept], candidates.score[kept])
