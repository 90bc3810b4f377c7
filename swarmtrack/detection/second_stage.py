"""A second stage: a small network that looks at one candidate at a time, and says whether it is a drone, and how wide.

Theory of operation. A detector answers for every cell of a picture, and has little to spend on any one of them. Of its
candidates, a dozen at most, the second stage is shown each one alone: a square around the centre, scaled with the box,
so that a drone fills it whether it is near or far. It answers how much likelier than before this is a drone, as log
odds, which are added to those of the detector:

    logit(score') = logit(score) + weight · log_odds + offset

What a track is confirmed by, its likeness, is lower than that by a number of log odds, the doubt (`likeness`). Where a
track is expected the score does not fall below the detector's own: that something is still there is one question, and
what it is another.

It may also answer how wide the drone's span is, if it stands level across the view, as a share of the square's side.
Then boxes are made as wide as the detector says that it draws a drone of such a span. So they mean what they did, and
tell distances better: by how much boxes are too wide or too narrow differs from drone to drone, spans by less.

Two stages are how R-CNN (Girshick et al. 2014) and the cascade of Viola & Jones (2001) are built. weight and offset are
fitted to candidates that neither stage was trained on, and stand in the file. It works with the boxes of any detector.
`docs/decisions/0039-two-stages.md` has what it brought.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from swarmtrack.detection import metadata
from swarmtrack.detection.heads import Candidates
from swarmtrack.detection.metadata import Metadata, box_width_of
from swarmtrack.detection.model import ELEMENTS, first_answer, open_session, trial_limit
from swarmtrack.detection.odds import logit, probability
from swarmtrack.errors import ModelError
from swarmtrack.messages import Array, Image
from swarmtrack.relative.box_width import BoxWidth

SECOND_STAGE_HEAD = "second_stage"
SECOND_STAGE_LEAST_SCORE = 0.15  # score from which on a candidate is looked at again
SECOND_STAGE_MOST_BOXES = 16  # candidates of one frame that are looked at again: the best
SECOND_STAGE_SMALLEST_PX = 8.0  # px of the image: no square is smaller
SECOND_STAGE_MOST_SIDES = 16.0  # longer sides of a box that it may be shown
LARGEST_SIDE = 256  # px of its input
RESIZED = 3.0  # times: a box becomes no wider than so often itself, and no narrower


AS_ANSWERED = BoxWidth(factor=1.0)


class SecondLook(NamedTuple):
    """Answer for n candidates. score (n,) of both stages; resize (n,): what each box is multiplied by to be as wide
    as one around a drone of its span; ones where the span is unknown.
    """

    score: Array
    resize: Array


class _Answer(NamedTuple):
    """About n squares: log odds (n,), and spans (n,) as shares of their sides, where the net tells them."""

    log_odds: Array
    span: Array | None


class SecondStage:
    """A classifier's session with its pre- and postprocessing. Raises `ModelError` for an unsupported one."""

    def __init__(
        self, path: Path, threads: int = 1, providers: Sequence[str] = ("cpu",), cache: Path | None = None
    ) -> None:
        self.path = path
        self._session = open_session(path, threads, providers, cache)
        written = self._session.get_modelmeta().custom_metadata_map
        entry = Metadata(str(path), written).entry
        entry("head", metadata.one_of([SECOND_STAGE_HEAD]), SECOND_STAGE_HEAD)
        self.around = entry("around", _extent, f"a positive number, {SECOND_STAGE_MOST_SIDES:g} at most")
        """Side of the square that it is shown, in longer sides of the box."""
        self.weight, self.offset = entry("fusion", metadata.two, "a JSON list of two numbers")
        self.score_threshold = entry("score_threshold", metadata.fraction, "a number in 0…1")
        """Of both stages' score: from which on a detection is shown."""
        self._doubt = entry(
            "doubt", metadata.number, f"a number, none beyond {metadata.LARGEST_METADATA_NUMBER:g}"
        )
        self.tells_spans = len(self._session.get_outputs()) > 1
        self.box_width = box_width_of(str(path), written) or AS_ANSWERED
        """How wide spans are as it answers them, beside the true ones, and how far they are off."""
        self._input, self._side, self._element = self._check_input()
        empty: NDArray[Any] = np.zeros((1, 3, self._side, self._side), self._element)
        first_answer(
            path,
            lambda options: self._answer(empty, options),
            limit_s=trial_limit(self._session),
            what="an empty square",
        )

    def classify(self, image: Image, found: Candidates, drawn: BoxWidth) -> SecondLook:
        """Classify candidates (n) in an image, best first, given the detector's model of box widths. In a crowd the
        last ones are left out, with log odds of 0.
        """
        log_odds, resize = np.zeros(len(found.score)), np.ones(len(found.score))
        if len(log_odds):
            centre, size = found.centre[:SECOND_STAGE_MOST_BOXES], found.size[:SECOND_STAGE_MOST_BOXES]
            sides = self.around * np.maximum(size.max(axis=1), SECOND_STAGE_SMALLEST_PX)
            answer = self._look(image, centre, sides)
            log_odds[:SECOND_STAGE_MOST_BOXES] = answer.log_odds
            if answer.span is not None:
                span = (answer.span * sides - self.box_width.padding_px) / self.box_width.factor
                width = drawn.factor * span + drawn.padding_px
                resize[:SECOND_STAGE_MOST_BOXES] = np.clip(
                    width / np.maximum(size[:, 0], 1.0), 1.0 / RESIZED, RESIZED
                )
        score = probability(logit(found.score) + self.weight * log_odds + self.offset)
        return SecondLook(score, resize)

    def likeness(self, score: Array) -> Array:
        """Probability of being a drone, from scores (n,) of both stages, for the confirmation of tracks. A
        detection is shown on a suspicion, a track is confirmed on more: the log odds are lower by the doubt in
        the file.
        """
        return probability(logit(score) - self._doubt)

    def _look(self, image: Image, centre: Array, sides: Array) -> _Answer:
        """At squares with centres (n, 2) and sides (n,) px of an image."""
        squares = [
            square(image, where, side, self._side) for where, side in zip(centre, sides.tolist(), strict=True)
        ]
        return self._answer(np.asarray(cv2.dnn.blobFromImages(squares), self._element))

    def _answer(self, squares: NDArray[Any], options: ort.RunOptions | None = None) -> _Answer:
        said = [np.asarray(each, float) for each in self._session.run(None, {self._input: squares}, options)]
        for each in said[:2]:
            if each.shape != (len(squares),) or not np.isfinite(each).all():
                raise ModelError(
                    f"{self.path}: answered NaN or {each.shape} to {len(squares)} squares, expected a number of each"
                )
        return _Answer(said[0], said[1] if self.tells_spans else None)

    def _check_input(self) -> tuple[str, int, type]:
        """Name, side and type of the only input: (n, 3, side, side)."""
        inputs = self._session.get_inputs()
        shape = inputs[0].shape if len(inputs) == 1 else []
        sides = shape[2:] if len(shape) == 4 and shape[1] == 3 and not isinstance(shape[0], int) else []
        good = len(sides) == 2 and sides[0] == sides[1] and isinstance(sides[0], int)
        if not good or not 8 <= sides[0] <= LARGEST_SIDE or inputs[0].type not in ELEMENTS:
            found = "; ".join(f"{entry.name} {entry.type} {entry.shape}" for entry in inputs) or "none"
            raise ModelError(
                f"{self.path}: inputs are {found}; expected one of shape [n, 3, side, side], {LARGEST_SIDE} px at most"
            )
        return inputs[0].name, sides[0], ELEMENTS[inputs[0].type]


