"""`[output] video`: the frames with what was tracked in them, drawn and encoded in a thread of its own."""

from __future__ import annotations

import asyncio
import logging
import math
import os
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from swarmtrack.errors import SourceError
from swarmtrack.messages import Array, Frame, Image, ScanReport, TrackStatus
from swarmtrack.outputs.destinations import WEBM, check_suffix
from swarmtrack.outputs.drawing import DrawnTrack, Trails, name_of, place_tags
from swarmtrack.outputs.palette import Rgb

log = logging.getLogger(__name__)

VIDEO_FRAMES_KEPT = 16  # a scan that waits for its gyro sample is at most a few frames behind
MOST_REPEATED = 300  # of one frame: a stall of a minute need not be watched
MAX_BACKLOG = 8  # frames waiting to be encoded, before a live camera's are dropped

FASTEST_VIDEO_HZ = 60.0  # no screen shows more
USUAL_VIDEO_FPS = 30.0  # of what has a single frame

ELLIPSE_MAX_RADIUS_PX = 2000  # radius of an ellipse
FONT, FONT_SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.45
TAG_PAD_PX, TAG_HEIGHT_PX = 4, 17
TRAIL_OPACITY = 0.55
CLOSING_S = 2.0  # s that the summary stands at the end
CLOSING_DIMMED = 0.35  # of the last picture's brightness
WAYS_LISTED = 14  # tracks, the longest ones
WAY_POINTS = 1000  # of one track's way, before every other is dropped
WHITE = (255, 255, 255)


def annotate(frame: Frame, t_s: float, tracks: list[DrawnTrack], trails: Trails | None = None) -> Image:
    """A copy of the frame with its tracks drawn and, by `trails`, the way of each."""
    image = _in_colour(frame.image)
    trails = trails or Trails()
    trails.follow(t_s, tracks)
    boxed = [track for track in tracks if not track.is_dot]
    bare = image.copy()
    for track in boxed:
        cv2.polylines(image, [trails.of(track.track_id)], False, track.colour[::-1], 1, cv2.LINE_AA)
    cv2.addWeighted(image, TRAIL_OPACITY, bare, 1.0 - TRAIL_OPACITY, 0.0, dst=image)
    for track in tracks:
        _draw(image, track)
    _write_tags(image, [(track.label, track.box, track.colour) for track in boxed])
    count = sum(track.status is TrackStatus.CONFIRMED for track in tracks)
    write_text(image, f"{t_s:7.2f} s  frame {frame.sequence}  {count} tracked", (8, 20), WHITE)
    return image


def _in_colour(image: Image) -> Image:
    """A copy."""
    return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image.copy()  # type: ignore[return-value]


def _write_tags(image: Image, tags: Sequence[tuple[str, Array, Rgb]]) -> None:
    """Each beside its box (2, 2)."""
    widths = [cv2.getTextSize(text, FONT, FONT_SCALE, 1)[0][0] + 2 * TAG_PAD_PX for text, _, _ in tags]
    height, width = image.shape[:2]
    places = place_tags([box for _, box, _ in tags], [(w, TAG_HEIGHT_PX) for w in widths], width, height)
    for (text, _, colour), (left, top, right, bottom) in zip(tags, places, strict=True):
        cv2.rectangle(image, _whole((left, top)), _whole((right, bottom)), colour[::-1], cv2.FILLED)
        baseline = _whole((left + TAG_PAD_PX, bottom - 5.0))
        cv2.putText(image, text, baseline, FONT, FONT_SCALE, (0, 0, 0), 1, cv2.LINE_AA)


