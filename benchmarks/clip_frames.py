"""The frames of a labelled clip, and what a detector finds in them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from swarmtrack.benchmarks.report import BenchmarkError
from swarmtrack.camera_sources.video import open_path
from swarmtrack.detection.detector import Detector
from swarmtrack.detection.expectation import Expectation
from swarmtrack.messages import Detections, Frame, StampKind
from swarmtrack.training.labelled_clips import Clip


def frames(clip: Clip) -> Iterator[Frame]:
    """As far as they can be decoded."""
    capture = open_path(clip.video)
    try:
        for number in range(clip.frames):
            decoded, image = capture.read()
            if not decoded:
                break
            yield Frame(number / clip.fps, 0.0, number, image.astype(np.uint8, copy=False), StampKind.MEDIA)
    finally:
        capture.release()


def detected(detector: Detector, frame: Frame, expectation: Expectation | None = None) -> Detections:
    """Raises BenchmarkError where the detector cannot look."""
    found = detector.detect(detector.plan(frame, expectation))
    if found is None:
        raise BenchmarkError(detector.status().text)
    return found


def look(clip: Clip, detector: Detector) -> list[Detections]:
    """What the detector finds in each frame."""
    looks = (detector.detect(detector.plan(frame)) for frame in frames(clip))
    return [found for found in looks if found is not None]
