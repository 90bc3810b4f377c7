"""What the autopilot hears, and how far the drone flies on, when an engaged agent is stopped, killed, frozen or breaks.

Real agents with real guards, each with a simulated ArduCopter (`lab/world/response.py`), over UDP in real time
(docs/formation.md). Also what a guard costs: its share of a core, its memory, and its delay.
"""

from __future__ import annotations

import argparse
import asyncio
import math
import os
import random
import signal
import socket
import tempfile
import time
from collections.abc import AsyncIterator, Iterable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from swarmtrack.autopilot.links import Wire
from swarmtrack.autopilot.mavlink_autopilot import WayToAutopilot
from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.harness import Benchmark, amount, some_of
from swarmtrack.benchmarks.processes import cpu_seconds, descendants, free_port, module_process, rss_mb
from swarmtrack.formation.parameters import FlightLimits
from swarmtrack.geometry.geodesy import Geodetic
from swarmtrack.guard import GUARD_SLACK, Decision, Guard
from swarmtrack.lab.autopilots.autopilot import SimulatedArduPilot
from swarmtrack.lab.autopilots.channel import Channel
from swarmtrack.lab.autopilots.firmware import FlightMode
from swarmtrack.lab.autopilots.pilot import GuidedPilot
from swarmtrack.lab.autopilots.px4 import SimulatedPx4
from swarmtrack.lab.autopilots.senses import DroneSenses
from swarmtrack.lab.world.guided import GuidedDrone
from swarmtrack.lab.world.response import Triple
from swarmtrack.lab.world.trajectory import wander
from swarmtrack.lab.world.world import World
from swarmtrack.runtime.guard_process import GuardProcess, guard_limits

NAME = "guard"
TOLD, QUICK_TOLD = 1_000_000, 10_000
SPEED_M_S = 2.5
ORIGIN = Geodetic.from_degrees(47.4, 8.5, 400.0)
START = (0.0, 0.0, -20.0)
# s: of steady flight before anything happens, and afterwards until it is judged.
STEADY_S, AFTER_S = 3.0, 6.0
# s: frozen for so long.
FROZEN_S = 2.0
PATIENCE_S = 60.0
COST_S, QUICK_COST_S = 30.0, 3.0
# s, asked: zero is heard, or nothing gets worse; and nothing is heard any more.
ZERO_WITHIN_S, SILENT_AFTER_S = 0.35, 1.3
CONFIG = """
[team]
airframe_span_m = 0.5
share = "velocity"
[drone]
id = 2
start = {{ position_m = [0.0, 0.0, -20.0], position_sigma_m = 0.3 }}
[camera]
source = "detections://127.0.0.1:9/2"
intrinsics = {{ fx = 430.0, fy = 430.0, cx = 319.5, cy = 239.5, width = 640, height = 480 }}
[autopilot]
link = "udpin:127.0.0.1:{port}"
[network]
transport = "memory"
[formation]
enabled = true
leader = 1
height_m = 19.0
limits = {{ fence_radius_m = 200.0 }}
[formation.slots]
2 = [-4.0, 3.0, -1.0]
"""


class Heard(NamedTuple):
    """A set point as the autopilot heard it."""

    t: float
    speed: float


class Hears:
    """A simulated autopilot that keeps what it was told to fly."""

    heard: list[Heard]

    def understand(self, message: Any, now: float, channel: Channel) -> None:
        if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
            self.heard.append(Heard(now, math.hypot(message.vx, message.vy, message.vz)))
        super().understand(message, now, channel)  # type: ignore[misc]


class FlownArduPilot(Hears, SimulatedArduPilot): ...


class FlownPx4(Hears, SimulatedPx4): ...


