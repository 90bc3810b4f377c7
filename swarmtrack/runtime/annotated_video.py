"""`[output] video`: the frames with what was tracked in them, drawn and encoded in a thread of its own."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from swarmtrack.errors import SourceError
from swarmtrack.messages import FOREIGN, Frame, Image, ScanReport, TrackStatus
from swarmtrack.relative.read_out import read_out
from swarmtrack.runtime.outputs import SeenTrack, check_suffix
from swarmtrack.runtime.palette import colour_of

log = logging.getLogger(__name__)

FRAMES_KEPT = 16  # a scan that waits for its gyro sample is at most a few frames behind
MAX_BACKLOG = 8  # frames waiting to be encoded, before a live camera's are dropped

GREY, RED = (200, 200, 200), (60, 60, 255)


def annotate(frame: Frame, t_s: float, seen: list[SeenTrack]) -> Image:
    """A copy of the frame with boxes, names, distances, velocities (a quarter of a second ahead) and 3σ ellipses."""
    grey = frame.image.ndim == 2
    image: Image = cv2.cvtColor(frame.image, cv2.COLOR_GRAY2BGR) if grey else frame.image.copy()  # type: ignore[assignment]
    for track in seen:
        _draw(image, track)
    count = sum(track.entry.track.status is TrackStatus.CONFIRMED for track in seen)
    _write(image, f"{t_s:7.2f} s  frame {frame.sequence}  {count} tracked", (8, 20), (255, 255, 255))
    return image


def _draw(image: Image, seen: SeenTrack) -> None:
    identity, status = seen.entry.identity, seen.entry.track.status
    colour = RED if identity == FOREIGN else GREY if identity is None else colour_of(int(identity))[::-1]
    u, v = seen.centre
    w, h = np.where(np.isnan(seen.size), 20.0, seen.size)
    thick = 2 if status is TrackStatus.CONFIRMED else 1
    corner, opposite = (round(u - w / 2), round(v - h / 2)), (round(u + w / 2), round(v + h / 2))
    if status is TrackStatus.TENTATIVE:
        cv2.circle(image, (round(u), round(v)), 3, colour, 1, cv2.LINE_AA)
        return
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
    _write(image, label, (max(0, min(corner[0], image.shape[1] - 9 * len(label))), baseline), colour)


def label_of(seen: SeenTrack) -> str:
    """Who it is, how far away where that is known, and whether it is lost: `drone 2 8.4 m`."""
    identity, relative = seen.entry.identity, seen.entry.relative
    parts = [f"track {seen.entry.track.id}" if identity is None else _name(identity)]
    if relative is not None:
        read = read_out(relative.position, relative.velocity, relative.cov)
        parts.append(f"{read.distance:.1f} m")
    if seen.entry.track.status is not TrackStatus.CONFIRMED:
        parts.append("(lost)")
    return " ".join(parts)


def _name(identity: int | str) -> str:
    return f"drone {identity}" if identity != FOREIGN else FOREIGN


def _write(image: Image, text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
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


class AnnotatedVideo:
    """`[output] video`: drawn and encoded in a thread of its own.

    `lossless` waits for the encoder (a file at pace `fast`); otherwise frames that it cannot take in time are dropped
    and counted.
    """

    def __init__(self, path: Path, *, lossless: bool) -> None:
        _check_video(path)
        self._path = path
        self._lossless = lossless
        self._frames: deque[Frame] = deque(maxlen=FRAMES_KEPT)
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="video")
        self._pending: deque[Future[None]] = deque()
        self._writer: cv2.VideoWriter | None = None
        self._first: tuple[float, Image] | None = None
        self._start: float | None = None
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
        image = annotate(frame, t_s, seen)
        if self._writer is None:
            if self._first is None:
                self._first = (frame.t, image)  # the frame rate is known with the second frame
                return
            began, first = self._first
            self._open(first, 1.0 / (frame.t - began) if frame.t > began else 30.0)
        assert self._writer is not None
        self._writer.write(image)

    def _open(self, first: Image, fps: float) -> None:
        height, width = first.shape[:2]
        codec = cv2.VideoWriter.fourcc(*"mp4v")
        self._writer = cv2.VideoWriter(str(self._path), codec, min(max(fps, 1.0), 240.0), (width, height))
        if not self._writer.isOpened():
            log.warning("output.video: OpenCV cannot write %s; frames are being lost", self._path)
        self._writer.write(first)

    def _finish(self) -> None:
        if self._writer is None and self._first is not None:
            self._open(self._first[1], 30.0)
        if self._writer is not None:
            self._writer.release()
