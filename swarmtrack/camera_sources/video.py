"""`file:` a video file, read by OpenCV's FFmpeg."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from swarmtrack.camera_sources.address import CameraAddress, in_range, nearest, read_options
from swarmtrack.camera_sources.container_end import is_complete
from swarmtrack.camera_sources.edit_list import edited_duration_s
from swarmtrack.camera_sources.limits import (
    DEEP_BITS,
    DEFAULT_VIDEO_HZ,
    END_SLACK_PERIODS,
    LONGEST_VIDEO_PAUSE_S,
    MOST_FAILED_READS,
    MOST_VIDEO_FRAMES,
)
from swarmtrack.camera_sources.playback import PACES, Picture, PlaybackCamera, play
from swarmtrack.camera_sources.stretch import Stretch
from swarmtrack.clock import Clock
from swarmtrack.errors import SourceError

# FFmpeg writes its complaints to stderr, before the sentence that we say. Read once, at OpenCV's first use of it.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


# FFmpeg's code of the one deep format that OpenCV gives as it is: AV_PIX_FMT_GRAY16LE.
GREY_16_BITS = int.from_bytes(b"Y1\0\x10", "little")


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
    """A video file with at least one frame. size: (width, height) px; announced: number of frames in its header, or 0;
    note: what a user should know of how it is played, or empty.
    """

    def __init__(self, path: Path, fps: float | None) -> None:
        """fps: instead of the file's times. Raises SourceError if there is nothing to play."""
        self._path = path
        self._fps = fps
        self._unreadable, self._last_s = 0, 0.0
        if not os.path.exists(path):
            raise SourceError(f"video file {path}: not found, expected a video that is there")
        if path.is_dir():
            raise SourceError(
                f"video file {path}: is a folder; a folder of images is written images://{path}"
            )
        if not os.access(path, os.R_OK):
            raise SourceError(f"video file {path}: permission denied")
        capture = open_path(path)
        try:
            if not capture.isOpened():
                raise SourceError(
                    f"video file {path}: {path.stat().st_size} bytes that are not a readable video; "
                    "a recording that was cut off before it was closed looks like this"
                )
            # A stream that was joined in its middle begins with frames that cannot be decoded.
            for _ in range(MOST_FAILED_READS):
                found, image = capture.read()
                if found:
                    break
            if not found:
                raise SourceError(f"video file {path}: holds no frame that can be read")
            self.size = (image.shape[1], image.shape[0])
            file_fps = capture.get(cv2.CAP_PROP_FPS)
            count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
            pixels = int(capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)) & 0xFFFFFFFF
        finally:
            capture.release()
        self.announced = int(count) if 0 < count < MOST_VIDEO_FRAMES else 0
        self.period = 1 / (fps or (file_fps if 0.01 <= file_fps <= 1000 else DEFAULT_VIDEO_HZ))
        self._header_s = self.announced / file_fps if self.announced and file_fps > 0.0 else 0.0
        self._is_deep = pixels == GREY_16_BITS
        notes = []
        if fps is None and self.announced == 0 and _has_no_times(path):
            notes.append(
                f"the file holds no times: {1 / self.period:g} frames per second are assumed (fps= sets them)"
            )
        if self._is_deep:
            notes.append("16 bits per pixel are stretched to 8")
        elif (bits := _depth(pixels)) >= DEEP_BITS or (bits > 8 and _is_grey(pixels)):
            notes.append(
                f"{bits} bits per pixel are cut to 8, and faint contrast is lost: convert it with "
                "ffmpeg -i FILE -c:v ffv1 -pix_fmt gray16le OUT.mkv"
            )
        self.note = "; ".join(notes)

    def play(self) -> Iterator[Picture]:
        options = [cv2.CAP_PROP_CONVERT_RGB, 0] if self._is_deep else []
        capture = open_path(self._path, options)
        stretch = Stretch()
        try:
            origin, media, last, sequence, failed = 0.0, 0.0, -self.period, 0, 0
            self._unreadable = 0
            while failed <= MOST_FAILED_READS:
                found, image = capture.read()
                if not found:
                    # The end, or damage with more behind it: OpenCV gives the same answer to both.
                    failed += 1
                    continue
                media = capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
                if sequence == 0:
                    origin = media
                for _ in range(failed):
                    self._unreadable += 1
                    last += self.period
                    yield Picture(last, sequence, None)
                    sequence += 1
                failed = 0
                # Damaged files have times that stand still or jump. Time does not.
                trusted = self._fps is None and last < media - origin < last + LONGEST_VIDEO_PAUSE_S
                last = media - origin if trusted else last + self.period
                yield Picture(last, sequence, stretch(np.asarray(image)))
                sequence += 1
            self._last_s = media - origin
        finally:
            capture.release()

    def ending(self, pictures: int) -> tuple[bool, str]:
        """Fewer frames than the header announces need not be damage: the file may be trimmed by an edit list, or have a
        varying rate, and its header only a duration, which may be that of the sound. So the file itself is asked,
        without decoding.
        """
        good, lost = pictures - self._unreadable, self._unreadable
        complete = is_complete(self._path)
        if complete is False:
            return False, f"ended after {good} frames: the file is cut off there, its end is missing"
        # The header's count is off by one in honest files.
        if 0 < good < self.announced - 1:
            there, last_s = _packets(self._path)
            slack = END_SLACK_PERIODS * self.period
            shown_s = min(self._header_s, edited_duration_s(self._path) or self._header_s)
            too_short = there < self.announced - 1 and max(last_s, self._last_s) + slack < shown_s
            if too_short and not complete:
                return (
                    False,
                    f"ended after {good} of {self.announced} frames: the rest of the file cannot be read",
                )
            # Of a file that an edit list trims, the decoder leaves out packets at the end, or at the beginning.
            if self._last_s + slack >= last_s:
                lost = max(lost, there - good)
        if lost > 1 or self._unreadable:
            return False, f"ended after {good} frames: {lost} more could not be read"
        return True, f"ended after {good} frames"