@dataclass(slots=True)
class Sky:
    """A drone in the air, and its autopilot of the class `kind` at port `port`, in real time."""

    port: int
    seed: int
    kind: type[FlownArduPilot | FlownPx4] = FlownArduPilot
    epoch: float = field(default_factory=time.monotonic)
    drone: GuidedDrone = field(init=False)
    pilot: GuidedPilot = field(init=False)
    autopilot: FlownArduPilot | FlownPx4 = field(init=False)

    def __post_init__(self) -> None:
        firmware = self.kind.firmware
        drift = wander(World(self.seed, {}).chance("wander", 2), 0.1)
        self.drone = GuidedDrone(START, 0.0, firmware.response, drift, hovers=True)
        senses = DroneSenses(World(self.seed, {2: self.drone}), 2, self.epoch, earth=ORIGIN)
        self.pilot = GuidedPilot(
            self.drone, firmware, epoch=self.epoch, origin=ORIGIN, located=lambda t: True,
            errors=senses.lasting_errors,
        )  # fmt: skip
        self.autopilot = self.kind(senses, pilot=self.pilot, boot_at=self.epoch - 40.0)
        self.autopilot.heard = []

    @property
    def messages(self) -> list[Heard]:
        return self.autopilot.heard

    def north(self, t: float) -> float:
        """m, of the drone itself, without its sway."""
        return self.drone.state(t - self.epoch).position[0]

    @asynccontextmanager
    async def served(self) -> AsyncIterator[None]:
        sky = self.autopilot

        class Socket(asyncio.DatagramProtocol):
            def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
                sky.receive(data, time.monotonic())

        loop = asyncio.get_running_loop()
        transport, _ = await loop.create_datagram_endpoint(Socket, local_addr=("127.0.0.1", 0))

        async def fly() -> None:
            while True:
                for data in sky.step(time.monotonic()):
                    transport.sendto(data, ("127.0.0.1", self.port))
                await asyncio.sleep(0.002)

        flight = asyncio.create_task(fly())
        try:
            yield
        finally:
            flight.cancel()
            await asyncio.gather(flight, return_exceptions=True)
            transport.close()


def guard_of(agent: int) -> int:
    """The process ID of an agent's guard: its only child."""
    (guard,) = descendants(agent)
    return guard


CASES = {
    "stopped": ("SIGTERM", signal.SIGTERM),
    "killed": ("SIGKILL", signal.SIGKILL),
    "frozen": ("SIGSTOP for 2 s", signal.SIGSTOP),
    "raises": ("a task raises", signal.SIGUSR1),
    "blocked": ("the event loop stands still for 2 s", signal.SIGUSR2),
    "guard-frozen": ("SIGSTOP for 2 s to the guard", signal.SIGSTOP),
    "guard-killed": ("SIGKILL to the guard", signal.SIGKILL),
}
"""In words, and the signal, to the agent or to its guard."""


class Flight(NamedTuple):
    """zero_s: from the event until the first set point of zero velocity, NaN: none came; last_s: until the last set
    point of all; worst: the fastest that came after ZERO_WITHIN_S [m/s]; flown_m: how far the drone flew on."""

    zero_s: float
    last_s: float
    worst: float
    flown_m: float

    @property
    def ok(self) -> bool:
        """Zero in time, or nothing got worse and nothing was heard; silent in time."""
        in_time = self.zero_s <= ZERO_WITHIN_S or self.last_s <= ZERO_WITHIN_S
        return in_time and self.worst == 0.0 and self.last_s <= SILENT_AFTER_S


@asynccontextmanager
async def flying_agent(sky: Sky, speed: float) -> AsyncIterator[asyncio.subprocess.Process]:
    """A real agent (`scripted_agent.py`) that flies the drone of a sky north with `speed` [m/s]; killed at the end."""
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "drone.toml"
        config.write_text(CONFIG.format(port=sky.port))
        async with sky.served():
            words = ("swarmtrack.benchmarks.scripted_agent", "--config", str(config), "--flies", str(speed))
            async with module_process(*words, stderr=asyncio.subprocess.DEVNULL) as agent:
                yield agent


async def engage(sky: Sky, speed: float) -> None:
    """By a pilot who tries until the agent is there, and flies."""
    begun = time.monotonic()
    while not any(heard.speed > 0.99 * speed for heard in sky.messages):
        if time.monotonic() > begun + PATIENCE_S:
            raise report.BenchmarkError(f"no agent flew within {PATIENCE_S:g} s")
        for mode in (FlightMode.HOLD, FlightMode.GUIDED):
            sky.pilot.switch_to(mode, time.monotonic())
            await asyncio.sleep(1.2)


