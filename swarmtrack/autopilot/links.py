"""Links to an autopilot: UDP, TCP, a serial port, a recording, or none.

A link carries one connection: `run` returns at the end of a recording, and raises `LinkDown` with a sentence where the
other end is away. The caller decides when to try again. Every link stamps arrival before it does anything else.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import fcntl
import logging
import math
import mmap
import os
import socket
import termios
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple, Protocol, cast

import serial

from swarmtrack.autopilot.address import LinkAddress, parse_address
from swarmtrack.autopilot.dataflash import read_dataflash
from swarmtrack.autopilot.datagrams import Address, DatagramSocket, open_socket
from swarmtrack.autopilot.framer import MavlinkFrame
from swarmtrack.autopilot.limits import (
    LINK_CONNECT_TIMEOUT_S,
    LINK_SEND_BUFFER_BYTES,
    RECORDS_PER_TURN,
    SERIAL_READ_BYTES,
    TLOG_SAID_STEPS,
    UDP_PEER_SILENT_S,
)
from swarmtrack.autopilot.log_files import check_kind
from swarmtrack.autopilot.logged_flight import LoggedFlight
from swarmtrack.autopilot.tlog import heartbeats, records
from swarmtrack.autopilot.ulog import read_ulog
from swarmtrack.clock import Clock
from swarmtrack.errors import SourceError

log = logging.getLogger(__name__)

LOG_READERS: dict[str, Callable[[Path], LoggedFlight]] = {"ulog": read_ulog, "bin": read_dataflash}


class LinkDown(Exception):
    """The connection failed or ended; the text names the reason. It is tried again."""


class Wire(NamedTuple):
    """What another process needs to write to the same end. peer: of an unconnected socket, else None."""

    descriptor: int
    peer: Address | None = None


class Receiver(Protocol):
    """Receiver of a link's bytes; called on the event loop."""

    def opened(self) -> None:
        """The port is open, the connection stands."""
        ...

    def received(self, t: float, data: bytes, sender: Address | None = None) -> bool:
        """`data` came at t on our clock; True when it held a frame of our own autopilot. sender: of a datagram."""
        ...

    def overheard(self, t: float, data: bytes) -> None:
        """A datagram came at t that is not read, for the autopilot sends from another address."""
        ...


class Link(Protocol):
    """One link to an autopilot.

    datagrams: `received` gets them one by one; recording: time comes from the file, sending goes nowhere;
    bytes_per_second: capacity of the line, None where it hardly matters; remark: the last fault that did not end the
    connection, or empty; foreign: datagrams from other addresses than the autopilot's that were not read, since the
    start; numbered: its frames have the autopilot's own sequence numbers; left_out: what of a log is not used.
    """

    address: LinkAddress
    datagrams: bool
    recording: bool
    bytes_per_second: float | None
    remark: str
    foreign: int
    numbered: bool
    left_out: tuple[str, ...]

    async def run(self, receiver: Receiver) -> None: ...

    def send(self, data: bytes) -> None:
        """Send a frame if that is possible now; never blocks."""
        ...

    def wire(self) -> Wire | None:
        """The wire that `send` now writes to; None where there is none."""
        ...

    def drop(self, reason: str) -> None:
        """End the connection: `run` raises `LinkDown(reason)`. Only where silence means a dead connection (TCP)."""
        ...


def open_link(address: str, clock: Clock) -> Link:
    """The link for an address such as `udpin:127.0.0.1:14540`; `SourceError` where it can never work."""
    parsed = parse_address(address)
    match parsed.scheme:
        case "udpin" | "udpout":
            return UdpLink(parsed, clock)
        case "tcp":
            return TcpLink(parsed, clock)
        case "serial":
            return SerialLink(parsed, clock)
        case "tlog":
            return TlogLink(parsed, clock)
        case "ulog" | "bin":
            return LoggedLink(parsed, clock)
        case "none":
            return NoLink(parsed)


