"""The guard: a program of its own between the formation's law and the autopilot. It can only slow down, or let go.

The agent of a follower starts it, and sends it ten times per second what the law has decided, when, and where the
autopilot says the drone is. The guard alone sends set points. It sends the last decision while that is younger than
`SETPOINT_STALE_S` and `Guard.refusal` has nothing against it. It sends zero velocity for an older one, slows down for a
refused one, and after `SETPOINT_DEAD_S` of either it sends nothing more until the pilot engages again. An agent that
hangs, is stopped or dies changes none of this: the guard needs no word from it.

Theory of operation. `Guard` is told of everything and of the time, and answers with what to send: it reads no clock and
touches nothing. `Program` is around it: one socket to the agent, which also hands over the open link to the
autopilot (SCM_RIGHTS), and one loop. It reads no config, writes no file, and imports the standard library alone. It
speaks as a MAVLink component of its own, so that its sequence numbers and signatures are its own too.

Why a process, and why this one owns no link: docs/decisions/0041-the-guard.md.
"""

from __future__ import annotations

import math
import os
import select
import signal
import socket
import struct
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from typing import Any, NamedTuple

Velocity = tuple[float, float, float]
GUARD_STANDSTILL: Velocity = (0.0, 0.0, 0.0)

# s: a decision that comes is sent at once, and again as often as this while no other comes.
AGAIN_S = 0.15
# s: an older decision is zero velocity, and one older than SETPOINT_DEAD_S the end. So long what is refused is waited
# for, too.
SETPOINT_STALE_S, SETPOINT_DEAD_S = 0.3, 1.0
# s: `due` adds what `command` subtracts.
SETPOINT_TIME_ROUNDING_S = 1e-6
# s: after the agent has said that it stops, zeros are sent for so long: one datagram may be lost.
GUARD_LAST_WORDS_S = 0.25
# s: a place that the autopilot told longer ago says nothing of where the drone is.
OLDEST_PLACE_S = 0.5
# 1/s: of the room that is left to fence, floor and ceiling, as much may be used up. The law's barrier uses the same.
GUARD_GAMMA_PER_S = 0.5
# m beyond the law's own fence, floor and ceiling: the guard is for what the law does not keep, not for its rounding.
GUARD_MARGIN_M = 1.0
# Of a limit, and m/s: rounding, no more.
GUARD_SLACK, GUARD_SLACK_M_S = 1e-6, 1e-3


class GuardLimits(NamedTuple):
    """What no set point exceeds, of [formation.limits]: m/s, m/s, rad/s, m/s², m/s², rad/s², m, m."""

    speed: float
    climb: float
    yaw_rate: float
    acceleration: float
    evasion: float
    """How fast a set point may change: evading is quicker than `acceleration`."""
    yaw_acceleration: float
    fence_radius: float
    fence_height: float


class Decision(NamedTuple):
    """What the law has decided at t [s, CLOCK_MONOTONIC] in a pilot's engagement `number`.

    velocity [m/s] and place [m]: NED, in the axes of the autopilot's local frame; yaw_rate [rad/s]; place_t [s]: when
    the autopilot's message with the place arrived; room [m]: from there down to the least height. NaN: not known.
    """

    number: int
    t: float
    velocity: Velocity
    yaw_rate: float
    place: Velocity
    place_t: float
    room: float


class Command(NamedTuple):
    """velocity [m/s] NED, local frame; yaw_rate [rad/s]."""

    velocity: Velocity
    yaw_rate: float


ZERO = Command(GUARD_STANDSTILL, 0.0)