async def fly(case: str, seed: int) -> Flight:
    """One flight: engaged, at speed, and then `case` happens."""
    sky = Sky(free_port(), seed)
    async with flying_agent(sky, SPEED_M_S) as agent:
        await engage(sky, SPEED_M_S)
        return await _happen(case, sky, agent.pid)


async def _happen(case: str, sky: Sky, agent: int) -> Flight:
    await asyncio.sleep(STEADY_S + 0.1 * np.random.default_rng(len(sky.messages)).random())
    event = time.monotonic()
    where = sky.north(event)
    pid, number = guard_of(agent) if case.startswith("guard") else agent, CASES[case][1]
    os.kill(pid, number)
    if number == signal.SIGSTOP:
        await asyncio.sleep(FROZEN_S)
        os.kill(pid, signal.SIGCONT)
    await asyncio.sleep(max(event + AFTER_S - time.monotonic(), 0.0))
    after = [heard for heard in sky.messages if heard.t > event]
    zeros = [heard.t - event for heard in after if heard.speed == 0.0]
    late = [heard.speed for heard in after if heard.t > event + ZERO_WITHIN_S]
    last, flown_m = (
        max((heard.t - event for heard in after), default=0.0),
        sky.north(time.monotonic()) - where,
    )
    return Flight(min(zeros, default=math.nan), last, max(late, default=0.0), flown_m)


class Told(NamedTuple):
    """decisions: of anything at all; sent: set points that came of them; beyond: how many of these broke a limit."""

    decisions: int
    sent: int
    beyond: int


ODD = (math.nan, math.inf, -math.inf, 1e308, -1e308, 1e-308, 0.0, 2.5, -2.5, 1.0, 0.8)


def told_anything(decisions: int, seed: int = 1) -> Told:
    """The guard's rules, in told time: every number of a decision is odd, large or ordinary, in any order."""
    limits = guard_limits(FlightLimits())
    chance = random.Random(seed)

    def number() -> float:
        kind = chance.random()
        return chance.choice(ODD) if kind < 0.1 else chance.gauss(0.0, 20.0 if kind < 0.2 else 1.0)

    def place() -> Triple:
        return number(), number(), number()

    guard, now, sent, beyond = Guard(limits), 100.0, 0, 0
    for _ in range(decisions):
        now += chance.expovariate(10.0)
        decided_at, placed_at = now - abs(chance.gauss(0.0, 0.2)), now - abs(chance.gauss(0.0, 0.3))
        if chance.random() < 0.02:
            decided_at, placed_at = number(), number()
        it = guard.over + chance.choice((0, 1, 1, 1, 1, 2))
        guard.decided(Decision(it, decided_at, place(), number(), place(), placed_at, number()), now)
        if chance.random() < 0.01:
            guard.end(it)
        answer = guard.command(now, gone=chance.random() < 0.01)
        if answer is not None:
            sent += 1
            # NaN fails each.
            fits = math.hypot(*answer.velocity) <= limits.speed * (1.0 + 2.0 * GUARD_SLACK)
            fits = fits and abs(answer.velocity[2]) <= limits.climb * (1.0 + 2.0 * GUARD_SLACK)
            beyond += not (fits and abs(answer.yaw_rate) <= limits.yaw_rate * (1.0 + 2.0 * GUARD_SLACK))
    return Told(decisions, sent, beyond)


class Cost(NamedTuple):
    """share: of a core; mb: resident; p95_ms, worst_ms: from a decision to its set point in the autopilot's socket."""

    share: float
    mb: float
    p95_ms: float
    worst_ms: float


