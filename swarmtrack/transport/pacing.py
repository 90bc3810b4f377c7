"""How much of what nobody needs in flight may be said: tracks and pictures give way before the radio is full.

Theory of operation. A bucket fills at a rate; what is said takes as many bytes from it as go out, to all listeners
together. What finds it empty is not said and not kept: the next that is said is the newest. A message may take more
than is left, so that a message larger than the bucket is said at last.

The rate is without limit until packets wait (`congestion`). Then it is half of what was said, and half again while they
wait; afterwards it grows, by a fifth each second, until it is more than is asked for. Where links have come or gone
it begins low, so that the radio is not full before anything of it can be seen. Never is it more than the budget, nor
less than a thousand bytes a second. (RFC 6817 gives way by the same sign.)

Pure state; times by any clock [s].
"""

from __future__ import annotations

import math

from swarmtrack.transport.congestion import Waiting
from swarmtrack.transport.limits import (
    MESSAGE_OVERHEAD_BYTES,
    PACE_BURST_S,
    PACE_CAREFUL_GROWTH,
    PACE_CUT_HOLD_S,
    PACE_FIRST_BYTES_PER_S,
    PACE_LEAST_BYTES_PER_S,
    PACE_QUICK_GROWTH,
    PACE_UNLIMITED_FACTOR,
    PACKETS_LATE_S,
    PACKETS_UNSENT_BYTES,
)


class Pacing:
    """budget_bytes_s: at most, to all listeners together; None: no budget."""

    def __init__(self, budget_bytes_s: float | None = None) -> None:
        self._budget = math.inf if budget_bytes_s is None else budget_bytes_s
        self._rate = math.inf
        self._growth = PACE_QUICK_GROWTH
        self._tokens = 0.0
        self._filled_at = -math.inf
        self._cut_at = -math.inf
        self._looked_at: float | None = None
        self._asked = self._said = 0.0
        self._asked_s = 0.0

    @property
    def bytes_s(self) -> float:
        """What may be said in a second; infinite: whatever is asked for."""
        return min(self._rate, self._budget)

    @property
    def gives_way(self) -> bool:
        """Whether less is said than is asked for, because packets waited or by the budget; not for being new."""
        waited = self._growth == PACE_CAREFUL_GROWTH or self._budget <= self._rate
        return waited and self._asked_s > self.bytes_s

    def allows(self, size: int, listeners: int, now: float, *, tracks: bool) -> bool:
        """Whether a message of `size` bytes may be said now; counted as said. Tracks go before all else. listeners: how
        many times it goes out."""
        cost = float((size + MESSAGE_OVERHEAD_BYTES) * listeners)
        self._asked += cost
        rate = self.bytes_s
        if math.isfinite(rate):
            full = rate * PACE_BURST_S
            self._tokens = min(full, self._tokens + rate * max(0.0, now - max(self._filled_at, now - 1.0)))
            self._filled_at = now
            if self._tokens <= (0.0 if tracks else 0.5 * full):
                return False
            self._tokens -= cost
        self._said += cost
        return True

    def begin(self) -> None:
        """Somebody begins to listen, or a link was lost."""
        self._rate = min(self._rate, PACE_FIRST_BYTES_PER_S)

    def adjust(self, waiting: Waiting, now: float) -> None:
        """To be called a few times a second."""
        if self._looked_at is None or now <= self._looked_at:
            self._looked_at = now
            return
        seconds = now - self._looked_at
        said_s, self._asked_s = self._said / seconds, self._asked / seconds
        self._looked_at, self._said, self._asked = now, 0.0, 0.0
        if waiting.delay_s > PACKETS_LATE_S or waiting.unsent > PACKETS_UNSENT_BYTES:
            if now - self._cut_at >= PACE_CUT_HOLD_S:
                self._cut_at, self._growth = now, PACE_CAREFUL_GROWTH
                self._rate = max(
                    PACE_LEAST_BYTES_PER_S, 0.5 * min(self._rate, max(said_s, PACE_LEAST_BYTES_PER_S))
                )
        elif math.isfinite(self._rate):
            self._rate *= self._growth**seconds
            if self._rate > PACE_UNLIMITED_FACTOR * self._asked_s > 0.0:
                self._rate, self._growth = math.inf, PACE_QUICK_GROWTH
