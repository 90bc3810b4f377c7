"""What is known of the paths that a config writes to: for the check of a config and for doctor alike."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from swarmtrack.config.drone import DroneConfig
from swarmtrack.diagnosis.surroundings import DiskFacts
from swarmtrack.errors import SourceError, SwarmtrackError
from swarmtrack.outputs.destinations import check_outputs


def disk_facts(config: DroneConfig) -> tuple[DiskFacts, ...]:
    """Writability and free space of everything that [output] and [recording] name."""
    output, folder = config.output, config.recording.dir
    found = []
    if output.jsonl is not None:
        found.append(_disk("output.jsonl", output.jsonl, lambda path: check_outputs(path, None)))
    if output.video is not None:
        found.append(_disk("output.video", output.video, lambda path: check_outputs(None, path)))
    if folder is not None:
        found.append(_disk("recording.dir", folder, _check_folder))
    return tuple(found)


def _check_folder(path: Path) -> None:
    """That a folder can be written into, or made. Raises SourceError."""
    there = _nearest(path)
    if not there.is_dir():
        raise SourceError(f"{there}: is not a folder, expected one that can be written into")
    if not os.access(there, os.W_OK | os.X_OK):
        raise SourceError(f"{there}: is not writable")


def _nearest(path: Path) -> Path:
    """Itself, or what of the way to it exists."""
    return next(p for p in (path.absolute(), *path.absolute().parents) if p.exists())


def _disk(what: str, path: Path, check: Callable[[Path], None]) -> DiskFacts:
    refused = ""
    try:
        check(path)
    except SwarmtrackError as error:
        refused = str(error).removeprefix(f"{what}: ")
    try:
        state = os.statvfs(_nearest(path))
        free = float(state.f_bavail) * state.f_frsize
    except OSError as error:
        refused, free = refused or str(error.strerror), 0.0
    return DiskFacts(what, path, refused, free)
