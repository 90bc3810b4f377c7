"""What the machine has room for, and how busy it was, by what the kernel counts.

Of what a flight needs there is an estimate by its rates; the figures are those of `swarmtrack bench first-command`. How
fast the machine is is measured with a piece of work that is always the same.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from time import sleep
from typing import NamedTuple

import numpy as np

from swarmtrack.clock import Clock, cpu_seconds
from swarmtrack.lab.scenarios.scenario import Scenario
from swarmtrack.lab.swarm.detail import Detail

STAT = Path("/proc/stat")
MEMORY_FILE = Path("/proc/meminfo")
AGENT_MB = {"onnx": 85.0, "oracle": 55.0}
"""What each agent has for itself alone, as the kernel counts it (Private_Dirty)."""


class _Ticks(NamedTuple):
    """Of all cores together, in the kernel's hundredths: idle, in all, and spent by our own processes."""

    idle: int
    total: int
    own: int


class Spent(NamedTuple):
    """0…1 of all cores' time that was spent on anything, and by other programs than ours; NaN where nobody knows."""

    busy: float
    by_others: float


NOBODY_KNOWS = Spent(math.nan, math.nan)


class MachineLoad:
    """From when it was made until it is asked, and over parts of that time."""

    def __init__(self, ours: Callable[[], Iterable[int]] = lambda: (), stat: Path = STAT) -> None:
        """ours: the process IDs of all children of ours that live."""
        self._stat = stat
        self._ours = ours
        self._own: dict[int, int] = {}
        self._began = self._ticks()
        self._looks: list[tuple[float, _Ticks]] = []

    def sample(self, t: float) -> None:
        """To be called a few times a second. t [s] by any clock that only rises."""
        ticks = self._ticks()
        if ticks is not None:
            self._looks.append((t, ticks))

    def spent_in(self, spans: Collection[tuple[float, float]]) -> Spent:
        """As `spent`, over those spans of time (from, to) [s] alone; NaN where there was no look in them."""
        sums = np.zeros(3)
        for (begin, before), (end, after) in pairwise(self._looks):
            if any(begin < last and first < end for first, last in spans):
                sums += np.subtract(after, before)
        return _shares(_Ticks(*map(int, sums)))

    def spent(self) -> Spent:
        """Until now."""
        began, now = self._began, self._ticks()
        if began is None or now is None:
            return NOBODY_KNOWS
        return _shares(_Ticks(*(after - before for after, before in zip(now, began, strict=True))))

    def _ticks(self) -> _Ticks | None:
        try:
            first = self._stat.read_text(encoding="ascii").splitlines()[0].split()
            ticks = [int(word) for word in first[1:9]]  # guests are counted under user as well
            return _Ticks(ticks[3] + ticks[4], sum(ticks), self._own_ticks())
        except (OSError, ValueError, IndexError):
            return None

    def _own_ticks(self) -> int:
        """Of our processes until now; who has ended keeps what was last seen."""
        for pid in (os.getpid(), *self._ours()):
            try:
                line = self._stat.with_name(str(pid)).joinpath("stat").read_text(encoding="utf-8")
            except OSError:
                continue
            # utime and stime: proc(5), fields 14 and 15; the name before them may hold anything.
            fields = line.rpartition(")")[2].split()
            self._own[pid] = int(fields[11]) + int(fields[12])
        return sum(self._own.values())


def _shares(ticks: _Ticks) -> Spent:
    if ticks.total <= 0:
        return NOBODY_KNOWS
    busy = 1.0 - ticks.idle / ticks.total
    return Spent(busy, min(max(busy - ticks.own / ticks.total, 0.0), 1.0))


# Cores that each part of a flight takes, on the machine on which `REFERENCE_S` was measured: an agent, by what it gets;
# its part of the simulator and of the judge; and a frame with all that is done with it, s.
AGENT, PER_IMU_HZ, PER_TRACKS_HZ, PER_DRONE = 0.065, 1e-4, 3e-4, 0.08
PER_FRAME_S = 0.002
PER_PICTURE_S = 0.0165  # drawn and looked at, of `PICTURE` pixels
PICTURE = 640 * 480
REFERENCE_S = 0.0086  # s of CPU for `_usual_work`
FAIR = 0.5  # of what others use, so much is left to us where everybody wants more: Linux is fair
FILLED = 0.85  # of what is there may be planned with
HARDLY_MORE = 1.1


def cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0))


