"""How long until everybody knows everybody, and at what cost: meshes of 3, 10 and 30, a hundred clients of two routers.

Every session is a whole `ZenohTransport` with its token, its queryable and its announcement; several share a process,
because it is the network that is measured, not Python's memory times a hundred. All start at the same moment. Bytes are
those of the sessions' TCP connections, as the kernel counts them, both ways and with all that Zenoh says for itself.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import secrets
import socket
import struct
import sys
import time
from collections.abc import Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack, ExitStack, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.harness import Benchmark
from swarmtrack.benchmarks.processes import module_process, rss_mb, said
from swarmtrack.clock import SystemClock
from swarmtrack.messages import Announcement
from swarmtrack.transport import keys
from swarmtrack.transport.settings import Mode, NetworkSettings
from swarmtrack.transport.zenoh_session import close_session, open_session
from swarmtrack.transport.zenoh_transport import ZenohTransport

NAME = "clients"
ROUTERS: Final = 2
PROCESSES: Final = 4  # that the sessions share
IDLE_S: Final = 5.0  # for what it costs once everybody knows everybody
PATIENCE_S: Final = 60.0


@dataclass(frozen=True, slots=True)
class Team:
    """sessions: how many; mode: peers dial each other, clients dial `ROUTERS` routers."""

    sessions: int
    mode: Mode

    @property
    def name(self) -> str:
        if self.mode == Mode.CLIENT:
            return f"{self.sessions} clients, {ROUTERS} routers"
        return f"{self.sessions} in a mesh"


TEAMS: Final = (Team(3, Mode.PEER), Team(10, Mode.PEER), Team(30, Mode.PEER), Team(100, Mode.CLIENT))
QUICK: Final = (Team(3, Mode.PEER), Team(10, Mode.CLIENT))
PER_SESSION: Final = ("announcements_sent", "bytes_until_known", "idle_bytes_s", "rss_mb")


# --- the one that asks ---------------------------------------------------------------------------


async def measure(team: Team) -> dict[str, Any]:
    """Start the team, wait until everybody knows everybody, then watch it idle. complete: how many sessions knew all
    others; per session: means."""
    name = f"bench-{secrets.token_hex(4)}"
    async with AsyncExitStack() as stack:
        routers = free_ports(ROUTERS) if team.mode == Mode.CLIENT else []
        relays = [
            await stack.enter_async_context(program(Task("router", name, [port], routers[:i])))
            for i, port in enumerate(routers)
        ]
        for relay in relays:
            await said(relay, PATIENCE_S)
        ports = free_ports(team.sessions) if team.mode == Mode.PEER else []
        processes = min(PROCESSES, max(1, team.sessions // 3))
        ids = [list(range(1 + i, team.sessions + 1, processes)) for i in range(processes)]
        shares = [
            await stack.enter_async_context(
                program(Task("sessions", name, ports, routers, of_process, team.sessions))
            )
            for of_process in ids
        ]
        await answers(shares)  # everything is imported
        start = time.perf_counter() + 0.2
        await answers(shares, str(start))  # their sessions know everybody
        found = [json.loads(line) for line in await answers(shares, "idle")]
        router_rss = [rss_mb(relay.pid) for relay in relays]
    known = sorted(known for share in found for known in share.pop("known_s"))
    total = {name: sum(share[name] for share in found) for name in found[0]}
    n = team.sessions
    return {
        "team": team.name,
        "sessions": n,
        "complete": len(known),
        "known_median_s": float(np.median(known)) if known else float("nan"),
        "known_last_s": known[-1] if len(known) == n else float("nan"),
        "announcement_bytes": found[0]["announcement_bytes"],
        **{f"{name}_per_session": total[name] / n for name in PER_SESSION},
        "cpu_s_total": total["cpu_s"],
        "idle_cpu_percent_total": total["idle_cpu_percent"],
        "router_rss_mb": router_rss,
    }


async def answers(processes: Sequence[asyncio.subprocess.Process], asked: str = "") -> list[str]:
    """The next line of each, once all are asked."""
    for process in processes if asked else ():
        assert process.stdin is not None
        process.stdin.write(f"{asked}\n".encode())
    return [await said(process, 2.0 * PATIENCE_S) for process in processes]


def program(task: Task) -> AbstractAsyncContextManager[asyncio.subprocess.Process]:
    """This module as another process."""
    return module_process("swarmtrack.benchmarks.hundred_clients", json.dumps(asdict(task)))


def free_ports(n: int) -> list[int]:
    """n ports, free a moment ago."""
    with ExitStack() as stack:
        probes = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(n)]
        return [probe.getsockname()[1] for probe in probes]


# --- the others ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Task:
    """What a process is told. listen, connect: ports on loopback; listen: by ID in a mesh, or the router's own; ids: of
    its sessions, of as many in all."""

    role: str
    name: str
    listen: list[int]
    connect: list[int]
    ids: list[int] = field(default_factory=list)
    sessions: int = 0

    def network(self, drone_id: int) -> NetworkSettings:
        """Peers dial those of lower ID; clients one router each, half of them the other first."""
        if self.listen:
            own, lower = self.listen[drone_id - 1], self.listen[: drone_id - 1]
            return NetworkSettings(self.name, endpoints([own]), endpoints(lower))
        turn = drone_id % len(self.connect)
        routers = self.connect[turn:] + self.connect[:turn]
        return NetworkSettings(self.name, connect=endpoints(routers), mode=Mode.CLIENT)


def endpoints(ports: Sequence[int]) -> tuple[str, ...]:
    return tuple(f"tcp/127.0.0.1:{port}" for port in ports)


async def be_router(task: Task) -> None:
    session = await open_session(
        NetworkSettings(task.name, endpoints(task.listen), endpoints(task.connect), mode=Mode.ROUTER)
    )
    print("ready", flush=True)
    await asyncio.to_thread(sys.stdin.readline)
    await close_session(session, [])


class Member:
    """One session, and when it knew all others."""

    def __init__(self, task: Task, drone_id: int) -> None:
        self.drone_id = drone_id
        self.boot, self.clock = keys.new_boot(), SystemClock()
        self.transport = ZenohTransport(task.network(drone_id), drone_id, self.boot, self.clock)
        self.known_at: float | None = None
        self._others = task.sessions - 1

    async def meet(self) -> None:
        """Open, announce, and listen until all others are known."""
        await self.transport.open()
        await self.transport.announce(
            Announcement(
                self.drone_id, self.boot, 1, self.clock.now(), 0.01, np.zeros(3), np.eye(3), np.eye(3)
            )
        )
        known: set[int] = set()
        async for event in self.transport.events():
            if isinstance(event, Announcement):
                known.add(event.drone_id)
                if len(known) == self._others:
                    self.known_at = time.perf_counter()
                    return

    def counter(self, name: str) -> int:
        return int(dict(self.transport.status().counters)[name])


async def be_sessions(task: Task) -> None:
    members = [Member(task, drone_id) for drone_id in task.ids]
    print("ready", flush=True)
    start = float(await asyncio.to_thread(sys.stdin.readline))
    rss_before, cpu = rss_mb(), time.process_time()
    await asyncio.sleep(start - time.perf_counter())
    with suppress(TimeoutError):
        async with asyncio.timeout(PATIENCE_S):
            await asyncio.gather(*[member.meet() for member in members])
    cpu_s, traffic = time.process_time() - cpu, tcp_bytes()
    print("known", flush=True)
    await asyncio.to_thread(sys.stdin.readline)  # others may still be asking
    cpu, idle_traffic = time.process_time(), tcp_bytes()
    await asyncio.sleep(IDLE_S)
    share = {
        "known_s": [member.known_at - start for member in members if member.known_at is not None],
        "announcement_bytes": members[0].counter("announcement_bytes"),
        "announcements_sent": sum(member.counter("announcements_sent") for member in members),
        "bytes_until_known": traffic,
        "idle_bytes_s": (tcp_bytes() - idle_traffic) / IDLE_S,
        "rss_mb": rss_mb() - rss_before,
        "cpu_s": cpu_s,
        "idle_cpu_percent": 100.0 * (time.process_time() - cpu) / IDLE_S,
    }
    print(json.dumps(share), flush=True)
    await asyncio.to_thread(sys.stdin.readline)  # the others may still be counting


_BYTES_ACKED_AND_RECEIVED: Final = (120, "=QQ")  # where Linux has them in struct tcp_info


def tcp_bytes() -> int:
    """Sent and received by all TCP connections of this process so far."""
    total = 0
    for fd in Path("/proc/self/fd").iterdir():
        with suppress(OSError):
            if not str(fd.readlink()).startswith("socket:"):
                continue
            with socket.socket(fileno=os.dup(int(fd.name))) as connection:
                if connection.family == socket.AF_INET and connection.type == socket.SOCK_STREAM:
                    info = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 256)
                    offset, layout = _BYTES_ACKED_AND_RECEIVED
                    total += sum(struct.unpack_from(layout, info, offset))
    return total


# --- the table -----------------------------------------------------------------------------------


def _measured(args: argparse.Namespace) -> dict[str, Any]:
    teams = QUICK if args.quick else TEAMS
    outcomes = []
    with report.progress(NAME, total=len(teams)) as advance:
        for team in teams:
            advance(team.name)
            outcomes.append(asyncio.run(measure(team)))
    return {"teams": outcomes}


COLUMNS: report.Columns = (
    ("sessions", "{team}"),
    ("complete", "{complete} of {sessions}"),
    ("everybody known: median / last s", "{known_median_s:.2f} / {known_last_s:.2f}"),
    ("announcement bytes", "{announcement_bytes:.0f}"),
    ("times sent", "{announcements_sent_per_session:.1f}"),
    ("bytes until known", "{bytes_until_known_per_session:.0f}"),
    ("bytes/s idle", "{idle_bytes_s_per_session:.0f}"),
    ("RSS MB", "{rss_mb_per_session:.1f}"),
    ("routers' RSS MB", lambda row: ", ".join(f"{rss:.0f}" for rss in row["router_rss_mb"]) or "–"),
    ("CPU s, all", "{cpu_s_total:.1f}"),
    ("idle CPU %, all", "{idle_cpu_percent_total:.1f}"),
)


def _page(result: dict[str, Any]) -> str:
    return report.page(
        "# Everybody knows everybody", "Per session unless said.", report.table_of(COLUMNS, result["teams"])
    )


BENCH = Benchmark(NAME, _measured, _page)


def main() -> None:
    """One of the processes, see `program`."""
    task = Task(**json.loads(sys.argv[1]))
    asyncio.run(be_router(task) if task.role == "router" else be_sessions(task))


if __name__ == "__main__":
    main()
