"""Labelled sequences for `bench mot`, and the detections that all its trackers are given.

Annotations of drones seen from a flying drone, `Video_*_gt.txt` of the repository
jingliinpurdue/Fast-and-Robust-UAV-to-UAV-Detection-and-Tracking (BSD-3-Clause), have boxes, but no identities. They are
linked by these rules. Frame by frame each identity goes on at its last velocity, and takes the nearest box, one to
one, within `LINK_SIDES` of its longer side or `LINK_LEAST_PX`, times the frames since it was seen. A box of more than
`LINK_AREA` times the area, or less, is another's. An identity that was not seen for `LINK_GAP` frames has ended; what
is left over begins one.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from swarmtrack.benchmarks.report import BenchmarkError
from swarmtrack.lab.score.clip_score import TruthBoxes
from swarmtrack.messages import Array
from swarmtrack.training.labelled_clips import drone_clips, read_truth

ANNOTATED_HZ, ANNOTATED_SIZE = 30.0, (1920, 1080)
LINK_SIDES, LINK_LEAST_PX, LINK_AREA, LINK_GAP = 1.5, 20.0, 4.0, 15
FRAME_LINE = re.compile(r"time_layer:\s*(\d+)\s+detections:(.*)")
BOX = re.compile(r"\(([^)]*)\)")
NOBODY = TruthBoxes(np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2)))


class LabelledSequence(NamedTuple):
    """frames: the labelled boxes of each, at hz; size: (width, height) px."""

    name: str
    frames: list[TruthBoxes]
    hz: float
    size: tuple[int, int]

    def every(self, step: int) -> LabelledSequence:
        """Each step-th frame."""
        return self._replace(frames=self.frames[::step], hz=self.hz / step)


class DetectedFrame(NamedTuple):
    """centre (m, 2) px, size (m, 2) px, score (m,)."""

    centre: Array
    size: Array
    score: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Faults:
    """Of a detector: misses; noise of centre and size, px and as a share of the side; false boxes per frame; and scores
    of true and false ones, as beta distributions."""

    p_detection: float = 0.9
    sigma_px: float = 1.0
    sigma_side: float = 0.05
    clutter: float = 0.3
    true_score: tuple[float, float] = (8.0, 2.0)
    false_score: tuple[float, float] = (3.0, 4.0)


def clip_sequences(data: Path) -> list[LabelledSequence]:
    """Our clips, with the identities of their labels."""
    found = []
    for clip in drone_clips(data):
        truth = read_truth(clip.truth)
        frames = [truth.get(k, NOBODY) for k in range(clip.frames)]
        found.append(LabelledSequence(clip.name, frames, clip.fps, (clip.width, clip.height)))
    return found


def annotated_sequences(folder: Path) -> list[LabelledSequence]:
    """Every `Video_*_gt.txt` of a folder, by number, linked. Raises BenchmarkError where there is none."""
    files = sorted(folder.glob("Video_*_gt.txt"), key=lambda path: int(path.stem.split("_")[1]))
    if not files:
        raise BenchmarkError(
            f"{folder}: no Video_*_gt.txt, expected the repository's Data/Annotation_update_180925"
        )
    return [
        LabelledSequence(
            path.stem.removesuffix("_gt"), linked(read_annotation(path)), ANNOTATED_HZ, ANNOTATED_SIZE
        )
        for path in files
    ]


def read_annotation(path: Path) -> list[Array]:
    """(n, 4) px of each frame: y1, x1, y2, x2; nothing in frames without a line. Raises BenchmarkError, with the line,
    for what is none."""
    frames: list[Array] = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        match = FRAME_LINE.fullmatch(line.strip())
        try:
            if match is None or int(match[1]) <= len(frames):
                raise ValueError("no frame, or one that was before")
            frames += [np.empty((0, 4))] * (int(match[1]) - 1 - len(frames))
            rows = [[float(value) for value in box.split(",")] for box in BOX.findall(match[2])]
            frames.append(np.array(rows).reshape(len(rows), 4))
        except ValueError as error:
            expected = f'expected "time_layer: {len(frames) + 1} detections: (y1, x1, y2, x2), …"'
            raise BenchmarkError(f"{path}:{number}: found {line[:40]!r} ({error}), {expected}") from error
    return frames


def linked(frames: Sequence[Array]) -> list[TruthBoxes]:
    """Boxes (n, 4) of each frame with identities, by the rules above."""
    alive: dict[int, _Identity] = {}
    found, begun = [], 0
    for k, corners in enumerate(frames):
        centre, size = (
            0.5 * (corners[:, [1, 0]] + corners[:, [3, 2]]),
            corners[:, [3, 2]] - corners[:, [1, 0]],
        )
        alive = {id: one for id, one in alive.items() if k - one.seen <= LINK_GAP}
        ids = np.full(len(centre), -1, np.int64)
        names = list(alive)
        rows, columns = _nearest([alive[name] for name in names], k, centre, size)
        for row, column in zip(rows, columns, strict=True):
            ids[column] = names[row]
        for column in np.flatnonzero(ids < 0):
            ids[column], begun = begun, begun + 1
        for column, name in enumerate(ids.tolist()):
            before = alive.get(name)
            velocity = np.zeros(2) if before is None else (centre[column] - before.centre) / (k - before.seen)
            alive[name] = _Identity(k, centre[column], size[column], velocity)
        found.append(TruthBoxes(ids, centre, size))
    return found


class _Identity(NamedTuple):
    seen: int
    centre: Array
    size: Array
    velocity: Array


def _nearest(known: list[_Identity], k: int, centre: Array, size: Array) -> tuple[Array, Array]:
    """Rows of those that are known, and columns of their boxes in frame k."""
    cost = np.full((len(known), len(centre)), np.inf)
    for row, one in enumerate(known):
        frames = k - one.seen
        distance = np.linalg.norm(centre - one.centre - frames * one.velocity, axis=1)
        reach = max(LINK_SIDES * one.size.max(), LINK_LEAST_PX) * frames
        larger = size.prod(axis=1) / one.size.prod()
        same = (distance < reach) & (larger < LINK_AREA) & (larger > 1.0 / LINK_AREA)
        cost[row, same] = distance[same]
    rows, columns = linear_sum_assignment(np.where(np.isfinite(cost), cost, 1e9))
    good = np.isfinite(cost[rows, columns])
    return rows[good], columns[good]


def detected(sequence: LabelledSequence, faults: Faults, rng: np.random.Generator) -> list[DetectedFrame]:
    """What a detector with these faults finds in each frame, best first."""
    sizes = np.concatenate([frame.size for frame in sequence.frames])
    found = []
    for frame in sequence.frames:
        seen = rng.random(len(frame.id)) < faults.p_detection
        size, n = frame.size[seen], int(seen.sum())
        sigma = faults.sigma_px + faults.sigma_side * size
        centre = frame.centre[seen] + sigma * rng.standard_normal((n, 2))
        size = size * np.exp(faults.sigma_side * rng.standard_normal((n, 2)))
        m = int(rng.poisson(faults.clutter)) if len(sizes) else 0
        score = np.concatenate([rng.beta(*faults.true_score, n), rng.beta(*faults.false_score, m)])
        centre = np.concatenate([centre, rng.uniform((0.0, 0.0), sequence.size, (m, 2))])
        size = np.concatenate([size, sizes[rng.integers(len(sizes), size=m)] if m else np.empty((0, 2))])
        order = np.argsort(-score, kind="stable")
        found.append(DetectedFrame(centre[order], size[order], score[order]))
    return found
