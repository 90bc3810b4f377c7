"""The agent's end of its guard (`swarmtrack/guard.py`): starts it, speaks to it, and notices when it is gone."""

from __future__ import annotations

import contextlib
import logging
import socket
import subprocess
import sys
from typing import NamedTuple, Protocol

from swarmtrack import guard
from swarmtrack.autopilot.mavlink_autopilot import WayToAutopilot
from swarmtrack.formation.parameters import FlightLimits
from swarmtrack.guard import Decision, GuardLimits

log = logging.getLogger(__name__)

# s that the guard is waited for when the agent stops: its last words, and the end of a process.
ENDS_WITHIN_S = 0.25 + guard.GUARD_LAST_WORDS_S
# Onboard computers are 191 … 194 (MAV_COMP_ID_ONBOARD_COMPUTER).
FIRST_COMPONENT, COMPONENTS = 191, 4


class Release(NamedTuple):
    """The guard has ended an engagement by itself."""

    number: int
    why: str


class GuardNews(NamedTuple):
    """What a guard has said since it was asked last."""

    releases: tuple[Release, ...] = ()
    died: bool = False


class GuardLine(Protocol):
    """The guard as its decider sees it. All but `stop` returns at once."""

    @property
    def alive(self) -> bool: ...
    @property
    def sent(self) -> int:
        """Set points, since the first start."""
        ...

    @property
    def stale(self) -> int:
        """Number of zeros sent for want of a fresh decision."""
        ...

    @property
    def refused(self) -> int:
        """Number of zeros sent in place of a rejected decision."""
        ...

    def start(self) -> None: ...
    def reach(self, way: WayToAutopilot | None) -> None:
        """So the autopilot is reached just now."""
        ...

    def decide(self, decision: Decision) -> None: ...
    def stand(self) -> None:
        """There is no engagement, and the autopilot expects zeros."""
        ...

    def end(self, number: int) -> None:
        """An engagement is over: nothing more is sent."""
        ...

    def news(self) -> GuardNews: ...
    def stop(self) -> None:
        """The agent stops: last zeros are sent, and the guard ends."""
        ...


class GuardProcess:
    """A guard in a process of its own. Only `start` starts it again.

    limits: what it enforces; key: signs what it sends, None: nothing does.
    """

    def __init__(self, limits: FlightLimits, key: bytes | None) -> None:
        self.pid: int | None = None
        self._limits, self._key = guard_limits(limits), key
        self._process: subprocess.Popen[bytes] | None = None
        self._socket: socket.socket | None = None
        self._way: WayToAutopilot | None = None
        self._counts: tuple[int, int, int] = (0, 0, 0)
        self._before = self._counts
        self._died = False

    @property
    def alive(self) -> bool:
        return self._socket is not None

    @property
    def sent(self) -> int:
        return self._before[0] + self._counts[0]

    @property
    def stale(self) -> int:
        return self._before[1] + self._counts[1]

    @property
    def refused(self) -> int:
        return self._before[2] + self._counts[2]

    def start(self) -> None:
        """Where none runs."""
        if self.alive:
            return
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        # -I -S: nothing but the standard library is to be found; a session of its own: a terminal's Ctrl-C and Ctrl-Z
        # are for the agent.
        command = [sys.executable, "-I", "-S", guard.__file__, str(theirs.fileno()), *map(repr, self._limits)]
        with theirs:
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, pass_fds=[theirs.fileno()], start_new_session=True
            )
        ours.setblocking(False)
        self._socket, self._way, self.pid = ours, None, self._process.pid
        self._before = (self.sent, self.stale, self.refused)
        self._counts = (0, 0, 0)
        if self._key is not None:
            self._tell(guard.KEY + self._key)

    def reach(self, way: WayToAutopilot | None) -> None:
        if way == self._way or self._socket is None:
            return
        self._way = way
        if way is None:
            self._tell(guard.NO_LINK)
            return
        component = FIRST_COMPONENT + (way.component - FIRST_COMPONENT + 1) % COMPONENTS
        host, port = ("", 0) if way.wire.peer is None else way.wire.peer[:2]
        opened = guard.OPENED.pack(way.system, component, way.target, way.version_1, port) + host.encode()
        self._tell(guard.LINK + opened, way.wire.descriptor)

    def decide(self, decision: Decision) -> None:
        numbers = (*decision.velocity, decision.yaw_rate, *decision.place, decision.place_t, decision.room)
        self._tell(guard.DECISION + guard.DECIDED.pack(decision.number, decision.t, *numbers))

    def stand(self) -> None:
        self._tell(guard.STAND)

    def end(self, number: int) -> None:
        self._tell(guard.END + guard.SETPOINT_NUMBER.pack(number))

    def news(self) -> GuardNews:
        releases = []
        while self._socket is not None:
            try:
                data = self._socket.recv(guard.LARGEST_DATAGRAM_BYTES)
            except BlockingIOError:
                break
            except OSError:
                data = b""
            kind, body = data[:1], data[1:]
            if not kind:
                self._close()
                self._died = True
            elif kind == guard.SENT:
                self._counts = guard.COUNTS.unpack(body)
            elif kind == guard.RELEASED:
                (number,) = guard.SETPOINT_NUMBER.unpack(body[: guard.SETPOINT_NUMBER.size])
                releases.append(Release(number, body[guard.SETPOINT_NUMBER.size :].decode()))
        died, self._died = self._died, False
        return GuardNews(tuple(releases), died)

    def stop(self) -> None:
        """Waits for its end, a quarter of a second during an engagement: until then the link is the guard's, too."""
        self._tell(guard.STOP)
        if self._process is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(ENDS_WITHIN_S)
        self._close()
        self._died = False

    def _tell(self, data: bytes, *descriptors: int) -> None:
        """To the guard; what it has no room for is lost, and missed as soon as it sends nothing."""
        if self._socket is None:
            return
        try:
            socket.send_fds(self._socket, [data], descriptors)
        except BlockingIOError:
            pass
        except OSError:
            self._close()
            self._died = True

    def _close(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket = self.pid = None
        if self._process is not None and self._process.poll() is not None:
            log.info("formation: the guard has ended, code %s", self._process.returncode)


def guard_limits(limits: FlightLimits) -> GuardLimits:
    """Those that a guard enforces."""
    return GuardLimits(
        speed=limits.speed,
        climb=limits.climb,
        yaw_rate=limits.yaw_rate,
        acceleration=limits.acceleration,
        evasion=limits.evasion,
        yaw_acceleration=limits.yaw_acceleration,
        fence_radius=limits.fence_radius,
        fence_height=limits.fence_height,
    )
