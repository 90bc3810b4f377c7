"""Every tracker on real detections: each labelled clip is looked at once, by the shipped detector, in every frame.

What the detector found goes through an `Onboard` for each tracker, with the agent's own parameters, as it would in
flight. Scores: see `swarmtrack.lab.score.clip_score`.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.lone_onboard import lone_onboard
from swarmtrack.benchmarks.real_clips import START_S
from swarmtrack.detection.detector import Detector
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.lab.score.clip_score import ClipScore, TrackPoints, score_clip
from swarmtrack.messages import Detections, Frame, StampKind, TrackStatus
from swarmtrack.tracking import AGENT_PARAMETERS, create_tracker
from swarmtrack.training.labelled_clips import Clip, drone_clips, read_truth


class ClipRow(NamedTuple):
    """One tracker on one clip; ms: median processor time of a scan."""

    clip: str
    tracker: str
    score: ClipScore
    ms: float


def play_clips(folder: Path, trackers: Sequence[str]) -> list[ClipRow]:
    clips = drone_clips(folder)
    detector = Detector()
    rows = []
    with report.progress("real clips", len(clips)) as advance:
        for clip in clips:
            seen = look(clip, detector)
            rows += [follow(clip, seen, tracker) for tracker in trackers]
            advance(clip.name)
    return rows


def frames(clip: Clip) -> Iterator[Frame]:
    """As far as they can be decoded."""
    capture = cv2.VideoCapture(str(clip.video))
    try:
        for number in range(clip.frames):
            decoded, image = capture.read()
            if not decoded:
                break
            yield Frame(number / clip.fps, 0.0, number, image.astype(np.uint8, copy=False), StampKind.MEDIA)
    finally:
        capture.release()


def look(clip: Clip, detector: Detector) -> list[Detections]:
    """What the detector finds in each frame."""
    looks = (detector.look(detector.plan(frame)) for frame in frames(clip))
    return [found for found in looks if found is not None]


def follow(clip: Clip, seen: Sequence[Detections], tracker: str) -> ClipRow:
    # Nobody calibrated these cameras. They do not turn, so the focal length is of no consequence for the tracks.
    camera = PinholeCamera(
        clip.width, clip.width, (clip.width - 1) / 2, (clip.height - 1) / 2, clip.width, clip.height
    )
    onboard = lone_onboard(camera, create_tracker(tracker, camera=camera, **AGENT_PARAMETERS))
    claimed: dict[int, TrackPoints] = {}
    spent = []
    for detections in seen:
        begin = time.thread_time()
        onboard.tell(detections)
        spent.append(time.thread_time() - begin)
        tracks = [entry.track for entry in onboard.tracks(detections.t).tracks]
        confirmed = [track for track in tracks if track.status is TrackStatus.CONFIRMED]
        claimed[detections.sequence] = TrackPoints(
            np.array([track.id for track in confirmed], np.int64),
            np.array([track.mean[::2] for track in confirmed]).reshape(-1, 2),
        )
    frames = range(round(START_S * clip.fps), clip.frames)
    score = score_clip(read_truth(clip.truth), claimed, frames)
    return ClipRow(clip.name, tracker, score, 1e3 * float(np.median(spent)))