def _draw(image: Image, track: DrawnTrack) -> None:
    colour = track.colour[::-1]
    centre, tip = map(_whole, track.arrow)
    if track.is_dot:
        cv2.circle(image, centre, 3, colour, 1, cv2.LINE_AA)
        return
    corner, opposite = map(_whole, track.box)
    cv2.rectangle(image, corner, opposite, colour, 1 if track.is_lost else 2, cv2.LINE_AA)
    cv2.arrowedLine(image, centre, tip, colour, 1, cv2.LINE_AA, 0, 0.2)
    long, short, angle = track.ellipse
    radii = max(1, min(round(long), ELLIPSE_MAX_RADIUS_PX)), max(1, min(round(short), ELLIPSE_MAX_RADIUS_PX))
    cv2.ellipse(image, centre, radii, math.degrees(angle), 0, 360, colour, 1, cv2.LINE_AA)


def _whole(point: Array | tuple[float, float]) -> tuple[int, int]:
    return round(point[0]), round(point[1])


def write_text(image: Image, text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)


@dataclass(slots=True)
class _Way:
    """Of one confirmed track, from its first to its last moment [s]."""

    name: str
    colour: Rgb
    began_s: float
    ended_s: float = 0.0
    points: list[tuple[int, int]] = field(default_factory=list)


class Ways:
    """Where every track was, for the picture at the end."""

    def __init__(self) -> None:
        self._of: dict[int, _Way] = {}

    def follow(self, t_s: float, tracks: Sequence[DrawnTrack]) -> None:
        for track in tracks:
            if track.status is not TrackStatus.CONFIRMED:
                continue
            way = self._of.setdefault(track.track_id, _Way("", track.colour, t_s))
            name = name_of(track.identity) if isinstance(track.identity, int) else f"track {track.track_id}"
            way.name, way.colour, way.ended_s = name, track.colour, t_s
            way.points.append(_whole(track.centre))
            if len(way.points) > WAY_POINTS:
                del way.points[1::2]
            if len(self._of) > 2 * WAYS_LISTED:
                shortest = min(self._of, key=lambda id: self._of[id].ended_s - self._of[id].began_s)
                del self._of[shortest]

    def summary(self, last: Image, t_s: float, tracks: int) -> Image:
        """The last picture, dimmed, with the way of each track and when it was tracked."""
        image: Image = cv2.convertScaleAbs(_in_colour(last), alpha=CLOSING_DIMMED)  # type: ignore[assignment]
        listed = sorted(self._of.values(), key=lambda way: way.began_s - way.ended_s)[:WAYS_LISTED]
        for way in listed:
            cv2.polylines(image, [np.array(way.points, np.int32)], False, way.colour[::-1], 2, cv2.LINE_AA)
            cv2.circle(image, way.points[-1], 4, way.colour[::-1], cv2.FILLED, cv2.LINE_AA)
        plural = "" if tracks == 1 else "s"
        write_text(image, f"{tracks} track{plural} in {t_s:.1f} s", (8, 22), WHITE)
        for k, way in enumerate(listed):
            text = f"{way.name}  {way.began_s:.1f} ... {way.ended_s:.1f} s"
            write_text(image, text, (8, 46 + 20 * k), way.colour[::-1])
        return image


def _check_video(path: Path) -> None:
    """Raise SourceError now where OpenCV would only write nothing later."""
    check_suffix(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.open("ab").close()
    except OSError as error:
        raise SourceError(
            f"output.video: {path}: {error.strerror}, expected a file that can be written"
        ) from error


def _writer(path: Path, fps: float, size: tuple[int, int]) -> cv2.VideoWriter:
    codec = "VP80" if path.suffix.lower() == WEBM else "mp4v"
    with _no_complaint():
        return cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), fps, size)


@contextmanager
def _no_complaint() -> Iterator[None]:
    """OpenCV writes to the process's stderr that WebM has no tag for its own codec, and goes on."""
    sys.stderr.flush()
    kept, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nothing, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nothing)


