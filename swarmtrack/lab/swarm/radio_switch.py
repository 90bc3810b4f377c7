"""The radio emulator's switch: a process that carries Ethernet frames between TAP devices, and loses and delays them.

Theory of operation. A drone's radio is a TAP device in its namespace; what it sends is read here, what it hears is
written here. Launcher and switch share one page of memory, `RadioChannel`: faults go one way, counters the other, so a
fault holds from the next frame on and nobody waits for anybody. The switch is a process of its own because a frame
must not wait until the launcher has drawn its table. It ends when its standard input does, so it cannot outlive the
launcher.

A frame is on the air once and heard by each receiver or not: that is decided for each ordered pair of drones by a
generator of its own, so the pattern of losses between two drones does not depend on what others send. There is no
retransmission as in 802.11: a loss here is one that remains after it. Delay is uniform in latency ± jitter, and the
frames of one ordered pair stay in order, as one radio's do; those of different pairs overtake each other. On demand
those of one pair do as well, and some arrive twice, as over several hops.

A radio may be narrow: what it sends then leaves one frame after the other, at so many bits per second. A few seconds'
worth waits in the radio, as in real ones, and what finds no room there is lost.
"""

from __future__ import annotations

import argparse
import errno
import heapq
import itertools
import mmap
import os
import random
import select
import signal
import sys
from collections.abc import Sequence
from typing import Final, NamedTuple

from swarmtrack.clock import SystemClock

MTU: Final = 1500  # bytes
MAX_FRAME: Final = MTU + 64  # bytes, with the Ethernet header and whatever tags
RADIO_FRAMES_PER_TURN: Final = 32  # frames of one radio before the others get their turn
MAX_WAITING_FRAMES: Final = 8192  # delayed frames: 12 MB, a second of 100 Mbit/s; the channel holds no more
BUFFER: Final = 16384  # bytes that wait in a narrow radio: two seconds at 64 kbit/s
COUNT_BYTES: Final = 8  # bytes of a double, exact for counts up to 2^53
PAIR_COLUMNS, PORT_ROWS = 6, 7  # of `RadioChannel`
# In an Ethernet frame that holds an IPv4 packet without options: both protocols' numbers, and where they are.
IPV4_TYPE, IPV4_TYPE_AT = b"\x08\x00", slice(12, 14)
UDP_PROTOCOL, PROTOCOL_AT = 17, 23


class RadioChannel:
    """What the radio channel does to frames, of each ordered pair of ports, and what it carried, of each port.

    A page of doubles in memory that two processes share; pairs are indexed `source * ports + receiver`. `blocked` is
    0 for a receiver that can hear the source; `repeated` is the probability that a frame arrives twice, and
    `disordered` 0 where frames stay in order. `bits_per_s` is 0 for a radio that is as fast as you like,
    `longest_frame` 0 for one that carries frames of any length, and `udp_blocked` 0 for one that carries UDP.
    """

    def __init__(self, fd: int, ports: int) -> None:
        pairs = ports * ports
        self.ports = ports
        self._memory = mmap.mmap(fd, self.size(ports))
        numbers = memoryview(self._memory).cast("d")
        columns = [numbers[i * pairs : (i + 1) * pairs] for i in range(PAIR_COLUMNS)]
        self.loss, self.latency_s, self.jitter_s, self.blocked, self.repeated, self.disordered = columns
        counts = numbers[PAIR_COLUMNS * pairs :]
        rows = [counts[i * ports : (i + 1) * ports] for i in range(PORT_ROWS)]
        self.sent_frames, self.sent_bytes, self.lost_frames, self.blocked_frames, *rest = rows
        self.bits_per_s, self.longest_frame, self.udp_blocked = rest

    @staticmethod
    def size(ports: int) -> int:
        """Bytes."""
        return COUNT_BYTES * (PAIR_COLUMNS * ports * ports + PORT_ROWS * ports)


class Delivery(NamedTuple):
    """A frame on its way; sorted by when it is due."""

    due: float
    serial: int
    port: int
    frame: bytes


