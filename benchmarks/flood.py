"""A member that floods: what it costs another's event loop, and whether the others still get through (docs/wire.md).

Three processes on loopback: the one that is measured (this one), a friend that announces itself five times a second,
and a member that sends ten thousand messages a second of one sort. A task that wants to wake every 5 ms tells the lag.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import enum
import os
import secrets
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractAsyncContextManager
from dataclasses import asdict, dataclass
from functools import cache
from itertools import count
from typing import Any, Final

import numpy as np
import zenoh
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.harness import Benchmark
from swarmtrack.benchmarks.processes import module_process, rss_mb, said
from swarmtrack.clock import SystemClock
from swarmtrack.messages import Announcement, PeerArrived, Sighting, SightingReport
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind
from swarmtrack.transport.peers import Verify
from swarmtrack.transport.settings import NetworkSettings
from swarmtrack.transport.zenoh_session import close_session, open_session
from swarmtrack.transport.zenoh_transport import ZenohTransport
from swarmtrack.wire import codec
from swarmtrack.wire.announcement import announcement_message, sign_announcement
from swarmtrack.wire.fields import MAX_MESSAGE_BYTES, SIGNATURE_BYTES
from swarmtrack.wire.sightings import sightings_message

NAME = "flood"
RATE_HZ: Final = 10_000.0  # of the flood
SECONDS, QUICK_SECONDS = 5.0, 1.0  # of each measurement
TICK_S: Final = 0.005  # of the task that tells the lag
FRIEND_S: Final = 0.2  # between two announcements of the friend
PATIENCE_S: Final = 20.0  # until all know each other, on a busy machine
MEASURED, FRIEND, FLOODER = 1, 2, 3  # the drones' IDs


class Sort(enum.StrEnum):
    """What the flood is made of."""

    NOTHING = "nothing"
    ANNOUNCEMENTS = "announcements"  # valid and signed, each newer than the last
    FORGERIES = "forgeries"  # the same, with a signature that is none
    SIGHTINGS = "sightings"  # valid reports, each newer than the last
    GARBAGE = "garbage"  # 1 KiB of random bytes, on all its keys in turn
    LARGE = "large"  # the same with 64 KiB, as many as the link takes
    TOKENS = "tokens"  # boots that come and go
    QUESTIONS = "questions"  # for the announcement of the one that is measured, anew each


# --- the one that is measured --------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Outcome:
    """Lags of the event loop [ms], the friend's announcements, and what the flood cost and came to.

    superseded: messages that a later one on their key replaced while they waited; events_hz: told to the agent.
    """

    flood: str
    sent_hz: float
    lag_p50_ms: float
    lag_p95_ms: float
    lag_p99_ms: float
    lag_max_ms: float
    rss_before_mb: float
    rss_after_mb: float
    cpu_percent: float
    friend_announced: int
    friend_heard: int
    friend_delay_p95_ms: float
    superseded: int
    events_hz: float


async def measure(sort: Sort, seconds: float) -> Outcome:
    """Flood an agent's transport for so long."""
    team = f"flood-{secrets.token_hex(4)}"
    boot, clock = keys.new_boot(), SystemClock()
    transport = member(MEASURED, team, boot, clock, verify)
    heard = Heard()
    await transport.open()
    listening = asyncio.create_task(heard.listen(transport, clock))
    try:
        async with program("friend", team, sort), program("flooder", team, sort) as flooder:
            await transport.announce(announcement(MEASURED, boot, 1, clock.now()))
            await asyncio.wait_for(heard.both.wait(), PATIENCE_S)
            assert flooder.stdin is not None
            flooder.stdin.write(b"start\n")
            await said(flooder, PATIENCE_S)  # it floods
            events, before = heard.events, len(heard.friend_delays)
            rss, cpu, began = rss_mb(), time.process_time(), time.perf_counter()
            lags = await lags_of_the_loop(seconds)
            took = time.perf_counter() - began
            cpu, events, after = time.process_time() - cpu, heard.events - events, len(heard.friend_delays)
            flooder.stdin.write(b"stop\n")
            sent_hz = float(await said(flooder, PATIENCE_S))
            rss_after = rss_mb()
    finally:
        counters = dict(transport.status().counters)
        await transport.close()
        await listening
    p50, p95, p99 = np.percentile(lags, [50, 95, 99])
    delays = heard.friend_delays[before:after]
    return Outcome(
        flood=str(sort),
        sent_hz=0.0 if sort == Sort.NOTHING else sent_hz,
        lag_p50_ms=1e3 * float(p50),
        lag_p95_ms=1e3 * float(p95),
        lag_p99_ms=1e3 * float(p99),
        lag_max_ms=1e3 * max(lags),
        rss_before_mb=rss,
        rss_after_mb=rss_after,
        cpu_percent=100.0 * cpu / took,
        friend_announced=round(took / FRIEND_S),
        friend_heard=after - before,
        friend_delay_p95_ms=1e3 * float(np.percentile(delays, 95)) if delays else float("nan"),
        superseded=int(counters["samples_superseded"]),
        events_hz=events / took,
    )


