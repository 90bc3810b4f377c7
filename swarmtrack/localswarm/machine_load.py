"""What the machine has room for, and how busy it was, by what the kernel counts."""

from __future__ import annotations

import math
from collections.abc import Collection
from itertools import pairwise
from pathlib import Path

STAT = Path("/proc/stat")
MEMORY = Path("/proc/meminfo")
AGENT_MB = {"onnx": 85.0, "oracle": 55.0}
"""What each agent has for itself alone, as the kernel counts it (Private_Dirty)."""


class MachineLoad:
    """From when it was made until it is asked, and over parts of that time."""

    def __init__(self, stat: Path = STAT) -> None:
        self._stat = stat
        self._began = self._ticks()
        self._looks: list[tuple[float, tuple[int, int]]] = []

    def look(self, t: float) -> None:
        """To be called a few times a second. t [s] by any clock that only rises."""
        ticks = self._ticks()
        if ticks is not None:
            self._looks.append((t, ticks))

    def share_in(self, spans: Collection[tuple[float, float]]) -> float:
        """As `share`, over those spans of time (from, to) [s] alone; NaN where there was no look in them."""
        idle = total = 0
        for (begin, before), (end, after) in pairwise(self._looks):
            if any(begin < last and first < end for first, last in spans):
                idle, total = idle + after[0] - before[0], total + after[1] - before[1]
        return 1.0 - idle / total if total else math.nan

    def share(self) -> float:
        """0…1 of all cores' time that was spent on anything, by others too; NaN where the kernel does not say."""
        began, now = self._began, self._ticks()
        if began is None or now is None or now[1] <= began[1]:
            return math.nan
        return 1.0 - (now[0] - began[0]) / (now[1] - began[1])

    def _ticks(self) -> tuple[int, int] | None:
        """Idle, and all."""
        try:
            first = self._stat.read_text(encoding="ascii").splitlines()[0].split()
            ticks = [int(word) for word in first[1:9]]  # guests are counted under user as well
            return ticks[3] + ticks[4], sum(ticks)
        except (OSError, ValueError, IndexError):
            return None


def too_large(drones: int, detector: str, memory: Path = MEMORY) -> str:
    """Why a flight of so many agents does not fit into the memory that is free; empty: it does, or nobody knows."""
    try:
        lines = memory.read_text(encoding="ascii").splitlines()
        free_mb = next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")) / 1024.0
    except (OSError, ValueError, IndexError, StopIteration):
        return ""
    each = AGENT_MB[detector]
    if drones * each <= free_mb:
        return ""
    need_gb, free_gb = drones * each / 1024.0, free_mb / 1024.0
    return (
        f"{drones} drones: {drones} agents need {need_gb:.1f} GB of memory, {free_gb:.1f} GB are free, "
        f"expected {int(free_mb / each)} drones at most on this machine"
    )


def lighter_flights(drones: int, detector: str) -> str:
    """What to try where the machine was too busy for a flight of so many drones with that detector."""
    fewer = ["with fewer --drones"] if drones > 2 else []
    oracle = ["with --detector oracle"] if detector != "oracle" else []
    return " or ".join([*fewer, *oracle, "when nothing else runs on it"])