def cost(seconds: float, *, signed: bool = False) -> Cost:
    """Of one guard that is told ten decisions per second."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link,
    ):
        autopilot.bind(("127.0.0.1", 0))
        autopilot.settimeout(1.0)
        link.bind(("127.0.0.1", 0))
        link.setblocking(False)
        guard = GuardProcess(FlightLimits(), bytes(32) if signed else None)
        guard.start()
        assert guard.pid is not None
        wire = Wire(link.fileno(), autopilot.getsockname())
        guard.reach(WayToAutopilot(wire, 0.0, 1, 191, target=1, version_1=False))
        took, begun, used = [], math.nan, math.nan
        rng = np.random.default_rng(1)
        for k in range(round(10.0 * seconds) + 10):
            if k == 10:
                # Its start is not what it costs.
                begun, used = time.monotonic(), cpu_seconds(guard.pid)
            t = time.monotonic()
            velocity: Triple = (1.0, 0.0, 0.1 * float(rng.random()))
            guard.decide(Decision(1, t, velocity, 0.1, START, t, 10.0))
            autopilot.recv(512)
            took.append(time.monotonic() - t)
            guard.news()
            time.sleep(max(t + 0.1 - time.monotonic(), 0.0))
        share = (cpu_seconds(guard.pid) - used) / (time.monotonic() - begun)
        mb = rss_mb(guard.pid)
        guard.stop()
    late = 1e3 * np.array(took[10:])
    return Cost(share, mb, float(np.percentile(late, 95)), float(late.max()))


class Found(NamedTuple):
    """Flights by case, what came of decisions of anything at all, and what a guard costs."""

    flown: dict[str, list[Flight]]
    told: Told
    costs: dict[str, Cost]


def _measured(args: argparse.Namespace) -> Found:
    flown: dict[str, list[Flight]] = {case: [] for case in args.cases}
    with report.progress(NAME, args.runs * len(args.cases)) as advance:
        for case, flights in flown.items():
            for seed in range(1, args.runs + 1):
                flights.append(asyncio.run(fly(case, seed)))
                advance(case)
    seconds = QUICK_COST_S if args.quick else COST_S
    costs = {"unsigned": cost(seconds), "signed": cost(seconds, signed=True)}
    return Found(flown, told_anything(QUICK_TOLD if args.quick else TOLD), costs)


def _record(found: Found) -> dict[str, Any]:
    return {
        "speed_m_s": SPEED_M_S,
        "cases": {case: [flight._asdict() for flight in flights] for case, flights in found.flown.items()},
        "told_anything": found.told._asdict(),
        "cost": {name: one._asdict() for name, one in found.costs.items()},
    }


COLUMNS: report.Columns = (
    ("what happens", "{case}"),
    ("flights", "{flights}"),
    ("in order", "{ok}"),
    ("zero heard after, at most s", "{zero_s:.2f}"),
    ("last set point after, at most s", "{last_s:.2f}"),
    ("flown on, at most m", "{flown_m:.2f}"),
)
COST_COLUMNS: report.Columns = (
    ("guard", "{name}"),
    ("% of a core", "{share:.2p}"),
    ("MB", "{mb:.2f}"),
    ("decision to set point, p95 ms", "{p95_ms:.2f}"),
    ("worst ms", "{worst_ms:.2f}"),
)


def page(found: Found) -> str:
    rows = []
    for case, flights in found.flown.items():
        most = {
            name: _most(getattr(one, name) for one in flights) for name in ("zero_s", "last_s", "flown_m")
        }
        ok = sum(flight.ok for flight in flights)
        rows.append({"case": CASES[case][0], "flights": len(flights), "ok": ok, **most})
    return report.page(
        f"An agent flies its drone north at {SPEED_M_S:g} m/s; then this happens. In order: a set point of zero "
        f"velocity is heard within {ZERO_WITHIN_S:g} s, or none at all; none that is not zero after that; and "
        f'nothing after {SILENT_AFTER_S:g} s. "–": no zero was heard.',
        report.table_of(COLUMNS, rows),
        report.filled(
            "Of {decisions} decisions of anything at all came {sent} set points: {beyond} were no numbers, or beyond a "
            "limit.",
            found.told,
        ),
        report.table_by_name(COST_COLUMNS, {name: one._asdict() for name, one in found.costs.items()}),
    )


def _most(values: Iterable[float]) -> float:
    return max((value for value in values if math.isfinite(value)), default=math.nan)


BENCH = Benchmark(
    NAME,
    _measured,
    page,
    options=(amount("--runs", 20, 1, "flights of each case"), some_of("--cases", CASES)),
    record=_record,
)
