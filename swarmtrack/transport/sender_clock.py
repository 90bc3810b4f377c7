"""Time of a teammate's message on our clock, even if its wall clock or ours is hours off.

Theory of operation. A message states its time twice: as the sender's UTC, and as its age when the bytes were made. The
sum of the two is the time of sending on the sender's wall clock; its difference to the arrival is the offset of the
two clocks plus the time on the way. Only the latter varies, and only upwards, so the smallest of the last differences
is the best estimate. While it is small both clocks are taken to be synchronised, with UTC more accurate than any
estimate from arrivals; otherwise the time is mapped to our clock by the estimate.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from swarmtrack.transport.limits import ARRIVAL_SIGMA_S, CLOCK_DIFFERENCES_KEPT, CLOCK_STEP_S
from swarmtrack.wire.announcement import AnnouncementMessage
from swarmtrack.wire.motion import MotionMessage
from swarmtrack.wire.ranging import RangeMessage
from swarmtrack.wire.sightings import SightingsMessage
from swarmtrack.wire.strangers import StrangersMessage


class StampedTime(NamedTuple):
    """An instant on our monotonic clock, and its standard deviation [s]."""

    t: float
    sigma: float


class SenderClock:
    """Clock of one boot; takes every message of it in order."""

    def __init__(self) -> None:
        self._differences: deque[float] = deque(maxlen=CLOCK_DIFFERENCES_KEPT)

    def time_of(
        self,
        message: AnnouncementMessage | SightingsMessage | MotionMessage | RangeMessage | StrangersMessage,
        *,
        arrived: float,
        utc_offset: float,
        tolerance: float,
    ) -> StampedTime:
        """Time of the message's content. arrived: on our monotonic clock; utc_offset: ours, UTC minus monotonic.

        tolerance [s]: two clocks that differ by less count as synchronised.
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
        """Our UTC minus the sender's, including the quickest message's transit; 0 before the first."""
        return min(self._differences, default=0.0)
