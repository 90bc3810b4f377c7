"""Whether a stamp is our autopilot's: its clock counts from its boot, forward, and no faster than time passes.

A stamp that goes back is no reboot by itself. A clock that began again since it was last read counts less than the time
since then; whatever goes back and counts more is a late copy, a second sender under the same ID, or a counter of 32
bits that has wrapped. Likewise a stamp that leaps ahead of time is another clock's.

So what does not fit is dropped, and followed as a second clock. It takes the place of ours when it can only be ours
after a reboot, or when ours has been silent for CLOCK_REPLACED_AFTER_S. Hence the clock is reset once per reboot, and
without one never more often than once in that time.

A firmware may stamp its messages by different clocks, so each kind of message has a `BootClock` of its own.
"""

from __future__ import annotations

import enum
import math
from collections import deque
from dataclasses import dataclass

from swarmtrack.autopilot.limits import (
    CLOCK_AHEAD_RATE,
    CLOCK_AHEAD_S,
    CLOCK_FIRST_READINGS,
    CLOCK_INTERVAL_S,
    CLOCK_REPLACED_AFTER_S,
    COPY_REMEMBERED_S,
    REBOOT_READINGS,
    REBOOT_SLACK_S,
    SHORTEST_REBOOT_S,
)

# s: after so long a counter of 32 bits begins again.
MILLISECONDS_WRAP_S, MICROSECONDS_WRAP_S = 2**32 * 1e-3, 2**32 * 1e-6


class StampStep(enum.Enum):
    """Class of a stamp relative to those before it. OTHER: late, or of another clock; REBOOT: the first that is
    believed of a clock that has begun again; REPLACED: of one that has not, after ours had fallen silent.
    """

    NEXT = enum.auto()
    SAME = enum.auto()
    OTHER = enum.auto()
    REBOOT = enum.auto()
    REPLACED = enum.auto()


@dataclass(slots=True)
class _SecondClock:
    """What did not fit. began_at, read_at [s]: ours; stamp [s]: its newest; readings: how often it advanced."""

    began_at: float
    read_at: float
    stamp: float
    readings: int = 1

    def advance(self, t: float, stamp: float) -> bool:
        """Whether the stamp is this clock's next one."""
        if not self.stamp < stamp <= self.stamp + _most_ahead(t - self.read_at):
            return False
        self.read_at, self.stamp = t, stamp
        self.readings += 1
        return True


def _most_ahead(elapsed: float) -> float:
    """s by which a stamp may exceed the one before it, `elapsed` s later."""
    return CLOCK_AHEAD_S + CLOCK_AHEAD_RATE * max(0.0, elapsed - CLOCK_INTERVAL_S)