def needed_cores(scenario: Scenario, detector: str, speed: float) -> float:
    """Of a flight. speed: of this machine, in that of the reference."""
    agent = AGENT + PER_IMU_HZ * scenario.imu_rate_hz + PER_TRACKS_HZ * scenario.tracks_hz
    for camera in scenario.cameras:
        picture = camera.lens.width * camera.lens.height / PICTURE if detector == "onnx" else 0.0
        agent += camera.fps * (PER_FRAME_S + PER_PICTURE_S * picture)
    return len(scenario.members) * (agent + PER_DRONE) / speed


@dataclass(frozen=True, slots=True)
class Capacity:
    """What the machine had to give before a flight. others: cores that other programs used; speed: beside the machine
    on which the figures above were measured."""

    cores: int
    others: float
    speed: float

    @property
    def free(self) -> float:
        """Cores that nobody used."""
        return max(self.cores - self.others, 0.0)

    def suffices(self, needed: float) -> bool:
        """Whether a flight gets what it needs."""
        return needed <= FILLED * (self.free + FAIR * self.others)


LOAD_PERIOD_S = 1.0


def look_around(load: MachineLoad, began: float, clock: Clock) -> Capacity:
    """What the machine has to give, by what was used since `load` was made at `began` [s], for a second at least."""
    time_left = began + LOAD_PERIOD_S - clock.now()
    if time_left > 0.0:
        sleep(time_left)
    spent = load.spent()
    others = 0.0 if math.isnan(spent.by_others) else spent.by_others * (os.cpu_count() or 1)
    return Capacity(cores(), min(others, float(cores())), machine_speed())


def machine_speed() -> float:
    """In that of the reference, by the best of several rounds: whatever disturbs one only adds to it."""
    return REFERENCE_S / min(_usual_work() for _ in range(5))


def _usual_work() -> float:
    """CPU seconds of what agents and simulator do all the time: small matrices, and Python's own numbers."""
    began, matrix, total = cpu_seconds(), np.eye(6), 0.0
    for k in range(10000):
        matrix = matrix @ matrix
        total += (k % 7) * 0.5
    return cpu_seconds() - began


def choose_detail(scenario: Scenario, detector: str, capacity: Capacity) -> Detail:
    """The most for which the machine has time; where it has none for any, the most that needs hardly more than the
    least: of who gets detections anyhow, small pictures save nothing."""
    needed = {detail: needed_cores(detail.of(scenario), detector, capacity.speed) for detail in Detail}
    least = HARDLY_MORE * min(needed.values())
    return next(detail for detail in Detail if capacity.suffices(needed[detail]) or needed[detail] <= least)


def described(scenario: Scenario, detector: str, capacity: Capacity, detail: Detail) -> str:
    """One line: what is free, what the flight needs, and what is flown for it."""
    seen = detail.of(scenario)
    needed = needed_cores(seen, detector, capacity.speed)
    line = f"{capacity.free:.1f} of {capacity.cores} cores are free, this flight needs about {needed:.1f}"
    if detail is Detail.FULL:
        return line
    whole = needed_cores(scenario, detector, capacity.speed)
    rates = f"{seen.fps:g} frames, {seen.imu_rate_hz:g} gyro samples and {seen.tracks_hz:g} tracks per second"
    return f"{line} with {detail} detail ({rates}), {whole:.1f} with all of it (--detail full)"


def too_large(drones: int, detector: str, memory: Path = MEMORY_FILE) -> str:
    """Why a flight of so many agents does not fit into the memory that is free; empty: it does, or nobody knows."""
    try:
        lines = memory.read_text(encoding="ascii").splitlines()
        free_mb = next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")) / 1024.0
    except (OSError, ValueError, IndexError, StopIteration):
        return ""
    each = AGENT_MB[detector]
    if drones * each <= free_mb:
        return ""
    need_gb, free_gb = drones * each / 1024.0, free_mb / 1024.0
    return (
        f"{drones} drones: {drones} agents need {need_gb:.1f} GB of memory, {free_gb:.1f} GB are free, "
        f"expected {int(free_mb / each)} drones at most on this machine"
    )


def lighter_flights(drones: int, detector: str) -> str:
    """What to try where the machine was too busy for a flight of so many drones with that detector."""
    fewer = ["with fewer --drones"] if drones > 2 else []
    oracle = ["with --detector oracle"] if detector != "oracle" else []
    return " or ".join([*fewer, *oracle, "when nothing else runs on it"])
