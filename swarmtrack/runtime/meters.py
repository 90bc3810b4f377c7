"""Meters of rates, durations and costs for the health message, over the last seconds."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

METER_WINDOW_VALUES = 512  # values a meter remembers


class Spread(NamedTuple):
    """Median, 95th percentile and maximum."""

    p50: float
    p95: float
    max: float


class RateMeter:
    """Events per second since the last `read`."""

    def __init__(self) -> None:
        self._since: float | None = None
        self._count = 0

    def tick(self, n: int = 1) -> None:
        self._count += n

    def read(self, now: float) -> float:
        """Hz since the last call; the first call starts the measure and says 0."""
        elapsed = 0.0 if self._since is None else now - self._since
        count, self._count, self._since = self._count, 0, now
        return count / elapsed if elapsed > 0.0 else 0.0


class LatencyMeter:
    """The last `window` durations of one kind, seconds."""

    def __init__(self, window: int = METER_WINDOW_VALUES) -> None:
        self._values: deque[float] = deque(maxlen=window)

    def add(self, seconds: float) -> None:
        self._values.append(max(seconds, 0.0))

    def read(self) -> Spread | None:
        """Percentiles of the last values, or None before the first."""
        if not self._values:
            return None
        p50, p95, top = np.percentile(self._values, [50, 95, 100])
        return Spread(float(p50), float(p95), float(top))


class ProcessMeter:
    """CPU and memory of this process, as the kernel accounts for them."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._read_at = now()
        self._cpu_at = _cpu_seconds()

    def cpu_percent(self) -> float:
        """CPU time since the last call, in per cent of one core."""
        now, cpu = self._now(), _cpu_seconds()
        elapsed, used = now - self._read_at, cpu - self._cpu_at
        self._read_at, self._cpu_at = now, cpu
        return 100.0 * used / elapsed if elapsed > 0.0 else 0.0

    @staticmethod
    def rss_mb() -> float:
        """Resident memory, 10⁶ bytes."""
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        return pages * os.sysconf("SC_PAGESIZE") / 1e6


def _cpu_seconds() -> float:
    times = os.times()
    return times.user + times.system
