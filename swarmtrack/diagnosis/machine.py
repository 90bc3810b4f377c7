"""Facts of the machine: what is written where, how hot it is."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from contextlib import suppress
from pathlib import Path

from swarmtrack.config import DroneConfig
from swarmtrack.diagnosis.surroundings import DiskFacts, HeatFacts
from swarmtrack.errors import SwarmtrackError
from swarmtrack.runtime.outputs import check_outputs

THERMAL = Path("/sys/class/thermal")
PLAUSIBLE_CELSIUS = (-40.0, 150.0)


def disk(config: DroneConfig) -> tuple[DiskFacts, ...]:
    """Of everything that [output] names."""
    output = config.output
    written = (("output.jsonl", output.jsonl, None), ("output.video", None, output.video))
    return tuple(
        _disk(what, jsonl, video) for what, jsonl, video in written if jsonl is not None or video is not None
    )


def _disk(what: str, jsonl: Path | None, video: Path | None) -> DiskFacts:
    path = jsonl or video
    assert path is not None
    refused = ""
    try:
        check_outputs(jsonl, video)
    except SwarmtrackError as error:
        refused = str(error).removeprefix(f"{what}: ")
    there = next(p for p in (path.absolute(), *path.absolute().parents) if p.exists())
    try:
        state = os.statvfs(there)
        free = float(state.f_bavail) * state.f_frsize
    except OSError as error:
        refused, free = refused or str(error.strerror), 0.0
    return DiskFacts(what, path, refused, free)


def heat(thermal: Path = THERMAL) -> HeatFacts:
    """What Linux and, on a Raspberry Pi, its firmware say."""
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
