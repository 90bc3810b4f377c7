"""One flight of a local swarm: the simulator, one real agent process for each drone, and somebody who watches them.

World time 0 comes once everybody should be there; until then all drones hover. Agents start two or so at a time, late
ones at their time; those that the scenario kills are killed and started again. Where others fly, so are those that
somebody else kills. If a scenario scripts the radio, each agent lives in a network namespace of its own
(`swarmtrack/lab/swarm/radio.py`).
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import os
import secrets
import shlex
import signal
import sys
import tempfile
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from swarmtrack.clock import SystemClock, utc_offset
from swarmtrack.config.toml.layers import Table
from swarmtrack.errors import ungrouped
from swarmtrack.lab.scenarios.files import limits_of, load_scenario, read_scenario
from swarmtrack.lab.scenarios.scenario import FaultKind, Scenario, ScenarioFault, as_told
from swarmtrack.lab.score.swarm_verdict import Limits, SwarmReport
from swarmtrack.lab.swarm.configs import RadioEnds, Sources, write_configs
from swarmtrack.lab.swarm.detail import Detail
from swarmtrack.lab.swarm.machine_load import FAIR, Capacity, MachineLoad, Spent, look_around, needed_cores
from swarmtrack.lab.swarm.outside import NoTruth
from swarmtrack.lab.swarm.page import FlightPage, open_page
from swarmtrack.lab.swarm.processes import Child, Children, ProcessDied
from swarmtrack.lab.swarm.radio import RadioEmulator
from swarmtrack.lab.swarm.recording import FlightRecording
from swarmtrack.lab.swarm.table import Spectator, flight_end
from swarmtrack.lab.swarm.truth_feed import follow_truth
from swarmtrack.lab.swarm.watch import Watch
from swarmtrack.lab.swarm.world_file import OutsideWorld, load_world
from swarmtrack.lab.world.followed import FollowedDrone
from swarmtrack.tracking import DEFAULT_TRACKER
from swarmtrack.transport import keys
from swarmtrack.transport.settings import NetworkSettings
from swarmtrack.transport.zenoh_listener import ZenohListener

AGENT_START_CPU_S = {"onnx": 1.6, "oracle": 1.2}
MAX_SLOWDOWN = 4.0  # of the agents' start, by what else the machine is doing
RECOGNISE_S = 2.5
RADIO_LINKS_S = 6.0  # through a bad radio, a connection takes several attempts
WORD_S = 3.0  # s between two words while one waits
SIMULATOR_PATIENCE_S = 60.0  # on a machine that is busy with something else
# The truth comes 50 ms after an exposure, and a picture takes up to 70 ms.
MAX_OUTSIDE_FRAME_AGE_S = 0.3
START_PATIENCE_S = 8.0  # that one agent may hold up the next ones' start
AGENT_NICENESS = 5
DETECTORS_SHARE = 0.1  # of all cores: where all detectors take more, they look through fewer tiles
SHOW_HZ = 4.0
AGENT_PORT = 7447  # in namespaces each has all ports to itself
GROUND_PATIENCE_S = 600.0  # s, where a flight counts from take-off: an EKF takes 40 s to let anybody arm
TAKE_OFF_LOOK_S = 0.25  # s between two looks whether somebody has taken off
AGENT_RESTART_S = 1.0  # s, as configs/systemd has it on a drone: RestartSec
AGENT_LAST_WORDS_S = 0.3  # s after the end, for what is still on its way


@dataclass(frozen=True, slots=True)
class FlightPlan:
    """What `swarmtrack sim` is asked for. seconds: None: the scenario's own; world: a file, instead of the scenario.

    seed: None: that of the world file, 1 of a scenario.
    """

    scenario: str
    drones: int | None = None
    seconds: float | None = None
    seed: int | None = None
    tracker: str = DEFAULT_TRACKER
    detector: str = "onnx"
    keep: bool = False
    record: Path | None = None
    monitor_port: int | None = None
    """Of the web page, 0: any; None: no page."""
    world: Path | None = None
    team: str | None = None
    """Its name; None: a new one."""
    detail: Detail = Detail.FULL
    """Of a scenario."""

    def load(self) -> FlownPlan:
        """Raises ConfigError."""
        if self.world is not None:
            outside = load_world(self.world, seed=self.seed, keep_s=math.inf)
            followed = {drone_id: one.drone for drone_id, one in outside.outsiders.items()}
            return FlownPlan(outside.scenario, outside.limits, outside.table, followed, outside)
        layers = read_scenario(self.scenario)
        seed = 1 if self.seed is None else self.seed
        whole, followed = as_told(load_scenario(self.scenario, seed=seed, drones=self.drones))
        limits = self.detail.expected(whole, limits_of(layers))
        return FlownPlan(self.detail.of(whole), limits, layers.table, followed)


@dataclass(frozen=True, slots=True)
class FlownPlan:
    """What a plan comes to.

    files: what its files say; followed: drones of which the simulator tells where they are; outside: where others fly,
    who.
    """

    scenario: Scenario
    limits: Limits
    files: Table
    followed: Mapping[int, FollowedDrone]
    outside: OutsideWorld | None = None


Landed = Callable[[SwarmReport, FlightPage | None], Awaitable[None]]


async def fly(
    plan: FlightPlan, spectator: Spectator, landed: Landed | None = None, capacity: Capacity | None = None
) -> SwarmReport:
    """Raises RadioError before anything was started, and ProcessDied with the last lines of a log.

    landed: awaited once every process has ended but that of the page, where there is one: it ends after it. capacity:
    what the machine has to give; None: that is looked at first.
    """
    flown = plan.load()
    if capacity is None:
        clock = SystemClock()
        capacity = await asyncio.to_thread(look_around, MachineLoad(), clock.now(), clock)
    scenario = flown.scenario
    async with AsyncExitStack() as stack:
        emulator = None
        if scenario.needs_radio:
            emulator = await stack.enter_async_context(RadioEmulator(scenario.members, seed=scenario.seed))
            radio = scenario.radio
            emulator.impair(loss=radio.loss, latency_s=radio.latency_s, jitter_s=radio.jitter_s)
            emulator.narrow(radio.kbit_s)
        folder = Path(tempfile.mkdtemp(prefix="swarmtrack-sim-"))
        if plan.keep:
            spectator.print_line(f"configs and logs: {folder}")
        children = await stack.enter_async_context(Children(folder, keep=plan.keep))
        flight = _SwarmFlight(
            plan, flown, capacity, folder=folder, children=children, emulator=emulator, spectator=spectator
        )
        report = await flight.run()
        if flight.page is not None:
            flight.page.finish(flight_end(report, plan.record))
            await children.end_all(but=flight.page.child)
            spectator.close()
            if landed is not None:
                await landed(report, flight.page)
            return report
    spectator.close()
    if landed is not None:
        await landed(report, None)
    return report


class _SwarmFlight:
    def __init__(
        self,
        plan: FlightPlan,
        flown: FlownPlan,
        capacity: Capacity,
        *,
        folder: Path,
        children: Children,
        emulator: RadioEmulator | None,
        spectator: Spectator,
    ) -> None:
        self._plan = plan
        self._flown = flown
        self._load = MachineLoad(lambda: children.pids)
        self._scenario = scenario = flown.scenario
        self._folder = folder
        self._children = children
        self._emulator = emulator
        self._spectator = spectator
        self._team = plan.team or f"sim-{secrets.token_hex(4)}"
        self._clock = SystemClock()
        self._seconds = plan.seconds or scenario.seconds
        starters = [drone_id for drone_id in scenario.members if scenario.starts_s.get(drone_id, 0.0) <= 0.0]
        starting_s = len(starters) * AGENT_START_CPU_S[plan.detector] / capacity.speed
        starting = starting_s / max(capacity.cores - FAIR * capacity.others, capacity.cores / MAX_SLOWDOWN)
        # Where not everybody gets what he wants, the simulator comes first: it stands for hardware, which waits for no
        # computer that is connected to it. Else it would only be other programs that come before our agents.
        crowded = needed_cores(scenario, plan.detector, capacity.speed) > capacity.cores
        self._nice = ["nice", "-n", str(AGENT_NICENESS)] if crowded else []
        self._cores = capacity.cores
        # Generous: hovering a little longer costs nothing.
        self._lead = starting + RECOGNISE_S + (RADIO_LINKS_S if emulator is not None else 0.0)
        self._recording: FlightRecording
        self._watch: Watch
        self._configs: Mapping[int, Path] = {}
        self._agents: dict[int, Child] = {}
        self._killed: asyncio.Queue[int] = asyncio.Queue()
        """Drones whose agents somebody else has killed, and which are to be started again."""
        self._cut_off_s = math.nan
        self.page: FlightPage | None = None

    async def run(self) -> SwarmReport:
        ready = await self._start_simulator()
        self._prepare(ready["epoch_s"])
        self._configs = write_configs(
            self._folder,
            self._scenario,
            team=self._team,
            tracker=self._plan.tracker,
            sources=self._sources(ready["drones"]),
            simulator=shlex.join(["python", *self._simulator_arguments()]),
            radio=self._radio_ends(),
            recordings=self._plan.record and self._plan.record.absolute(),
            origin=None if self._flown.outside is None else self._flown.outside.origin,
            epoch_utc=ready["epoch_s"] + utc_offset(self._clock),
            share=self._share_of_detectors(),
        )
        self._note_how_to_listen(ready)
        if self._plan.monitor_port is not None:
            self.page = await self._open_page(self._plan.monitor_port)
        listener = ZenohListener(self._listening(), keys.all_but_video(self._team), self._clock)
        await listener.open()
        watch = self._watch
        plan = self._plan
        self._recording.begin(
            self._flown.files,
            drones=plan.drones,
            outside=self._flown.outside is not None,
            tracker=plan.tracker,
            detector=plan.detector,
            detail=plan.detail,
        )
        with self._recorded_to_its_end(), ungrouped(ProcessDied):
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(watch.listen(self._recording.tee(listener.samples())), name="hear")
                background = [
                    tasks.create_task(watch.evaluate(), name="judge"),
                    tasks.create_task(self._show(), name="show"),
                    tasks.create_task(self._start_agents(), name="agents"),
                    tasks.create_task(self._restart_agents(), name="restarts"),
                    *(tasks.create_task(self._play(fault), name=str(fault.kind)) for fault in self._faults()),
                    *self._following(tasks, ready),
                ]
                try:
                    await self._until_the_end()
                finally:
                    for task in background:
                        task.cancel()
                    await listener.close()
        if listener.dropped:
            self._spectator.note(
                f"{listener.dropped} messages came too fast to be judged: this machine is too busy"
            )
        await self._land()
        report = self._report()
        await asyncio.to_thread(self._recording.end, report, self._watch.ends_at)
        return report

    def _note_how_to_listen(self, ready: Mapping[str, Any]) -> None:
        """Where ground stations and listeners find the flight."""
        if self._flown.outside is None:
            for drone_id in self._flown.followed if self._scenario.star is None else ():
                where = ready["drones"][str(drone_id)]["ground"]
                self._spectator.note(f"drone {drone_id}: a ground station flies it at {where}")
        for line in self._how_to_listen():
            self._spectator.print_line(line)

    @contextlib.contextmanager
    def _recorded_to_its_end(self) -> Iterator[None]:
        """Whatever ends a flight early, the files of its recording are closed."""
        try:
            yield
        except BaseException:
            self._recording.abandon()
            raise

    # --- starting -----------------------------------------------------------------------

    async def _start_simulator(self) -> dict[str, Any]:
        """The line that says where everything is. Raises NoTruth where others fly and nobody tells."""
        what = "the truth about each drone" if self._flown.outside is not None else "the simulator"
        self._spectator.note(f"waiting for {what} …")
        argv = [sys.executable, *self._simulator_arguments(), "--lead", repr(self._lead)]
        if self._emulator is not None:
            argv += ["--host", self._emulator.wire_address]
        simulator = await self._children.start("simulator", argv, talks=True)
        assert simulator.process.stdout is not None
        waiting = asyncio.create_task(self._say_how_long(what))
        try:
            async with asyncio.timeout(SIMULATOR_PATIENCE_S):
                line = await simulator.process.stdout.readline()
        except TimeoutError:
            raise ProcessDied(f"the simulator is not ready after {SIMULATOR_PATIENCE_S:g} s") from None
        finally:
            waiting.cancel()
        if not line:
            raise ProcessDied((await self._children.died).describe_end())
        ready: dict[str, Any] = json.loads(line)
        if not ready["ready"]:
            raise NoTruth(ready["error"])
        return ready

    async def _say_how_long(self, what: str) -> None:
        """That something goes on, while nothing else is to be seen."""
        count, seconds = len(self._scenario.members), 0.0
        while True:
            await asyncio.sleep(WORD_S)
            seconds += WORD_S
            self._spectator.note(f"waiting for {what}: {count} drones, {seconds:.0f} s …")

    def _sources(self, drones: dict[str, dict[str, Any]]) -> dict[int, Sources]:
        """Where each agent finds its sensors. drones: as the simulator says it."""
        outside = self._flown.outside
        if outside is None:
            return {
                int(n): Sources(one["camera"], one["autopilot"], more_cameras=tuple(one["cameras"][1:]))
                for n, one in drones.items()
            }
        return {
            drone_id: Sources(
                drones[str(drone_id)]["camera"],
                one.link,
                system_id=one.truth.system_id,
                start=one.start,
                max_frame_age_s=MAX_OUTSIDE_FRAME_AGE_S,
            )
            for drone_id, one in outside.outsiders.items()
        }

    def _share_of_detectors(self) -> float:
        """Of the time, that each may look; all together may use so much of the machine."""
        eyes = len(self._scenario.members) * len(self._scenario.cameras)
        return min(DETECTORS_SHARE * self._cores / eyes, 1.0) if self._plan.detector == "onnx" else 1.0

    def _prepare(self, epoch: float) -> None:
        """Get ready to judge and to record. epoch: world time 0."""
        self._recording = FlightRecording(
            self._plan.record,
            self._scenario,
            self._clock,
            team=self._team,
            epoch=epoch,
            seconds=self._seconds,
        )
        self._watch = Watch(
            self._scenario, self._clock, self._recording.hearing, epoch=epoch, seconds=self._seconds
        )

    def _following(self, tasks: asyncio.TaskGroup, ready: dict[str, Any]) -> Iterator[asyncio.Task[None]]:
        """Where others fly, or a ground station: a task that hears from the simulator where they are."""
        drones = self._flown.followed
        if drones:
            follow = follow_truth(ready["truth"], drones, self._spectator.note, self._recording.told)
            yield tasks.create_task(follow, name="follow")

    async def _open_page(self, port: int) -> FlightPage:
        """Where there is a screen, in a browser, too."""
        screen = sys.stdout.isatty() and bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
        page = await open_page(
            self._children,
            [*self._nice, sys.executable, "-m", "swarmtrack.agents.main"],
            self._listening(),
            port=port,
            patience_s=SIMULATOR_PATIENCE_S,
            show=screen,
        )
        self._spectator.print_line(page.said)
        return page

    def _simulator_arguments(self) -> list[str]:
        """What decides what is flown."""
        plan = self._plan
        flown = ["--scenario", plan.scenario] if plan.world is None else ["--world", str(plan.world)]
        arguments = [*flown, "--seed", str(self._scenario.seed), "--detector", plan.detector]
        if plan.drones is not None:
            arguments += ["--drones", str(plan.drones)]
        if plan.detail is not Detail.FULL:
            arguments += ["--detail", plan.detail]
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

    def _how_to_listen(self) -> Iterator[str]:
        """The commands that hear this team, for a second terminal."""
        network = ["--team", self._team]
        if self._emulator is not None:
            cables = self._listening().connect
            network += [word for end in cables for word in ("--connect", end)] + ["--insecure"]
        yield f"listen: swarmtrack echo 'identities/*' {shlex.join(network)}"
        yield f"look:   swarmtrack monitor {shlex.join(network)}"

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
            program = [sys.executable, "-m", "swarmtrack.lab.swarm.skewed_clock", str(skew)]
            argv = [*program, "swarmtrack.agents.vehicle", *arguments]
        argv = [*self._nice, *argv]
        if self._emulator is not None:
            argv = self._emulator.wrap(drone_id, argv)
        self._watch.started(drone_id)
        self._recording.flown("started", drone_id)
        self._agents[drone_id] = await self._children.start(
            f"drone {drone_id}", argv, replace=lambda agent: self._replace(drone_id, agent)
        )

    def _replace(self, drone_id: int, agent: Child) -> bool:
        """Whether an agent that ended, not by us, is started again. In a rehearsal somebody may kill it, to see what
        becomes of its drone; one that was never heard is no rehearsal, but a fault of its own."""
        by = agent.killed_by
        if self._flown.outside is None or by is None or self._watch.agents[drone_id].boot is None:
            return False
        self._spectator.print_line(
            f"drone {drone_id}: its agent was killed ({by.name}), and is started again in {AGENT_RESTART_S:g} s"
        )
        self._watch.ended(drone_id)
        self._recording.flown("ended", drone_id)
        self._killed.put_nowait(drone_id)
        return True

    async def _restart_agents(self) -> None:
        """Those that somebody else has killed, until cancelled."""

        async def restart(drone_id: int) -> None:
            await asyncio.sleep(AGENT_RESTART_S)
            await self._start_agent(drone_id)

        async with asyncio.TaskGroup() as tasks:
            while True:
                drone_id = await self._killed.get()
                tasks.create_task(restart(drone_id), name=f"restart drone {drone_id}")

    # --- in flight ----------------------------------------------------------------------

    async def _until_the_end(self) -> None:
        """Of what is judged, and a little longer."""
        watch = self._watch
        if self._scenario.from_take_off:
            while math.isinf(watch.ends_at) and watch.t < GROUND_PATIENCE_S:
                await self._until(watch.t + TAKE_OFF_LOOK_S)
            if math.isinf(watch.ends_at):
                self._spectator.print_line(f"no drone took off within {GROUND_PATIENCE_S:g} s")
                return
            took_off_at = self._scenario.world.took_off_at
            self._spectator.print_line(
                f"{took_off_at:.0f} s: take-off; the flight ends at {watch.ends_at:.0f} s"
            )
        try:
            await self._until(watch.ends_at + AGENT_LAST_WORDS_S)
        except asyncio.CancelledError:
            task = asyncio.current_task()
            if task is None or not 0.0 < watch.t < watch.ends_at:
                raise
            # Somebody has seen enough: what was flown is judged. A second signal ends all at once.
            task.uncancel()
            self._cut_off_s = watch.t
            watch.cut_off(watch.t)
            self._spectator.note("interrupted: judging what was flown …")

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
            self._load.sample(self._watch.t)
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
        if self.page is not None:
            self.page.landed()
        for child in self._agents.values():
            child.ending = True
        total = self._watch.waiting
        if total > 1000:
            self._spectator.note(f"judging the remaining {total} views …")
        await self._watch.judge_the_rest()
        if self._watch.unjudged:
            self._spectator.note(
                f"{self._watch.unjudged} views were not judged: the truth at their times is missing"
            )

    def _spent(self) -> Spent:
        """While something was late, else over the whole flight."""
        spent = self._load.spent_in(self._watch.late(self._flown.limits))
        return self._load.spent() if math.isnan(spent.busy) else spent

    def _report(self) -> SwarmReport:
        plan, spent = self._plan, self._spent()
        return self._watch.report(
            seconds=self._seconds,
            seed=self._scenario.seed,
            tracker=plan.tracker,
            detector=plan.detector,
            limits=self._flown.limits,
            machine_busy=round(spent.busy, 3),
            others_busy=round(spent.by_others, 3),
            detail=plan.detail,
            cut_off_s=self._cut_off_s,
        )


def _endpoint(address: str) -> str:
    return f"tcp/{address}:{AGENT_PORT}"
