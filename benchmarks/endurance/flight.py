"""A long flight by `swarmtrack sim` in processes of its own, measured from outside.

Memory and CPU of every process are read from /proc; the rest is what the agents say of themselves in their health, and
what the monitor sends to a viewer who looks at all of them.
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import re
import time
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import aiohttp

from swarmtrack.benchmarks.endurance.verdict import JUDGE, AgentWindow, ViewerWindow, Window
from swarmtrack.benchmarks.processes import OURS, cpu_seconds, descendants, module_process, rss_mb
from swarmtrack.benchmarks.report import BenchmarkError
from swarmtrack.clock import SystemClock
from swarmtrack.recording.reader import FLIGHT_PLAN, recordings_below
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind
from swarmtrack.transport.settings import NetworkSettings
from swarmtrack.transport.zenoh_listener import ZenohListener
from swarmtrack.wire import codec
from swarmtrack.wire.health import HealthMessage

SCENARIO = "hover-triangle"
RECORDING = "recording"  # the folder of its recordings
PATIENCE_S = 90.0  # for a swarm to stand, on a machine that is busy
LANDING_S = 600.0  # for the judge to end: the truth of a long flight is many poses
STOP_S = 20.0  # after SIGTERM
LAST_LINES = 15  # of what it said, shown where it failed


@dataclass
class Swarm:
    """The flying swarm. pids by process; epoch: of world time, on this machine's monotonic clock."""

    launcher: asyncio.subprocess.Process
    said: deque[str] = field(default_factory=lambda: deque(maxlen=LAST_LINES))
    monitor_url: str = ""
    team: str = ""
    epoch: float = math.nan
    pids: dict[str, int] = field(default_factory=dict)

    def failed(self, why: str) -> BenchmarkError:
        lines = "\n".join(f"  | {line}" for line in self.said) or "  | (it said nothing)"
        return BenchmarkError(f"endurance: {why}. The last lines of `swarmtrack sim`:\n{lines}")


# --- the swarm ---------------------------------------------------------------------------------------


@asynccontextmanager
async def flying(folder: Path, seconds: float, tracker: str) -> AsyncIterator[Swarm]:
    """`swarmtrack sim` with monitor and recording, its verdict in `folder`; ended on leaving, whatever happens."""
    words = f"sim --scenario {SCENARIO} --detector oracle --tracker {tracker} --seconds {seconds} --monitor".split()
    words += ["--record", str(folder / RECORDING), "--json", str(folder / "verdict.json")]
    async with module_process(OURS, *words, stderr=asyncio.subprocess.STDOUT, patience_s=STOP_S) as launcher:
        swarm = Swarm(launcher)
        listening = asyncio.create_task(_listen_to(swarm))
        try:
            yield swarm
        finally:
            listening.cancel()


async def _listen_to(swarm: Swarm) -> None:
    assert swarm.launcher.stdout is not None
    async for line in swarm.launcher.stdout:
        swarm.said.append(line.decode(errors="replace").rstrip())
        found = re.search(r"monitor of team (\S+): (http\S+)", swarm.said[-1])
        if found is not None:
            swarm.team, swarm.monitor_url = found[1], found[2]