class Guard:
    """Takes decisions and the time [s]; `due` says when `command` is to be asked next, at the latest."""

    def __init__(self, limits: GuardLimits) -> None:
        self.limits = limits
        self.refusals = self.stale = 0
        """Set points that were sent in a decision's stead: it was refused, or too old."""
        self._engaged = 0
        self._over = 0
        """Engagements up to this number are over, whatever is decided for them."""
        self._decision: Decision | None = None
        self._heard_at = self._stood_at = self._sent_at = -math.inf
        self._refused_since = math.inf
        self._sent = ZERO
        self._centre: Velocity | None = None
        self._floor = math.inf
        self._released = ""
        self._slows = False
        """Whether the last decision is to come to a stop, half as fast as the acceleration allows or faster."""

    @property
    def engaged(self) -> bool:
        return self._engaged > 0

    @property
    def over(self) -> int:
        """The engagement that ended last."""
        return self._over

    def take_release(self) -> str:
        """Why the guard itself has ended an engagement since the last call; empty if it has not."""
        released, self._released = self._released, ""
        return released

    def decided(self, decision: Decision, now: float) -> bool:
        """Take a decision; False for one of an engagement that is over."""
        if decision.number <= self._over:
            return False
        if decision.number != self._engaged:
            self._engaged, self._sent, self._sent_at = decision.number, ZERO, now
            self._centre, self._floor = None, math.inf
            self._refused_since = math.inf
            self._decision = None
        self._slows = self._is_slower(decision)
        self._decision, self._heard_at = decision, now
        self._settle(decision, now)
        return True

    def stands(self, now: float) -> None:
        """Zeros are wanted just now, without an engagement: PX4 asks for them."""
        self._stood_at = now

    def end(self, number: int) -> None:
        """The pilot has ended it: nothing more is sent."""
        self._over = max(self._over, number)
        self._engaged, self._decision = 0, None
        self._stood_at = -math.inf

    def due(self) -> float:
        """Infinite where nothing will have to be sent."""
        if not self.engaged:
            return math.inf
        next_at, stale_at = self._sent_at + AGAIN_S, self._heard_at + SETPOINT_STALE_S
        return min(next_at, stale_at) if self._sent_at < stale_at else next_at

    def command(self, now: float, *, gone: bool = False) -> Command | None:
        """What to send now; None: nothing. gone: the agent is, so its last decision is none any more."""
        decision = self._decision
        if decision is None:
            return ZERO if now - self._stood_at < SETPOINT_STALE_S else None
        dt = min(max(now - self._sent_at, 0.0), SETPOINT_STALE_S)
        # A stamp from the future is worth no more than one of the moment when it came.
        age = now - min(decision.t, self._heard_at)
        if not age <= SETPOINT_DEAD_S:
            self._release(f"no decision for {age:.1f} s")
            if now - self._sent_at > SETPOINT_DEAD_S:
                # It was the guard that stood still: the autopilot has long helped itself.
                return None
            answer = ZERO
        elif gone or age > SETPOINT_STALE_S - SETPOINT_TIME_ROUNDING_S:
            self.stale += 1
            answer = ZERO
        else:
            answer = self._checked(decision, dt, now)
        self._sent, self._sent_at = answer, now
        return answer

    def _checked(self, decision: Decision, dt: float, now: float) -> Command:
        """The decision, if it may be flown; else slower than before."""
        limits = self.limits
        slower = Command(
            _towards(self._sent.velocity, GUARD_STANDSTILL, limits.acceleration * dt),
            _turned(self._sent.yaw_rate, 0.0, limits.yaw_acceleration * dt),
        )
        refusal = self.refusal(decision, now)
        if not refusal:
            self._refused_since = math.inf
            return Command(
                _towards(self._sent.velocity, decision.velocity, limits.evasion * dt),
                _turned(self._sent.yaw_rate, decision.yaw_rate, 2.0 * limits.yaw_acceleration * dt),
            )
        self.refusals += 1
        self._refused_since = min(self._refused_since, now)
        if now - self._refused_since > SETPOINT_DEAD_S:
            self._release(f"refused: {refusal}")
            return ZERO
        return slower

    def refusal(self, decision: Decision, now: float) -> str:
        """What a decision has against it, in words; empty: nothing."""
        limits, velocity = self.limits, decision.velocity
        if not all(map(math.isfinite, (*velocity, decision.yaw_rate))):
            return "a velocity that is not a number"
        speed, down = math.hypot(*velocity), velocity[2]
        for name, value, most in (
            ("speed", speed, limits.speed),
            ("climb", abs(down), limits.climb),
            ("yaw rate", abs(decision.yaw_rate), limits.yaw_rate),
        ):
            if value > most * (1.0 + GUARD_SLACK):
                return f"{name} {value:.4g}, at most {most:.4g}"
        # Whoever comes to a stop by itself may do so wherever it is.
        if self._slows or speed == 0.0:
            return ""
        is_known = 0.0 <= now - decision.place_t <= OLDEST_PLACE_S and all(map(math.isfinite, decision.place))
        if self._centre is None or not is_known:
            return "its position is unknown"
        north, east, low = (here - there for here, there in zip(decision.place, self._centre, strict=True))
        away = math.hypot(north, east)
        outward = (velocity[0] * north + velocity[1] * east) / away if away > 0.0 else 0.0
        for name, room, leads in (
            ("fence", limits.fence_radius - away, outward),
            ("ceiling", limits.fence_height + low, -down),
            ("floor", min(limits.fence_height, self._floor) - low, down),
        ):
            if leads > max(GUARD_GAMMA_PER_S * (room + GUARD_MARGIN_M), 0.0) + GUARD_SLACK_M_S:
                return f"{leads:.1f} m/s towards the {name}, {room:.1f} m from it"
        return ""

    def _is_slower(self, decision: Decision) -> bool:
        before = self._decision
        if before is None:
            return False
        most = math.hypot(*before.velocity) - 0.5 * self.limits.acceleration * (decision.t - before.t)
        return decision.t > before.t and math.hypot(*decision.velocity) <= most

    def _settle(self, decision: Decision, now: float) -> None:
        """The fence stands around where the autopilot said the drone was when it was engaged, the floor below that."""
        numbers = (*decision.place, decision.room)
        if (
            self._centre is None
            and now - decision.place_t <= OLDEST_PLACE_S
            and all(map(math.isfinite, numbers))
        ):
            self._centre, self._floor = decision.place, decision.room

    def _release(self, why: str) -> None:
        self._released = why
        self.end(self._engaged)