class Heard:
    """What the measured one was told. both: set once friend and flooder have announced themselves."""

    def __init__(self) -> None:
        self.both = asyncio.Event()
        self.friend_delays: list[float] = []
        self.events = 0
        self._announced: set[int] = set()

    async def listen(self, transport: ZenohTransport, clock: SystemClock) -> None:
        async for event in transport.events():
            self.events += 1
            if not isinstance(event, Announcement):
                continue
            self._announced.add(event.drone_id)
            if event.drone_id == FRIEND:
                self.friend_delays.append(clock.now() - event.t)
            if self._announced >= {FRIEND, FLOODER}:
                self.both.set()


async def lags_of_the_loop(seconds: float) -> list[float]:
    """How late [s] a task woke that wanted to every TICK_S."""
    lags = []
    end = time.perf_counter() + seconds
    while (due := time.perf_counter() + TICK_S) < end:
        await asyncio.sleep(TICK_S)
        lags.append(max(0.0, time.perf_counter() - due))
    return lags


def program(role: str, team: str, sort: Sort) -> AbstractAsyncContextManager[asyncio.subprocess.Process]:
    """One of the others."""
    return module_process("swarmtrack.benchmarks.flood", role, team, str(sort))


# --- the others ----------------------------------------------------------------------------------


async def be_friend(team: str) -> None:
    """Announce for ever."""
    boot, clock = keys.new_boot(), SystemClock()
    transport = member(FRIEND, team, boot, clock)
    await transport.open()
    for sequence in count(1):
        await transport.announce(announcement(FRIEND, boot, sequence, clock.now()))
        await asyncio.sleep(FRIEND_S)


async def be_flooder(team: str, sort: Sort) -> None:
    """A member in order that floods from a line on stdin to the next, and then prints its rate [Hz]."""
    boot, clock = keys.new_boot(), SystemClock()
    transport = member(FLOODER, team, boot, clock)
    await transport.open()
    await transport.announce(announcement(FLOODER, boot, 1, clock.now()))
    async for event in transport.events():
        if isinstance(event, PeerArrived) and event.drone_id == MEASURED:
            break
    session = await open_session(NetworkSettings(team=team))
    send = sender(sort, session, team, boot)
    await asyncio.to_thread(sys.stdin.readline)
    stopped = threading.Event()
    print("flooding", flush=True)
    flood = asyncio.create_task(asyncio.to_thread(send_until, stopped, send))
    await asyncio.to_thread(sys.stdin.readline)
    stopped.set()
    print(await flood, flush=True)
    await close_session(session, [])


def send_until(stopped: threading.Event, send: Callable[[], None]) -> float:
    """Send at RATE_HZ, or as fast as it goes; the rate it came to [Hz]."""
    began = time.perf_counter()
    sent = 0
    while not stopped.is_set():
        due = (time.perf_counter() - began) * RATE_HZ
        while sent < due and not stopped.is_set():
            send()
            sent += 1
        time.sleep(0.002)
    return sent / (time.perf_counter() - began)