class NoLink:
    """No autopilot: `run` waits until it is cancelled."""

    datagrams = False
    recording = False
    bytes_per_second: float | None = None
    remark = ""
    foreign = 0
    numbered = True
    left_out: tuple[str, ...] = ()

    def __init__(self, address: LinkAddress) -> None:
        self.address = address

    async def run(self, receiver: Receiver) -> None:
        await asyncio.Event().wait()

    def send(self, data: bytes) -> None:
        """Nothing is sent."""

    def wire(self) -> None:
        """There is no wire."""

    def drop(self, reason: str) -> None:
        """Nothing to drop."""


class LiveLink:
    """Common defaults of links to a live autopilot."""

    datagrams = False
    recording = False
    bytes_per_second: float | None = None
    foreign = 0
    numbered = True
    left_out: tuple[str, ...] = ()

    def __init__(self, address: LinkAddress, clock: Clock) -> None:
        self.address = address
        self.remark = ""
        self._clock = clock


class UdpLink(LiveLink):
    """`udpin` listens, and answers to the autopilot's address; `udpout` sends first.

    The peer is learned from a valid frame of our autopilot only: otherwise any sender of one byte captures our answers.
    It is kept until it has been silent for UDP_PEER_SILENT_S: what others send meanwhile is counted and not read, or
    anyone in reach could feed us a false position.
    """

    datagrams = True

    def __init__(self, address: LinkAddress, clock: Clock) -> None:
        super().__init__(address, clock)
        self._listens = address.scheme == "udpin"
        self._peer: Address | None = None
        self._heard_at = -math.inf
        self._stranger: Address | None = None
        self._socket: DatagramSocket | None = None

    async def run(self, receiver: Receiver) -> None:
        self.remark = ""
        self._peer = self._stranger = None
        host, port = self.address.host, self.address.port
        try:
            async with asyncio.timeout(LINK_CONNECT_TIMEOUT_S):
                self._socket = await open_socket(host, port, self._clock, listens=self._listens)
        except TimeoutError as error:  # nothing else of UDP takes its time
            raise LinkDown(f"no name server resolved {host} within {LINK_CONNECT_TIMEOUT_S:g} s") from error
        except OSError as error:
            raise LinkDown(self._why(error)) from error
        loop = asyncio.get_running_loop()
        loop.add_reader(self._socket, self._read, self._socket, receiver)
        try:
            receiver.opened()
            await asyncio.Event().wait()
        finally:
            loop.remove_reader(self._socket)
            self._socket.close()
            self._socket = None

    def _read(self, opened: DatagramSocket, receiver: Receiver) -> None:
        """All that came since the last look."""
        try:
            for arrival, data, sender in opened.waiting():
                if self._peer not in (None, sender) and arrival - self._heard_at < UDP_PEER_SILENT_S:
                    self._refuse(sender)
                    receiver.overheard(arrival, data)
                elif receiver.received(arrival, data, sender):
                    self.meet(sender, arrival)
        except OSError as error:
            self._note(error)

    def meet(self, peer: Address, t: float) -> None:
        """Our autopilot was heard from there at t [s]."""
        self._peer, self._heard_at = peer, t
        self.remark = ""

    def _why(self, error: OSError) -> str:
        if error.errno == errno.EADDRINUSE:
            return f"busy, port {self.address.port} is held by {holder_of_udp_port(self.address.port)}"
        if error.errno == errno.EACCES:
            return f"permission: port {self.address.port} needs root, choose one above 1023"
        return network_trouble(error, self.address)

    def _refuse(self, sender: Address) -> None:
        """Said once for each connection: whoever forges may come from thousands of ports."""
        self.foreign += 1
        if self._stranger is None and self._peer is not None:
            self._stranger = sender
            log.warning(
                "%s: %s port %d sends as well: ignored while the autopilot sends, at %s port %d",
                self.address,
                *sender[:2],
                *self._peer[:2],
            )

    def _note(self, error: OSError) -> None:
        refused = isinstance(error, ConnectionRefusedError)
        self.remark = "nothing listens there" if refused else network_trouble(error, self.address)

    def send(self, data: bytes) -> None:
        if self._socket is None or (self._listens and self._peer is None):
            return
        try:
            self._socket.send(data, self._peer if self._listens else None)
        except OSError as error:
            self._note(error)

    def wire(self) -> Wire | None:
        if self._socket is None or (self._listens and self._peer is None):
            return None
        return Wire(self._socket.fileno(), self._peer if self._listens else None)

    def drop(self, reason: str) -> None:
        """Does nothing: silence means nothing on a UDP socket."""