def open_path(path: Path, parameters: Sequence[int] = ()) -> cv2.VideoCapture:
    """Open a file whatever its name is: FFmpeg takes a name with a colon for a protocol, OpenCV takes UTF-8 only."""
    name = os.path.abspath(path)
    try:
        name.encode()
    except UnicodeEncodeError:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            return open_video(f"file:/proc/self/fd/{descriptor}", parameters)
        finally:
            os.close(descriptor)
    return open_video(f"file:{name}", parameters)


def _packets(path: Path) -> tuple[int, float]:
    """Number of packets with frames in a file, and the time [s] of the last from the first: without decoding."""
    capture = open_path(path, [cv2.CAP_PROP_FORMAT, -1])
    count, last_ms = 0, 0.0
    try:
        while capture.grab():
            count += 1
            last_ms = max(last_ms, capture.get(cv2.CAP_PROP_POS_MSEC))
    finally:
        capture.release()
    return count, last_ms / 1e3


def _has_no_times(path: Path) -> bool:
    """Whether a file is a bare stream of H.264, H.265 (NAL units) or JPEGs. Those of MPEG-2 and MPEG-4 hold a rate; the
    codes that they begin with are no NAL unit's, whose first bit is 0.
    """
    with path.open("rb") as file:
        head = file.read(5)
    is_nal = head.startswith((b"\0\0\0\1", b"\0\0\1")) and head.lstrip(b"\0")[1:2] < b"\x80"
    return is_nal or head.startswith(b"\xff\xd8")


def _is_grey(pixels: int) -> bool:
    return b"Y1" in (pixels.to_bytes(4, "little")[:2], pixels.to_bytes(4, "big")[:2])


def _depth(pixels: int) -> int:
    """Bits per channel by FFmpeg's code of a pixel format: a letter, the layout, and the bits; or the reverse."""
    code = pixels.to_bytes(4, "little")
    bits = next(
        (bits for letter, bits in ((code[:1], code[3]), (code[3:], code[0])) if letter in (b"Y", b"G")), 8
    )
    return bits if bits <= 16 else 8


def open_video_file(
    address: CameraAddress, *, clock: Clock, size: tuple[int, int] | None, base: Path | None
) -> PlaybackCamera:
    """A video file as a camera."""
    options = read_options(address, VideoOptions)
    return play(VideoFile(address.path(base), options.fps), address, options, clock=clock, size=size)