async def until_standing(swarm: Swarm, folder: Path, drones: int) -> None:
    """Until simulator, monitor and all agents run. folder: as in `flying`."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        found = {name: pid for pid in descendants(swarm.launcher.pid) if (name := name_of(pid)) is not None}
        if swarm.monitor_url and sum(name.startswith("drone") for name in found) == drones:
            break
        if swarm.launcher.returncode is not None:
            raise swarm.failed(f"the swarm ended with {swarm.launcher.returncode} before it flew")
        if time.monotonic() > deadline:
            raise swarm.failed(f"the swarm does not stand after {PATIENCE_S:g} s")
        await asyncio.sleep(0.1)
    swarm.pids = {**dict(sorted(found.items())), JUDGE: swarm.launcher.pid}
    # The launcher writes its plan before it starts an agent.
    (flown,) = recordings_below(folder / RECORDING / "swarm")
    swarm.epoch = flown.attached(FLIGHT_PLAN)["epoch_s"]


async def landed(swarm: Swarm, folder: Path) -> dict[str, Any]:
    """Waits for its verdict, and returns it."""
    try:
        await asyncio.wait_for(swarm.launcher.wait(), LANDING_S)
    except TimeoutError:
        raise swarm.failed(f"there is no verdict {LANDING_S:g} s after landing") from None
    file = folder / "verdict.json"
    if not file.exists():
        raise swarm.failed(f"the swarm ended with {swarm.launcher.returncode} and no verdict")
    found: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return found


def name_of(pid: int) -> str | None:
    """What a process of the swarm is, by its arguments; None: nothing that is measured, or that has ended."""
    try:
        arguments = Path(f"/proc/{pid}/cmdline").read_text(encoding="utf-8", errors="replace").split("\0")
    except OSError:
        return None
    if "swarmtrack.agents.simulator" in arguments:
        return "simulator"
    if "monitor" in arguments:
        return "monitor"
    configs = (re.search(r"drone-(\d+)\.toml$", argument) for argument in arguments)
    return next((f"drone {found[1]}" for found in configs if found), None)


# --- who listens and looks ----------------------------------------------------------------------------


class Healths:
    """The agents' health since the last `drain`."""

    def __init__(self) -> None:
        self._news: dict[int, list[HealthMessage]] = {}
        self._last: dict[int, HealthMessage] = {}

    def add(self, drone_id: int, health: HealthMessage) -> None:
        self._news.setdefault(drone_id, []).append(health)

    def drain(self) -> dict[int, AgentWindow]:
        """Of every agent that was heard before, too: counters want a beginning."""
        news, self._news = self._news, {}
        found = {
            drone_id: agent_window(self._last[drone_id], healths)
            for drone_id, healths in sorted(news.items())
            if drone_id in self._last
        }
        self._last |= {drone_id: healths[-1] for drone_id, healths in news.items()}
        return found


def agent_window(before: HealthMessage, healths: list[HealthMessage]) -> AgentWindow:
    """before: the last message of the window before; healths: those of this one, at least one."""
    last = healths[-1]
    uptimes = [before.uptime_s, *(health.uptime_s for health in healths)]
    spans = [later - earlier for earlier, later in pairwise(uptimes)]
    seconds = sum(spans)

    def rate(name: str) -> float:
        counts = (h.rates[name].got_hz * span for h, span in zip(healths, spans, strict=True))
        return sum(counts) / seconds if seconds > 0.0 else math.nan

    def counted(link: str, counter: str) -> int:
        return int(_counter(last, link, counter) - _counter(before, link, counter))

    lags = [lag for health in healths if (lag := health.latencies.get("loop_lag")) is not None]
    return AgentWindow(
        healths=len(healths),
        rates_hz={name: rate(name) for name in last.rates},
        lag_p95_s=max((lag.p95_s for lag in lags), default=math.nan),
        lag_max_s=max((lag.max_s for lag in lags), default=math.nan),
        imu_samples=counted("autopilot", "imu_samples"),
        imu_expected=(last.rates["imu"].asked_hz or math.nan) * seconds,
        imu_lost=counted("autopilot", "imu_lost"),
        imu_gaps=counted("autopilot", "gaps"),
        frames_dropped=_frames_dropped(last) - _frames_dropped(before),
        recorded=counted("recording", "written"),
        unrecorded=counted("recording", "lost"),
    )


def _counter(health: HealthMessage, link: str, counter: str) -> float:
    return next((one.counters.get(counter, 0.0) for one in health.links if one.name == link), 0.0)


def _frames_dropped(health: HealthMessage) -> int:
    """Overtaken while the agent was busy, too old when their turn came, or behind the tracker's time."""
    cameras = [link.counters for link in health.links if {"frames", "dropped"} <= link.counters.keys()]
    # A camera's link bears its address as name.
    return int(sum(counters["dropped"] for counters in cameras)) + sum(
        health.drops.get(name, 0) for name in ("stale_frames", "late_scans")
    )


