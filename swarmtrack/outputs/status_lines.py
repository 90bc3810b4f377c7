"""Which lines a pilot gets to read, and when: news that lasts, each once, and never a stream of them."""

from __future__ import annotations

import math
from collections import deque
from typing import Generic, NamedTuple, TypeVar

from swarmtrack.autopilot.notices import Severity

BURST = 4  # lines at once
LINE_EVERY = 2.0  # s after them
WAITING = 16  # lines at most; of more, the least severe goes first
STALE_AFTER = 15.0  # s: a line that nobody could hear for so long is no news any more
SAY_AGAIN = 10.0  # s before the same line comes again
REMEMBERED_LINES = 64  # lines for that; whoever makes more of them in that time is flooding us

_V = TypeVar("_V")


class Line(NamedTuple):
    severity: Severity
    text: str
    t: float


class Debounced(Generic[_V]):
    """A state that is news once it has lasted for `hold` s, at most every `rest` s. told: what was said of it last."""

    def __init__(self, told: _V, *, hold: float, rest: float = 0.0) -> None:
        self.told = told
        self._value = told
        self._since = -math.inf
        self._told_at = -math.inf
        self._hold = hold
        self._rest = rest

    def is_news(self, value: _V, now: float) -> bool:
        """Whether it is now told that it is `value`."""
        if value != self._value:
            self._value, self._since = value, now
        settled = now - self._since >= self._hold and now - self._told_at >= self._rest
        if value == self.told or not settled:
            return False
        self.told, self._told_at = value, now
        return True


class StatusLines:
    """Lines that wait to be said. untold: how many were dropped, because too many came or there was no listener."""

    def __init__(self) -> None:
        self.untold = 0
        self._waiting: deque[Line] = deque()
        self._said: dict[str, float] = {}
        self._allowance = float(BURST)
        self._counted_at: float | None = None

    def add(self, severity: Severity, text: str, now: float) -> None:
        """A line for the pilot, unless the same one has just been told."""
        self._said = {line: t for line, t in self._said.items() if now - t < SAY_AGAIN}
        if text in self._said:
            return
        if len(self._said) >= REMEMBERED_LINES:
            self.untold += 1
            return
        self._said[text] = now
        self._waiting.append(Line(severity, text, now))
        if len(self._waiting) > WAITING:
            self._waiting.remove(max(self._waiting, key=lambda line: (line.severity, -line.t)))
            self.untold += 1

    def next(self, now: float) -> Line | None:
        """The line to say now, if there is one and it is not too soon; it waits on until `mark_sent`."""
        if self._counted_at is not None:
            self._allowance = min(BURST, self._allowance + (now - self._counted_at) / LINE_EVERY)
        self._counted_at = now
        while self._waiting and now - self._waiting[0].t > STALE_AFTER:
            self._waiting.popleft()
            self.untold += 1
        return self._waiting[0] if self._waiting and self._allowance >= 1.0 else None

    def mark_sent(self) -> None:
        """The line of `next` is out."""
        self._waiting.popleft()
        self._allowance -= 1.0