class TcpLink(LiveLink, asyncio.Protocol):
    """Client of a TCP server: a simulator or a router."""

    def __init__(self, address: LinkAddress, clock: Clock) -> None:
        super().__init__(address, clock)
        self._transport: asyncio.Transport | None = None
        self._receiver: Receiver
        self._lost: asyncio.Future[str]

    async def run(self, receiver: Receiver) -> None:
        loop = asyncio.get_running_loop()
        self._receiver, self._lost = receiver, loop.create_future()
        try:
            async with asyncio.timeout(LINK_CONNECT_TIMEOUT_S):
                await loop.create_connection(lambda: self, self.address.host, self.address.port)
        except TimeoutError as error:
            raise LinkDown(
                f"no answer from {self.address.host} within {LINK_CONNECT_TIMEOUT_S:g} s"
            ) from error
        except OSError as error:
            raise LinkDown(network_trouble(error, self.address)) from error
        try:
            receiver.opened()
            raise LinkDown(await self._lost)
        finally:
            if self._transport is not None:
                self._transport.abort()
            self._transport = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)

    def data_received(self, data: bytes) -> None:
        arrival = self._clock.now()
        self._receiver.received(arrival, data)

    def connection_lost(self, exc: Exception | None) -> None:
        self.drop("the other end closed the connection" if exc is None else f"the connection broke: {exc}")

    def send(self, data: bytes) -> None:
        if self._transport is not None and self._transport.get_write_buffer_size() <= LINK_SEND_BUFFER_BYTES:
            self._transport.write(data)

    def wire(self) -> Wire | None:
        opened = None if self._transport is None else self._transport.get_extra_info("socket")
        return None if opened is None or opened.fileno() < 0 else Wire(opened.fileno())

    def drop(self, reason: str) -> None:
        if not self._lost.done():
            self._lost.set_result(reason)


class SerialLink(LiveLink):
    """A serial port or USB device, opened exclusively; the device may come and go."""

    def __init__(self, address: LinkAddress, clock: Clock) -> None:
        super().__init__(address, clock)
        self.bytes_per_second = address.baud / 10  # 8N1: ten bits a byte
        self._fd: int | None = None
        self._unsent = bytearray()
        self._receiver: Receiver
        self._lost: asyncio.Future[str]

    async def run(self, receiver: Receiver) -> None:
        loop = asyncio.get_running_loop()
        port = self._open()
        self._receiver, self._lost = receiver, loop.create_future()
        self._fd = fd = port.fileno()
        self._unsent.clear()
        loop.add_reader(fd, self._readable)
        try:
            receiver.opened()
            raise LinkDown(await self._lost)
        finally:
            self._detach()
            port.close()

    def _open(self) -> serial.Serial:
        path = self.address.path
        try:
            port = serial.Serial(path, self.address.baud, timeout=0, write_timeout=0, exclusive=True)
        except ValueError as error:
            raise LinkDown(f"{path} refuses {self.address.baud} baud: {error}") from error
        except serial.SerialException as error:
            raise LinkDown(serial_trouble(path, error.errno, str(error))) from error
        except termios.error as error:
            raise LinkDown(f"{path} went away while it was opened: {error}") from error
        # The lock binds only programs that ask for it; those that do not would steal every other byte.
        with contextlib.suppress(OSError):
            fcntl.ioctl(port.fileno(), termios.TIOCEXCL)
        others = [holder for holder in holders_of(os.path.realpath(path)) if holder.pid != os.getpid()]
        self.remark = f"also open in {others[0]}, which takes bytes away from us" if others else ""
        if others:
            log.warning("%s is %s", path, self.remark)
        return port

    def _readable(self) -> None:
        arrival = self._clock.now()
        assert self._fd is not None
        try:
            data = os.read(self._fd, SERIAL_READ_BYTES)
        except BlockingIOError:
            return
        except OSError as error:
            self._end(f"unplugged: {error.strerror}")
            return
        if not data:
            self._end("unplugged: end of file")
            return
        self._receiver.received(arrival, data)

    def _end(self, reason: str) -> None:
        self._detach()
        self.drop(reason)

    def _detach(self) -> None:
        """Take the descriptor off the loop before it is closed: its number may soon mean another file."""
        if self._fd is not None:
            loop = asyncio.get_running_loop()
            loop.remove_reader(self._fd)
            loop.remove_writer(self._fd)
        self._fd = None

    def send(self, data: bytes) -> None:
        if self._fd is None or len(self._unsent) + len(data) > LINK_SEND_BUFFER_BYTES:
            return
        self._unsent += data
        self._writable()

    def _writable(self) -> None:
        if self._fd is None:
            return
        try:
            del self._unsent[: os.write(self._fd, self._unsent)]
        except BlockingIOError:
            pass
        except OSError as error:
            self._end(f"unplugged: {error.strerror}")
            return
        loop = asyncio.get_running_loop()
        if self._unsent:
            loop.add_writer(self._fd, self._writable)
        else:
            loop.remove_writer(self._fd)

    def wire(self) -> Wire | None:
        return None if self._fd is None else Wire(self._fd)

    def drop(self, reason: str) -> None:
        if not self._lost.done():
            self._lost.set_result(reason)


