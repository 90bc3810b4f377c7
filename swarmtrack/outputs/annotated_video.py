"""`[output] video`: the frames with what was tracked in them, drawn and encoded in a thread of its own."""

from __future__ import annotations

import asyncio
import logging
import os
import sys
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from swarmtrack.errors import SourceError
from swarmtrack.messages import FOREIGN, Frame, Image, ScanReport, TrackStatus
from swarmtrack.outputs.destinations import WEBM, SeenTrack, check_suffix
from swarmtrack.outputs.palette import colour_of
from swarmtrack.relative.read_out import read_out

log = logging.getLogger(__name__)

FRAMES_KEPT = 16  # a scan that waits for its gyro sample is at most a few frames behind
MOST_REPEATED = 300  # of one frame: a stall of a minute need not be watched
MAX_BACKLOG = 8  # frames waiting to be encoded, before a live camera's are dropped

TRAIL_S = 1.0  # of a track's way
FASTEST_HZ = 60.0  # no screen shows more
USUAL_FPS = 30.0  # of what has a single frame

GREY, RED = (200, 200, 200), (60, 60, 255)


class Trails:
    """Where each track was in the last second. alone: there is no team, so that each track has a colour of its own."""

    def __init__(self, *, alone: bool = False) -> None:
        self.alone = alone
        self._of: dict[int, deque[tuple[float, int, int]]] = {}

    def follow(self, t_s: float, seen: list[SeenTrack]) -> None:
        """Tracks that have ended are forgotten."""
        kept = {track.entry.track.id: track for track in seen}
        self._of = {id: trail for id, trail in self._of.items() if id in kept}
        for id, track in kept.items():
            trail = self._of.setdefault(id, deque())
            trail.append((t_s, round(track.centre[0]), round(track.centre[1])))
            while trail[0][0] < t_s - TRAIL_S:
                trail.popleft()

    def of(self, track_id: int) -> NDArray[np.int32]:
        """(n, 2) px, oldest first."""
        return np.array([(u, v) for _, u, v in self._of.get(track_id, ())], dtype=np.int32).reshape(-1, 2)


def annotate(frame: Frame, t_s: float, seen: list[SeenTrack], trails: Trails | None = None) -> Image:
    """A copy of the frame with boxes, names, distances, velocities (a quarter of a second ahead), 3σ ellipses and, by
    `trails`, the way of each track."""
    grey = frame.image.ndim == 2
    image: Image = cv2.cvtColor(frame.image, cv2.COLOR_GRAY2BGR) if grey else frame.image.copy()  # type: ignore[assignment]
    trails = trails or Trails()
    trails.follow(t_s, seen)
    for track in seen:
        _draw(image, track, trails)
    count = sum(track.entry.track.status is TrackStatus.CONFIRMED for track in seen)
    write_text(image, f"{t_s:7.2f} s  frame {frame.sequence}  {count} tracked", (8, 20), (255, 255, 255))
    return image


def _colour(seen: SeenTrack, *, alone: bool) -> tuple[int, int, int]:
    """Blue, green, red."""
    identity = seen.entry.identity
    if identity == FOREIGN:
        return RED
    if identity is None and not alone:
        return GREY
    red, green, blue = colour_of(seen.entry.track.id if identity is None else int(identity))
    return blue, green, red


