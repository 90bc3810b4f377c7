"""One flight of a local swarm: the simulator, one real agent process for each drone, and somebody who watches them.

World time 0 comes once everybody should be there; until then all drones hover. Agents start two or so at a time, late
ones at their time; those that the scenario kills are killed and started again. If it scripts the radio, each agent
lives in a network namespace of its own (`swarmtrack/localswarm/radio.py`).
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import secrets
import shlex
import signal
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path

from swarmtrack.clock import SystemClock
from swarmtrack.errors import first_of
from swarmtrack.evaluation.swarm_verdict import SwarmReport
from swarmtrack.localswarm.configs import RadioEnds, Sources, write_configs
from swarmtrack.localswarm.processes import Child, Children, ProcessDied
from swarmtrack.localswarm.radio import RadioEmulator
from swarmtrack.localswarm.recording import FlightRecording
from swarmtrack.localswarm.table import Spectator
from swarmtrack.localswarm.watch import Watch
from swarmtrack.scenario_file import load_limits, load_scenario
from swarmtrack.simulation.scenarios import FaultKind, Scenario, ScenarioFault
from swarmtrack.tracking import DEFAULT_TRACKER
from swarmtrack.transport import keys
from swarmtrack.transport.settings import NetworkSettings
from swarmtrack.transport.zenoh_listener import ZenohListener

# s of lead before world time 0, generous: hovering a little longer costs nothing.
SIMULATOR_START_S = 3.0
AGENT_START_CPU_S = {"onnx": 1.6, "oracle": 1.2}
MAX_SLOWDOWN = 4.0  # of the agents' start, by what else the machine is doing
RECOGNISE_S = 2.5
RADIO_LINKS_S = 6.0  # through a bad radio, a connection takes several attempts
SIMULATOR_PATIENCE_S = 60.0  # on a machine that is busy with something else
START_PATIENCE_S = 8.0  # that one agent may hold up the next ones' start
AGENT_NICENESS = 5  # the simulator stands for hardware, which waits for no computer that is connected to it
SHOW_HZ = 4.0
AGENT_PORT = 7447  # in namespaces each has all ports to itself
LAST_WORDS_S = 0.3  # s after the end, for what is still on its way


@dataclass(frozen=True, slots=True)
class FlightPlan:
    """What `swarmtrack sim` is asked for. seconds: None: the scenario's own; folder: for configs and logs."""

    scenario: str
    drones: int | None = None
    seconds: float | None = None
    seed: int = 1
    tracker: str = DEFAULT_TRACKER
    detector: str = "onnx"
    keep: bool = False
    record: Path | None = None
    monitor_port: int | None = None
    """Of the web page, 0: any; None: no page."""

    def load(self) -> Scenario:
        return load_scenario(self.scenario, seed=self.seed, drones=self.drones)


async def fly(plan: FlightPlan, spectator: Spectator) -> SwarmReport:
    """Raises RadioError before anything was started, and ProcessDied with the last lines of a log."""
    scenario = plan.load()
    async with AsyncExitStack() as stack:
        emulator = None
        if scenario.needs_radio:
            emulator = await stack.enter_async_context(RadioEmulator(scenario.members, seed=scenario.seed))
            radio = scenario.radio
            emulator.impair(loss=radio.loss, latency_s=radio.latency_s, jitter_s=radio.jitter_s)
        folder = Path(tempfile.mkdtemp(prefix="swarmtrack-sim-"))
        if plan.keep:
            spectator.note(f"configs and logs: {folder}")
        children = await stack.enter_async_context(Children(folder, keep=plan.keep))
        return await _SwarmFlight(
            plan, scenario, folder=folder, children=children, emulator=emulator, spectator=spectator
        ).run()