def sender(sort: Sort, session: zenoh.Session, team: str, boot: str) -> Callable[[], None]:
    """A function that sends one message of the flood."""
    pose, identities = (keys.key(team, kind, FLOODER) for kind in (Kind.POSE, Kind.IDENTITIES))
    match sort:
        case Sort.NOTHING:
            return lambda: None
        case Sort.ANNOUNCEMENTS | Sort.FORGERIES:
            sign = signing_key(FLOODER).sign if sort == Sort.ANNOUNCEMENTS else _no_signature
            first = announcement_message(announcement(FLOODER, boot, _FIRST, 0.0), 1.7e9, 0.0)
            data = numbered(codec.encode(first))
            return lambda: session.put(pose, sign_announcement(next(data), pose, sign))
        case Sort.SIGHTINGS:
            data = numbered(codec.encode(sightings_message(sightings(boot, _FIRST), 1.7e9, 0.0)))
            return lambda: session.put(identities, next(data))
        case Sort.GARBAGE | Sort.LARGE:
            noise = os.urandom(1024 if sort == Sort.GARBAGE else MAX_MESSAGE_BYTES)
            turns = [keys.key(team, kind, FLOODER) for kind in Kind if kind != Kind.ALIVE]
            turns.append(keys.key(team, Kind.ALIVE, FLOODER, boot))
            number = count()
            return lambda: session.put(turns[next(number) % len(turns)], noise)
        case Sort.TOKENS:

            def come_and_go() -> None:
                key = keys.key(team, Kind.ALIVE, FLOODER, keys.new_boot())
                session.liveliness().declare_token(key).undeclare()  # type: ignore[no-untyped-call]

            return come_and_go
        case Sort.QUESTIONS:
            question = f"{keys.key(team, Kind.POSE, MEASURED)}?{keys.ANEW}"
            unheard: Any = zenoh.handlers.Callback(lambda reply: None, indirect=False)

            def ask() -> None:
                session.get(question, unheard, timeout=1.0)

            return ask


_FIRST: Final = 2**16  # from here on MessagePack writes a sequence as 0xce and four bytes


def numbered(data: bytes) -> Iterator[bytes]:
    """The same message over and over, its sequence counting up from _FIRST: encoding each would be slower."""
    at = data.index(b"\xce" + struct.pack(">I", _FIRST)) + 1
    for sequence in count(_FIRST):
        yield data[:at] + struct.pack(">I", sequence) + data[at + 4 :]


def announcement(drone_id: int, boot: str, sequence: int, t: float) -> Announcement:
    return Announcement(drone_id, boot, sequence, t, 0.01, np.zeros(3), np.eye(3), np.eye(3))


def sightings(boot: str, sequence: int) -> SightingReport:
    """Of a team of thirty that all see all."""
    known = tuple(drone_id for drone_id in range(1, 31) if drone_id != FLOODER)
    others = tuple(Sighting(drone_id, 0.99, np.array([0.6, 0.0, 0.8]), 0.01) for drone_id in known)
    return SightingReport(FLOODER, boot, sequence, 0.0, 0.01, np.zeros(3), 0.1, known, others)


def member(
    drone_id: int, team: str, boot: str, clock: SystemClock, verify: Verify | None = None
) -> ZenohTransport:
    return ZenohTransport(
        NetworkSettings(team=team), drone_id, boot, clock, sign=signing_key(drone_id).sign, verify=verify
    )


@cache
def signing_key(drone_id: int) -> Ed25519PrivateKey:
    """For this benchmark: everybody can work out everybody's."""
    return Ed25519PrivateKey.from_private_bytes(drone_id.to_bytes(32))


def verify(drone_id: int, signed: bytes, signature: bytes) -> bool:
    try:
        signing_key(drone_id).public_key().verify(signature, signed)
    except InvalidSignature:
        return False
    return True


def _no_signature(signed: bytes) -> bytes:
    return bytes(SIGNATURE_BYTES)


# --- the table -----------------------------------------------------------------------------------


def _measured(args: argparse.Namespace) -> dict[str, Any]:
    seconds = QUICK_SECONDS if args.quick else SECONDS
    floods = []
    with report.progress(NAME, total=len(Sort)) as advance:
        for sort in Sort:
            advance(str(sort))
            floods.append(asdict(asyncio.run(measure(sort, seconds))))
    return {"seconds": seconds, "rate_hz": RATE_HZ, "floods": floods}


COLUMNS: report.Columns = (
    ("flood", "{flood}"),
    ("sent /s", "{sent_hz:.0f}"),
    (
        "lag p50 / p95 / p99 / max ms",
        " / ".join(f"{{lag_{of}_ms:.1f}}" for of in ("p50", "p95", "p99", "max")),
    ),
    ("RSS before → after MB", "{rss_before_mb:.0f} → {rss_after_mb:.0f}"),
    ("CPU %", "{cpu_percent:.0f}"),
    ("friend's announcements", "{friend_heard} of {friend_announced}"),
    ("after (p95) ms", "{friend_delay_p95_ms:.1f}"),
    ("events /s", "{events_hz:.0f}"),
)
BENCH = Benchmark(
    NAME,
    _measured,
    lambda result: report.page("# A member that floods", report.table_of(COLUMNS, result["floods"])),
)


def main() -> None:
    """One of the others, see `program`."""
    role, team, sort = sys.argv[1:]
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(be_friend(team) if role == "friend" else be_flooder(team, Sort(sort)))


if __name__ == "__main__":
    main()
