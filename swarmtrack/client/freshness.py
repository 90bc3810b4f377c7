"""Whether a message is news, or repeated, out of order, or of another time.

A member's message cannot be forged in a team with keys, but a router can repeat one, and any network may deliver late.
Such a message is handed over with a mark: what to do with it is the planner's to decide.

A message's order is by what only grows in one run of its sender's process: a sequence, or the time since its start.
Its time is compared with our wall clock. A drone whose clock is off by hours is known after `CLOCK_LEARNED_OF` messages
in order whose times agree with each other: from then on its times are compared with that clock of its own. A queue or
a router makes messages later, never earlier. So a clock that is known is corrected by messages that come earlier than
it allows; later ones are off time, until they are all that comes for `LEARNED_ANEW_AFTER_S`, or the sender restarts.

Pure state; one `MessageOrder` per drone and kind of message.
"""

from __future__ import annotations

import enum
import statistics
from collections import deque
from typing import Final

CLOCK_LEARNED_OF: Final = 16
OFF_TIME_S: Final = 2.0
"""s: more than messages take on their way."""
LEARNED_ANEW_AFTER_S: Final = 60.0
"""s: longer than any queue. Whose clock was set back in flight is off time for so long."""
ORDERS_KEPT: Final = 256
"""By which a late message is told from one that was delivered before: five seconds of tracks."""


class Mark(enum.StrEnum):
    """What is wrong with a message as news."""

    REPEATED = "repeated"
    """Delivered before."""
    OUT_OF_ORDER = "out of order"
    """Older than the newest that was delivered, which it has been overtaken by."""
    OFF_TIME = "off time"
    """Its time is more than two seconds from now by the clock that its drone is known to have, or by ours."""


class MessageOrder:
    """Takes each message as it arrives."""

    def __init__(self) -> None:
        self._newest: float | None = None
        self._orders: deque[float] = deque(maxlen=ORDERS_KEPT)
        self._clock_s = 0.0
        """Our UTC minus the sender's, as far as it is known."""
        self._clock_known = False
        self._no_news_since: float | None = None
        """UTC of the first message after the newest that was news."""
        self._apart: deque[float] = deque(maxlen=CLOCK_LEARNED_OF)

    def restart(self) -> None:
        """The sender's process is another one now; its machine's clock is the same."""
        self._newest = None
        self._orders.clear()
        self._apart.clear()
        self._clock_known = False
        self._no_news_since = None

    def marks(self, order: float, t_utc_s: float, utc: float) -> frozenset[Mark]:
        """order: sequence or time since the start; t_utc_s: of the message; utc: ours when it arrived, s."""
        if self._no_news_since is not None and utc - self._no_news_since > LEARNED_ANEW_AFTER_S:
            self.restart()
        marks = set()
        if order in self._orders:
            marks.add(Mark.REPEATED)
        elif self._newest is not None and order < self._newest:
            marks.add(Mark.OUT_OF_ORDER)
        apart = utc - t_utc_s
        if not marks:
            self._learn(apart)
        self._orders.append(order)
        if abs(apart - self._clock_s) > OFF_TIME_S:
            marks.add(Mark.OFF_TIME)
        if marks:
            self._no_news_since = utc if self._no_news_since is None else self._no_news_since
        else:
            self._newest, self._no_news_since = order, None
        return frozenset(marks)

    def _learn(self, apart: float) -> None:
        self._apart.append(apart)
        steady = max(self._apart) - min(self._apart) <= OFF_TIME_S
        if steady and len(self._apart) == CLOCK_LEARNED_OF:
            middle = statistics.median(self._apart)
            found = middle if abs(middle) > OFF_TIME_S else 0.0
            self._clock_s = min(found, self._clock_s) if self._clock_known else found
            self._clock_known = True