class _SwarmFlight:
    def __init__(
        self,
        plan: FlightPlan,
        scenario: Scenario,
        *,
        folder: Path,
        children: Children,
        emulator: RadioEmulator | None,
        spectator: Spectator,
    ) -> None:
        self._plan = plan
        self._scenario = scenario
        self._folder = folder
        self._children = children
        self._emulator = emulator
        self._spectator = spectator
        self._team = f"sim-{secrets.token_hex(4)}"
        self._clock = SystemClock()
        self._seconds = plan.seconds or scenario.seconds
        self._cores = len(os.sched_getaffinity(0))
        starters = [drone_id for drone_id in scenario.members if scenario.starts_s.get(drone_id, 0.0) <= 0.0]
        busy = min(1.0 + os.getloadavg()[0] / self._cores, MAX_SLOWDOWN)
        starting = busy * len(starters) * AGENT_START_CPU_S[plan.detector] / self._cores
        lead = SIMULATOR_START_S + starting + RECOGNISE_S + (RADIO_LINKS_S if emulator is not None else 0.0)
        self._epoch = self._clock.now() + lead
        self._recording = FlightRecording(
            plan.record, scenario, self._clock, team=self._team, epoch=self._epoch, seconds=self._seconds
        )
        self._watch = Watch(
            scenario, self._clock, self._recording.hearing, epoch=self._epoch, seconds=self._seconds
        )
        self._configs: Mapping[int, Path] = {}
        self._agents: dict[int, Child] = {}

    async def run(self) -> SwarmReport:
        sources = await self._start_simulator()
        self._configs = write_configs(
            self._folder,
            self._scenario,
            team=self._team,
            tracker=self._plan.tracker,
            sources=sources,
            simulator=shlex.join(["python", *self._simulator_arguments()]),
            radio=self._radio_ends(),
            recordings=self._plan.record and self._plan.record.absolute(),
        )
        if self._plan.monitor_port is not None:
            await self._start_monitor(self._plan.monitor_port)
        listener = ZenohListener(self._listening(), keys.all_but_video(self._team), self._clock)
        await listener.open()
        watch = self._watch
        plan = self._plan
        self._recording.begin(plan.scenario, plan.drones, plan.tracker, plan.detector)
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(watch.hear(self._recording.heard(listener.samples())), name="hear")
                background = [
                    tasks.create_task(watch.judge(), name="judge"),
                    tasks.create_task(self._show(), name="show"),
                    tasks.create_task(self._start_agents(), name="agents"),
                    *(tasks.create_task(self._play(fault), name=str(fault.kind)) for fault in self._faults()),
                ]
                try:
                    await self._until(self._seconds + LAST_WORDS_S)
                finally:
                    for task in background:
                        task.cancel()
                    await listener.close()
        except* ProcessDied as group:
            raise first_of(group) from None
        if listener.dropped:
            self._spectator.note(
                f"{listener.dropped} messages came too fast to be judged: this machine is too busy"
            )
        await self._land()
        report = self._report()
        await asyncio.to_thread(self._recording.end, report)
        return report

    # --- starting -----------------------------------------------------------------------

    async def _start_simulator(self) -> dict[int, Sources]:
        self._spectator.note("starting the simulator …")
        argv = [sys.executable, *self._simulator_arguments(), "--epoch", repr(self._epoch)]
        if self._emulator is not None:
            argv += ["--host", self._emulator.wire_address]
        simulator = await self._children.start("simulator", argv, talks=True)
        assert simulator.process.stdout is not None
        try:
            async with asyncio.timeout(SIMULATOR_PATIENCE_S):
                line = await simulator.process.stdout.readline()
        except TimeoutError:
            raise ProcessDied(f"the simulator is not ready after {SIMULATOR_PATIENCE_S:g} s") from None
        if not line:
            raise ProcessDied((await self._children.died).describe_end())
        ready = json.loads(line)
        return {
            int(drone_id): Sources(addresses["camera"], addresses["autopilot"])
            for drone_id, addresses in ready["drones"].items()
        }

    async def _start_monitor(self, port: int) -> None:
        """A process of its own, that takes no time from judging. Where there is a screen, its page is opened."""
        arguments = ["monitor", "--team", self._team, "--port", str(port)]
        for endpoint in self._listening().connect:
            arguments += ["--connect", endpoint, "--insecure"]
        if sys.stdout.isatty() and (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            arguments.append("--open")
        argv = ["nice", "-n", str(AGENT_NICENESS), sys.executable, "-m", "swarmtrack.agents.main", *arguments]
        monitor = await self._children.start("monitor", argv, talks=True)
        assert monitor.process.stdout is not None
        async with asyncio.timeout(SIMULATOR_PATIENCE_S):
            line = await monitor.process.stdout.readline()
        if not line:
            raise ProcessDied((await self._children.died).describe_end())
        self._spectator.note(f"{line.decode().strip()} (until the flight ends)")

    def _simulator_arguments(self) -> list[str]:
        """What decides what is flown."""
        plan = self._plan
        arguments = ["--scenario", plan.scenario, "--seed", str(plan.seed), "--detector", plan.detector]
        if plan.drones is not None:
            arguments += ["--drones", str(plan.drones)]
        return ["-m", "swarmtrack.agents.simulator", *arguments]

    def _radio_ends(self) -> dict[int, RadioEnds] | None:
        """Each listens on its radio, and on its cable for us; it dials the radios of lower IDs."""
        emulator = self._emulator
        if emulator is None:
            return None
        members = self._scenario.members
        return {
            drone_id: RadioEnds(
                listen=(
                    _endpoint(emulator.radio_address(drone_id)),
                    _endpoint(emulator.drone_wire_address(drone_id)),
                ),
                connect=tuple(
                    _endpoint(emulator.radio_address(other)) for other in members if other < drone_id
                ),
            )
            for drone_id in members
        }

    def _listening(self) -> NetworkSettings:
        if self._emulator is None:
            return NetworkSettings(team=self._team)
        cables = tuple(_endpoint(self._emulator.drone_wire_address(d)) for d in self._scenario.members)
        return NetworkSettings(team=self._team, connect=cables, insecure=True)

    async def _start_agents(self) -> None:
        """As many at a time as there are cores: an agent that starts takes one for itself."""
        cores = asyncio.Semaphore(self._cores)
        starts = self._scenario.starts_s

        async def start_in_turn(drone_id: int) -> None:
            start_s = starts.get(drone_id, 0.0)
            if start_s > 0.0:
                await self._until(start_s)
            async with cores:
                await self._start_agent(drone_id)
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(START_PATIENCE_S):
                        await self._watch.until_alive(drone_id)

        async with asyncio.TaskGroup() as tasks:
            for drone_id in self._scenario.members:
                tasks.create_task(start_in_turn(drone_id), name=f"start drone {drone_id}")

    async def _start_agent(self, drone_id: int) -> None:
        arguments = ["--config", str(self._configs[drone_id]), "--quiet"]
        argv = [sys.executable, "-m", "swarmtrack.agents.vehicle", *arguments]
        skew = self._scenario.utc_offset_s.get(drone_id, 0.0)
        if skew:
            program = [sys.executable, "-m", "swarmtrack.localswarm.skewed_clock", str(skew)]
            argv = [*program, "swarmtrack.agents.vehicle", *arguments]
        argv = ["nice", "-n", str(AGENT_NICENESS), *argv]
        if self._emulator is not None:
            argv = self._emulator.wrap(drone_id, argv)
        self._watch.started(drone_id)
        self._recording.flown("started", drone_id)
        self._agents[drone_id] = await self._children.start(f"drone {drone_id}", argv)

    # --- in flight ----------------------------------------------------------------------

    async def _until(self, world_time: float) -> None:
        """Wait; raises ProcessDied as soon as a process ends that should not."""
        seconds = world_time - self._watch.t
        if seconds > 0.0:
            await asyncio.wait([self._children.died], timeout=seconds)
        if self._children.died.done():
            raise ProcessDied(self._children.died.result().describe_end())

    async def _show(self) -> None:
        self._spectator.note("starting the agents …")
        while True:
            self._spectator.show(self._watch)
            await asyncio.sleep(1.0 / SHOW_HZ)

    def _faults(self) -> Iterator[ScenarioFault]:
        """Those that are ours to play; the others are the simulator's."""
        ours = (FaultKind.KILL, FaultKind.PARTITION, FaultKind.LOSS, FaultKind.LATENCY)
        return (fault for fault in self._scenario.faults if fault.kind in ours)

    async def _play(self, fault: ScenarioFault) -> None:
        await self._until(fault.at_s)
        if fault.kind is FaultKind.KILL:
            await asyncio.gather(*(self._kill(d, fault.seconds) for d in fault.drones or self._agents))
            return
        emulator, radio = self._emulator, self._scenario.radio
        assert emulator is not None, "such a scenario needs a radio"
        drones = fault.drones or self._scenario.members
        match fault.kind:
            case FaultKind.PARTITION:
                emulator.cut(drones)
            case FaultKind.LOSS:
                emulator.impair(drones, loss=fault.value)
            case FaultKind.LATENCY:
                emulator.impair(drones, latency_s=fault.value)
        await self._until(fault.at_s + fault.seconds)
        match fault.kind:
            case FaultKind.PARTITION:
                emulator.heal()
            case FaultKind.LOSS:
                emulator.impair(drones, loss=radio.loss)
            case FaultKind.LATENCY:
                emulator.impair(drones, latency_s=radio.latency_s)

    async def _kill(self, drone_id: int, away_s: float) -> None:
        """kill -9, and start again unless it is to stay dead."""
        self._watch.ended(drone_id)
        self._recording.flown("ended", drone_id)
        await self._children.end(self._agents[drone_id], signal.SIGKILL)
        if away_s > 0.0:
            await asyncio.sleep(away_s)
            await self._start_agent(drone_id)

    # --- after landing ------------------------------------------------------------------

    async def _land(self) -> None:
        for child in self._agents.values():
            child.ending = True
        total = self._watch.waiting
        if total > 1000:
            self._spectator.note(f"judging the remaining {total} views …")
        await self._watch.judge_the_rest()

    def _report(self) -> SwarmReport:
        plan = self._plan
        return self._watch.report(
            seconds=self._seconds,
            seed=plan.seed,
            tracker=plan.tracker,
            detector=plan.detector,
            limits=load_limits(plan.scenario),
        )


def _endpoint(address: str) -> str:
    return f"tcp/{address}:{AGENT_PORT}"
