"""Detection of queues on the way of our packets, from the kernel's statistics of our TCP links.

Keep-alives go over TCP or TLS in every mesh, several times in each lease, so the kernel measures the round trip all
the time. Where it is much longer than the shortest one of the last minutes, packets wait somewhere: most likely in the
radio. The kernel reports a running mean; two means give the sample between them. In a full radio every packet waits. A
lost answer looks late as well, but not every one, so the shortest of the last few counts, and of the links at one
address of ours the shortest: they have the same radio. Two more signs are reported apart, because losses alone give
them, too: how long an answer has been due, and bytes that TCP itself could not send yet.

A link that is QUIC alone (to routers) gives no statistics, and neither does a system other than Linux.
"""

from __future__ import annotations

import socket
import struct
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple

from swarmtrack.transport.limits import (
    CONGESTION_SAMPLES,
    PACKETS_LATE_S,
    PACKETS_LATE_SHARE,
    PACKETS_QUEUED_S,
    PACKETS_UNSENT_BYTES,
    ROUND_TRIP_MEAN_WEIGHT,
    SIGN_OF_LIFE_S,
)
from swarmtrack.transport.own_sockets import own_streams

# In `struct tcp_info`: packets without an answer; ms since the last answer; the mean of round trips, us; bytes not sent
# yet; the shortest round trip, us.
_UNANSWERED, _LAST_ANSWER, _RTT, _UNSENT, _MIN_RTT, _SIZE = 24, 56, 68, 144, 148, 152


class Sent(NamedTuple):
    """Statistics of one link. own: our address; rtt_s: mean round trip; min_rtt_s: the shortest of some minutes;
    unanswered_s: since the last answer, where one is due; unsent: bytes.
    """

    own: str
    rtt_s: float
    min_rtt_s: float
    unanswered_s: float
    unsent: int


class Waiting(NamedTuple):
    """Queues, of the worst address, on the link there where each is least. delay_s: excess of the measured round trips
    over the shortest; unsent: bytes; round_trip_s: the shortest; silent_s: since an answer is due.
    """

    delay_s: float
    unsent: int
    round_trip_s: float = 0.0
    silent_s: float = 0.0

    @property
    def is_late(self) -> bool:
        """Whether packets wait for longer than usual, or are lost."""
        return self.is_measured_late or self.silent_s > PACKETS_LATE_S

    @property
    def is_measured_late(self) -> bool:
        """Whether packets that were answered, or that TCP could not send yet, waited for longer than usual."""
        usual = max(PACKETS_LATE_S, PACKETS_LATE_SHARE * self.round_trip_s)
        return self.delay_s > usual or self.unsent > PACKETS_UNSENT_BYTES

    @property
    def is_queue(self) -> bool:
        """Whether it is a queue that was measured, and not merely answers that were lost."""
        return self.delay_s > PACKETS_QUEUED_S or self.unsent > PACKETS_UNSENT_BYTES

    def is_shorter(self, other: Waiting, share: float) -> bool:
        """Whether packets wait for less than this share of another time, in all that was too much then."""
        delay = other.delay_s <= PACKETS_LATE_S or self.delay_s < share * other.delay_s
        unsent = other.unsent <= PACKETS_UNSENT_BYTES or self.unsent < share * other.unsent
        return delay and unsent


class Congestion:
    """Pure state: `measure` takes the statistics of every link at each sampling."""

    def __init__(self) -> None:
        self._means: dict[str, float] = {}
        self._delays: dict[str, deque[float]] = {}

    def measure(self, links: Mapping[str, Sent]) -> Waiting:
        """links: by any name that stays with the link."""
        for gone in self._means.keys() - links.keys():
            del self._means[gone], self._delays[gone]
        for name, sent in links.items():
            before = self._means.get(name)
            delays = self._delays.setdefault(name, deque(maxlen=CONGESTION_SAMPLES))
            if before is None or sent.rtt_s != before:
                last = (
                    sent.rtt_s if before is None else before + ROUND_TRIP_MEAN_WEIGHT * (sent.rtt_s - before)
                )
                delays.append(max(0.0, last - sent.min_rtt_s))
            self._means[name] = sent.rtt_s
        at: dict[str, list[Waiting]] = {}
        for name, sent in links.items():
            silent_s = max(0.0, sent.unanswered_s - SIGN_OF_LIFE_S)
            at.setdefault(sent.own, []).append(
                Waiting(min(self._delays[name]), sent.unsent, sent.min_rtt_s, silent_s)
            )
        radios = [_fieldwise(min, each) for each in at.values()]
        return _fieldwise(max, radios) if radios else Waiting(0.0, 0)


def _fieldwise(choose: Callable[..., Any], all_of_them: Sequence[Waiting]) -> Waiting:
    """choose: min or max; it chooses the wait and its usual round trip together."""
    waiting: Waiting = choose(all_of_them)
    return waiting._replace(
        unsent=choose(each.unsent for each in all_of_them),
        silent_s=choose(each.silent_s for each in all_of_them),
    )


def look_at_links(ends: Collection[str]) -> dict[str, Sent]:
    """Statistics of the TCP links, by HOST:PORT of the other end in Zenoh's form. None where the system has none."""
    found = {}
    for stream in own_streams() if ends else ():
        try:
            host, port, *_ = stream.getpeername()
            own = stream.getsockname()[0]
            told = stream.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _SIZE)
        except OSError:  # not connected, or gone
            continue
        end = f"[{host}]:{port}" if stream.family == socket.AF_INET6 else f"{host}:{port}"
        if end in ends and len(told) == _SIZE:
            found[end] = _sent(own, told)
    return found


def _sent(own: str, told: bytes) -> Sent:
    def number(at: int) -> int:
        return int(struct.unpack_from("=I", told, at)[0])

    return Sent(
        own,
        1e-6 * number(_RTT),
        1e-6 * number(_MIN_RTT),
        1e-3 * number(_LAST_ANSWER) if number(_UNANSWERED) else 0.0,
        number(_UNSENT),
    )