class BootClock:
    """Reads one kind of message. wrap_s: after which its counter may begin again.

    apart [s]: what did not fit last, less our newest, NaN before there was such; wraps: of the counter since it counted
    from 0; turns: those that were seen.
    """

    def __init__(self, wrap_s: float) -> None:
        self.apart = math.nan
        self.wraps = self.turns = 0
        self._wrap_s = wrap_s
        self._newest: float | None = None
        self._read_at = -math.inf
        self._readings = 0
        self._least_delayed = -math.inf
        """The largest of all stamps less their arrivals [s]."""
        self._second: _SecondClock | None = None

    def read(self, t: float, raw: float, near: float | None = None) -> tuple[StampStep, float]:
        """Classify the stamp `raw` [s] that came at t [s]; return it with the wraps added.

        near [s]: about what it has to be, by another kind of message of the same autopilot; None: unknown.
        """
        stamp = self._unwrapped(t, raw, near)
        if stamp == self._newest:
            return StampStep.SAME, stamp
        if self._newest is not None and self._has_begun_again(t, raw, stamp):
            self._begin_again(t, raw)
            return StampStep.REBOOT, raw
        if self._newest is None or (stamp > self._newest and self._is_in_time(t, stamp)):
            self._newest, self._read_at = stamp, t
            self._readings += 1
            self._least_delayed = max(self._least_delayed, stamp - t)
            return StampStep.NEXT, stamp
        self.apart = stamp - self._newest
        return self._follow(t, raw), stamp

    def _is_in_time(self, t: float, stamp: float) -> bool:
        """Whether a later stamp is not ahead of time: soon after the newest, or hardly less delayed than any before."""
        assert self._newest is not None
        soon = stamp <= self._newest + _most_ahead(t - self._read_at)
        as_ever = stamp - t <= self._least_delayed + CLOCK_AHEAD_S
        return soon or as_ever or self._readings < CLOCK_FIRST_READINGS

    def _has_begun_again(self, t: float, raw: float, stamp: float) -> bool:
        """Whether after a silence it is less than it would be, though more than it was. A simulator that was paused
        goes on from where it was.
        """
        assert self._newest is not None
        silence = t - self._read_at
        behind = self._newest + silence - stamp
        is_later = stamp > self._newest + CLOCK_AHEAD_S
        return (
            silence >= SHORTEST_REBOOT_S
            and is_later
            and behind > max(SHORTEST_REBOOT_S, 0.02 * silence)
            and self.may_be_reboot(t, raw)
        )

    def _begin_again(self, t: float, raw: float) -> None:
        self._newest, self._read_at, self._second, self.wraps = raw, t, None, 0
        self._readings, self._least_delayed = 1, raw - t

    def may_be_reboot(self, t: float, raw: float) -> bool:
        """Whether a clock that has begun again since the last reading could say so."""
        return raw <= t - self._read_at + REBOOT_SLACK_S

    def _unwrapped(self, t: float, raw: float, near: float | None) -> float:
        """A clock that is being heard wraps; one that was silent for longer may have rebooted."""
        if self._newest is None:
            if near is not None and abs(math.remainder(near - raw, self._wrap_s)) < SHORTEST_REBOOT_S:
                self.wraps = round((near - raw) / self._wrap_s)
            return raw + self.wraps * self._wrap_s
        wraps = self.wraps
        if abs(t - self._read_at) < SHORTEST_REBOOT_S:
            beside = round((self._newest - raw) / self._wrap_s)
            # A late one may be of before the wrap.
            is_near = abs(raw + beside * self._wrap_s - self._newest) < 2 * SHORTEST_REBOOT_S
            if is_near and beside >= 0 and abs(beside - wraps) == 1:
                wraps = beside
                self.turns += wraps > self.wraps
                self.wraps = max(self.wraps, wraps)
        return raw + wraps * self._wrap_s

    def _follow(self, t: float, raw: float) -> StampStep:
        second = self._second
        if second is None or not second.advance(t, raw):
            self._second = second = _SecondClock(t, t, raw)
        if second.began_at < self._read_at:
            return StampStep.OTHER
        silence, proven = t - self._read_at, second.readings >= REBOOT_READINGS
        if self.may_be_reboot(t, raw) and (proven or silence >= SHORTEST_REBOOT_S):
            step = StampStep.REBOOT
        elif proven and silence >= CLOCK_REPLACED_AFTER_S:
            step = StampStep.REPLACED
        else:
            return StampStep.OTHER
        self._begin_again(t, raw)
        return step

    @property
    def is_shared(self) -> bool:
        """Whether what did not fit advances as a clock does."""
        return self._second is not None and self._second.readings >= REBOOT_READINGS


class CopyMemory:
    """Recognises contents that have come before, within COPY_REMEMBERED_S: a second way has brought them again."""

    def __init__(self) -> None:
        self._seen: set[int] = set()
        self._order: deque[tuple[float, int]] = deque()

    def has(self, t: float, message_id: int, content: bytes) -> bool:
        """Whether it has come before t [s]; from now on it has."""
        while self._order and t - self._order[0][0] > COPY_REMEMBERED_S:
            self._seen.discard(self._order.popleft()[1])
        key = hash((message_id, content))
        if key in self._seen:
            return True
        self._seen.add(key)
        self._order.append((t, key))
        return False