def square(image: Image, centre: Array, side: float, pixels: int) -> Image:
    """(pixels, pixels, 3) BGR: what lies within a square of `side` px around a centre (2,) of the image, (h, w) grey or
    (h, w, 3) BGR; beyond its edges as at them."""
    scale = pixels / side
    low = np.floor(np.asarray(centre) - side / 2 - 2).astype(int)
    high = np.ceil(np.asarray(centre) + side / 2 + 3).astype(int)
    height, width = image.shape[:2]
    x0, y0 = np.clip(low, 0, [width - 1, height - 1])
    x1, y1 = np.clip(high, [x0 + 1, y0 + 1], [width, height])
    part = image[y0:y1, x0:x1]
    if part.ndim == 2 or part.shape[2] == 1:
        part = np.asarray(cv2.cvtColor(np.ascontiguousarray(part), cv2.COLOR_GRAY2BGR), np.uint8)
    if scale < 0.7:
        part = np.asarray(cv2.GaussianBlur(part, (0, 0), 0.35 / scale), np.uint8)
    shift = (pixels - 1) / 2 - scale * (np.asarray(centre) - [x0, y0])
    how = np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])
    seen = cv2.warpAffine(
        part, how, (pixels, pixels), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(seen, np.uint8)


def _extent(text: str) -> float:
    if not 0.0 < (value := metadata.number(text)) <= SECOND_STAGE_MOST_SIDES:
        raise ValueError(text)
    return value