class RecordingLink(ABC):
    """Autopilot messages of a recorded flight.

    The first record is at clock.now() of the start and the others at the recording's own distances, so integrals over
    time stay right at any speed; `speed` only says how early they are delivered. 0: as fast as it goes.
    """

    datagrams = True
    recording = True
    bytes_per_second: float | None = None
    remark = ""
    foreign = 0
    numbered = True
    left_out: tuple[str, ...] = ()

    def __init__(self, address: LinkAddress, clock: Clock) -> None:
        if not os.path.isfile(address.path):
            raise SourceError(f"autopilot link {address}: no such file: {address.path}")
        self.address = address
        self._clock = clock

    @abstractmethod
    async def run(self, receiver: Receiver) -> None: ...

    async def _play(self, records: Iterable[tuple[float, bytes]], receiver: Receiver) -> None:
        """records: (time [s], bytes), ascending."""
        start = self._clock.now()
        first: float | None = None
        for i, (stamp, record) in enumerate(records):
            first = stamp if first is None else first
            if self.address.speed:
                wait = start + (stamp - first) / self.address.speed - self._clock.now()
                if wait > 0:
                    await asyncio.sleep(wait)
            if i % RECORDS_PER_TURN == 0:
                await asyncio.sleep(0)
            receiver.received(start + stamp - first, record)
        if first is None:
            raise SourceError(f"autopilot link {self.address}: holds no record, is it a telemetry log?")

    def send(self, data: bytes) -> None:
        """Nothing is sent to a recording."""
        return

    def wire(self) -> None:
        """There is no wire."""
        return

    def drop(self, reason: str) -> None:
        """A recording ends by itself."""
        return


class TlogLink(RecordingLink):
    """A recording of a ground station: 8 bytes of big-endian UTC microseconds before each frame."""

    # Some programs write whatever they have read.
    datagrams = False
    _steps = 0

    async def run(self, receiver: Receiver) -> None:
        with self._map() as data:
            self._steps = 0
            receiver.opened()
            await self._play(records(data, self._on_step, self._on_useless), receiver)
        if self._steps > TLOG_SAID_STEPS:
            log.warning("%s: that clock was set %d times in all", self.address, self._steps)

    def heartbeats(self) -> Iterator[list[MavlinkFrame]]:
        """All of them, piece by piece of the file."""
        with self._map() as data:
            yield from heartbeats(data)

    def _on_useless(self) -> None:
        log.warning(
            "%s: the times in it do not advance as time does: those of its autopilot are used from here on",
            self.address,
        )

    def _on_step(self, at: float, by: float) -> None:
        self._steps += 1
        if self._steps > TLOG_SAID_STEPS:
            return
        log.warning(
            "%s: the clock of the computer that wrote it was set by %+.1f s at %.1f s: its times go on by the "
            "autopilot's clock",
            self.address,
            by,
            at,
        )

    def _map(self) -> mmap.mmap:
        check_kind(Path(self.address.path), "tlog")
        try:
            with Path(self.address.path).open("rb") as file:
                return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError) as error:  # ValueError: the file is empty
            raise SourceError(f"autopilot link {self.address}: {error}") from error