def _draw(image: Image, seen: SeenTrack, trails: Trails) -> None:
    status = seen.entry.track.status
    colour = _colour(seen, alone=trails.alone)
    u, v = seen.centre
    w, h = np.where(np.isnan(seen.size), 20.0, seen.size)
    thick = 2 if status is TrackStatus.CONFIRMED else 1
    corner, opposite = (round(u - w / 2), round(v - h / 2)), (round(u + w / 2), round(v + h / 2))
    if status is TrackStatus.TENTATIVE:
        cv2.circle(image, (round(u), round(v)), 3, colour, 1, cv2.LINE_AA)
        return
    cv2.polylines(image, [trails.of(seen.entry.track.id)], False, colour, 1, cv2.LINE_AA)
    cv2.rectangle(image, corner, opposite, colour, thick, cv2.LINE_AA)
    ahead = seen.centre + 0.25 * seen.velocity
    cv2.arrowedLine(
        image, (round(u), round(v)), (round(ahead[0]), round(ahead[1])), colour, 1, cv2.LINE_AA, 0, 0.2
    )
    variances, axes = np.linalg.eigh(seen.cov)
    radii = 3.0 * np.sqrt(np.maximum(variances, 0.0))
    angle = float(np.degrees(np.arctan2(axes[1, 1], axes[0, 1])))
    size = (max(1, min(round(radii[1]), 2000)), max(1, min(round(radii[0]), 2000)))
    cv2.ellipse(image, (round(u), round(v)), size, angle, 0, 360, colour, 1, cv2.LINE_AA)
    label = label_of(seen)
    # Above the box, or below it where there is no room between the image's edge and the line at its top.
    baseline = corner[1] - 5 if corner[1] > 40 else opposite[1] + 17
    write_text(image, label, (max(0, min(corner[0], image.shape[1] - 9 * len(label))), baseline), colour)


def label_of(seen: SeenTrack) -> str:
    """Who it is, how far away where that is known, and whether it is lost: `drone 2 8.4 m`."""
    identity, relative = seen.entry.identity, seen.entry.relative
    number = f"track {seen.entry.track.id}"
    parts = [
        number
        if identity is None
        else f"{_name(identity)}, {number}"
        if identity == FOREIGN
        else _name(identity)
    ]
    if relative is not None:
        read = read_out(relative.position, relative.velocity, relative.cov)
        parts.append(f"{read.distance:.1f} m")
    if seen.entry.track.status is not TrackStatus.CONFIRMED:
        parts.append("(lost)")
    return " ".join(parts)


def _name(identity: int | str) -> str:
    return f"drone {identity}" if identity != FOREIGN else FOREIGN


def write_text(image: Image, text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)


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

    def __init__(self, path: Path, fps: float = USUAL_FPS) -> None:
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
        self.fps = min(max(self.fps, 1.0), FASTEST_HZ)
        self._writer = _writer(self._path, self.fps, (width, height))
        if not self._writer.isOpened():
            log.warning("output.video: OpenCV cannot write %s; frames are being lost", self._path)
        return self._writer


class AnnotatedVideo:
    """`[output] video`: drawn and encoded in a thread of its own.

    `lossless` waits for the encoder (a file at pace `fast`); otherwise frames that it cannot take in time are dropped
    and counted. alone: there is no team.
    """

    def __init__(self, path: Path, *, lossless: bool, alone: bool = False) -> None:
        self._video = TimedVideo(path)
        self._lossless = lossless
        self._frames: deque[Frame] = deque(maxlen=FRAMES_KEPT)
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="video")
        self._pending: deque[Future[None]] = deque()
        self._first: tuple[float, Image] | None = None
        self._start: float | None = None
        self._begun = False
        self._trails = Trails(alone=alone)
        self.dropped = 0

    def keep(self, frame: Frame) -> None:
        """Remember a frame until its scan is reported."""
        self._frames.append(frame)

    def write(self, report: ScanReport, seen: list[SeenTrack]) -> None:
        while self._pending and self._pending[0].done():
            self._pending.popleft().result()
        frame = next((f for f in self._frames if f.sequence == report.sequence), None)
        if frame is None or (len(self._pending) >= MAX_BACKLOG and not self._lossless):
            self.dropped += 1
            return
        start = self._start = frame.t if self._start is None else self._start
        self._pending.append(self._worker.submit(self._encode, frame, frame.t - start, seen))

    async def drain(self) -> None:
        """For `lossless`: wait until the encoder has caught up."""
        while self._lossless and len(self._pending) >= MAX_BACKLOG:
            await asyncio.wrap_future(self._pending.popleft())

    def close(self) -> None:
        self._worker.submit(self._finish).result()
        self._worker.shutdown()

    def _encode(self, frame: Frame, t_s: float, seen: list[SeenTrack]) -> None:
        image = annotate(frame, t_s, seen, self._trails)
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
        self._video.fps = 1.0 / (t - began) if t is not None and t > began else USUAL_FPS
        self._video.write(first, 0.0)

    def _finish(self) -> None:
        self._begin()
        self._video.close()
