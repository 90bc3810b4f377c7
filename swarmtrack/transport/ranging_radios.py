"""Processes that publish for the ranging radios on board, and which of their messages count: pure state.

A radio has no liveliness token: the process that reads it need not be an agent. Others are kept out by Zenoh's access
control, which lets only a drone's own certificate publish below its ID.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from swarmtrack.transport.limits import MAX_MEASURED_PER_RADIO, MAX_RADIOS, REPORTED_CLOCKS_AGREE_S
from swarmtrack.transport.sender_clock import SenderClock, StampedTime
from swarmtrack.wire.ranging import RangeMessage


@dataclass(slots=True)
class _Radio:
    clock: SenderClock = field(default_factory=SenderClock)
    said: dict[int, int] = field(default_factory=dict)
    """By teammate: the last sequence."""


class RangingRadios:
    """Radios of one drone. `counters` counts rejected messages by reason."""

    def __init__(self) -> None:
        self._radios: dict[str, _Radio] = {}
        self.counters: Counter[str] = Counter()

    def time_of(self, message: RangeMessage, *, arrived: float, utc_offset: float) -> StampedTime | None:
        """Time of the measurement on our monotonic clock; None where it does not count, and is counted."""
        radio = self._radios.pop(message.boot, None) or _Radio()
        # The newest stands last.
        self._radios[message.boot] = radio
        if len(self._radios) > MAX_RADIOS:
            del self._radios[next(iter(self._radios))]
        last = radio.said.get(message.other)
        if last is not None and message.sequence <= last:
            self.counters["ranges_repeated"] += 1
            return None
        if last is None and len(radio.said) >= MAX_MEASURED_PER_RADIO:
            self.counters["ranges_beyond_limit"] += 1
            return None
        radio.said[message.other] = message.sequence
        return radio.clock.time_of(
            message, arrived=arrived, utc_offset=utc_offset, tolerance=REPORTED_CLOCKS_AGREE_S
        )
