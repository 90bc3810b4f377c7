"""One MAVLink link of a simulated autopilot: what was asked for on it, who speaks there, what waits to be sent.

As in ArduPilot and PX4, every link has its own stream rates, sequence numbers and heartbeats.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol

from pymavlink.dialects.v20 import common

LARGEST_DATAGRAM = 1200  # bytes


class MavlinkAddress(NamedTuple):
    """Who speaks or is spoken to; 0: everybody."""

    system: int
    component: int


class ReportStream(Protocol):
    """One message at its rate. Times are seconds since boot on the autopilot's own clock."""

    @property
    def due(self) -> float:
        """When the next one is sent."""
        ...

    @property
    def sampled(self) -> float:
        """When that was measured which is sent then: its stamp."""
        ...

    def advance(self) -> None:
        """It is sent."""
        ...

    def skip_to(self, stamp: float) -> None:
        """Go on at `stamp`; what was due before is not sent."""
        ...


class SteadyReports:
    """A stream whose samples are taken when they are due, in whole intervals [s]."""

    def __init__(self, interval: float, stamp: float) -> None:
        self.interval = interval
        self.skip_to(stamp)

    def skip_to(self, stamp: float) -> None:
        self._count = math.ceil(stamp / self.interval - 1e-9)

    @property
    def due(self) -> float:
        return self._count * self.interval

    @property
    def sampled(self) -> float:
        return self.due

    def advance(self) -> None:
        self._count += 1


class Channel:
    """A link. Whoever spoke on it is reached there."""

    def __init__(self, own: MavlinkAddress) -> None:
        self.mav = common.MAVLink(None, *own)
        self.reset()

    def reset(self) -> None:
        """As after a boot."""
        self.mav.seq = 0
        self.streams: dict[int, ReportStream] = {}
        self.heard: set[MavlinkAddress] = set()
        self.heartbeat_due = -math.inf
        self._outbox: list[bytes] = []

    @property
    def next_due(self) -> float:
        """When the next stream has something to send, on the autopilot's own clock; -inf: something waits."""
        if self._outbox:
            return -math.inf
        return min((stream.due for stream in self.streams.values()), default=math.inf)

    def frame(self, message: Any) -> bytes:
        data = bytes(message.pack(self.mav))
        self.mav.seq = (self.mav.seq + 1) % 256
        return data

    def send(self, message: Any) -> None:
        """A message of our own, with the next datagram."""
        self._outbox.append(self.frame(message))

    def forward(self, frame: bytes) -> None:
        """Somebody else's message, untouched: it keeps its sender, its number and its signature."""
        self._outbox.append(frame)

    def drain(self) -> list[bytes]:
        """What waits to be sent."""
        frames, self._outbox = self._outbox, []
        return frames

    def reaches(self, target: MavlinkAddress) -> bool:
        """Whether somebody spoke here whom a message with that target concerns."""
        return any(
            target.system in (0, other.system)
            and (target.system == 0 or target.component in (0, other.component))
            for other in self.heard
        )


def target_of(message: Any) -> MavlinkAddress:
    """Whom a message is for; those without a target are for everybody."""
    return MavlinkAddress(getattr(message, "target_system", 0), getattr(message, "target_component", 0))


def datagrams(frames: list[bytes]) -> Iterator[bytes]:
    """The frames in as few datagrams as hold them."""
    datagram = b""
    for frame in frames:
        if len(datagram) + len(frame) > LARGEST_DATAGRAM:
            yield datagram
            datagram = b""
        datagram += frame
    if datagram:
        yield datagram
