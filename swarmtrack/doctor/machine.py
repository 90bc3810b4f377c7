"""Facts of the machine: its temperature."""

from __future__ import annotations

import re
import shutil
import subprocess
from contextlib import suppress
from pathlib import Path

from swarmtrack.diagnosis.surroundings import HeatFacts

THERMAL = Path("/sys/class/thermal")
PLAUSIBLE_CELSIUS = (-40.0, 150.0)


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
