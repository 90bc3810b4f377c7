"""Rate limit for messages that flight does not need: tracks and pictures give way before the radio is full.

Theory of operation. A token bucket fills at a rate; a message takes as many bytes as go out, to all listeners
together. A message that finds it empty is dropped, not kept: the next one sent is the newest. A message may take more
than is left, so that one larger than the bucket is sent eventually.

The rate is unlimited until packets wait (`congestion`). Then it is half of what was sent, and half again while they
wait; afterwards it grows by a fifth each second until it exceeds the demand. After a link came or went it begins low,
so that the radio is not full before that can be measured. It is never more than the budget, nor less than a thousand
bytes per second. (RFC 6817 yields on the same signal.)

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
    """budget_bytes_s: upper limit, to all listeners together; None: none."""

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
        """Current rate limit; infinite: no limit."""
        return min(self._rate, self._budget)

    @property
    def gives_way(self) -> bool:
        """Whether the rate is below the demand because of waiting packets or the budget, not because of a new link."""
        waited = self._growth == PACE_CAREFUL_GROWTH or self._budget <= self._rate
        return waited and self._asked_s > self.bytes_s

    def allows(self, size: int, listeners: int, now: float, *, tracks: bool) -> bool:
        """Whether a message of `size` bytes may be sent now; then it is counted as sent. Tracks have priority.
        listeners: number of copies.
        """
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
        """A subscriber appeared, or a link was lost."""
        self._rate = min(self._rate, PACE_FIRST_BYTES_PER_S)

    def adjust(self, waiting: Waiting, now: float) -> None:
        """Adapt the rate to the queues. To be called a few times per second."""
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
