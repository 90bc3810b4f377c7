"""Facts of the machine: output paths, temperature."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from swarmtrack.config.drone import DroneConfig
from swarmtrack.diagnosis.surroundings import DiskFacts, HeatFacts
from swarmtrack.errors import SourceError, SwarmtrackError
from swarmtrack.outputs.destinations import check_outputs

THERMAL = Path("/sys/class/thermal")
PLAUSIBLE_CELSIUS = (-40.0, 150.0)


def disk(config: DroneConfig) -> tuple[DiskFacts, ...]:
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


def heat(thermal: Path = THERMAL) -> HeatFacts:
    """Temperatures from Linux and, on a Raspberry Pi, its firmware."""
    celsius = {}
    for zone in sorted(thermal.glob("thermal_zone*")):
        with suppress(OSError, ValueError):
            value = int((zone / "temp").read_text(encoding="ascii")) / 1e3
            if PLAUSIBLE_CELSIUS[0] < value < PLAUSIBLE_CELSIUS[1]:
                celsius[(zone / "type").read_text(encoding="utf-8").strip()] = value
    return HeatFacts(celsius, _throttled())


def _throttled() -> int | None:
    program = shutil.which("vcgencmd")
    if program is None:
        return None
    with suppress(OSError, subprocess.SubprocessError):
        said = subprocess.run(
            [program, "get_throttled"], capture_output=True, text=True, timeout=2.0, check=True
        ).stdout
        if match := re.search(r"throttled=0x([0-9a-fA-F]+)", said):
            return int(match[1], 16)
    return None
