"""Rate limit for messages that flight does not need: tracks and pictures give way before the radio is full.

Theory of operation. A token bucket fills at a rate; a message takes as many bytes as go out, to all listeners
together. A message that finds it empty is dropped, not kept: the next one sent is the newest. A message may take more
than is left, so that one larger than the bucket is sent eventually.

The rate is unlimited until packets wait (`congestion`). Packets also wait for other reasons: a long way, losses, frames
that a radio does not carry. Full is what a lower rate makes quicker. So the first sign starts a trial: for a few
seconds little is sent. If packets wait for less time then, the radio was full: the rate begins at the least, is cut
while they wait, and grows by a quarter each second until it exceeds the demand. (What was sent before the trial, cut by
a third, still filled the radio for seconds, and lives were missed.) If the trial shortened nothing, it is taken back,
and not repeated for a while that doubles each time, unless the waiting gets much worse.

After a link came or went the rate begins low, so that the radio is not full before that can be measured. But for
trials it is never less than five tracks per second, nor ever more than the budget. (RFC 6817 yields on the same signal;
CoDel, RFC 8289, judges by the shortest wait of an interval, as `congestion` does.)

Pure state; times by any clock [s].
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from dataclasses import dataclass, replace

from swarmtrack.transport.congestion import Waiting
from swarmtrack.transport.limits import (
    MESSAGE_OVERHEAD_BYTES,
    PACE_BURST_S,
    PACE_CAREFUL_GROWTH,
    PACE_CUT,
    PACE_CUT_HOLD_S,
    PACE_DEEP_QUEUE_S,
    PACE_LEAST_BYTES_PER_S,
    PACE_LEAST_HZ,
    PACE_LOW,
    PACE_MUTE_S,
    PACE_QUICK_GROWTH,
    PACE_TRIAL_BACK_OFFS,
    PACE_TRIAL_HZ,
    PACE_TRIAL_LEAST_S,
    PACE_TRIAL_OVER,
    PACE_TRIAL_REST_S,
    PACE_TRIAL_S,
    PACE_TRIAL_SHORTER,
    PACE_UNLIMITED_FACTOR,
    PACE_USUAL_LOOKS,
    PACE_WORSE,
)


@dataclass(frozen=True, slots=True)
class _Trial:
    """since [s]; worst: how long packets usually waited at most since then; sent: bytes per second before it."""

    since: float
    worst: Waiting
    sent: float


class Pacing:
    """budget_bytes_s: upper limit, to all listeners together; None: none."""

    def __init__(self, budget_bytes_s: float | None = None) -> None:
        self._budget = math.inf if budget_bytes_s is None else budget_bytes_s
        self._rate = math.inf
        self._least = PACE_LEAST_BYTES_PER_S
        self._growth = PACE_QUICK_GROWTH
        self._tokens = 0.0
        self._filled_at = -math.inf
        self._cut_at = -math.inf
        self._looked_at: float | None = None
        self._asked = self._said = 0.0
        self._asked_s = 0.0
        self._recent: deque[Waiting] = deque(maxlen=PACE_USUAL_LOOKS)
        self._trial: _Trial | None = None
        self._vain: _Trial | None = None
        """The last trial that shortened nothing."""
        self._vain_times = 0
        self._vain_until = -math.inf
        self._worst = Waiting(0.0, 0)
        self._low_since = -math.inf

    @property
    def bytes_s(self) -> float:
        """Current rate limit; infinite: no limit."""
        if self._trial is not None:
            return min(PACE_TRIAL_HZ / PACE_LEAST_HZ * self._least, self._budget)
        return min(max(self._rate, self._least), self._budget)

    @property
    def is_full(self) -> bool:
        """Whether the radio was found to be full, and has not recovered yet."""
        return self._trial is None and self._growth == PACE_CAREFUL_GROWTH

    @property
    def may_be_full(self) -> bool:
        """Whether packets wait: the radio was found to be full, or a trial is to show whether it is."""
        return self._trial is not None or self.is_full

    @property
    def gives_way(self) -> bool:
        """Whether the rate is below the demand because the radio is full, or because of the budget; not because of a
        new link or a trial.
        """
        by_budget = math.isfinite(self._budget) and self._trial is None and self._budget <= self._rate
        return (self.is_full or by_budget) and self._asked_s > self.bytes_s

    @property
    def is_limited(self) -> bool:
        """Whether the demand may be more than the rate: messages had better be short."""
        return math.isfinite(self.bytes_s)

    def allows(self, size: int, listeners: int, now: float, *, tracks: bool) -> bool:
        """Whether a message of `size` bytes may be sent now; then it is counted as sent. Tracks have priority.
        listeners: number of copies.
        """
        cost = float((size + MESSAGE_OVERHEAD_BYTES) * listeners)
        self._asked += cost
        if tracks and cost:
            self._least = PACE_LEAST_HZ * cost
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
        """A subscriber appeared, or a link was lost. Where a trial was in vain not long ago, losses end links."""
        if self._looked_at is None or self._looked_at >= self._vain_until:
            self._rate = min(self._rate, self._least)

    def adjust(self, waiting: Waiting, now: float) -> None:
        """Adapt the rate to the queues. To be called a few times per second."""
        if self._looked_at is None or now <= self._looked_at:
            self._looked_at = now
            return
        seconds = now - self._looked_at
        said_s, self._asked_s = self._said / seconds, self._asked / seconds
        self._looked_at, self._said, self._asked = now, 0.0, 0.0
        usual = self._usual(waiting)
        if self._trial is not None:
            self._judge(self._trial, usual, now)
        elif not waiting.is_late:
            self._grow(seconds)
        elif self.is_full:
            if self._is_no_better(usual, now):
                self._take_back(_Trial(now, self._worst, max(said_s, self._least)), now)
            elif now - self._cut_at >= PACE_CUT_HOLD_S:
                self._cut(min(self._rate, max(said_s, self._least)), now)
        elif said_s > 0.0 and not self._is_vain(waiting, now):
            self._trial = _Trial(now, usual, said_s)
        else:
            self._grow(seconds)

    def _judge(self, trial: _Trial, usual: Waiting, now: float) -> None:
        # What waited already when it began is measured later.
        trial = self._trial = replace(trial, worst=max(trial.worst, usual))
        over = not usual.is_late or usual.is_shorter(trial.worst, PACE_TRIAL_OVER)
        if now - trial.since < (PACE_TRIAL_LEAST_S if over else PACE_TRIAL_S):
            return
        self._trial = None
        is_deep = usual.delay_s > PACE_DEEP_QUEUE_S or usual.silent_s > PACE_MUTE_S
        is_quicker = over or usual.is_shorter(trial.worst, PACE_TRIAL_SHORTER)
        if is_deep or (is_quicker and trial.worst.is_queue):
            self._worst, self._low_since = trial.worst, now
            self._cut(self._least, now)
        else:
            self._take_back(trial, now)

    def _is_no_better(self, usual: Waiting, now: float) -> bool:
        """Whether the rate has been low for a while and that shortened nothing either: then the trial erred. Nothing
        but a queue makes every packet wait for more than a second.
        """
        if self._rate > PACE_LOW * self._least:
            self._low_since = now
        is_deep = usual.delay_s > PACE_DEEP_QUEUE_S
        is_better = usual.is_shorter(self._worst, PACE_TRIAL_SHORTER)
        return not is_deep and not is_better and now - self._low_since > PACE_TRIAL_S

    def _take_back(self, trial: _Trial, now: float) -> None:
        self._growth, self._vain = PACE_QUICK_GROWTH, trial
        self._rate = max(self._least, PACE_CUT * trial.sent)
        self._vain_until = now + PACE_TRIAL_REST_S * 2.0**self._vain_times
        self._vain_times = min(self._vain_times + 1, PACE_TRIAL_BACK_OFFS)

    def _usual(self, waiting: Waiting) -> Waiting:
        """The median of the last two seconds: a quick packet among late ones proves nothing."""
        self._recent.append(waiting)
        return Waiting(
            statistics.median(each.delay_s for each in self._recent),
            int(statistics.median(each.unsent for each in self._recent)),
            waiting.round_trip_s,
            statistics.median(each.silent_s for each in self._recent),
        )

    def _is_vain(self, waiting: Waiting, now: float) -> bool:
        """Whether a trial was in vain not long ago, and things are not much worse."""
        is_worse = self._vain is not None and self._vain.worst.is_shorter(waiting, 1.0 / PACE_WORSE)
        return now < self._vain_until and not (waiting.is_measured_late and is_worse)

    def _cut(self, sent: float, now: float) -> None:
        self._cut_at, self._growth = now, PACE_CAREFUL_GROWTH
        self._rate = max(self._least, PACE_CUT * sent)

    def _grow(self, seconds: float) -> None:
        if not math.isfinite(self._rate):
            return
        self._rate = max(self._rate, self._least) * self._growth**seconds
        if self._rate > PACE_UNLIMITED_FACTOR * self._asked_s > 0.0:
            self._rate, self._growth = math.inf, PACE_QUICK_GROWTH