def _towards(now: Velocity, wanted: Velocity, most: float) -> Velocity:
    """From one velocity to another, by `most` at most."""
    step = [goal - here for here, goal in zip(now, wanted, strict=True)]
    length = math.hypot(*step)
    share = 1.0 if length <= most else most / length
    return (
        wanted
        if share == 1.0
        else (now[0] + share * step[0], now[1] + share * step[1], now[2] + share * step[2])
    )


def _turned(now: float, wanted: float, most: float) -> float:
    return now + min(max(wanted - now, -most), most)


# ── MAVLink: one message; a test compares it with pymavlink's ────────────────────────────────────────────────────────

SETPOINT_MESSAGE, SETPOINT_CRC_EXTRA = 84, 143
LOCAL_NED, TARGET_COMPONENT, SIGNED_FLAG = 1, 1, 1
# Ignored: position, acceleration and heading; used: velocity and yaw rate.
MASK = 0b010111000111
PAYLOAD = struct.Struct("<I11fH3B")
# s UTC, where signing's time begins: 2015-01-01; and its ticks per second.
SIGNING_BEGAN, SIGNING_TICKS = 1_420_070_400, 100_000


class Speaker:
    """SET_POSITION_TARGET_LOCAL_NED as (system, component) to a component of that system, signed where there is a key
    of 32 bytes. version_1: as MAVLink 1, which knows no signatures.
    """

    def __init__(self, system: int, component: int, key: bytes = b"") -> None:
        self.system, self.component, self.key = system, component, key
        self.target, self.version_1 = TARGET_COMPONENT, False
        self._sequence = 0
        self._ticks = 0

    def frame(self, point: Command, now: float, utc: float) -> bytes:
        payload = PAYLOAD.pack(
            int(now * 1e3) % 2**32, *GUARD_STANDSTILL, *point.velocity, *GUARD_STANDSTILL, 0.0, point.yaw_rate,
            MASK, self.system, self.target, LOCAL_NED,
        )  # fmt: skip
        sender = (self._sequence, self.system, self.component)
        if self.version_1:
            magic, head = b"\xfe", bytes((len(payload), *sender, SETPOINT_MESSAGE))
        else:
            flags = SIGNED_FLAG if self.key else 0
            magic, head = (
                b"\xfd",
                bytes((len(payload), flags, 0, *sender)) + SETPOINT_MESSAGE.to_bytes(3, "little"),
            )
        body = head + payload
        frame = magic + body + struct.pack("<H", _crc(body + bytes((SETPOINT_CRC_EXTRA,))))
        self._sequence = (self._sequence + 1) % 256
        return frame + self._signature(frame, utc) if self.key and not self.version_1 else frame

    def _signature(self, frame: bytes, utc: float) -> bytes:
        self._ticks = max(self._ticks + 1, int((utc - SIGNING_BEGAN) * SIGNING_TICKS))
        stamp = bytes((self.component,)) + self._ticks.to_bytes(6, "little")
        return stamp + bytes(_sha256()(self.key + frame + stamp).digest()[:6])


def _sha256() -> Callable[[bytes], Any]:
    """Python's own, which hashlib is not without OpenSSL: that would be a third of this process's memory."""
    for name in ("_sha2", "_sha256", "hashlib"):  # from 3.12 on, 3.11, any other
        with suppress(ImportError):
            return import_module(name).sha256  # type: ignore[no-any-return]
    raise AssertionError("no SHA-256 in this Python")


def _crc(data: bytes) -> int:
    """X.25, as MAVLink computes it."""
    crc = 0xFFFF
    for byte in data:
        x = (byte ^ crc) & 0xFF
        x ^= (x << 4) & 0xFF
        crc = (crc >> 8) ^ (x << 8) ^ (x << 3) ^ (x >> 4)
    return crc


# ── between agent and guard: datagrams; the first byte says which ────────────────────────────────────────────────────

KEY, LINK, NO_LINK, DECISION, STAND, END, STOP = b"K", b"L", b"l", b"D", b"Z", b"E", b"S"
RELEASED, SENT = b"R", b"T"
DECIDED = struct.Struct("<I10d")  # number, t, velocity, yaw_rate, place, place_t, room
SETPOINT_NUMBER = struct.Struct("<I")
# System and component of its messages, component that they are for, whether that hears MAVLink 1 only, port of the peer
# (0: the link has one peer); then its host.
OPENED = struct.Struct("<BBB?H")
COUNTS = struct.Struct("<III")  # set points sent; in the stead of stale decisions; of refused ones
LARGEST_DATAGRAM_BYTES = 512


