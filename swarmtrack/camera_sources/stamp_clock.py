"""Clock of a camera's stamps: which of ours they are on, if on any.

A stamp near a clock of ours need not be of it: a camera's uptime is near ours if both were switched on together, and
a camera without NTP may be a second behind. What tells is the least age over some frames. A true stamp is older than
its arrival by the camera's latency, which some frame shows without a queue: more than nothing, less than what makes
frames useless. Outside of that the stamps are of another clock. CLOCK_MONOTONIC is one machine's: only a sender on ours
can have it.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from swarmtrack.camera_sources.limits import (
    HTTP_LEAST_AGE_S,
    HTTP_MONOTONIC_SIGMA_S,
    HTTP_STAMP_WINDOW_S,
    HTTP_UTC_SIGMA_S,
    STAMP_LATE_S,
    STAMPS_COMPARED,
)
from swarmtrack.clock import Clock

SAME_DAY_S = 86400.0


class StampBounds(NamedTuple):
    """low_s, high_s: of the least age of some frames at their arrival; from late_s on it may be that of the clock.
    window_s: a stamp further from a clock is on another. credit: so many frames may be older than high_s before that
    is held against their clock.
    """

    low_s: float
    late_s: float
    high_s: float
    window_s: float
    credit: int = 0


HTTP_STAMP_BOUNDS = StampBounds(HTTP_LEAST_AGE_S[0], STAMP_LATE_S, HTTP_LEAST_AGE_S[1], HTTP_STAMP_WINDOW_S)


class _OurClock(NamedTuple):
    """One that stamps may be on. ages: of the last frames [s]."""

    name: str
    sigma: float
    ages: deque[float]


class StampClock:
    """Judges the stamps of one connection. problem: why they are not used, doubt: why they may be wrong, or empty."""

    def __init__(
        self, clock: Clock, *, same_machine: bool, utc: bool = True, bounds: StampBounds = HTTP_STAMP_BOUNDS
    ) -> None:
        """same_machine, utc: whether they may be on our monotonic clock, in UTC."""
        self._clock = clock
        self._bounds = bounds
        self.problem = self.doubt = ""
        self._monotonic = _OurClock("this machine's monotonic clock", HTTP_MONOTONIC_SIGMA_S, _ages())
        self._utc = _OurClock("UTC", HTTP_UTC_SIGMA_S, _ages())
        self._candidates = [self._monotonic] * same_machine + [self._utc] * utc

    def exposure(self, stamp: float, arrived: float) -> tuple[float, float] | None:
        """(exposure [s] on our monotonic clock, its standard deviation [s]); None where the stamp is on no clock of
        ours. stamp [s]: from the stream, NaN for one that is no number; arrived: on our clock.
        """
        bounds = self._bounds
        now = self._clock.now()
        nearest: tuple[float, _OurClock] | None = None
        for ours in self._candidates:
            clock_now = now if ours is self._monotonic else self._clock.utc()
            age = arrived - now + clock_now - stamp
            if abs(age) < bounds.window_s:
                ours.ages.append(age)
                high = math.inf if len(ours.ages) <= bounds.credit else bounds.high_s
                least = min(ours.ages)
                if bounds.low_s <= least <= high:
                    self.problem = ""
                    self.doubt = _doubt(least, ours) if least > bounds.late_s else ""
                    # What is beyond any usual latency may be the clock's as well, evenly from none to all of it.
                    offset_sigma = max(0.0, least - bounds.late_s) / 12**0.5
                    return arrived - age, math.hypot(ours.sigma, offset_sigma)
                age = min(ours.ages)
            if not math.isnan(age) and (nearest is None or abs(age) < abs(nearest[0])):
                nearest = age, ours
        self.doubt = ""
        self.problem = "they are no numbers of seconds" if nearest is None else self._apart(*nearest)
        for unit, per_second in (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)):
            if abs(stamp / per_second - self._clock.utc()) < SAME_DAY_S:
                self.problem = f"they are {unit}, expected seconds"
        return None

    def _apart(self, age: float, ours: _OurClock) -> str:
        low, _, high, window, _ = self._bounds
        way = "behind" if age > 0.0 else "ahead of"
        count = f"{len(ours.ages)} frame{'s' if len(ours.ages) > 1 else ''}"
        youngest = f" by the youngest of {count}" if abs(age) < window else ""
        found = f"their clock is {abs(age):.3g} s {way} {ours.name}{youngest}"
        found += ", or the stream is that late" if 0.0 < age < window else ""
        return f"{found}, expected {1e3 * low:+.0f} to {1e3 * high:+.0f} ms"


def _doubt(age: float, ours: _OurClock) -> str:
    return (
        f"stamps are {1e3 * age:.0f} ms old or more: the stream is late, or their clock is behind {ours.name}"
    )


def _ages() -> deque[float]:
    return deque(maxlen=STAMPS_COMPARED)
