"""A team of real agents in network namespaces, one simulator for their sensors, and a spectator who knows the truth.

The agents talk over the radio of a `RadioEmulator`. Sensors and spectator are on the cables, so what is done to the
radio is done to nothing else. Times are seconds of CLOCK_MONOTONIC, which all processes of a machine share.
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import re
import secrets
import signal
import sys
import time
from asyncio.subprocess import DEVNULL, PIPE, Process
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path

from support.patience import PATIENCE
from support.places import ROOT
from swarmtrack.clock import SystemClock
from swarmtrack.config.drone import NetworkSection
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.score.swarm_score import MIN_SWARM_HIT_RADIUS_PX
from swarmtrack.lab.score.swarm_truth import SwarmTruth
from swarmtrack.lab.swarm.configs import Sources, write_configs
from swarmtrack.lab.swarm.radio import RadioEmulator
from swarmtrack.messages import Array
from swarmtrack.security import names
from swarmtrack.security.authority import create_authority, open_authority
from swarmtrack.security.loading import load_credentials
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind
from swarmtrack.transport.settings import NetworkSettings
from swarmtrack.transport.topology import of_monitor
from swarmtrack.transport.zenoh_listener import ZenohListener
from swarmtrack.wire import codec
from swarmtrack.wire.tracks import TrackMessage, TracksMessage

GROUND = 250  # the radio of whoever listens without being of the team
JUDGED_AGE_S = 0.3  # three scans
MAX_FRAME_AGE_S = 1.0  # where processes wait for each other, a late frame is better than none
SEED = 1
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}


class Lines:
    """What a process says, with the time at which it was read."""

    def __init__(self, name: str, process: Process) -> None:
        assert process.stderr is not None
        self.name = name
        self.process = process
        self.said: list[tuple[float, str]] = []
        self._news = asyncio.Condition()
        self._reading = asyncio.create_task(self._read(process.stderr), name=f"lines of {name}")

    async def _read(self, stream: asyncio.StreamReader) -> None:
        while line := await stream.readline():
            async with self._news:
                self.said.append((time.monotonic(), line.decode(errors="replace").rstrip()))
                self._news.notify_all()

    def times(self, pattern: str, since: float = 0.0) -> list[float]:
        """When it said what matches, at or after `since`."""
        return [t for t, line in self.said if t >= since and re.search(pattern, line)]

    async def until(self, pattern: str, since: float = 0.0) -> float:
        """The first time; waits for it."""
        try:
            async with asyncio.timeout(PATIENCE), self._news:
                await self._news.wait_for(lambda: self.times(pattern, since))
        except TimeoutError:
            tail = "\n".join(line for _, line in self.said[-30:])
            raise AssertionError(f"{self.name} did not say {pattern!r}; its last lines:\n{tail}") from None
        return self.times(pattern, since)[0]

    async def end(self, number: signal.Signals) -> float:
        """Send the signal and wait for the end; when it was sent."""
        sent = time.monotonic()
        with suppress(ProcessLookupError):
            self.process.send_signal(number)
        # wait() would wait for the end of its output too, which nobody may have read.
        async with asyncio.timeout(PATIENCE):
            while self.process.returncode is None:  # noqa: ASYNC110
                await asyncio.sleep(0.02)
        await self._reading
        return sent


@dataclass(frozen=True, slots=True)
class Look:
    """What one observer published, beside the truth of the instant that it speaks of.

    t: of its arrival; order: the drones in view from left to right; named: the ID on each confirmed track that has one,
    and whose track that is: of the drone with that ID if it is at its box, else of the nearest. While two drones cross,
    either may be the nearest to both tracks; who confused them has a wrong name once they have parted. scan_age_s: how
    long the tracks were carried on without a scan; an agent that gets no CPU does so badly, and confuses nobody.
    """

    t: float
    order: tuple[int, ...]
    named: frozenset[tuple[int, int]]
    scan_age_s: float = 0.0

    @property
    def in_view(self) -> frozenset[int]:
        return frozenset(self.order)

    def is_judged(self) -> bool:
        """Whether the tracks are fresh enough to tell whose they are."""
        return self.scan_age_s <= JUDGED_AGE_S

    def knows(self, drone: int) -> bool:
        """Whether it calls this drone by its name."""
        return (drone, drone) in self.named

    def calls_somebody(self, drone: int) -> bool:
        """Whether it calls anybody by this name."""
        return drone in {name for name, _ in self.named}

    def is_right(self) -> bool:
        """Everybody in view has the right name."""
        return all(map(self.knows, self.in_view))

    def is_wrong(self) -> bool:
        """Somebody has another's name; unknown is not wrong."""
        return self.is_judged() and any(name != nearest for name, nearest in self.named)


