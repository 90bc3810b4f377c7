"""UDP socket that is emptied at each read: all datagrams since the last one, each with its time of arrival.

An autopilot sends some hundred datagrams per second, several at a time, and a reader that is late stamps them late. So
the kernel stamps them (`SO_TIMESTAMPNS`). Its stamps are of the wall clock, which may step; they are bounded by the
last read and this one.

An arrival may be told late, never early: a clock map takes each for a bound and keeps the tightest of a minute
(`clock_map`), so a single one that is milliseconds too early moves all its stamps for as long.
"""

from __future__ import annotations

import asyncio
import socket
import struct
from collections.abc import Iterator
from typing import NamedTuple

from swarmtrack.autopilot.limits import DATAGRAMS_PER_TURN
from swarmtrack.clock import Clock

# Not in Python's socket module. The answer comes under the same number, as a struct timespec.
SO_TIMESTAMPNS = 35
TIMESPEC = struct.Struct("@ll")
ANCILLARY = socket.CMSG_SPACE(TIMESPEC.size)
LARGEST_UDP_BYTES = 65536  # bytes

Address = tuple[str, int]


class Datagram(NamedTuple):
    """arrival [s]: on our clock."""

    arrival: float
    data: bytes
    sender: Address


class DatagramSocket:
    """Open until `close`; no method blocks."""

    def __init__(self, opened: socket.socket, clock: Clock) -> None:
        self._socket = opened
        self._clock = clock
        self._looked_at = clock.now()

    def waiting(self) -> Iterator[Datagram]:
        """Datagrams since the last call, in order, at most `DATAGRAMS_PER_TURN`. Raises `OSError` for a reported
        network error; the next call reads the rest.
        """
        since = self._looked_at
        utc = self._clock.utc()
        began = self._clock.now()  # second: a pause between the two makes arrivals late
        for _ in range(DATAGRAMS_PER_TURN):
            try:
                data, ancillary, _, sender = self._socket.recvmsg(LARGEST_UDP_BYTES, ANCILLARY)
            except BlockingIOError:
                self._looked_at = began
                return
            read = self._clock.now()  # not `began`: it may have come while the ones before were handled
            stamp = _stamp(ancillary)
            arrival = read if stamp is None else began + stamp - utc
            yield Datagram(min(max(arrival, since), read), data, sender)

    def send(self, data: bytes, receiver: Address | None = None) -> None:
        """Send to the other end, or to a receiver where there is none. Dropped when there is no room: all our
        messages are soon repeated. Raises `OSError`.
        """
        try:
            if receiver is None:
                self._socket.send(data)
            else:
                self._socket.sendto(data, receiver)
        except BlockingIOError:
            pass

    def fileno(self) -> int:
        """Descriptor for the event loop, which wakes the reader."""
        return self._socket.fileno()

    def close(self) -> None:
        self._socket.close()


async def open_socket(host: str, port: int, clock: Clock, *, listens: bool) -> DatagramSocket:
    """Open a socket bound to host:port if it listens, else connected to it. Raises `OSError`, that of the last
    address tried.
    """
    loop = asyncio.get_running_loop()
    trouble: OSError | None = None
    for family, kind, protocol, _, address in await loop.getaddrinfo(host, port, type=socket.SOCK_DGRAM):
        opened = socket.socket(family, kind, protocol)
        try:
            opened.setblocking(False)
            opened.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
            if listens:
                opened.bind(address)
            else:
                opened.connect(address)
        except OSError as error:
            opened.close()
            trouble = error
        else:
            return DatagramSocket(opened, clock)
    raise trouble or OSError(f"{host} has no address")


def _stamp(ancillary: list[tuple[int, int, bytes]]) -> float | None:
    """The kernel's, s UTC; None where it gave none."""
    for level, kind, value in ancillary:
        if level == socket.SOL_SOCKET and kind == SO_TIMESTAMPNS and len(value) == TIMESPEC.size:
            seconds, nanoseconds = TIMESPEC.unpack(value)
            return float(seconds + 1e-9 * nanoseconds)
    return None
