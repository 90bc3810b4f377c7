"""The detector as the agent sees it: frames in, detections out, one call at a time from one worker thread."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from swarmtrack.detection import letterbox
from swarmtrack.detection.heads import HEADS, Candidates, suppress
from swarmtrack.detection.letterbox import Letterbox
from swarmtrack.detection.model import Metadata, check_input, model_path, open_session, read_metadata
from swarmtrack.errors import ModelError
from swarmtrack.messages import Detections, Frame, LinkStatus
from swarmtrack.runtime.clock import Clock, SystemClock

WINDOW = 256  # frames over which latency is reported: about ten seconds of video
SMALLEST, LARGEST = 8, 8192  # px: sides of an image that make sense


class Percentiles(NamedTuple):
    """Of one stage, s. Zero before the first frame."""

    p50: float
    p95: float
    max: float


class Latency(NamedTuple):
    """Of the last `WINDOW` frames. pre: letterbox and layout; infer: the net; post: decoding and suppression."""

    pre: Percentiles
    infer: Percentiles
    post: Percentiles


class Detector:
    """Finds drones in single frames with an ONNX model.

    model: a shipped model's name or a file. score_threshold: instead of the model's own. input_scale: enlarge images
    before looking, for drones of few pixels (the time grows with its square). providers: ONNX Runtime's, by short name,
    best first. A model that cannot work raises `ModelError` here; a bad frame later is counted and yields nothing.
    """

    def __init__(
        self,
        model: str | Path = "default",
        *,
        score_threshold: float | None = None,
        input_scale: float = 1.0,
        threads: int = 1,
        providers: Sequence[str] = ("cpu",),
        max_detections: int = 64,
        clock: Clock | None = None,
    ) -> None:
        if score_threshold is not None and not 0 < score_threshold < 1:
            raise ModelError(
                f"detector score_threshold: found {score_threshold}, expected a number between 0 and 1"
            )
        if not 0.1 <= input_scale <= 8:
            raise ModelError(f"detector input_scale: found {input_scale}, expected a number in 0.1…8")
        if threads < 1 or max_detections < 1:
            raise ModelError(
                f"detector threads, max_detections: found {threads}, {max_detections}, expected at least 1"
            )
        self._path = model_path(model)
        self._session = open_session(self._path, threads, providers)
        self._fixed_size = check_input(self._path, self._session)
        self.metadata: Metadata = read_metadata(self._path, self._session, list(HEADS))
        self._input_name = self._session.get_inputs()[0].name
        self.score_threshold = self.metadata.score_threshold if score_threshold is None else score_threshold
        self._input_scale = input_scale
        self._limit = max_detections
        self._clock = clock or SystemClock()
        self._seconds = np.zeros((WINDOW, 3))  # ring of (pre, infer, post)
        self._frames = self._found = self._refused = self._broken = 0
        self._trouble = ""
        # Once now, on a small image: a net whose outputs are not understood must not be discovered in flight.
        self._look(np.full((64, 96, 3), self.metadata.pad_value, np.uint8))

    def detect(self, frame: Frame) -> Detections | None:
        """All drones in the frame, best first, in pixels of the image as given.

        None where it could not look (counted, and said in `status`): that is not the same as seeing nobody, which
        would count against every track.
        """
        trouble = _unusable(frame.image)
        if trouble:
            self._refused += 1
            self._trouble = trouble
            return None
        try:
            found, seconds = self._look(frame.image)
        except ModelError as error:  # NaN from this image only: the next one may be fine
            self._broken += 1
            self._trouble = str(error)
            return None
        self._seconds[self._frames % WINDOW] = seconds
        self._frames += 1
        self._found += len(found.score)
        self._trouble = ""
        return Detections(frame.t, frame.sequence, found.centre, found.size, found.score)

    def warm_up(self, width: int, height: int) -> None:
        """Look at two empty images, so that the first real one does not pay for memory and kernels."""
        for _ in range(2):
            self._look(np.full((height, width, 3), self.metadata.pad_value, np.uint8))

    @property
    def latency(self) -> Latency:
        """How long the last frames took."""
        seconds = self._seconds[: min(self._frames, WINDOW)].copy()
        if len(seconds) == 0:
            seconds = np.zeros((1, 3))
        stages = np.percentile(seconds, [50, 95, 100], axis=0).T
        pre, infer, post = (Percentiles(*map(float, stage)) for stage in stages)
        return Latency(pre, infer, post)

    def status(self) -> LinkStatus:
        """One line and the counters for the health message; not ok while the newest frame could not be used."""
        latency = self.latency
        runs_on = ", ".join(name.removesuffix("ExecutionProvider") for name in self._session.get_providers())
        pace = f", {1e3 * latency.infer.p50:.1f} ms a frame" if self._frames else ""
        text = self._trouble or f"{self._path.name} on {runs_on}{pace}"
        counters = [
            ("frames", self._frames),
            ("detections", self._found),
            ("refused_frames", self._refused),
            ("broken_outputs", self._broken),
        ]
        times = [
            (f"{stage}_{name}_ms", 1e3 * value)
            for stage, percentiles in latency._asdict().items()
            for name, value in percentiles._asdict().items()
        ]
        return LinkStatus("detector", not self._trouble, text, (*counters, *times))

    def _look(self, image: NDArray[np.uint8]) -> tuple[Candidates, tuple[float, float, float]]:
        """Candidates in pixels of the image, and the seconds spent on (pre, infer, post)."""
        started = self._clock.now()
        height, width = image.shape[:2]
        box = self._letterbox(width, height)
        meta = self.metadata
        blob = cv2.dnn.blobFromImage(
            box.to_input(image, meta.pad_value),
            scalefactor=meta.scale,
            mean=meta.mean,
            swapRB=meta.channel_order == "RGB",
        )
        prepared = self._clock.now()
        outputs = self._session.run(None, {self._input_name: blob})
        answered = self._clock.now()
        if not all(np.isfinite(output).all() for output in outputs):
            raise ModelError(
                f"{self._path}: the net answered NaN or infinity for an image of {width}x{height}"
            )
        found = HEADS[meta.head](outputs, meta, self.score_threshold)
        centre, size = box.points_to_image(found.centre), box.sizes_to_image(found.size)
        # The padding is not part of the image, and what is found there is not in the world.
        inside = ((centre > -0.5) & (centre < [width - 0.5, height - 0.5])).all(axis=1)
        found = suppress(Candidates(centre[inside], size[inside], found.score[inside]), limit=self._limit)
        return found, (prepared - started, answered - prepared, self._clock.now() - answered)

    def _letterbox(self, width: int, height: int) -> Letterbox:
        if self._fixed_size is not None:
            w, h = self._fixed_size
            return letterbox.fit_fixed(width, height, input_width=w, input_height=h)
        return letterbox.fit(width, height, scale=self._input_scale, multiple=self.metadata.multiple)


def _unusable(image: NDArray[np.uint8]) -> str:
    """Why an image cannot be looked at, or nothing."""
    expected = f"expected uint8 (h, w) or (h, w, 3), sides of {SMALLEST} to {LARGEST} px"
    found = f"frame of shape {image.shape}, {image.dtype}"
    shaped = image.ndim == 2 or (image.ndim == 3 and image.shape[2] in (1, 3))
    if (
        image.dtype != np.uint8
        or not shaped
        or not all(SMALLEST <= side <= LARGEST for side in image.shape[:2])
    ):
        return f"{found} dropped, {expected}"
    return ""
