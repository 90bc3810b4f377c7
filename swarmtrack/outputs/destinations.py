"""What an agent writes for people, beside the network: a JSON line for each scan; `annotated_video` adds a picture.

Pixels here are those of the image as the camera gave it: the tracker's undistorted ones are distorted again.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np

from swarmtrack.errors import SourceError
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array, IdentifiedTrack, ScanReport
from swarmtrack.relative.record import relative_record

log = logging.getLogger(__name__)

WEBM = ".webm"  # VP8, which browsers play
VIDEO_KEY = "output.video"  # of a config
VIDEO_SUFFIXES = (".mp4", ".m4v", ".mov", ".mkv", ".avi", WEBM)  # all others take MPEG-4


class SeenTrack(NamedTuple):
    """A track in the pixels of the image: centre (2,), velocity (2,), covariance (2, 2) of the centre, size (2,)."""

    entry: IdentifiedTrack
    centre: Array
    velocity: Array
    cov: Array
    size: Array


def as_seen(report: ScanReport, *lenses: PinholeCamera) -> list[SeenTrack]:
    """The tracks of a scan, each back in the image as its camera gave it. lenses: of all cameras of the drone."""
    entries = report.tracks.tracks
    if len(lenses) == 1:
        return _as_seen(entries, lenses[0])
    seen = {
        track.entry.track.id: track
        for camera, lens in enumerate(lenses)
        for track in _as_seen([entry for entry in entries if entry.track.camera == camera], lens)
    }
    return [seen[entry.track.id] for entry in entries if entry.track.id in seen]


def _as_seen(entries: Sequence[IdentifiedTrack], camera: PinholeCamera) -> list[SeenTrack]:
    """Those of one camera."""
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
    """`[output] jsonl`: a line for each processed frame (DESIGN.md, contract 4). t_s counts from the first frame.

    cameras: how many the drone has. With several, a line says whose frame it is of, and each track in whose image it
    is.
    """

    def __init__(self, path: Path, *, cameras: int = 1) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file: TextIO = path.open("w", encoding="utf-8", buffering=1)  # a line is whole or absent
        except OSError as error:
            raise SourceError(
                f"output.jsonl: {path}: {error.strerror}, expected a file that can be written"
            ) from error
        self._start: float | None = None
        self._several = cameras > 1
        self.failed = 0

    def write(self, report: ScanReport, seen: list[SeenTrack]) -> None:
        start = self._start = report.tracks.t if self._start is None else self._start
        line = {
            "t_s": round(report.tracks.t - start, 6),
            "frame": report.sequence,
            **({"camera": report.camera} if self._several else {}),
            "tracks": [_record(track, several=self._several) for track in seen],
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


def _record(seen: SeenTrack, *, several: bool) -> dict[str, Any]:
    """several: the drone has more than one camera."""
    track = seen.entry.track
    w, h = (None if np.isnan(side) else round(float(side), 2) for side in seen.size)
    proof = seen.entry.proof
    proved = (
        {}
        if proof is None
        else {
            "proof": {"probability": round(proof.probability, 6), "proved_s": round(track.t - proof.since, 3)}
        }
    )
    return {
        "id": track.id,
        "identity": seen.entry.identity,
        **({"camera": track.camera} if several else {}),
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
        **proved,
        "relative": None if seen.entry.relative is None else relative_record(seen.entry.relative),
    }


def video_paths(path: Path, cameras: int) -> list[Path]:
    """The annotated video of each camera: `annotated.mp4`, `annotated-2.mp4`, …"""
    return [path, *(path.with_stem(f"{path.stem}-{number}") for number in range(2, cameras + 1))]


def check_outputs(
    jsonl: Path | None, video: Path | None, cameras: int = 1, *, video_key: str = VIDEO_KEY
) -> None:
    """Raise SourceError for what cannot be written, as far as one can tell without writing anything. video_key: where
    the video was asked for."""
    if video:
        check_suffix(video, video_key)
    videos = video_paths(video, cameras) if video else []
    for name, path in (("output.jsonl", jsonl), *((video_key, one) for one in videos)):
        if path is None:
            continue
        there = path if path.exists() else next(p for p in path.absolute().parents if p.exists())
        if there == path and path.is_dir():
            raise SourceError(f"{name}: {path} is a folder, expected a file that can be written")
        if (there != path and not there.is_dir()) or not os.access(there, os.W_OK):
            raise SourceError(f"{name}: {path}: no permission to write there, expected a file that can be")


def check_suffix(path: Path, key: str = VIDEO_KEY) -> None:
    if path.suffix.lower() not in VIDEO_SUFFIXES:
        raise SourceError(f"{key}: {path}: expected a name that ends in {', '.join(VIDEO_SUFFIXES)}")