class Switch:
    """Decides who hears a frame, and when. Told the time; reads and writes nothing."""

    def __init__(self, channel: RadioChannel, addresses: Sequence[bytes], seed: int) -> None:
        """addresses: of each port, 6 bytes."""
        self._channel = channel
        self._ports = {address: port for port, address in enumerate(addresses)}
        self._others = [[p for p in range(channel.ports) if p != port] for port in range(channel.ports)]
        pairs = itertools.product(range(channel.ports), repeat=2)
        self._chance = [random.Random(f"{seed}/{source}/{receiver}") for source, receiver in pairs]
        self._last_due = [0.0] * channel.ports**2
        self._free_at = [0.0] * channel.ports  # when a narrow radio has sent what waits in it
        self._serial = itertools.count()
        self._waiting: list[Delivery] = []

    def send(self, source: int, frame: bytes, now: float) -> list[int]:
        """A frame left the radio of `source`: the ports that hear it at once. Delayed ones wait for `deliver`."""
        channel = self._channel
        channel.sent_frames[source] += 1
        channel.sent_bytes[source] += len(frame)
        if frame[0] & 1:  # broadcast and multicast
            receivers = self._others[source]
        else:
            port = self._ports.get(frame[:6])
            if port is None or port == source:
                return []
            receivers = [port]
        sent = self._sent(source, frame, now)
        is_swallowed = (channel.udp_blocked[source] and is_udp(frame)) or (
            0 < channel.longest_frame[source] < len(frame)
        )
        if sent is None or is_swallowed:
            channel.lost_frames[source] += 1
            return []
        copies = [port for port in receivers for _ in range(self._copies(source, port))]
        return [port for port in copies if self._arrives_at_once(source, port, frame, now, sent)]

    def _copies(self, source: int, port: int) -> int:
        pair = source * self._channel.ports + port
        return 1 + (random.random() < self._channel.repeated[pair])

    def _sent(self, source: int, frame: bytes, now: float) -> float | None:
        """When the radio has sent a frame; None where it has no room for it."""
        bytes_per_s = self._channel.bits_per_s[source] / 8.0
        if not bytes_per_s:
            return now
        begin = max(now, self._free_at[source])
        if (begin - now) * bytes_per_s + len(frame) > BUFFER:
            return None
        self._free_at[source] = begin + len(frame) / bytes_per_s
        return self._free_at[source]

    def _arrives_at_once(self, source: int, port: int, frame: bytes, now: float, sent: float) -> bool:
        channel, pair = self._channel, source * self._channel.ports + port
        if channel.blocked[pair]:
            channel.blocked_frames[source] += 1
            return False
        loss, latency, jitter = channel.loss[pair], channel.latency_s[pair], channel.jitter_s[pair]
        # Drawn for each frame that could be lost, and only then: what is delayed does not change what is lost.
        if loss and self._chance[pair].random() < loss:
            channel.lost_frames[source] += 1
            return False
        due = sent + latency
        if jitter:
            due += jitter * random.uniform(-1.0, 1.0)
        if not channel.disordered[pair]:
            due = max(self._last_due[pair], due)
        if due <= now:
            return True
        self._delay(pair, Delivery(due, next(self._serial), port, frame), source)
        return False

    def _delay(self, pair: int, delivery: Delivery, source: int) -> None:
        if len(self._waiting) >= MAX_WAITING_FRAMES:
            self._channel.lost_frames[source] += 1
            return
        self._last_due[pair] = max(self._last_due[pair], delivery.due)
        heapq.heappush(self._waiting, delivery)

    def deliver(self, now: float) -> list[Delivery]:
        """The delayed frames that are due, in order."""
        due = []
        while self._waiting and self._waiting[0].due <= now:
            due.append(heapq.heappop(self._waiting))
        return due

    @property
    def next_due(self) -> float | None:
        return self._waiting[0].due if self._waiting else None


def is_udp(frame: bytes) -> bool:
    """Whether an Ethernet frame holds UDP over IPv4."""
    return frame[IPV4_TYPE_AT] == IPV4_TYPE and frame[PROTOCOL_AT : PROTOCOL_AT + 1] == bytes([UDP_PROTOCOL])


def run(switch: Switch, taps: Sequence[int], lifeline: int) -> None:
    """Carry frames until the lifeline's other end is closed. taps: non-blocking, by port."""
    clock = SystemClock()
    poll = select.epoll()
    ports = {fd: port for port, fd in enumerate(taps)}
    for fd in (*taps, lifeline):
        poll.register(fd, select.EPOLLIN)
    while True:
        due = switch.next_due
        for fd, _ in poll.poll(None if due is None else max(0.0, due - clock.now())):
            if fd == lifeline:
                return
            now = clock.now()
            for frame in _read(fd):
                for port in switch.send(ports[fd], frame, now):
                    _write(taps[port], frame)
        for delivery in switch.deliver(clock.now()) if switch.next_due is not None else ():
            _write(taps[delivery.port], delivery.frame)


def _write(tap: int, frame: bytes) -> None:
    """A radio that is switched off hears nothing."""
    try:
        os.write(tap, frame)
    except OSError as error:
        if error.errno != errno.EIO:
            raise


def _read(tap: int) -> list[bytes]:
    """At most BATCH frames that the radio wants to send."""
    frames: list[bytes] = []
    try:
        while len(frames) < RADIO_FRAMES_PER_TURN:
            frames.append(os.read(tap, MAX_FRAME))
    except BlockingIOError:
        pass
    return frames


def main() -> None:
    parser = argparse.ArgumentParser(
        description="The switch of swarmtrack's radio emulator, which starts it."
    )
    parser.add_argument("--channel", type=int, required=True, metavar="FD")
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("radios", nargs="+", metavar="FD=MAC", help="a TAP device and its radio's address")
    arguments = parser.parse_args()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group: the launcher says when
    taps, addresses = zip(*(radio.split("=") for radio in arguments.radios), strict=True)
    channel = RadioChannel(arguments.channel, len(taps))
    switch = Switch(channel, [bytes.fromhex(address) for address in addresses], arguments.seed)
    print("ready", flush=True)
    run(switch, [int(tap) for tap in taps], sys.stdin.fileno())


if __name__ == "__main__":
    main()