class Viewer:
    """What an open page gets. Says "drawn" at once, as a fast laptop would."""

    def __init__(self) -> None:
        self._states = self._views = self._bytes = 0
        self._state_at = self._began = time.monotonic()
        self._longest_wait = 0.0

    async def watch(self, url: str) -> None:
        """At every drone there is, until cancelled or until the monitor ends."""
        watched: list[int] = []
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(f"{url}ws", max_msg_size=0) as socket,
        ):
            self._state_at = time.monotonic()
            async for message in socket:
                self._bytes += len(message.data)
                if message.type is aiohttp.WSMsgType.TEXT:
                    now = time.monotonic()
                    self._longest_wait = max(self._longest_wait, now - self._state_at)
                    self._state_at = now
                    self._states += 1
                    drones = [drone["id"] for drone in json.loads(message.data)["drones"]]
                    if drones != watched:
                        watched = drones
                        await socket.send_json({"watch": [(drone, 0) for drone in drones]})
                else:
                    self._views += 1
                await socket.send_str("+")

    def drain(self) -> ViewerWindow:
        """Since the last call."""
        now = time.monotonic()
        seconds = now - self._began
        waited = max(self._longest_wait, now - self._state_at)
        states, views, kilobytes = (n / seconds for n in (self._states, self._views, 1e-3 * self._bytes))
        window = ViewerWindow(states, views, kilobytes, waited)
        self._states = self._views = self._bytes = 0
        self._began, self._longest_wait = now, 0.0
        return window


def machine_seconds() -> float:
    """Time in which the cores of this machine did something, since it started; waiting for a disk is nothing."""
    fields = Path("/proc/stat").read_text(encoding="ascii").split("\n")[0].split()[1:9]
    return sum(map(int, fields[:3] + fields[5:])) / os.sysconf("SC_CLK_TCK")


# --- measuring ----------------------------------------------------------------------------------------


async def measure(
    swarm: Swarm, flight_s: float, seconds: float, on_window: Callable[[Window], None]
) -> list[Window]:
    """Windows of so many seconds each, as many as fit between the beginning of the flight and `flight_s`."""
    healths, viewer = Healths(), Viewer()
    listener = ZenohListener(
        NetworkSettings(team=swarm.team), keys.key(swarm.team, Kind.HEALTH, "*"), SystemClock()
    )
    await listener.open()

    async def listen() -> None:
        async for sample in listener.samples():
            address = keys.parse(sample.key)
            if address is not None and address.kind is Kind.HEALTH and sample.payload:
                healths.add(address.drone_id, codec.decode(HealthMessage, sample.payload))

    others = [
        asyncio.create_task(listen(), name="the listener"),
        asyncio.create_task(viewer.watch(swarm.monitor_url), name="the viewer"),
    ]
    windows: list[Window] = []
    try:
        began = max(0.0, time.monotonic() - swarm.epoch)  # world time; later than 0 on a machine that is busy
        await _until(swarm, began, others)
        healths.drain()
        viewer.drain()
        before, machine = time.monotonic(), machine_seconds()
        cpu = {name: cpu_seconds(pid) for name, pid in swarm.pids.items()}
        for k in range(1, int((flight_s - began) / seconds) + 1):
            await _until(swarm, began + k * seconds, others)
            now, whole = time.monotonic(), machine_seconds()
            used = {name: cpu_seconds(pid) for name, pid in swarm.pids.items()}
            ours = sum(used.values()) - sum(cpu.values())
            window = Window(
                t_s=now - swarm.epoch,
                seconds=now - before,
                rss_mb={name: rss_mb(pid) for name, pid in swarm.pids.items()},
                cpu_percent={name: 100.0 * (used[name] - cpu[name]) / (now - before) for name in used},
                elsewhere_percent=max(0.0, 100.0 * (whole - machine - ours) / (now - before)),
                agents=healths.drain(),
                viewer=viewer.drain(),
            )
            before, machine, cpu = now, whole, used
            windows.append(window)
            on_window(window)
    finally:
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)
        await listener.close()
    return windows


async def _until(swarm: Swarm, t: float, others: list[asyncio.Task[None]]) -> None:
    """World time; raises BenchmarkError as soon as the swarm, the listener or the viewer ends."""
    ended = asyncio.create_task(swarm.launcher.wait())
    try:
        seconds = max(swarm.epoch + t - time.monotonic(), 0.0)
        done, _ = await asyncio.wait([ended, *others], timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
    finally:
        ended.cancel()
    if ended in done:
        raise swarm.failed(f"the swarm ended with {swarm.launcher.returncode} in flight")
    for task in done:
        why = task.exception() if isinstance(task, asyncio.Task) else None
        raise swarm.failed(f"{task.get_name()} ended in flight: {why or 'the connection closed'}")
