"""The only place that reads a clock. Everything else is told the time."""

from __future__ import annotations

import time
from typing import Protocol

cpu_seconds = time.thread_time
"""Of the calling thread: what work has cost, however long it took."""

UTC_SIGMA = 0.05  # s: what a companion kept by NTP knows of UTC


class Clock(Protocol):
    """Seconds. `now` never steps; `utc` is the wall clock, which may."""

    def now(self) -> float: ...
    def utc(self) -> float: ...


class SystemClock:
    """CLOCK_MONOTONIC, the clock of V4L2 buffer stamps, and the system's UTC."""

    def now(self) -> float:
        return time.monotonic()

    def utc(self) -> float:
        return time.time()


def utc_offset(clock: Clock) -> float:
    """What makes UTC of `now` [s], by both clocks at once. Less a `now` from before some work it would be too large by
    as long as that took, and what is stamped by it late."""
    return clock.utc() - clock.now()


class ManualClock:
    """A clock that is set: for tests, and for recordings processed as fast as they go."""

    def __init__(self, now: float = 0.0, utc: float = 1.7e9) -> None:
        self._now = now
        self._utc_offset = utc - now

    def now(self) -> float:
        return self._now

    def utc(self) -> float:
        return self._now + self._utc_offset

    def set(self, now: float) -> None:
        self._now = max(now, self._now)
