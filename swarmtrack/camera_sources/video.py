"""`file:` a video file, read by OpenCV's FFmpeg."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from swarmtrack.camera_sources.address import CameraAddress, in_range, nearest, read_options
from swarmtrack.camera_sources.limits import DEFAULT_VIDEO_HZ, LONGEST_VIDEO_PAUSE_S
from swarmtrack.camera_sources.playback import PACES, Picture, PlaybackCamera, play
from swarmtrack.clock import Clock
from swarmtrack.errors import SourceError

# FFmpeg writes its complaints to stderr, before the sentence that we say. Read once, at OpenCV's first use of it.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


@dataclass(frozen=True, slots=True)
class VideoOptions:
    pace: str = "realtime"
    loop: bool = False
    fps: float | None = None  # in place of the file's own times
    resize: bool = False

    def __post_init__(self) -> None:
        if self.pace not in PACES:
            raise ValueError(f'pace: found "{self.pace}"{nearest(self.pace, PACES)}')
        in_range("fps", self.fps, 0.01, 1000)


def open_video(source: str, parameters: Sequence[int] = ()) -> cv2.VideoCapture:
    """Open a file or stream with OpenCV's FFmpeg, without OpenCV's own warning on failure."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        return cv2.VideoCapture(source, cv2.CAP_FFMPEG, parameters)
    finally:
        cv2.utils.logging.setLogLevel(level)


class VideoFile:
    """A video file with at least one frame. size: (width, height) px; announced: number of frames in its header."""

    def __init__(self, path: Path, fps: float | None) -> None:
        """Raises SourceError if there is nothing to play."""
        self._path = path
        self._fps = fps
        if not os.path.exists(path):
            raise SourceError(f"video file {path}: not found, expected a video that is there")
        if path.is_dir():
            raise SourceError(
                f"video file {path}: is a folder; a folder of images is written images://{path}"
            )
        if not os.access(path, os.R_OK):
            raise SourceError(f"video file {path}: permission denied")
        capture = open_video(str(path))
        try:
            if not capture.isOpened():
                raise SourceError(
                    f"video file {path}: {path.stat().st_size} bytes that are not a readable video; "
                    "a recording that was cut off before it was closed looks like this"
                )
            found, image = capture.read()
            if not found:
                raise SourceError(f"video file {path}: holds no frame that can be read")
            self.size = (image.shape[1], image.shape[0])
            file_fps = capture.get(cv2.CAP_PROP_FPS)
            self.announced = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        finally:
            capture.release()
        self.period = 1 / (fps or (file_fps if 0.01 <= file_fps <= 1000 else DEFAULT_VIDEO_HZ))

    def play(self) -> Iterator[Picture]:
        capture = open_video(str(self._path))
        try:
            origin, last, sequence = 0.0, -self.period, 0
            while True:
                found, image = capture.read()
                if not found:
                    return
                media = capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
                if sequence == 0:
                    origin = media
                # Damaged files have times that stand still or jump. Time does not.
                trusted = self._fps is None and last < media - origin < last + LONGEST_VIDEO_PAUSE_S
                last = media - origin if trusted else last + self.period
                yield Picture(last, sequence, np.asarray(image, np.uint8))
                sequence += 1
        finally:
            capture.release()

    def ending(self, pictures: int) -> tuple[bool, str]:
        if 0 < pictures < self.announced - 1:  # the header's count is off by one in honest files
            return (
                False,
                f"ended after {pictures} of {self.announced} frames: the rest of the file cannot be read",
            )
        return True, f"ended after {pictures} frames"


def open_video_file(
    address: CameraAddress, *, clock: Clock, size: tuple[int, int] | None, base: Path | None
) -> PlaybackCamera:
    """A video file as a camera."""
    options = read_options(address, VideoOptions)
    return play(VideoFile(address.path(base), options.fps), address, options, clock=clock, size=size)
