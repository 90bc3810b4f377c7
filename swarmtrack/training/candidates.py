"""What a detector takes for drones in labelled pictures, cut out around each: a second stage learns from these.

A detector shows its candidates in whole frames that are shrunk, as they are, or in windows that are enlarged, and its
boxes are tighter there: so it looks at each picture in one of several scales.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.detection.net import Net
from swarmtrack.detection.second_stage import SECOND_STAGE_LEAST_SCORE, SECOND_STAGE_SMALLEST_PX, square
from swarmtrack.lab.score.detector_score import by_centre
from swarmtrack.relative.box_width import BoxWidth
from swarmtrack.training.dataset import TrainingSample, cut_out
from swarmtrack.training.labelled_images import Boxes, LabelledFrame
from swarmtrack.training.simulated_pictures import SIMULATED

DRONE_CLASS, OTHER, DRAWN = "drone", "other", "drawn"
# Scales of the pictures, and how often each is taken.
SCALES = ((1.0, 0.4), (0.5, 0.1), (1.5, 0.15), (2.0, 0.15), (3.0, 0.2))
CANDIDATE_WINDOW_PX = 320  # px of input: side of what is looked at where the scale is above 1
ROOM = 64  # px of the image that are added to it
CANDIDATES_PER_PICTURE = 24  # candidates of a picture
PER_PICTURE = (3, 1)  # that are wrong: the best, and others
SECOND_CANDIDATE_SHARE = (
    0.3  # of its longer side: a second candidate for one drone that is further off than that is wrong
)
KEPT_SIDE_PX = 96  # px: side of what is kept of each
KEPT_AROUND = 2.4  # longer sides of its box that this shows
# Of a quadrotor, over all yaws: the width of what is visible over its span.
OUTLINE = BoxWidth().factor
DRAWN_ROOM = (
    2.1  # of a picture that is drawn, candidates so far from its edges are taken, in longer sides of the box
)


class Candidate(NamedTuple):
    """picture (KEPT_SIDE_PX, KEPT_SIDE_PX, 3) BGR; kind: `DRONE_CLASS`, what else was labelled there, or `OTHER`;
    source: the clip; score: of the detector, 0 for what it overlooked; span: of a drone, px of the picture, NaN if
    unknown.
    """

    picture: NDArray[np.uint8]
    kind: str
    source: str
    score: float
    span: float = math.nan


class CandidateSource:
    """Looks for candidates with one detector, in scales drawn at random."""

    def __init__(self, net: Net, rng: np.random.Generator) -> None:
        self._net, self._rng = net, rng
        self._scales, self._chances = zip(*SCALES, strict=True)

    def of_frames(self, frames: Iterable[LabelledFrame]) -> Iterator[Candidate]:
        for frame in frames:
            yield from self._look(frame, self._scale())

    def of_whole_frames(self, frames: Iterable[LabelledFrame]) -> Iterator[Candidate]:
        """As they are: to fit the scores of both stages to each other."""
        for frame in frames:
            yield from self._look(frame, 1.0)

    def of_drawn(self, samples: Iterable[TrainingSample]) -> Iterator[Candidate]:
        for sample in samples:
            frame = LabelledFrame(DRAWN, DRAWN, DRAWN, sample.image, sample.drones, sample.others)
            yield from self._look(frame, self._scale(), sample.doubtful)

    def _scale(self) -> float:
        return float(self._rng.choice(self._scales, p=self._chances))

    def _look(self, frame: LabelledFrame, scale: float, doubtful: Boxes | None = None) -> Iterator[Candidate]:
        """doubtful: what may be a drone and is left out."""
        rng, drawn = self._rng, frame.source == DRAWN
        corner, part = (np.zeros(2, int), frame.image) if drawn else self._part(frame, scale)
        found, _ = self._net.infer(part, scale, SECOND_STAGE_LEAST_SCORE, CANDIDATES_PER_PICTURE)
        labels, spans = np.concatenate([frame.drones, frame.distractors]), _spans(frame)
        kinds = (DRONE_CLASS,) * len(frame.drones) + (frame.kinds or (OTHER,) * len(frame.distractors))
        boxes = np.concatenate([found.centre + corner, found.size], axis=1)
        hits = [_hit(box, labels) for box in boxes]
        first = {hit: row for row, hit in reversed(list(enumerate(hits)))}
        wrong = [
            row
            for row, (box, hit) in enumerate(zip(boxes, hits, strict=True))
            if (hit < 0 and (doubtful is None or _hit(box, doubtful) < 0))
            or (hit >= 0 and first[hit] != row and _apart(boxes[first[hit]], box) > SECOND_CANDIDATE_SHARE)
        ]
        best, others = PER_PICTURE
        wrong = wrong[:best] + rng.permutation(wrong[best:])[:others].astype(int).tolist()
        chosen: list[tuple[NDArray[np.float64], str, float, float]] = []
        for row, (box, hit) in enumerate(zip(boxes, hits, strict=True)):
            if row in wrong:
                chosen.append((box, OTHER, float(found.score[row]), math.nan))
            elif hit >= 0 and first[hit] == row:
                chosen.append((box, kinds[hit], float(found.score[row]), spans.get(hit, math.nan)))
        if frame.source != SIMULATED:  # its labels are tighter than any detector's boxes
            high = corner + np.array(part.shape[1::-1])
            for row in sorted(set(range(len(labels))) - set(hits)):
                box = labels[row]
                if ((box[:2] >= corner) & (box[:2] < high)).all() and (not drawn or rng.random() < 0.5):
                    chosen.append((box, kinds[row], 0.0, spans.get(row, math.nan)))
        for box, kind, score, span in chosen:
            if not drawn or _has_room(frame.image, box):
                yield _cut(frame, box, kind, score, span)

    def _part(self, frame: LabelledFrame, scale: float) -> tuple[NDArray[np.int_], NDArray[np.uint8]]:
        """What is looked at in this scale, mostly around something labelled; and its top left corner, px."""
        shown = np.array(frame.image.shape[1::-1])
        if scale <= 1.0:
            return np.zeros(2, int), frame.image
        rng, labels = self._rng, np.concatenate([frame.drones, frame.distractors])
        side = int(min(CANDIDATE_WINDOW_PX / scale + ROOM, *shown))
        middle = rng.uniform(0.0, shown)
        if len(labels) and rng.random() < 0.8:
            middle = labels[rng.integers(len(labels)), :2] + rng.uniform(-0.3, 0.3, 2) * side
        x, y = np.clip(middle - side / 2, 0, shown - side).astype(int).tolist()
        return np.array([x, y]), frame.image[y : y + side, x : x + side]


def _cut(frame: LabelledFrame, box: NDArray[np.float64], kind: str, score: float, span: float) -> Candidate:
    """What is at a box (4,) of a frame; span: px of the frame."""
    side = KEPT_AROUND * max(float(box[2:].max()), SECOND_STAGE_SMALLEST_PX)
    picture = square(frame.image, box[:2], side, KEPT_SIDE_PX)
    return Candidate(picture, kind, frame.source, score, span * KEPT_SIDE_PX / side)


def _has_room(image: NDArray[np.uint8], box: NDArray[np.float64]) -> bool:
    """Whether a box (4,) is not too near to the edge of a picture that is drawn."""
    room = DRAWN_ROOM / 2 * max(float(box[2:].max()), SECOND_STAGE_SMALLEST_PX)
    return bool((box[:2] >= room).all() and (box[:2] + room <= image.shape[1::-1]).all())


def _spans(frame: LabelledFrame) -> dict[int, float]:
    """By drone, px: what is known, or else as what is visible in front of a smooth sky says it."""
    if frame.spans_px is not None:
        return dict(enumerate(frame.spans_px.tolist()))
    if frame.source == DRAWN:
        return {}
    seen = {row: cut_out(frame.image, box) for row, box in enumerate(frame.drones)}
    return {row: float(found.tight[2]) / OUTLINE for row, found in seen.items() if found is not None}


def _apart(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Between the centres of two boxes, in longer sides of the first."""
    return float(np.hypot(*(other[:2] - one[:2])) / one[2:].max())


def _hit(box: NDArray[np.float64], labels: Boxes) -> int:
    """Which label a candidate means, −1: none."""
    if not len(labels):
        return -1
    quality = by_centre(box, labels)
    best = int(quality.argmax())
    return best if quality[best] > 0 else -1
