"""A radio network on one machine: each drone's processes in a network namespace of their own.

A namespace has two interfaces. `radio0` is the radio: a TAP device whose frames a switch in user space loses, delays
and cuts (`radio_switch.py`), because few kernels of containers and of virtual machines have netem. `wire0` is a
cable to the machine itself, a veth pair without faults and without a way to other drones: for the camera, the
autopilot, and whoever listens to the whole team.

Everything is anonymous: namespaces are open files, the TAP devices and the veth pairs live in them, the faults in
memory. When the launcher ends, also by SIGKILL, whatever was started through `wrap` is killed by the kernel, the switch
sees its input end, and nothing is left, on disk or in `ip link`.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import errno
import fcntl
import os
import shutil
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from io import FileIO
from typing import Final, Self

from swarmtrack.errors import SwarmtrackError
from swarmtrack.lab.swarm.radio_switch import MTU, RadioChannel

# 198.18.0.0/15 is kept for benchmarks (RFC 2544): no network that a machine is really on.
RADIO_NETWORK: Final = "198.18"  # the rest of an address is the drone's ID
WIRE_NETWORK: Final = "198.19"  # the third byte is the emulator's own, as several may be open on one machine
WIRE_HOST: Final = 254
MAX_RADIO_DRONES: Final = WIRE_HOST - 1
MAX_RADIO_DRONE_ID: Final = 0xFFFE  # 198.18.255.255 is everybody
PROGRAMS: Final = ("ip", "nsenter", "setpriv")
RADIO_CLOSE_S: Final = 2.0

CLONE_NEWNET: Final = 0x40000000
TUNSETIFF: Final = 0x400454CA
IFF_TAP, IFF_NO_PI = 0x0002, 0x1000


class RadioError(SwarmtrackError):
    """No radio can be emulated here; the text says what is missing, and how to get it."""


@dataclass(frozen=True, slots=True)
class RadioCounters:
    """What one drone's radio sent: a frame to everybody counts once. lost, cut: receptions that failed."""

    frames: int
    bytes: int
    lost: int
    cut: int