class TimedVideo:
    """Pictures at their own times: one that lasts is written again. Opened with the first."""

    def __init__(self, path: Path, fps: float = USUAL_VIDEO_FPS) -> None:
        """Raises SourceError where it cannot be written."""
        _check_video(path)
        self._path = path
        self.fps = fps
        self._writer: cv2.VideoWriter | None = None
        self._written = self._cut = 0
        """Frames; and those that stalls lasted beyond what is worth watching."""
        self._last: Image | None = None

    def write(self, image: Image, t_s: float) -> None:
        """At its time; the one before lasts until then."""
        writer = self._writer or self._open(image)
        slot = round(t_s * self.fps) - self._cut
        stall = max(slot - self._written - MOST_REPEATED, 0)
        self._cut, slot = self._cut + stall, slot - stall
        while self._last is not None and self._written < slot:
            writer.write(self._last)
            self._written += 1
        if self._written <= slot:
            writer.write(image)
            self._written += 1
        self._last = image

    def close(self) -> None:
        if self._writer is not None:
            self._writer.release()

    def _open(self, first: Image) -> cv2.VideoWriter:
        height, width = first.shape[:2]
        self.fps = min(max(self.fps, 1.0), FASTEST_VIDEO_HZ)
        self._writer = _writer(self._path, self.fps, (width, height))
        if not self._writer.isOpened():
            log.warning("output.video: OpenCV cannot write %s; frames are being lost", self._path)
        return self._writer


class AnnotatedVideo:
    """`[output] video`: drawn and encoded in a thread of its own.

    `lossless` waits for the encoder (a file at pace `fast`); otherwise frames that it cannot take in time are dropped
    and counted.
    """

    def __init__(self, path: Path, *, lossless: bool) -> None:
        self._video = TimedVideo(path)
        self._lossless = lossless
        self._frames: deque[Frame] = deque(maxlen=VIDEO_FRAMES_KEPT)
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="video")
        self._pending: deque[Future[None]] = deque()
        self._first: tuple[float, Image] | None = None
        self._start: float | None = None
        self._begun = False
        self._trails = Trails()
        self._ways, self._ids = Ways(), set[int]()
        self._last: tuple[float, Image] | None = None
        self.dropped = 0

    def add_frame(self, frame: Frame) -> None:
        """Remember a frame until its scan is reported."""
        self._frames.append(frame)

    def write(self, report: ScanReport, tracks: list[DrawnTrack]) -> None:
        while self._pending and self._pending[0].done():
            self._pending.popleft().result()
        frame = next((f for f in self._frames if f.sequence == report.sequence), None)
        if frame is None or (len(self._pending) >= MAX_BACKLOG and not self._lossless):
            self.dropped += 1
            return
        start = self._start = frame.t if self._start is None else self._start
        self._pending.append(self._worker.submit(self._encode, frame, frame.t - start, tracks))

    async def drain(self) -> None:
        """For `lossless`: wait until the encoder has caught up."""
        while self._lossless and len(self._pending) >= MAX_BACKLOG:
            await asyncio.wrap_future(self._pending.popleft())

    def close(self) -> None:
        self._worker.submit(self._finish).result()
        self._worker.shutdown()

    def _encode(self, frame: Frame, t_s: float, tracks: list[DrawnTrack]) -> None:
        image = annotate(frame, t_s, tracks, self._trails)
        self._ways.follow(t_s, tracks)
        self._ids.update(track.track_id for track in tracks if track.status is TrackStatus.CONFIRMED)
        self._last = t_s, frame.image
        if self._first is None:
            self._first = (frame.t, image)  # the frame rate is known with the second frame
            return
        self._begin(frame.t)
        self._video.write(image, t_s)

    def _begin(self, t: float | None = None) -> None:
        """With the first frame, whose rate is that to the next at t."""
        if self._first is None or self._begun:
            return
        self._begun = True
        began, first = self._first
        self._video.fps = 1.0 / (t - began) if t is not None and t > began else USUAL_VIDEO_FPS
        self._video.write(first, 0.0)

    def _finish(self) -> None:
        self._begin()
        if self._ids and self._last is not None:
            t_s, image = self._last
            closing = self._ways.summary(image, t_s, len(self._ids))
            period = 1.0 / self._video.fps
            self._video.write(closing, t_s + period)
            self._video.write(closing, t_s + period + CLOSING_S)
        self._video.close()
