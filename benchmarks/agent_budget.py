"""What an agent costs: tracker, detector, and whole processes (`swarmtrack bench cost --of agent`).

Functions are timed in this process, median of many calls. The agent is a process of its own, with a MAVLink autopilot
played over UDP (200 Hz of gyro), 15 Hz of frames and a listener on Zenoh; its latency is measured from outside: from
the exposure of a frame to the arrival of the first message with its tracks at another process.
"""

from __future__ import annotations

import argparse
import asyncio
import copy
import math
import os
import time
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from swarmtrack.benchmarks.figures import Figure, median_s
from swarmtrack.benchmarks.lone_agent import (
    CAMERA,
    FPS,
    agent_process,
    listening,
    scripted_agent,
    until_named,
    until_tracking,
)
from swarmtrack.benchmarks.processes import cpu_seconds, rss_mb
from swarmtrack.benchmarks.report import BenchmarkError
from swarmtrack.benchmarks.seen_team import IN_VIEW, STARTS, seen_team
from swarmtrack.benchmarks.trackers.timing import at_cost
from swarmtrack.detection.detector import Detector
from swarmtrack.messages import Frame, Scan, StampKind
from swarmtrack.tracking import create_tracker
from swarmtrack.tracking.base import Tracker
from swarmtrack.wire.health import HealthMessage

LOOK_MS = 20.0  # what the default model takes at 640 × 480 on one core of a server
SETTLE_S = 3.0  # after the first tracks: caches warm, the clock map converged
TEAMS = (5, 10, 30)
UPDATE_BUDGET_MS = {"kalman": 0.3, "jpdaf": 0.6, "gmphd": 0.8, "mbm": 2.0}