class RadioEmulator:
    """Use with `async with`. Needs root, or the root that `unshare -Urn` makes; else RadioError.

    Faults hold for every link; `impair` sets those of some drones. Delays are uniform in latency ± jitter and keep the
    order of one link unless it is `disordered`.
    """

    def __init__(self, drones: Sequence[int], *, seed: int) -> None:
        if len(set(drones)) != len(drones) or not 0 < len(drones) <= MAX_RADIO_DRONES:
            raise RadioError(
                f"radio: found the drones {list(drones)}, expected 1 to {MAX_RADIO_DRONES} of different IDs"
            )
        if not all(1 <= drone <= MAX_RADIO_DRONE_ID for drone in drones):
            raise RadioError(
                f"radio: found the drones {list(drones)}, expected IDs of 1 to {MAX_RADIO_DRONE_ID}"
            )
        self._ports: Mapping[int, int] = {drone: port for port, drone in enumerate(drones)}
        self._seed = seed
        self._memory = FileIO(os.memfd_create("swarmtrack-radio"), "r+")
        self._memory.truncate(RadioChannel.size(len(drones)))
        self._channel = RadioChannel(self._memory.fileno(), len(drones))
        # By drone: what keeps its namespace alive, and the far side of its radio, until the switch has that.
        self._namespaces: dict[int, FileIO] = {}
        self._taps: dict[int, FileIO] = {}
        self._claim: socket.socket | None = None
        self._block = 0
        self._switch: asyncio.subprocess.Process | None = None

    async def __aenter__(self) -> Self:
        try:
            await asyncio.to_thread(self._build)
            await self._start_switch()
        except BaseException:
            await self._close()
            raise
        return self

    async def __aexit__(self, kind: object, error: object, traceback: object) -> None:
        died = self._switch is not None and self._switch.returncode is not None
        await self._close()
        if died and error is None:
            raise RadioError("radio: its switch ended by itself, so no message arrived any more; see above")

    # --- where things are ---------------------------------------------------------------

    def wrap(self, drone: int, argv: Sequence[str]) -> list[str]:
        """The command that runs `argv` as one process in the drone's namespace.

        It is killed when the thread that started it ends, so start it from the main thread, as asyncio does.
        """
        namespace = f"--net=/proc/{os.getpid()}/fd/{self._namespaces[drone].fileno()}"
        return ["nsenter", namespace, "--", "setpriv", "--pdeathsig", "KILL", "--", *argv]

    def radio_address(self, drone: int) -> str:
        return f"{RADIO_NETWORK}.{drone >> 8}.{drone & 0xFF}"

    def drone_wire_address(self, drone: int) -> str:
        """Of the drone's end of its cable: where the launcher reaches its agent without the radio."""
        return f"{WIRE_NETWORK}.{self._block}.{self._ports[drone] + 1}"

    @property
    def wire_address(self) -> str:
        """Of this machine's end of every cable."""
        return f"{WIRE_NETWORK}.{self._block}.{WIRE_HOST}"

    # --- faults -------------------------------------------------------------------------

    def impair(
        self,
        drones: Collection[int] | None = None,
        *,
        loss: float | None = None,
        latency_s: float | None = None,
        jitter_s: float | None = None,
        repeated: float | None = None,
        disordered: bool | None = None,
    ) -> None:
        """Set what is given for every link to and from these drones, or for all.

        loss, repeated: probability that a frame is lost on its way to one receiver, or arrives there twice;
        disordered: frames of one link overtake each other within the jitter.
        """
        for name, share in (("loss", loss), ("repeated", repeated)):
            if share is not None and not 0.0 <= share <= 1.0:
                raise ValueError(f"{name}: found {share:g}, expected 0 to 1")
        for name, seconds in (("latency_s", latency_s), ("jitter_s", jitter_s)):
            if seconds is not None and not 0.0 <= seconds <= 60.0:
                raise ValueError(f"{name}: found {seconds:g}, expected 0 to 60 s")
        ports = {self._ports[drone] for drone in (self._ports if drones is None else drones)}
        channel = self._channel
        columns = (
            (channel.loss, loss),
            (channel.latency_s, latency_s),
            (channel.jitter_s, jitter_s),
            (channel.repeated, repeated),
            (channel.disordered, disordered),
        )
        for pair in self._pairs(lambda a, b: a in ports or b in ports):
            for column, value in columns:
                if value is not None:
                    column[pair] = value

    def narrow(self, kbit_s: float | None, drones: Collection[int] | None = None) -> None:
        """So much goes through each radio of these drones, or of all; None: as much as you like."""
        if kbit_s is not None and not 1.0 <= kbit_s <= 1e6:
            raise ValueError(f"kbit_s: found {kbit_s:g}, expected 1 to 1000000 kbit/s")
        for drone in self._ports if drones is None else drones:
            self._channel.bits_per_s[self._ports[drone]] = 0.0 if kbit_s is None else 1e3 * kbit_s

    def limit_frames(self, longest: int | None, drones: Collection[int] | None = None) -> None:
        """The radios of these drones, or of all, swallow longer frames, in bytes with their headers; None: none."""
        if longest is not None and not 100 <= longest <= MTU:
            raise ValueError(f"longest: found {longest}, expected 100 to {MTU} bytes")
        for drone in self._ports if drones is None else drones:
            self._channel.longest_frame[self._ports[drone]] = 0.0 if longest is None else longest

    def block_udp(self, drones: Collection[int] | None = None, *, blocked: bool = True) -> None:
        """The radios of these drones, or of all, swallow UDP, as a firewall does."""
        for drone in self._ports if drones is None else drones:
            self._channel.udp_blocked[self._ports[drone]] = float(blocked)

    def cut(self, side: Iterable[int]) -> None:
        """These drones and the others no longer hear each other; several cuts add up."""
        ports = {self._ports[drone] for drone in side}
        for pair in self._pairs(lambda a, b: (a in ports) != (b in ports)):
            self._channel.blocked[pair] = 1.0

    def deafen(self, listeners: Iterable[int], speakers: Iterable[int]) -> None:
        """These listeners no longer hear these speakers, who go on hearing them; adds to what is cut."""
        deaf = {self._ports[drone] for drone in listeners}
        unheard = {self._ports[drone] for drone in speakers}
        for pair in self._pairs(lambda a, b: a in unheard and b in deaf):
            self._channel.blocked[pair] = 1.0

    def silence(self, drone: int) -> None:
        """Nobody hears this drone, and it hears nobody."""
        self.cut({drone})

    def heal(self) -> None:
        """Undo every cut, also those in one direction."""
        for pair in self._pairs(lambda a, b: True):
            self._channel.blocked[pair] = 0.0

    def _pairs(self, chosen: Callable[[int, int], bool]) -> Iterator[int]:
        """Indices into the channel of the ordered pairs of ports that are chosen."""
        n = self._channel.ports
        return (a * n + b for a in range(n) for b in range(n) if chosen(a, b))

    @property
    def counters(self) -> Mapping[int, RadioCounters]:
        """By drone, since the start."""
        channel = self._channel
        return {
            drone: RadioCounters(
                frames=int(channel.sent_frames[port]),
                bytes=int(channel.sent_bytes[port]),
                lost=int(channel.lost_frames[port]),
                cut=int(channel.blocked_frames[port]),
            )
            for drone, port in self._ports.items()
        }

    # --- making and ending it -----------------------------------------------------------

    def _build(self) -> None:
        missing = [program for program in PROGRAMS if shutil.which(program) is None]
        if missing:
            raise RadioError(f"radio: no {', '.join(missing)} here; install iproute2 and util-linux")
        self._claim, self._block = _claim_block()
        for drone in self._ports:
            _in_a_thread_of_its_own(partial(self._make_namespace, drone))
        # Of a machine the loopback is up long since; in a namespace that `unshare -Urn` made, nobody has cared.
        commands = ["link set lo up"]
        for drone in self._ports:
            cable = self._cable(drone)
            commands += [
                f"link set dev {cable} addrgenmode none up",
                f"addr add {self.wire_address} peer {self.drone_wire_address(drone)} dev {cable}",
            ]
        _ip(commands)

    def _make_namespace(self, drone: int) -> None:
        """Put this thread, for good, into a new namespace and furnish it."""
        _unshare_network()
        self._namespaces[drone] = FileIO("/proc/thread-self/ns/net")
        self._taps[drone] = _open_tap("radio0")
        _ip(
            [
                "link set lo up",
                f"link set dev radio0 address {mac_address(drone).hex(':')} mtu {MTU} addrgenmode none",
                "link set dev radio0 up",
                f"addr add {self.radio_address(drone)}/16 brd + dev radio0",
                f"link add wire0 type veth peer name {self._cable(drone)} netns {os.getpid()}",
                "link set dev wire0 addrgenmode none up",
                f"addr add {self.drone_wire_address(drone)} peer {self.wire_address} dev wire0",
            ]
        )

    def _cable(self, drone: int) -> str:
        """The name of this machine's end."""
        return f"{_cable_prefix(self._block)}{drone}"

    async def _start_switch(self) -> None:
        radios = [f"{tap.fileno()}={mac_address(drone).hex()}" for drone, tap in self._taps.items()]
        self._switch = await asyncio.create_subprocess_exec(
            sys.executable,
            *("-m", "swarmtrack.lab.swarm.radio_switch"),
            *("--channel", str(self._memory.fileno()), "--seed", str(self._seed), *radios),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            pass_fds=(self._memory.fileno(), *(tap.fileno() for tap in self._taps.values())),
        )
        for tap in self._taps.values():
            tap.close()  # the switch's are the only ones now: when it ends, the radios do
        assert self._switch.stdout is not None
        if not await self._switch.stdout.readline():
            raise RadioError(
                f"radio: its switch ended at once, exit code {await self._switch.wait()}; see above"
            )

    async def _close(self) -> None:
        if self._switch is not None and self._switch.returncode is None:
            assert self._switch.stdin is not None
            self._switch.stdin.close()
            try:
                async with asyncio.timeout(RADIO_CLOSE_S):
                    await self._switch.wait()
            except TimeoutError:
                self._switch.kill()
                await self._switch.wait()
        for file in (*self._taps.values(), *self._namespaces.values(), self._memory):
            file.close()
        if self._claim is not None:
            # The kernel takes the cables with their namespaces, but in its own time.
            cables = [f"link del {self._cable(drone)}" for drone in self._namespaces]
            with contextlib.suppress(RadioError):
                await asyncio.to_thread(_ip, cables, to_the_end=True)
            self._claim.close()