class LoggedLink(RecordingLink):
    """An autopilot's own log, as the telemetry it would have sent meanwhile."""

    # The numbers are those of our conversion.
    numbered = False

    async def run(self, receiver: Receiver) -> None:
        flight = read_log(self.address.scheme, Path(self.address.path))
        _read_log.cache_clear()
        self.left_out = flight.left_out
        receiver.opened()
        await self._play(flight.records, receiver)


def read_log(scheme: str, path: Path) -> LoggedFlight:
    """An autopilot's own log. The last one is kept until it is played."""
    return _read_log(scheme, path, path.stat().st_mtime_ns)


@lru_cache(maxsize=1)
def _read_log(scheme: str, path: Path, changed_ns: int) -> LoggedFlight:
    return LOG_READERS[scheme](path)


class Holder:
    """A process that has a file open."""

    def __init__(self, pid: int) -> None:
        self.pid = pid

    def __str__(self) -> str:
        try:
            name = Path(f"/proc/{self.pid}/comm").read_text().strip()
        except OSError:
            name = "(gone)"
        return f"PID {self.pid} {name}"


def holders_of(target: str) -> list[Holder]:
    """Processes that have `target` open: a path, or `socket:[INODE]`. Those of other users show only to root."""
    found: list[Holder] = []
    for process in Path("/proc").iterdir():
        if not process.name.isdigit():
            continue
        try:
            if any(os.readlink(fd) == target for fd in (process / "fd").iterdir()):
                found.append(Holder(int(process.name)))
        except OSError:
            continue  # gone meanwhile, or not ours to look into
    return found


def holder_of_udp_port(port: int) -> str:
    """Process that is bound to a local UDP port, for people."""
    for table in ("/proc/net/udp", "/proc/net/udp6"):
        try:
            lines = Path(table).read_text().splitlines()[1:]
        except OSError:
            continue
        for line in lines:
            fields = line.split()
            if int(fields[1].rpartition(":")[2], 16) == port:
                return _first_of(holders_of(f"socket:[{fields[9]}]"))
    return "another program"


def _first_of(holders: list[Holder]) -> str:
    return str(holders[0]) if holders else "another user's program"


def serial_trouble(path: str, number: int | None, text: str) -> str:
    """Why a serial port does not open, and what to do about it."""
    if number == errno.ENOENT:
        return f"no such device: {path} (not plugged in, or under another name: see /dev/serial/by-id)"
    if number in (errno.EACCES, errno.EPERM):
        return (
            f"permission: cannot open {path}, add yourself to dialout: "
            "sudo usermod -aG dialout $USER, then log in again"
        )
    if number in (errno.EBUSY, errno.EAGAIN):
        return f"busy, held by {_first_of(holders_of(os.path.realpath(path)))}"
    if number == errno.ENOTTY or "configure port" in text:
        return f"{path} is not a serial port ({text})"
    return text


def network_trouble(error: OSError, address: LinkAddress) -> str:
    """Why a socket does not open or a packet does not leave."""
    where = f"{address.host}:{address.port}"
    if isinstance(error, socket.gaierror):
        return f"the name {address.host} is unknown here"
    if isinstance(error, ConnectionRefusedError):
        return f"nothing listens at {where}"
    if error.errno == errno.EADDRNOTAVAIL:
        return f"{address.host} is not an address of this machine"
    return f"{where}: {os.strerror(error.errno) if error.errno else error}"
