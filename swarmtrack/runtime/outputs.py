"""What an agent writes for people, beside the network: a JSON line and an annotated video frame for each scan.

Pixels here are those of the image as the camera gave it: the tracker's undistorted ones are distorted again.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import cv2
import numpy as np

from swarmtrack.errors import SourceError
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array, Frame, IdentifiedTrack, Image, TrackStatus
from swarmtrack.onboard import ScanReport

log = logging.getLogger(__name__)

FRAMES_KEPT = 16  # a scan that waits for its gyro sample is at most a few frames behind
VIDEO_SUFFIXES = (".mp4", ".m4v", ".mov", ".mkv", ".avi")  # containers that take MPEG-4
MAX_BACKLOG = 8  # frames waiting to be encoded, before a live camera's are dropped


class SeenTrack(NamedTuple):
    """A track in the pixels of the image: centre (2,), velocity (2,), covariance (2, 2) of the centre, size (2,)."""

    entry: IdentifiedTrack
    centre: Array
    velocity: Array
    cov: Array
    size: Array


def as_seen(report: ScanReport, camera: PinholeCamera) -> list[SeenTrack]:
    """The tracks of a scan, back in the image as the camera gave it."""
    entries = report.tracks.tracks
    ideal = np.array([entry.track.mean[::2] for entry in entries]).reshape(-1, 2)
    centre = camera.distort(ideal)
    undo = camera.undistort_jacobian(centre)
    seen = []
    for entry, uv, J in zip(entries, centre, undo, strict=True):
        if not (np.isfinite(uv).all() and np.isfinite(J).all()):
            continue  # outside what the lens can show
        by_ideal = np.linalg.inv(J)
        track = entry.track
        cov = by_ideal @ track.cov[::2, ::2] @ by_ideal.T
        seen.append(SeenTrack(entry, uv, by_ideal @ track.mean[1::2], cov, track.size))
    return seen


class JsonLines:
    """`[output] jsonl`: a line for each processed frame (DESIGN.md, contract 4). t_s counts from the first frame."""

    def __init__(self, path: Path) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file: TextIO = path.open("w", encoding="utf-8", buffering=1)  # a line is whole or absent
        except OSError as error:
            raise SourceError(
                f"output.jsonl: {path}: {error.strerror}, expected a file that can be written"
            ) from error
        self._start: float | None = None
        self.failed = 0

    def write(self, report: ScanReport, seen: list[SeenTrack]) -> None:
        start = self._start = report.tracks.t if self._start is None else self._start
        line = {
            "t_s": round(report.tracks.t - start, 6),
            "frame": report.sequence,
            "tracks": [_record(track) for track in seen],
        }
        try:
            self._file.write(json.dumps(line, allow_nan=False) + "\n")
        except OSError as error:  # the disk is full: the flight goes on
            if not self.failed:
                log.warning("output.jsonl: %s; lines are being lost", error.strerror)
            self.failed += 1

    def close(self) -> None:
        with suppress(OSError):  # what a full disk did not take was said when it was written
            self._file.close()


def _record(seen: SeenTrack) -> dict[str, Any]:
    track = seen.entry.track
    w, h = (None if np.isnan(side) else round(float(side), 2) for side in seen.size)
    return {
        "id": track.id,
        "identity": seen.entry.identity,
        "u_px": round(float(seen.centre[0]), 3),
        "v_px": round(float(seen.centre[1]), 3),
        "vu_px_s": round(float(seen.velocity[0]), 3),
        "vv_px_s": round(float(seen.velocity[1]), 3),
        "var_u_px2": round(float(seen.cov[0, 0]), 4),
        "var_v_px2": round(float(seen.cov[1, 1]), 4),
        "w_px": w,
        "h_px": h,
        "status": str(track.status),
        "probability": round(track.probability, 6),
    }


# Okabe & Ito's colours, told apart by all eyes (BGR); a drone keeps its colour everywhere.
COLOURS = [
    (0, 159, 230),
    (233, 180, 86),
    (115, 158, 0),
    (66, 228, 240),
    (178, 114, 0),
    (0, 94, 213),
    (167, 121, 204),
]
UNKNOWN, FOREIGN = (200, 200, 200), (60, 60, 255)


def annotate(frame: Frame, t_s: float, seen: list[SeenTrack]) -> Image:
    """A copy of the frame with boxes, names, velocities (a quarter of a second ahead) and 3σ ellipses."""
    grey = frame.image.ndim == 2
    image: Image = cv2.cvtColor(frame.image, cv2.COLOR_GRAY2BGR) if grey else frame.image.copy()  # type: ignore[assignment]
    for track in seen:
        _draw(image, track)
    count = sum(track.entry.track.status is TrackStatus.CONFIRMED for track in seen)
    _write(image, f"{t_s:7.2f} s  frame {frame.sequence}  {count} tracked", (8, 20), (255, 255, 255))
    return image


def _draw(image: Image, seen: SeenTrack) -> None:
    identity, status = seen.entry.identity, seen.entry.track.status
    colour = (
        FOREIGN
        if identity == "foreign"
        else UNKNOWN
        if identity is None
        else COLOURS[int(identity) % len(COLOURS)]
    )
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
    name = (
        f"track {seen.entry.track.id}"
        if identity is None
        else f"drone {identity}"
        if identity != "foreign"
        else "foreign"
    )
    label = name if status is TrackStatus.CONFIRMED else f"{name} (lost)"
    # Above the box, or below it where there is no room between the image's edge and the line at its top.
    baseline = corner[1] - 5 if corner[1] > 40 else opposite[1] + 17
    _write(image, label, (max(0, min(corner[0], image.shape[1] - 9 * len(label))), baseline), colour)


def _write(image: Image, text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)


def check_outputs(jsonl: Path | None, video: Path | None) -> None:
    """Raise SourceError for what cannot be written, as far as one can tell without writing anything."""
    if video:
        _check_suffix(video)
    for name, path in (("jsonl", jsonl), ("video", video)):
        if path is None:
            continue
        there = path if path.exists() else next(p for p in path.absolute().parents if p.exists())
        if there == path and path.is_dir():
            raise SourceError(f"output.{name}: {path} is a folder, expected a file that can be written")
        if (there != path and not there.is_dir()) or not os.access(there, os.W_OK):
            raise SourceError(
                f"output.{name}: {path}: no permission to write there, expected a file that can be"
            )


def _check_suffix(path: Path) -> None:
    if path.suffix.lower() not in VIDEO_SUFFIXES:
        raise SourceError(f"output.video: {path}: expected a name that ends in {', '.join(VIDEO_SUFFIXES)}")


def _check_video(path: Path) -> None:
    """Raise SourceError now where OpenCV would only write nothing later."""
    _check_suffix(path)
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