def mac_address(drone: int) -> bytes:
    """Of the drone's radio: locally administered, and readable: it ends in the ID."""
    return b"\x02\x73\x77\x00" + drone.to_bytes(2, "big")


def _in_a_thread_of_its_own(call: Callable[[], None]) -> None:
    """A namespace belongs to a thread: one that ends afterwards takes nobody else along."""
    failed: list[BaseException] = []

    def run() -> None:
        try:
            call()
        except BaseException as error:  # goes to whoever waits for the thread
            failed.append(error)

    thread = threading.Thread(target=run, name="into a namespace")
    thread.start()
    thread.join()
    if failed:
        raise failed[0]


def _cable_prefix(block: int) -> str:
    return f"air{block}-"


def _claim_block() -> tuple[socket.socket, int]:
    """A third byte for the wire's addresses that no other emulator in this network namespace uses.

    The claim is an abstract socket: as anonymous as all else here, and bound to this namespace, as addresses are.
    Cables of an emulator that was killed may be there for a moment more.
    """
    names = [name for _, name in socket.if_nameindex()]
    for block in range(256):
        claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            claim.bind(f"\0swarmtrack-radio-{block}")
        except OSError:
            claim.close()
            continue
        if not any(name.startswith(_cable_prefix(block)) for name in names):
            return claim, block
        claim.close()
    raise RadioError("radio: 256 radio emulators are open on this machine, expected one of them to end first")


