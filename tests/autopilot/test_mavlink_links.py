"""Addresses of both habits, and the links on real sockets, a pty and recordings."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import pty
import socket
import sys
from collections.abc import AsyncIterator

import pytest

from support.fake_autopilot import FakeAutopilot
from support.ports import free_port
from swarmtrack.autopilot import links
from swarmtrack.autopilot.address import parse_address
from swarmtrack.autopilot.limits import UDP_PEER_SILENT_S
from swarmtrack.autopilot.links import Link, LinkDown, open_link, serial_trouble
from swarmtrack.clock import ManualClock, SystemClock
from swarmtrack.errors import SourceError

TIMEOUT = 180.0  # s: ends a hang, and says nothing of speed


@pytest.mark.parametrize(
    ("written", "normal"),
    [
        ("udpin:0.0.0.0:14540", "udpin:0.0.0.0:14540"),
        ("udp:127.0.0.1:14550", "udpin:127.0.0.1:14550"),
        ("udpin://0.0.0.0:14540", "udpin:0.0.0.0:14540"),
        ("udp://:14540", "udpin:0.0.0.0:14540"),
        ("udpin:14540", "udpin:0.0.0.0:14540"),
        ("udpout:192.168.1.2:14550", "udpout:192.168.1.2:14550"),
        ("udpout://router.local:14550/", "udpout:router.local:14550"),
        ("udpin:[::1]:14540", "udpin:[::1]:14540"),
        ("tcp:127.0.0.1:5760", "tcp:127.0.0.1:5760"),
        ("tcpout://127.0.0.1:5760", "tcp:127.0.0.1:5760"),
        ("/dev/ttyACM0,921600", "serial:/dev/ttyACM0:921600"),
        ("/dev/ttyACM0:57600", "serial:/dev/ttyACM0:57600"),
        ("/dev/ttyACM0", "serial:/dev/ttyACM0:115200"),
        ("serial:///dev/ttyTHS1:921600", "serial:/dev/ttyTHS1:921600"),
        ("serial:/dev/ttyAMA0,57600", "serial:/dev/ttyAMA0:57600"),
        (
            "serial:/dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0:57600",
            "serial:/dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0:57600",
        ),
        (
            "/dev/serial/by-path/platform-xhci-usb-0:1",
            "serial:/dev/serial/by-path/platform-xhci-usb-0:1:115200",
        ),
        ("tlog:flight.tlog?speed=4", "tlog:flight.tlog?speed=4"),
        ("tlog:flight.tlog?pace=fast", "tlog:flight.tlog?speed=0"),
        ("flights/a.tlog", "tlog:flights/a.tlog?speed=1"),
        (" none ", "none"),
    ],
)
def test_addresses_of_both_habits_have_one_normal_form(written, normal):
    assert str(parse_address(written)) == normal
    assert str(parse_address(normal)) == normal


@pytest.mark.parametrize(
    ("written", "explained"),
    [
        ("udpni:0.0.0.0:14540", "did you mean 'udpin'"),
        ("0.0.0.0:14540", "has no scheme"),
        ("14540", "has no scheme"),
        ("tcpin:0.0.0.0:5760", "connect to the autopilot with tcp:"),
        ("COM3", "a Windows port"),
        ("udpin:0.0.0.0", "expected HOST:PORT"),
        ("udpin:0.0.0.0:0", r"port in 1…65535"),
        ("udpin:0.0.0.0:99999", r"port in 1…65535"),
        ("udpout::14550", "has no host"),
        ("udpout:drone..local:14550", "found host 'drone..local'"),
        ("tcp:127.0.0.1:²", "found port '²'"),
        ("serial:921600:/dev/ttyACM0", "found device '921600"),
        ("serial:/dev/ttyACM0:fast", "found baud rate 'fast'"),
        ("serial:ttyACM0:921600", "expected a path such as /dev/ttyACM0"),
        ("tlog:", "has no file"),
        ("tlog:a.tlog?sped=1", "found sped=1"),
        ("tlog:a.tlog?speed=quick", "found speed=quick"),
        ("", "unknown scheme"),
    ],
)
def test_mistakes_in_addresses_are_explained(written, explained):
    with pytest.raises(SourceError, match=explained) as error:
        parse_address(written)
    assert "udpin:127.0.0.1:14540" in str(error.value)  # shows how to write it


def test_a_recording_that_does_not_exist_can_never_work(tmp_path):
    with pytest.raises(SourceError, match="no such file"):
        open_link(f"tlog:{tmp_path}/missing.tlog", ManualClock())


class Recorder:
    """A receiver that keeps what came. ours: what counts as a frame of our autopilot."""

    def __init__(self, ours: bytes = b"") -> None:
        self.is_open = asyncio.Event()
        self.data: list[tuple[float, bytes]] = []
        self.beside: list[bytes] = []
        self._ours = ours
        self._came = asyncio.Event()

    def opened(self) -> None:
        self.is_open.set()

    def received(self, t: float, data: bytes, sender: object = None) -> bool:
        self.data.append((t, data))
        self._came.set()
        return bool(self._ours) and self._ours in data

    def overheard(self, t: float, data: bytes) -> None:
        self.beside.append(data)

    @property
    def bytes(self) -> bytes:
        return b"".join(data for _, data in self.data)

    async def has(self, expected: bytes) -> None:
        while expected not in self.bytes:
            self._came.clear()
            await self._came.wait()


@contextlib.asynccontextmanager
async def running(link: Link, receiver: Recorder) -> AsyncIterator[asyncio.Task[None]]:
    task = asyncio.create_task(link.run(receiver))
    opened = asyncio.create_task(receiver.is_open.wait())
    async with asyncio.timeout(TIMEOUT):
        await asyncio.wait([task, opened], return_when=asyncio.FIRST_COMPLETED)
        try:
            yield task
        finally:
            opened.cancel()
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


def udp_socket() -> socket.socket:
    s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    s.bind(("127.0.0.1", 0))
    s.settimeout(TIMEOUT)
    return s


async def test_udpin_answers_only_where_a_valid_frame_of_ours_came_from():
    port, receiver = free_port(), Recorder(ours=b"autopilot")
    link = open_link(f"udpin:127.0.0.1:{port}", SystemClock())
    with udp_socket() as autopilot, udp_socket() as stranger:
        async with running(link, receiver):
            stranger.sendto(b"one byte", ("127.0.0.1", port))
            await receiver.has(b"one byte")
            link.send(b"nobody is known yet")
            autopilot.sendto(b"autopilot", ("127.0.0.1", port))
            await receiver.has(b"autopilot")
            link.send(b"answer")
            assert (await asyncio.to_thread(autopilot.recv, 100)) == b"answer"
            stranger.setblocking(False)
            with pytest.raises(BlockingIOError):
                stranger.recv(100)


async def test_udpin_keeps_to_its_first_peer_while_that_lives(caplog):
    port, receiver, clock = free_port(), Recorder(ours=b"autopilot"), ManualClock(100.0)
    link = open_link(f"udpin:127.0.0.1:{port}", clock)
    with udp_socket() as autopilot, udp_socket() as stranger:
        async with running(link, receiver):
            autopilot.sendto(b"the autopilot", ("127.0.0.1", port))
            await receiver.has(b"the autopilot")
            for t in (100.1, 100.0 + 0.99 * UDP_PEER_SILENT_S):
                clock.set(t)
                stranger.sendto(b"forged autopilot", ("127.0.0.1", port))
                stranger.sendto(b"forged", ("127.0.0.1", port))
                # Datagrams of one machine come in their order: those before it were dealt with.
                autopilot.sendto(b"%f autopilot" % t, ("127.0.0.1", port))
                await receiver.has(b"%f autopilot" % t)
                link.send(b"answer")
                assert (await asyncio.to_thread(autopilot.recv, 100)) == b"answer"
            assert b"forged" not in receiver.bytes
            assert link.foreign == 4
            assert receiver.beside == 2 * [b"forged autopilot", b"forged"]
            (said,) = caplog.messages
            assert f"127.0.0.1 port {stranger.getsockname()[1]} sends as well: ignored" in said
            # A router that was restarted speaks from another port.
            clock.set(clock.now() + UDP_PEER_SILENT_S)
            stranger.sendto(b"the autopilot's new address", ("127.0.0.1", port))
            await receiver.has(b"the autopilot's new address")
            autopilot.sendto(b"the autopilot's old address", ("127.0.0.1", port))
            stranger.sendto(b"the autopilot again", ("127.0.0.1", port))
            await receiver.has(b"the autopilot again")
            assert b"old address" not in receiver.bytes


@pytest.mark.parametrize(
    ("address", "reachable"),
    [
        ("udpin:0.0.0.0:14540", True),
        ("udpin:14540", True),
        ("udpin:[::]:14540", True),
        ("udpin:192.168.1.2:14540", True),
        ("udpin:drone.local:14540", True),
        ("udpin:127.0.0.1:14540", False),
        ("udpin:127.3.2.1:14540", False),
        ("udpin:[::1]:14540", False),
        ("udpin:localhost:14540", False),
        ("udpout:192.168.1.2:14540", False),
        ("tcp:192.168.1.2:5760", False),
        ("/dev/ttyACM0", False),
        ("none", False),
    ],
)
def test_a_port_that_others_reach_is_told_from_one_that_only_this_machine_does(address, reachable):
    assert parse_address(address).reachable_from_outside == reachable


async def test_a_udp_port_in_use_names_its_holder():
    with udp_socket() as holder:
        link = open_link(f"udpin:127.0.0.1:{holder.getsockname()[1]}", SystemClock())
        with pytest.raises(LinkDown, match=rf"busy, port \d+ is held by PID {os.getpid()} "):
            await link.run(Recorder())


async def test_udpout_speaks_first_and_says_when_nobody_listens():
    port = free_port()
    link = open_link(f"udpout:127.0.0.1:{port}", SystemClock())
    async with running(link, Recorder()):
        while not link.remark:
            link.send(b"hello")
            await asyncio.sleep(0.001)
        assert link.remark == "nothing listens there"


@pytest.mark.parametrize("scheme", ["udpout", "tcp"])
async def test_a_name_server_that_does_not_answer_is_named_in_time(monkeypatch, scheme):
    async def getaddrinfo(self, *names, **kinds):
        await asyncio.Event().wait()

    monkeypatch.setattr(asyncio.BaseEventLoop, "getaddrinfo", getaddrinfo)
    monkeypatch.setattr(links, "LINK_CONNECT_TIMEOUT_S", 0.05)
    link = open_link(f"{scheme}:drone.local:14550", SystemClock())
    async with asyncio.timeout(TIMEOUT):
        with pytest.raises(LinkDown, match=r"drone\.local"):
            await link.run(Recorder())


async def test_tcp_says_who_refused_and_who_hung_up():
    port = free_port()
    with pytest.raises(LinkDown, match=f"nothing listens at 127.0.0.1:{port}"):
        await open_link(f"tcp:127.0.0.1:{port}", SystemClock()).run(Recorder())

    async def greet_and_leave(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(await reader.readexactly(5))
        writer.close()

    server = await asyncio.start_server(greet_and_leave, "127.0.0.1", 0)
    link = open_link(f"tcp:127.0.0.1:{server.sockets[0].getsockname()[1]}", SystemClock())
    receiver = Recorder()
    async with server, running(link, receiver) as task:
        link.send(b"hello")
        with pytest.raises(LinkDown, match="the other end closed the connection"):
            await task
    assert receiver.bytes == b"hello"


async def test_serial_carries_both_ways_and_notices_the_unplugging():
    ours, theirs = pty.openpty()
    link = open_link(f"serial:{os.ttyname(theirs)}:921600", SystemClock())
    assert link.bytes_per_second == 92160
    receiver = Recorder()
    async with running(link, receiver) as task:
        os.write(ours, b"\xfd\x11\x13\x03 every byte value passes")  # XON, XOFF and ^C too
        await receiver.has(b"\xfd\x11\x13\x03 every byte value passes")
        link.send(b"\x03back\x0a")
        assert await asyncio.to_thread(os.read, ours, 100) == b"\x03back\x0a"
        os.close(theirs)
        os.close(ours)
        with pytest.raises(LinkDown, match="unplugged"):
            await task


async def test_a_serial_port_that_another_program_holds_names_it():
    ours, theirs = pty.openpty()
    path = os.ttyname(theirs)
    code = (
        f"import serial; port = serial.Serial({path!r}, exclusive=True); print('open', flush=True); input()"
    )
    holder = await asyncio.create_subprocess_exec(
        sys.executable, "-c", code, stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE
    )
    assert holder.stdout is not None
    await holder.stdout.readline()
    os.close(theirs)
    with pytest.raises(LinkDown, match=rf"busy, held by PID {holder.pid} python"):
        await open_link(f"serial:{path}:57600", SystemClock()).run(Recorder())
    await holder.communicate(b"\n")
    os.close(ours)


async def test_a_missing_serial_device_and_a_plain_file_say_so(tmp_path):
    with pytest.raises(LinkDown, match="no such device: /dev/ttyNOWHERE"):
        await open_link("/dev/ttyNOWHERE", SystemClock()).run(Recorder())
    plain = tmp_path / "file"
    plain.write_text("not a port")
    with pytest.raises(LinkDown, match="is not a serial port"):
        await open_link(f"serial:{plain}:57600", SystemClock()).run(Recorder())


def test_a_serial_port_that_is_not_ours_tells_the_command_to_run():
    assert "usermod -aG dialout" in serial_trouble("/dev/ttyACM0", errno.EACCES, "")


START_US = 1_700_000_000_000_000


def tlog(frames: list[tuple[float, bytes]]) -> bytes:
    return b"".join((START_US + round(t * 1e6)).to_bytes(8, "big") + frame for t, frame in frames)


def heartbeat() -> bytes:
    return FakeAutopilot().step(0.0)[0]


async def test_a_recording_is_played_at_its_own_times_from_now_on(tmp_path):
    path = tmp_path / "a.tlog"
    path.write_bytes(tlog([(0.0, heartbeat()), (0.5, heartbeat()), (3600.0, heartbeat())]))
    receiver = Recorder()
    await open_link(f"tlog:{path}?speed=0", ManualClock(1000.0)).run(receiver)
    assert [t for t, _ in receiver.data] == pytest.approx([1000.0, 1000.5, 4600.0], abs=1e-5)
    assert receiver.bytes == 3 * heartbeat()


async def test_a_file_that_is_no_recording_is_refused(tmp_path):
    path = tmp_path / "a.tlog"
    path.write_bytes(b"\xff" * 1000)
    with pytest.raises(SourceError, match="holds no record"):
        await open_link(f"tlog:{path}", ManualClock()).run(Recorder())
    path.write_bytes(heartbeat() * 9)
    with pytest.raises(SourceError, match="is MAVLink without times, as a router or a raw log writes it"):
        await open_link(f"tlog:{path}", ManualClock()).run(Recorder())
    path.write_bytes(b"")
    with pytest.raises(SourceError, match="empty"):
        await open_link(f"tlog:{path}", ManualClock()).run(Recorder())