def measured(args: argparse.Namespace) -> list[Figure]:
    """Of --tracker; with --quick a tenth of the time, figures for orientation."""
    repeats, seconds = (50, 3.0) if args.quick else (1000, 20.0)
    return [
        *tracker_lines(args.tracker, repeats),
        *detector_lines(max(repeats // 10, 10)),
        *agent_lines(args.tracker, seconds),
        *prompt_lines(args.tracker, seconds / 2.0),
        *team_lines(args.tracker, seconds, TEAMS[:1] if args.quick else TEAMS),
        *detecting_lines(args.tracker, seconds),
        *startup_lines(1 if args.quick else 3),
    ]


# --- functions in this process -----------------------------------------------------------------------


def tracker_lines(name: str, repeats: int) -> list[Figure]:
    lines = [
        Figure(f"`at(now)`, {n} tracks, {name}", 1e3 * at_cost(name, n, repeats=repeats).ms, "µs", budget)
        for n, budget in ((10, 50.0), (200, None))
    ]
    crowd, scan = _crowd(name)
    durations = []
    for _ in range(repeats):
        fresh = copy.deepcopy(crowd)  # an update changes the tracker: each must meet the same one
        began = time.perf_counter()
        fresh.update(scan)
        durations.append(time.perf_counter() - began)
    what = f"update, 8 tracks × 18 detections in one gate, {name}"
    return [*lines, Figure(what, 1e3 * float(np.median(durations)), "ms", UPDATE_BUDGET_MS.get(name))]


def _crowd(name: str) -> tuple[Tracker, Scan]:
    """A tracker with 8 tracks within a few pixels, and a scan of 18 detections that all lie in the gates of all."""
    rng = np.random.default_rng(3)
    tracker = create_tracker(name, camera=CAMERA)
    tracker.initiate(0.0, np.array([320.0, 240.0]) + rng.normal(0.0, 1.0, (8, 2)))
    tracker.predict(1.0 / FPS, np.eye(3))
    return tracker, Scan(1.0 / FPS, np.array([320.0, 240.0]) + rng.normal(0.0, 2.0, (18, 2)))


def detector_lines(repeats: int) -> list[Figure]:
    detector = Detector()
    rng = np.random.default_rng(4)
    lines = []
    for width, height, budget in ((320, 240, 10.0), (640, 512, None)):
        detector.warm_up(width, height)
        image = rng.integers(90, 160, (height, width, 3), dtype=np.uint8)
        frame = Frame(0.0, 0.0, 0, image, StampKind.MEDIA)
        duration = median_s(partial(detector.detect, detector.plan(frame)), repeats)
        lines.append(
            Figure(f"detector, default model, {width} × {height}, one thread", 1e3 * duration, "ms", budget)
        )
    return lines


# --- a process of its own ----------------------------------------------------------------------------


class Measured(NamedTuple):
    """One agent's cost: CPU in % of a core, with a listener and without; RSS in 10⁶ bytes; latency (median, p95) from
    exposure to arrival."""

    cpu_percent: float
    rss_mb: float
    latency_ms: tuple[float, float]
    health: HealthMessage
    unheard_cpu_percent: float = math.nan


def agent_lines(tracker: str, seconds: float) -> list[Figure]:
    """An agent without the detector: one that sleeps as long as the default model takes stands in for it."""
    measured = measure_agent(tracker, seconds, ["--look-ms", str(LOOK_MS)], then_unheard=True)
    p50, p95 = (latency - LOOK_MS for latency in measured.latency_ms)
    who, heard = (
        "agent without the detector, 5 tracks:",
        "frame exposed → tracks heard elsewhere, beyond the detector",
    )
    return [
        Figure(f"{who} gyro samples reaching Onboard", measured.health.rates["imu"].got_hz, "Hz"),
        Figure(f"{who} CPU", measured.cpu_percent, "% of a core", 6.0),
        Figure(f"{who} CPU while nobody listens", measured.unheard_cpu_percent, "% of a core"),
        Figure(f"{who} memory, the idle model included", measured.rss_mb, "MB", 150.0),
        Figure(f"{heard}, median", p50, "ms"),
        Figure(f"{heard}, p95", p95, "ms", 10.0),
    ]


def prompt_lines(tracker: str, seconds: float) -> list[Figure]:
    """The same with a detector that answers at once, so that every scan waits for the gyro to reach its exposure."""
    _, p95 = measure_agent(tracker, seconds, ["--look-ms", "0"]).latency_ms
    return [Figure("the same, p95, with a detector that takes no time at all", p95, "ms")]


def team_lines(tracker: str, seconds: float, teams: Sequence[int]) -> list[Figure]:
    """Agents of teams, without the detector: five tracks, of which all are teammates in a team of more than five."""
    lines = []
    for n in teams:
        cpu_percent, memory_mb = asyncio.run(_measure_in_team(tracker, seconds, n))
        who = f"agent without the detector, 5 tracks, team of {n}:"
        lines.append(Figure(f"{who} CPU", cpu_percent, "% of a core"))
        lines.append(Figure(f"{who} memory", memory_mb, "MB"))
    return lines


def detecting_lines(tracker: str, seconds: float) -> list[Figure]:
    """An agent whose detector looks at every frame."""
    measured = measure_agent(tracker, seconds, ["--detector"])
    p50, p95 = measured.latency_ms
    who = f"agent with the detector at {CAMERA.width} × {CAMERA.height}:"
    return [
        Figure(f"{who} CPU", measured.cpu_percent, "% of a core"),
        Figure(f"{who} memory", measured.rss_mb, "MB"),
        Figure(f"{who} frame exposed → tracks heard elsewhere, median", p50, "ms"),
        Figure(f"{who} frame exposed → tracks heard elsewhere, p95", p95, "ms"),
        Figure(f"{who} in the detector, median", 1e3 * measured.health.latencies["detector"].p50_s, "ms"),
    ]


def measure_agent(
    tracker: str, seconds: float, options: list[str], *, then_unheard: bool = False
) -> Measured:
    """The scripted agent with these options, at 200 Hz of gyro and 15 Hz of frames, for `seconds` of its life.
    then_unheard: for as long again without a listener."""
    return asyncio.run(_measure_agent(tracker, seconds, options, then_unheard=then_unheard))


async def _measure_agent(tracker: str, seconds: float, options: list[str], *, then_unheard: bool) -> Measured:
    async with scripted_agent(["--fps", str(FPS), *options], {"tracker.name": tracker}) as agent:
        process, heard = agent.process, agent.heard
        await asyncio.sleep(SETTLE_S)
        heard.latencies.clear()
        cpu_percent = await _cpu_percent(process.pid, seconds)
        health = await heard.next_health()
        if len(heard.latencies) < 2:
            raise BenchmarkError("agent: no tracks arrived, expected them on Zenoh")
        p50, p95 = (1e3 * float(latency) for latency in np.percentile(heard.latencies, [50, 95]))
        measured = Measured(cpu_percent, rss_mb(process.pid), (p50, p95), health)
        if not then_unheard:
            return measured
        await agent.stop_listening()
        await asyncio.sleep(SETTLE_S)
        return measured._replace(unheard_cpu_percent=await _cpu_percent(process.pid, seconds))


async def _measure_in_team(tracker: str, seconds: float, n: int) -> tuple[float, float]:
    """CPU in % of a core and RSS in 10⁶ bytes, in a team of n, from when it names all of it that it sees."""
    options = ["--fps", str(FPS), "--look-ms", str(LOOK_MS)]
    entries = {"tracker.name": tracker, **STARTS}
    async with scripted_agent(options, entries) as agent, seen_team(agent.team, n):
        await until_named(agent.process, agent.heard, set(IN_VIEW[: n - 1]))
        await asyncio.sleep(SETTLE_S)
        return await _cpu_percent(agent.process.pid, seconds), rss_mb(agent.process.pid)


async def _cpu_percent(pid: int, seconds: float) -> float:
    """Of a core, for so long."""
    began, used = time.monotonic(), cpu_seconds(pid)
    await asyncio.sleep(seconds)
    return 100.0 * (cpu_seconds(pid) - used) / (time.monotonic() - began)


def startup_lines(times: int) -> list[Figure]:
    """The real program on the simulation, from fork to the first confirmed track heard."""
    took = float(np.median([asyncio.run(_first_track()) for _ in range(times)]))
    return [Figure("start of the program → first confirmed track heard, simulation", took, "s")]


async def _first_track() -> float:
    entries = {"drone.id": 1, "camera.source": "sim://hover-triangle?seed=1", "autopilot.link": "sim"}
    team = f"bench-{os.getpid()}"
    # The listener is up first, so that finding each other is all that is added to the agent's own start.
    async with listening(team) as heard:
        began = time.monotonic()
        with agent_process(
            ["swarmtrack.agents.vehicle", "--quiet"], entries | {"network.team": team}
        ) as process:
            await until_tracking(process, heard)
            assert heard.first_track_at is not None
            return heard.first_track_at - began