class Program:
    """Around a `Guard`: agent: the socket to the agent; everything else it learns from there."""

    def __init__(self, agent: socket.socket, limits: GuardLimits) -> None:
        agent.setblocking(False)
        self.guard = Guard(limits)
        self._agent = agent
        self._speaker = Speaker(1, 192)
        self._link = -1
        self._peer: tuple[str, int] | None = None
        """Of a link that hears several; None: whoever is at its other end."""
        self._ends_at = math.inf
        self._gone = False
        self._count = 0

    def run(self) -> None:
        """Until the agent is gone, and what that means to the autopilot is said."""
        waiting = select.poll()
        waiting.register(self._agent, select.POLLIN)
        while time.monotonic() < self._ends_at and (self.guard.engaged or not self._gone):
            wait = min(self.guard.due(), self._ends_at) - time.monotonic()
            timeout = None if wait == math.inf else max(1e3 * wait, 0.0)
            if waiting.poll(timeout):
                self._listen(waiting)
            if time.monotonic() >= self.guard.due():
                self._send()

    def _listen(self, waiting: select.poll) -> None:
        """One datagram of the agent, or that there will be none any more."""
        try:
            data, passed, _, _ = socket.recv_fds(self._agent, LARGEST_DATAGRAM_BYTES, 1)
        except BlockingIOError:
            return
        except OSError:
            data, passed = b"", []
        if not data:
            waiting.unregister(self._agent)
            self._gone = True
            self._send()
            return
        with suppress(struct.error, ValueError):  # what nobody understands is no decision: the last one ages
            self._hear(data[:1], data[1:], passed)

    def _hear(self, kind: bytes, body: bytes, passed: list[int]) -> None:
        now, guard = time.monotonic(), self.guard
        if kind == DECISION:
            number, t, *rest = DECIDED.unpack(body)
            velocity, yaw_rate, place = (rest[0], rest[1], rest[2]), rest[3], (rest[4], rest[5], rest[6])
            if guard.decided(Decision(number, t, velocity, yaw_rate, place, *rest[7:]), now):
                self._send()
        elif kind == STAND:
            guard.stands(now)
            self._send()
        elif kind == END:
            guard.end(*SETPOINT_NUMBER.unpack(body))
        elif kind == STOP:
            self._ends_at, self._gone = now + (GUARD_LAST_WORDS_S if guard.engaged else 0.0), True
            self._send()
        elif kind == KEY:
            self._speaker.key = body
        elif kind in (LINK, NO_LINK):
            if self._link >= 0:
                os.close(self._link)
            self._link = passed[0] if passed else -1
            if kind == LINK:
                speaker = self._speaker
                speaker.system, speaker.component, speaker.target, speaker.version_1, port = OPENED.unpack(
                    body[: OPENED.size]
                )
                self._peer = (body[OPENED.size :].decode(), port) if port else None

    def _send(self) -> None:
        """What the guard answers now."""
        now = time.monotonic()
        point = self.guard.command(now, gone=self._gone)
        if point is not None and write(self._link, self._peer, self._speaker.frame(point, now, time.time())):
            self._count += 1
            self._tell(SENT + COUNTS.pack(self._count, self.guard.stale, self.guard.refusals))
        released = self.guard.take_release()
        if released:
            self._tell(RELEASED + SETPOINT_NUMBER.pack(self.guard.over) + released.encode())

    def _tell(self, data: bytes) -> None:
        with suppress(OSError):  # it hangs, or is gone: nothing waits for it
            self._agent.send(data)


def write(link: int, peer: tuple[str, int] | None, frame: bytes) -> bool:
    """To the autopilot; whether it went. Never blocks: what finds no room is soon repeated."""
    for _ in range(2):
        try:
            if peer is None:
                return os.write(link, frame) == len(frame)
            opened = socket.socket(fileno=link)
            try:
                return opened.sendto(frame, socket.MSG_DONTWAIT, peer) == len(frame)
            finally:
                opened.detach()
        except ConnectionRefusedError:
            continue  # that was of an earlier datagram: this one has not been tried yet
        except OSError:
            return False
    return False


def main(arguments: list[str]) -> None:
    """arguments: the descriptor of the socket to the agent, then `GuardLimits`."""
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends with its agent, a second after it, and not before
    Program(socket.socket(fileno=int(arguments[0])), GuardLimits(*map(float, arguments[1:]))).run()


if __name__ == "__main__":
    main(sys.argv[1:])
