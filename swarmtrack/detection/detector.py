"""The detector as the agent uses it: frames in, detections out, one call at a time from one worker thread."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.clock import Clock, SystemClock
from swarmtrack.detection import motion_cue, second_stage
from swarmtrack.detection.attention import (
    AttentionParameters,
    AttentionWindows,
    TimeShare,
    Window,
    coverage,
)
from swarmtrack.detection.description import Declared, Description
from swarmtrack.detection.expectation import Expectation
from swarmtrack.detection.heads import Candidates, of_several_looks, suppress, together
from swarmtrack.detection.model import model_path, open_session, runs_on, second_stage_path
from swarmtrack.detection.motion_cue import Comparison, MotionCue
from swarmtrack.detection.net import TRIAL_SIZE, Net
from swarmtrack.detection.second_stage import SecondStage
from swarmtrack.errors import ModelError
from swarmtrack.messages import Array, Detections, Frame, LinkStatus
from swarmtrack.relative.box_width import BoxWidth

NOTHING_DECLARED = Declared()
USUAL_ATTENTION = AttentionParameters()
# Frames over which latency is reported: about ten seconds of video.
LATENCY_FRAMES = 256
# px: sides of an image that make sense.
SMALLEST_INPUT_PX, LARGEST_INPUT_PX = 8, 8192
# Score from which on a candidate is looked at again, by the second stage or for what moved.
LEAST_DETECTION_SCORE = min(motion_cue.MOTION_LEAST_SCORE, second_stage.SECOND_STAGE_LEAST_SCORE)


class Percentiles(NamedTuple):
    """Durations of one stage, s. Zero before the first frame."""

    p50: float
    p95: float
    max: float


class Latency(NamedTuple):
    """Latencies of the last `LATENCY_FRAMES` frames. pre: letterbox and layout; infer: the net; post: decoding,
    suppression, the second stage and what moved.
    """

    pre: Percentiles
    infer: Percentiles
    post: Percentiles


NO_BOXES = np.empty((0, 6))


class Look(NamedTuple):
    """Plan for one frame: the windows to look at, none where the frame cannot be used; the earlier frame to compare
    it with; the expected tracks (n, 6), as in `Expectation.boxes`.
    """

    frame: Frame
    windows: tuple[Window, ...]
    comparison: Comparison | None
    expected: Array = NO_BOXES


class _LookedAgain(NamedTuple):
    """found: the candidates that may be shown with both stages' scores, best first. Of each (n,): its likeness, the
    score from which it is shown, and what its box is to be resized by."""

    found: Candidates
    likeness: Array
    shown_from: Array
    resize: Array


class _Memory(NamedTuple):
    """Where to look next in the frames of one camera, and what was seen in its last ones."""

    attention: AttentionWindows
    motion: MotionCue | None
    time: TimeShare


class Detector:
    """Finds drones in single frames with an ONNX model; those of several cameras in any order.

    model: a shipped model's name or a file. score_threshold: instead of the model's own. input_scale: enlarge images
    before looking, for drones of few pixels (the time grows with its square). providers: ONNX Runtime's, by short name,
    best first; cache: folder of the engines that some of them compile. declared: what the file does not say of the net,
    or says wrongly. second_stage: which network looks at each candidate again; "auto" is the shipped one ("default"),
    where it was fitted to the model's scores, else "none". look: "whole" frames, or "guided" by the tracks as
    `attention` says; "auto": guided where the whole frame would be shrunk. motion: also ask what moved since an earlier
    frame (`motion_cue`). share: of the time that looks at one camera may take; where they take more, guided ones have
    no tiles. A model that cannot work raises `ModelError` here; a bad frame later is counted and yields nothing.
    """

    def __init__(
        self,
        model: str | Path = "default",
        *,
        score_threshold: float | None = None,
        input_scale: float = 1.0,
        threads: int = 1,
        providers: Sequence[str] = ("cpu",),
        cache: Path | None = None,
        declared: Declared = NOTHING_DECLARED,
        second_stage: str | Path = "auto",
        look: Literal["auto", "whole", "guided"] = "auto",
        attention: AttentionParameters = USUAL_ATTENTION,
        motion: bool = False,
        share: float = 1.0,
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
        self._clock = clock or SystemClock()
        self._session = open_session(self._path, threads, providers, cache)
        self._net = Net(self._path, self._session, declared, self._clock)
        self._drawn = self.description.box_width or BoxWidth()
        self._second = self._second_stage(second_stage, threads, providers, cache)
        self.own_threshold = (self._second or self.description).score_threshold
        """Score from which on detections are shown where nobody says otherwise."""
        self.score_threshold = self.own_threshold if score_threshold is None else score_threshold
        self._alone_threshold = (
            self.description.score_threshold if score_threshold is None else score_threshold
        )
        """Likewise, of the first stage's score where a track is expected."""
        self._input_scale = input_scale
        self._look = look
        self._attention_parameters = attention
        self._with_motion = motion
        self._share = share
        self._memories: dict[int, _Memory] = {}
        self._limit = max_detections
        self._seconds = np.zeros((LATENCY_FRAMES, 3))  # ring of (pre, infer, post)
        self._frames = self._found = self._refused = self._broken = self._windows = 0
        self._trouble = ""
        # Once now, on a small image: a net whose outputs are not understood must not be discovered in flight.
        self.warm_up(*(self._net.fixed_size or TRIAL_SIZE))

    def _second_stage(
        self, which: str | Path, threads: int, providers: Sequence[str], cache: Path | None
    ) -> SecondStage | None:
        if which == "auto":
            which = "default" if self.description.second_stage else "none"
        if which == "none":
            return None
        try:
            return SecondStage(second_stage_path(which), threads, providers, cache)
        except ModelError as error:
            raise ModelError(f"detector.second_stage: {error}") from error

    @property
    def path(self) -> Path:
        """Path of the model's file."""
        return self._path

    @property
    def net(self) -> Net:
        """The net itself, without counters."""
        return self._net

    @property
    def description(self) -> Description:
        """The net's description, with its source."""
        return self._net.description

    @property
    def second_stage(self) -> SecondStage | None:
        """The second stage, if any."""
        return self._second

    @property
    def box_width(self) -> BoxWidth | None:
        """Model of the widths of its boxes; None if unknown."""
        if self._second is None or not self._second.tells_spans:
            return self.description.box_width
        drawn = self._drawn
        return replace(self._second.box_width, factor=drawn.factor, padding_px=drawn.padding_px)

    @property
    def providers(self) -> tuple[str, ...]:
        """Providers of ONNX Runtime that really run the net, by short name, the first one first."""
        return runs_on(self._session)

    def plan(self, frame: Frame, expectation: Expectation | None = None) -> Look:
        """Plan the look at the next frame: quick, to be called where `expectation` may be. Without one: the whole
        frame, without the motion cue.
        """
        image = frame.image
        if _unusable(image):
            return Look(frame, (), None)
        height, width = image.shape[:2]
        scale = self._net.scale_of(width, height, self._input_scale)
        windows = [Window(0, 0, width, height, scale)]
        comparison, expected = None, NO_BOXES
        memory = self._memory(frame.camera)
        if expectation is not None:
            guided = self._look == "guided" or (self._look == "auto" and scale < 1.0)
            if guided or self._second is not None:
                expected = expectation.boxes(frame.t)
            if guided:
                has_time = memory.time.comes_to(frame.t)
                windows = memory.attention.next((width, height), scale, expected, has_time=has_time)
            if memory.motion is not None:
                comparison = memory.motion.compare(frame.t, expectation)
        return Look(frame, tuple(windows), comparison, expected)

    def detect(self, look: Look) -> Detections | None:
        """All drones in the windows of a planned look, best first, in pixels of the image as given.

        None where the detector could not look (counted, and reported in `status`): that is not an empty scan, which
        would count against every track.
        """
        frame, windows = look.frame, look.windows
        if not windows:
            self._refused += 1
            self._trouble = _unusable(frame.image)
            return None
        try:
            found, likeness, seconds = self._look_through(look)
        except ModelError as error:  # NaN from this image only: the next one may be fine
            self._broken += 1
            self._trouble = str(error)
            return None
        self._memory(frame.camera).time.spend(float(seconds.sum()))
        self._seconds[self._frames % LATENCY_FRAMES] = seconds
        self._frames += 1
        self._windows += len(windows)
        self._found += len(found.score)
        self._trouble = ""
        height, width = frame.image.shape[:2]
        seen = coverage(windows, (width, height))
        return Detections(
            frame.t,
            frame.sequence,
            found.centre,
            found.size,
            found.score,
            coverage=seen,
            likeness=likeness,
            camera=frame.camera,
        )

    def _memory(self, camera: int) -> _Memory:
        """What it remembers of the frames of one camera."""
        memory = self._memories.get(camera)
        if memory is None:
            attention = AttentionWindows(self._attention_parameters, self._net.fixed_size)
            motion = MotionCue() if self._with_motion else None
            memory = self._memories[camera] = _Memory(attention, motion, TimeShare(self._share))
        return memory

    def _look_through(self, look: Look) -> tuple[Candidates, Array | None, Array]:
        """What is in the windows, in pixels of the image, with its scores and their likeness as in `Detections`; and
        the seconds (3,) that it took."""
        threshold, image = self.score_threshold, look.frame.image
        alone = look.comparison is None and self._second is None
        least = threshold if alone else min(threshold, LEAST_DETECTION_SCORE)
        whole = (image.shape[1], image.shape[0])
        spent = np.zeros(3)
        parts = []
        for window in look.windows:
            part = image[window.y : window.y + window.height, window.x : window.x + window.width]
            found, seconds = self._net.infer(part, window.scale, least, self._limit)
            found = found._replace(centre=found.centre + np.array([window.x, window.y]))
            parts.append(found.select(~window.cuts(found.centre, found.size, whole)))
            spent += seconds
        found = parts[0] if len(parts) == 1 else suppress(together(parts), limit=self._limit)
        began = self._clock.now()
        likeness, shown_from, resize = None, np.full(len(found.score), threshold), np.ones(len(found.score))
        if self._second is not None:
            found, likeness, shown_from, resize = self._look_again(self._second, look, found)
        if len(parts) > 1:
            # Only now: what seemed likelier to the first stage is a house perhaps, and the drone is before it.
            once = of_several_looks(found, limit=self._limit)
            found, shown_from, resize = found.select(once), shown_from[once], resize[once]
            likeness = None if likeness is None else likeness[once]
        motion = self._memory(look.frame.camera).motion
        if motion is not None:
            likeness = found.score if likeness is None else likeness
            rows, score = motion.weigh(look.frame, found, shown_from, look.comparison)
            found, likeness, resize = found.select(rows)._replace(score=score), likeness[rows], resize[rows]
        found = found._replace(size=found.size * resize[:, None])
        spent[2] += self._clock.now() - began
        return found, likeness, spent

    def _look_again(self, second: SecondStage, look: Look, found: Candidates) -> _LookedAgain:
        judged = second.classify(look.frame.image, found, self._drawn)
        alone = _near(look.expected, found.centre) & (found.score > judged.score)
        score = np.where(alone, found.score, judged.score)
        resize = np.where(alone, 1.0, judged.resize)  # what it takes for no drone has no span
        shown_from = np.where(alone, self._alone_threshold, self.score_threshold)
        least = shown_from if look.comparison is None else np.minimum(shown_from, LEAST_DETECTION_SCORE)
        order = np.argsort(-score, kind="stable")
        order = order[(score >= least)[order]]
        return _LookedAgain(
            found._replace(score=score).select(order),
            second.likeness(judged.score[order]),
            shown_from[order],
            resize[order],
        )

    def warm_up(self, width: int, height: int) -> None:
        """Look at two empty images, so that the first real one does not pay for memory and kernels."""
        for _ in range(2):
            empty = np.full((height, width, 3), self.description.pad_value, np.uint8)
            window = Window(0, 0, width, height, self._input_scale)
            self._net.infer(empty, window.scale, self.score_threshold, self._limit)

    @property
    def latency(self) -> Latency:
        """Durations of the last frames."""
        seconds = self._seconds[: min(self._frames, LATENCY_FRAMES)].copy()
        if len(seconds) == 0:
            seconds = np.zeros((1, 3))
        stages = np.percentile(seconds, [50, 95, 100], axis=0).T
        pre, infer, post = (Percentiles(*map(float, stage)) for stage in stages)
        return Latency(pre, infer, post)

    def status(self) -> LinkStatus:
        """One line and the counters for the health message; not ok while the newest frame could not be used."""
        latency = self.latency
        pace = f", {1e3 * latency.infer.p50:.1f} ms per frame" if self._frames else ""
        stages = self._path.name if self._second is None else f"{self._path.name}, {self._second.path.name}"
        text = self._trouble or f"{stages} on {', '.join(self.providers)}{pace}"
        counters = [
            ("frames", self._frames),
            ("windows", self._windows),
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


def _near(expected: Array, centre: Array) -> NDArray[np.bool_]:
    """(n,) whether points (n, 2) lie where one of the tracks (m, 6) may be: within 3 σ and half its box."""
    half = expected[:, 2:4] + 0.5 * np.nan_to_num(expected[:, 4:6])
    apart = np.abs(centre[:, None] - expected[None, :, :2])
    within = np.asarray((apart <= half).all(axis=2), np.bool_)
    return np.asarray(within.any(axis=1))


def _unusable(image: NDArray[np.uint8]) -> str:
    """Why an image cannot be looked at, or nothing."""
    expected = f"expected uint8 (h, w) or (h, w, 3), sides of {SMALLEST_INPUT_PX} to {LARGEST_INPUT_PX} px"
    found = f"frame of shape {image.shape}, {image.dtype}"
    shaped = image.ndim == 2 or (image.ndim == 3 and image.shape[2] in (1, 3))
    if (
        image.dtype != np.uint8
        or not shaped
        or not all(SMALLEST_INPUT_PX <= side <= LARGEST_INPUT_PX for side in image.shape[:2])
    ):
        return f"{found} dropped, {expected}"
    return ""
