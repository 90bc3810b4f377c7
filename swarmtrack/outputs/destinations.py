"""Output files of an agent for people: a JSON line for each scan; `annotated_video` adds a picture.

Pixels here are those of the image as the camera gave it: the tracker's undistorted ones are distorted again.
"""

from __future__ import annotations

import json
import logging
import os
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from swarmtrack.errors import SourceError
from swarmtrack.messages import ScanReport
from swarmtrack.outputs.drawing import SeenTrack
from swarmtrack.relative.record import relative_record

log = logging.getLogger(__name__)

WEBM = ".webm"  # VP8, which browsers play
VIDEO_KEY = "output.video"  # of a config
VIDEO_SUFFIXES = (".mp4", ".m4v", ".mov", ".mkv", ".avi", WEBM)  # all others take MPEG-4


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