class Team:
    """Agents are started one by one, and end with the team. World time begins when it is opened."""

    def __init__(self, emulator: RadioEmulator, scenario_file: Path, folder: Path, *, secured: bool) -> None:
        self.emulator = emulator
        self.looks: dict[int, list[Look]] = {}
        self.agents: dict[int, Lines] = {}  # by drone, in their latest lives
        self._folder = folder
        self._scenario_file = scenario_file
        self._scenario = load_scenario(scenario_file, seed=SEED)
        self._truth = SwarmTruth(self._scenario.world, self._scenario.cameras)
        self._name = f"test-{secrets.token_hex(4)}"
        self._processes: list[Lines] = []
        self._sources: Mapping[int, Sources] = {}
        self._clock_off_s: dict[int, float] = {}
        self._looked = asyncio.Condition()
        self._watching: asyncio.Task[None] | None = None
        self._keys = self._make_keys(folder / "keys") if secured else None
        self._listener = ZenohListener(
            self._spectator(), keys.key(self._name, Kind.TRACKS, "*"), SystemClock()
        )
        self.epoch = 0.0

    @property
    def drones(self) -> Sequence[int]:
        return self._scenario.members

    async def open(self) -> None:
        self.epoch = time.monotonic()
        await self._start_simulator()
        await self._listener.open()
        self._watching = asyncio.create_task(self._watch(), name="spectator")

    async def close(self) -> None:
        await self._listener.close()
        if self._watching is not None:
            await self._watching
        for lines in self._processes:
            if lines.process.returncode is None:
                await lines.end(signal.SIGKILL)

    async def _start_simulator(self) -> None:
        words = {
            "--scenario": str(self._scenario_file), "--seed": str(SEED), "--epoch": repr(self.epoch),
            "--detector": "oracle", "--host": self.emulator.wire_address,
        }  # fmt: skip
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "swarmtrack.agents.simulator"),
            *(word for pair in words.items() for word in pair),
            stdin=PIPE,
            stdout=PIPE,
            stderr=PIPE,
            env=ENVIRONMENT,
        )
        simulator = Lines("the simulator", process)
        self._processes.append(simulator)
        assert process.stdout is not None
        ready = await asyncio.wait_for(process.stdout.readline(), PATIENCE)
        assert ready, "\n".join(line for _, line in simulator.said)
        drones = json.loads(ready)["drones"]
        self._sources = {
            int(drone): Sources(ends["camera"], ends["autopilot"]) for drone, ends in drones.items()
        }

    async def start(self, drone: int, *, name: int | None = None, clock_off_s: float = 0.0) -> Lines:
        """Start the drone's agent. name: the ID that it is given, its own if None; clock_off_s: of its wall clock."""
        name = drone if name is None else name
        path = self._write_config(drone, name)
        self._clock_off_s[name] = clock_off_s
        module = ["swarmtrack.agents.vehicle", "--config", str(path), "--quiet", "--log", "info"]
        if clock_off_s:
            module = ["swarmtrack.lab.swarm.skewed_clock", repr(clock_off_s), *module]
        process = await asyncio.create_subprocess_exec(
            *self.emulator.wrap(drone, [sys.executable, "-m", *module]),
            stdin=DEVNULL,
            stdout=DEVNULL,
            stderr=PIPE,
            env=ENVIRONMENT,
        )
        self.agents[drone] = Lines(f"the agent of drone {drone}", process)
        self._processes.append(self.agents[drone])
        return self.agents[drone]

    async def listen(self, key: str) -> Process:
        """Somebody on the ground listens over the radio, with the monitor's keys; what is heard comes as JSON lines."""
        assert self._keys is not None
        peers = ", ".join(f'{drone} = "{self.emulator.radio_address(drone)}"' for drone in self.drones)
        team = self._folder / "ground.toml"
        team.write_text(f'[network]\nteam = "{self._name}"\npeers = {{ {peers} }}\n')
        words = ["echo", key, "--config", str(team), "--keys", str(self._keys / "monitor")]
        process = await asyncio.create_subprocess_exec(
            *self.emulator.wrap(GROUND, [sys.executable, "-m", "swarmtrack.agents.main", *words]),
            stdin=DEVNULL,
            stdout=PIPE,
            stderr=PIPE,
            limit=1 << 20,
            env=ENVIRONMENT,
        )
        self._processes.append(Lines("the listener", process))
        return process

    def _write_config(self, drone: int, name: int) -> Path:
        folder = self._folder / f"{drone}-as-{name}"
        folder.mkdir(exist_ok=True)
        path = write_configs(
            folder,
            self._scenario,
            team=self._name,
            tracker="kalman",
            sources=self._sources,
            simulator="(of the test)",
        )[drone]
        text = path.read_text().replace(f"id = {drone}\n", f"id = {name}\n", 1)
        text = re.sub(r"max_age_s = .*", f"max_age_s = {MAX_FRAME_AGE_S}", text)
        path.write_text(f"{text}\n[network]\n{self._network(drone, name)}")
        return path

    def _network(self, drone: int, name: int) -> str:
        """The table [network]. Lower IDs are dialled over the radio; the cable is listened on for the spectator.

        With keys everybody's address is known. Without, whoever is heard of is dialled too, clones included.
        """
        own = [self.emulator.radio_address(drone), self.emulator.drone_wire_address(drone)]
        if self._keys is None:
            lower = [self.emulator.radio_address(other) for other in self.drones if other < drone]
            return f"insecure = true\nlisten = {json.dumps(own)}\nconnect = {json.dumps(lower)}\n"
        peers = ", ".join(f'{other} = "{self.emulator.radio_address(other)}"' for other in self.drones)
        folder = json.dumps(str(self._keys / names.drone(name)))
        return f"keys = {folder}\nlisten = {json.dumps(own)}\npeers = {{ {peers} }}\n"

    def _spectator(self) -> NetworkSettings:
        credentials = None
        if self._keys is not None:
            credentials = load_credentials(self._keys / "monitor", "monitor", time.time())
        cables = {str(drone): self.emulator.drone_wire_address(drone) for drone in self.drones}
        section = NetworkSection(team=self._name, peers=cables, insecure=credentials is None)
        return of_monitor(section, credentials)

    def _make_keys(self, folder: Path) -> Path:
        now = datetime.now(UTC)
        authority = create_authority(folder, self._name, now)
        authority.issue(["monitor", *map(names.drone, self.drones)], now)
        return folder

    def issue_monitors(self, number: int) -> list[str]:
        """Certificates for so many more listeners; their names."""
        assert self._keys is not None
        issued = [f"monitor-{k}" for k in range(number)]
        open_authority(self._keys).issue(issued, datetime.now(UTC))
        return issued

    def revoke(self, name: str) -> None:
        """As `swarmtrack keys revoke` does it on the CA's machine, which copies the roster to all others at once."""
        assert self._keys is not None
        open_authority(self._keys).revoke(name)

    # --- watching -----------------------------------------------------------------------

    async def _watch(self) -> None:
        async for sample in self._listener.samples():
            address = keys.parse(sample.key)
            assert address is not None
            message = codec.decode(TracksMessage, sample.payload)
            async with self._looked:
                look = self._look(address.drone_id, message)
                self.looks.setdefault(address.drone_id, []).append(look)
                self._looked.notify_all()

    def _look(self, observer: int, message: TracksMessage) -> Look:
        off = self._clock_off_s.get(observer, 0.0)
        t = message.t_utc_s - off - self.epoch - (time.time() - time.monotonic())  # world time
        view = self._truth.view(observer, t)
        boxes = {**view.in_view, **view.hidden}
        named = {
            (track.identity, _whose(track, boxes))
            for track in message.tracks
            if track.status == "confirmed" and isinstance(track.identity, int) and boxes
        }
        order = sorted(view.in_view, key=lambda drone: float(view.in_view[drone][0]))
        return Look(time.monotonic(), tuple(order), frozenset(named), message.scan_age_s)

    async def until(
        self, wanted: Callable[[Look], bool], observers: Sequence[int], since: float, what: str
    ) -> float:
        """The first time at or after `since` when the last word of each of these observers is as wanted."""

        def so() -> bool:
            last = [self.looks.get(observer, [])[-1:] for observer in observers]
            return all(looks and looks[0].t >= since and wanted(looks[0]) for looks in last)

        try:
            async with asyncio.timeout(PATIENCE), self._looked:
                await self._looked.wait_for(so)
        except TimeoutError:
            last = {observer: self.looks.get(observer, [])[-1:] for observer in observers}
            raise AssertionError(f"not in {PATIENCE:g} s: {what}; {last}; {self._last_lines()}") from None
        return time.monotonic()

    def _last_lines(self) -> str:
        """Of every process."""
        return "".join(
            f"\n--- {one.name}, exit code {one.process.returncode}:\n"
            + "\n".join(line for _, line in one.said[-8:])
            for one in self._processes
        )

    async def until_known(self, drones: Sequence[int], since: float) -> float:
        """When each of these drones calls each other one of them that it sees by its name."""
        return await self.until(
            lambda look: all(map(look.knows, look.in_view.intersection(drones))),
            drones,
            since,
            f"each of {drones} names the others",
        )

    async def until_met(self) -> None:
        """Until no agent misses another, by what they said last of each other."""
        for observer, agent in self.agents.items():
            for other in self.agents.keys() - {observer}:
                gone = agent.times(f"drone {other} is gone")
                await agent.until(f"drone {other} announced itself", gone[-1] if gone else 0.0)

    def wrong(self, observers: Sequence[int], since: float, until: float) -> int:
        """How often one of these observers gave a wrong name."""
        return sum(self.looks_between(observers, since, until, Look.is_wrong))

    def crossings(self, observers: Sequence[int], since: float, until: float) -> int:
        """How often two drones changed sides in the image of one of these observers."""
        orders = [
            [look.order for look in self.looks.get(observer, []) if since <= look.t < until]
            for observer in observers
        ]
        return sum(
            before != after and set(before) == set(after)
            for seen in orders
            for before, after in pairwise(seen)
        )

    def looks_between(
        self, observers: Sequence[int], since: float, until: float, judge: Callable[[Look], bool]
    ) -> list[bool]:
        """The judgement of everything that these observers said in that time."""
        found = [
            judge(look) for observer in observers for look in self.looks[observer] if since <= look.t < until
        ]
        assert found, "nobody said anything"
        return found

    def longest_silence(self, since: float, until: float) -> float:
        """Of any observer on its cable, which has no faults: seconds for which the machine, not the radio, failed."""
        gaps = [0.0]
        for looks in self.looks.values():
            times = [since, *(look.t for look in looks if since <= look.t < until), until]
            gaps += [after - before for before, after in pairwise(times)]
        return max(gaps)


def _whose(track: TrackMessage, boxes: Mapping[int, Array]) -> int:
    """The drone that a named track is of. boxes: of the truth, centre and size, px."""

    def off(drone: int) -> float:
        return math.dist((track.u_px, track.v_px), boxes[drone][:2])

    named = track.identity
    if isinstance(named, int) and named in boxes:
        at_its_box = off(named) <= max(MIN_SWARM_HIT_RADIUS_PX, 0.5 * float(max(boxes[named][2:])))
        return named if at_its_box else min(boxes, key=off)
    return min(boxes, key=off)


@asynccontextmanager
async def team_in_the_air(scenario: str, folder: Path, *, secured: bool = True) -> AsyncIterator[Team]:
    """Of a scenario's TOML; no agent is started yet. secured: with keys. Raises RadioError where there can be none."""
    file = folder / "scenario.toml"
    file.write_text(scenario)
    drones = load_scenario(file, seed=SEED).members
    async with RadioEmulator([*drones, GROUND], seed=SEED) as emulator:
        team = Team(emulator, file, folder, secured=secured)
        try:
            await team.open()
            yield team
        finally:
            await team.close()