def _unshare_network() -> None:
    """Put this thread into a new network namespace. (`os.unshare` comes with Python 3.12.)"""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(CLONE_NEWNET) == 0:
        return
    number = ctypes.get_errno()
    if number == errno.EPERM and os.geteuid() != 0:
        raise RadioError(
            "radio: radios in network namespaces need root; run as root, or below `unshare -Urn`"
        )
    if number == errno.EPERM:
        raise RadioError(
            "radio: this root may not make network namespaces (no CAP_SYS_ADMIN); "
            "a container needs --cap-add SYS_ADMIN --cap-add NET_ADMIN --device /dev/net/tun"
        )
    raise RadioError(f"radio: this kernel makes no network namespaces: {os.strerror(number)}")


def _open_tap(name: str) -> FileIO:
    """A TAP device in this thread's namespace; it lives as long as the descriptor, which does not block."""
    try:
        tap = FileIO(os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK), "r+")
    except OSError as error:
        raise RadioError(
            f"radio: /dev/net/tun: {error.strerror}; `modprobe tun`, give a container --device /dev/net/tun, "
            f"and users other than root read and write access to it"
        ) from None
    try:
        fcntl.ioctl(tap, TUNSETIFF, struct.pack("16sH22x", name.encode(), IFF_TAP | IFF_NO_PI))
    except OSError as error:
        tap.close()
        raise RadioError(
            f"radio: no TAP device {name}: {error.strerror}; it needs CAP_NET_ADMIN, which root has"
        ) from None
    return tap


def _ip(commands: Sequence[str], *, to_the_end: bool = False) -> None:
    """Run commands of ip(8) in this thread's namespace. to_the_end: also beyond one that fails."""
    options = ["-force"] if to_the_end else []
    finished = subprocess.run(
        ["ip", *options, "-batch", "-"],
        input="\n".join(commands),
        text=True,
        capture_output=True,
        check=False,
    )
    if finished.returncode != 0:
        # "Command failed -:3" counts the lines that it was given.
        reasons = finished.stderr.strip().splitlines()
        line = reasons[-1].rpartition(":")[2] if reasons else ""
        failed = commands[int(line) - 1] if line.isdecimal() else commands[0]
        raise RadioError(f"radio: `ip {failed}`: {reasons[0] if reasons else 'failed without a message'}")
