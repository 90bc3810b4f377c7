"""When it was that a teammate speaks of, though its wall clock may be hours off, or ours.

Theory of operation. What tells a time on the wire tells it twice: as the sender's UTC, and as the age it had when the
bytes were made. The sum of the two is when they were made, on the sender's wall clock; the difference to their arrival
is how far the two clocks are apart, plus the time on the way. Only the way varies, and only upwards, so the smallest of
the last differences is the best estimate. While it is small both clocks are taken to be kept by somebody, who knows
UTC better than we can tell from arrivals; otherwise the time is carried over to our clock by the estimate.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from swarmtrack.transport.limits import ARRIVAL_SIGMA_S, CLOCK_DIFFERENCES_KEPT, CLOCK_STEP_S
from swarmtrack.wire.announcement import AnnouncementMessage
from swarmtrack.wire.motion import MotionMessage
from swarmtrack.wire.ranging import RangeMessage
from swarmtrack.wire.sightings import SightingsMessage


class StampedTime(NamedTuple):
    """An instant on our monotonic clock, and its standard deviation [s]."""

    t: float
    sigma: float


class SenderClock:
    """Of one boot, whose every message in order is to be told."""

    def __init__(self) -> None:
        self._differences: deque[float] = deque(maxlen=CLOCK_DIFFERENCES_KEPT)

    def time_of(
        self,
        message: AnnouncementMessage | SightingsMessage | MotionMessage | RangeMessage,
        *,
        arrived: float,
        utc_offset: float,
        tolerance: float,
    ) -> StampedTime:
        """When the message's pose held. arrived: on our monotonic clock; utc_offset: ours, UTC minus monotonic.

        tolerance [s]: up to here two clocks count as one.
        """
        difference = arrived + utc_offset - (message.t_utc_s + message.age_s)
        if self._differences and difference > min(self._differences) + CLOCK_STEP_S:
            self._differences.clear()
        self._differences.append(difference)
        apart = min(self._differences)
        t = message.t_utc_s - utc_offset
        if abs(apart) <= tolerance:
            return StampedTime(t, message.t_sigma_s)
        return StampedTime(t + apart, max(message.t_sigma_s, ARRIVAL_SIGMA_S))

    @property
    def apart_s(self) -> float:
        """How far our UTC is ahead of the sender's, the quickest message's way included; 0 before the first."""
        return min(self._differences, default=0.0)
