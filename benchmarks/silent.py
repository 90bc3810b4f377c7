"""Who is who without a word on the air, over many flights: by the team's file, by codes, and by both.

One observer looks at N teammates at 5 to 20 m that hold their places in the wind, in the virtual swarm: real `Onboard`,
shipped tracker, misses, clutter and boxes that merge. Everybody's place in the file is off by `slots` metres per axis,
or nobody's place is known. Where codes are flown, they begin `CODE_S` after the observer began to look.

    swarmtrack bench silent [--seeds 60] [--drones 3 5 10] [--processes N] --out DIR

* all named: seconds from the beginning of the code (of the look, where there is none) until each teammate has had its
  right name; infinite where one had not within `SECONDS`.
* named: the share of teammates that bear their right name at the end.
* wrong: teammates that ever bore another's name, or were called foreign.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from swarmtrack.arguments import count
from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.command_line import add_common, add_processes, add_seeds, add_tracker
from swarmtrack.benchmarks.virtual_swarm import VirtualSwarm
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.lab.scenarios.scenario import (
    AnnouncedStart,
    Plan,
    Scenario,
    ScenarioCamera,
    announced_starts,
    fly,
)
from swarmtrack.lab.score.intervals import fraction_interval
from swarmtrack.lab.score.swarm_score import RATE_HZ, Glance, NamedTrack, SwarmScorer
from swarmtrack.lab.score.swarm_truth import SwarmTruth
from swarmtrack.lab.world.sensors import DetectorParameters
from swarmtrack.lab.world.trajectory import SteadyYaw
from swarmtrack.lab.world.world import World
from swarmtrack.messages import Array, TrackStatus
from swarmtrack.runtime.filed import SOMEWHERE_M

NAME = "silent"
SEEDS, QUICK_SEEDS = 60, 4
DRONES = (3, 5, 10)
OBSERVER = 1
RANGE_M, AZIMUTH, ELEVATION = (5.0, 20.0), 0.45, 0.2
APART_M, APART_RAD = 1.5, 0.03  # of two teammates; nearer, one may hide the other
HEIGHT_M = 12.0
WIND_M = 0.1  # RMS per axis, of who holds its place
CAMERA = PinholeCamera(fx=600.0, fy=600.0, cx=319.5, cy=255.5, width=640, height=512)
FPS, IMU_HZ = 7.0, 100.0
SEEN_AS = DetectorParameters(p_detection=0.9, centre_sigma=1.5, clutter_per_frame=0.2)
CODE_S = 2.0  # after the observer began to look
SECONDS = 10.0  # of looking, from the beginning of the code


class Mode(NamedTuple):
    """What is known: how exactly the file tells who starts where [m], None: not at all; and whether codes are flown."""

    words: str
    slots_m: float | None
    code: bool


MODES = (
    Mode("slots within 0.3 m", 0.3, code=False),
    Mode("slots within 1 m", 1.0, code=False),
    Mode("code", None, code=True),
    Mode("slots within 1 m, then code", 1.0, code=True),
)


@dataclass(frozen=True, slots=True)
class Flight:
    """What came of one: seconds until each teammate was named (inf: never), who was at the end, who was ever wrong."""

    all_named_s: float
    named: int
    wrong: int


def scenario_of_seed(n: int, mode: Mode, seed: int) -> Scenario:
    """An observer, and n teammates that it sees."""
    chance = World(seed, {}).chance("silent layout", n)
    eye = np.array([0.0, 0.0, -HEIGHT_M])
    plans = {OBSERVER: Plan(eye, SteadyYaw(0.0))}
    places = _places(n, chance)
    plans |= {OBSERVER + 1 + k: Plan(eye + place, SteadyYaw(math.pi)) for k, place in enumerate(places)}
    team = tuple(plans)
    codes_s = (CODE_S,) if mode.code else ()
    world = fly(seed, plans, WIND_M, codes_s=codes_s, team=team)
    announced = announced_starts(world, mode.slots_m or SOMEWHERE_M)
    announced[OBSERVER] = AnnouncedStart(world.flown(OBSERVER).position(0.0), 0.0, mode.slots_m or 0.3)
    return Scenario(
        world=world,
        cameras=(ScenarioCamera(CAMERA, fps=FPS),),
        imu_rate_hz=IMU_HZ,
        detector=SEEN_AS,
        announced=announced,
        announces=False,
        codes_s=codes_s,
    )


def _places(n: int, chance: np.random.Generator) -> list[Array]:
    """(3,) m from the observer; nobody hides anybody."""
    places: list[Array] = []
    while len(places) < n:
        azimuth, elevation = chance.uniform(-AZIMUTH, AZIMUTH), chance.uniform(-ELEVATION, ELEVATION)
        ray = np.array([math.cos(azimuth), math.sin(azimuth), -math.tan(elevation)])
        place = chance.uniform(*RANGE_M) * ray / np.linalg.norm(ray)
        if all(_apart(place, other) for other in places):
            places.append(place)
    return places


def _apart(one: Array, other: Array) -> bool:
    across = float(np.linalg.norm(np.cross(one, other)))
    angle = math.atan2(across, float(one @ other))
    return float(np.linalg.norm(one - other)) > APART_M and angle > APART_RAD


def look(n: int, mode: Mode, tracker: str, seed: int) -> Flight:
    """One flight, as fast as it computes; the same arguments give the same flight."""
    scenario = scenario_of_seed(n, mode, seed)
    swarm = VirtualSwarm(scenario, tracker=tracker, observers=[OBSERVER])
    judge = _Judge(scenario)
    begins = CODE_S if mode.code else 0.0
    for scan in swarm.fly(begins + SECONDS):
        tracks = [
            NamedTrack(one.track.id, one.identity, one.identity_probability, *one.track.mean[::2].tolist())
            for one in scan.tracks.tracks
            if one.track.status is TrackStatus.CONFIRMED
        ]
        judge.see(scan.exposed_t, tuple(tracks))
    return judge.flight(begins)


class _Judge:
    """Which track is whom in truth, and how it was called."""

    def __init__(self, scenario: Scenario) -> None:
        self._truth = SwarmTruth(scenario.world, scenario.cameras)
        self._scorer = SwarmScorer(scenario.members, start=0.0, end=math.inf)
        self._others = set(scenario.members) - {OBSERVER}
        self._first: dict[int, float] = {}
        self._wrong: set[int] = set()
        self._names: dict[int, object] = {}

    def see(self, t: float, tracks: tuple[NamedTrack, ...]) -> None:
        view = self._truth.view(OBSERVER, t)
        glance = Glance(OBSERVER, "virtual", math.floor(t * RATE_HZ), t, view.in_view, view.hidden, tracks)
        seen = self._scorer.add(glance)
        tracked = {judged.drone_id for judged in seen}
        for judged in seen:
            name, drone = judged.track.identity, judged.drone_id
            if drone is None:
                # Nobody's track with a name; one that has drifted off its drone, which has no other, is no wrong name.
                self._wrong |= {name} & tracked & self._others if isinstance(name, int) else set()
                continue
            self._names[drone] = name
            if name == drone:
                self._first.setdefault(drone, t)
            elif name is not None:
                self._wrong.add(drone)

    def flight(self, begins: float) -> Flight:
        last = max(self._first.values()) if self._first.keys() == self._others else math.inf
        named = sum(self._names.get(drone) == drone for drone in self._others)
        return Flight(max(last - begins, 0.0), named, len(self._wrong))


@dataclass(frozen=True, slots=True, kw_only=True)
class Programme:
    """Which flights."""

    seeds: int = SEEDS
    drones: Sequence[int] = DRONES
    tracker: str = "mbm"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_common(parser)
    add_tracker(parser)
    add_seeds(parser, SEEDS, QUICK_SEEDS)
    parser.add_argument(
        "--drones", type=count, nargs="+", metavar="N", help="teammates in view (default: 3 5 10)"
    )
    add_processes(parser)


def run(args: argparse.Namespace) -> None:
    p = Programme(
        seeds=args.seeds or (QUICK_SEEDS if args.quick else SEEDS),
        drones=tuple(args.drones or DRONES),
        tracker=args.tracker,
    )
    publish(args.out, p, processes=args.processes)


def publish(out: Path, p: Programme, *, processes: int | None) -> dict[str, Any]:
    """Fly everything, write silent.json and silent.md into `out`, and return what is in the JSON."""
    rows = [(n, mode) for mode in MODES for n in p.drones]
    found = []
    with (
        multiprocessing.get_context("spawn").Pool(processes) as pool,
        report.progress(NAME, len(rows) * p.seeds) as advance,
    ):
        for n, mode in rows:
            flights = []
            for flight in pool.imap(partial(look, n, mode, p.tracker), range(1, p.seeds + 1)):
                flights.append(flight)
                advance(f"{mode.words}, {n} drones")
            found.append({"mode": mode.words, "drones": n, **summary(n, flights)})
    result = {"tracker": p.tracker, "seeds": p.seeds, "rows": found}
    report.write(out, NAME, result, _markdown(result))
    return result


def summary(n: int, flights: Sequence[Flight]) -> dict[str, Any]:
    """Of one row; intervals over flights."""
    times = np.sort([flight.all_named_s for flight in flights])
    trials = np.full(len(flights), float(n))

    def share(counts: Sequence[int]) -> dict[str, float]:
        return fraction_interval(np.array(counts, dtype=float), trials)._asdict()

    return {
        "all_named_s": {"p50": _quantile(times, 0.5), "p95": _quantile(times, 0.95)},
        "named": share([flight.named for flight in flights]),
        "wrong": share([flight.wrong for flight in flights]),
        "wrong_names": sum(flight.wrong for flight in flights),
        "names": n * len(flights),
    }


def _quantile(times: Array, of: float) -> float:
    """The time that this share does not exceed."""
    return float(times[min(math.ceil(of * len(times)), len(times)) - 1])


def _markdown(result: dict[str, Any]) -> str:
    def percent(interval: dict[str, float]) -> str:
        value, low, high = (100.0 * interval[key] for key in ("value", "low", "high"))
        return f"{value:.1f} ({low:.1f} … {high:.1f})"

    rows = [
        [
            row["mode"],
            str(row["drones"]),
            report.number(row["all_named_s"]["p50"], 1),
            report.number(row["all_named_s"]["p95"], 1),
            percent(row["named"]),
            f"{row['wrong_names']} of {row['names']}",
            percent(row["wrong"]),
        ]
        for row in result["rows"]
    ]
    header = ["known", "drones", "all named, s: median", "95 %", "named, %", "wrong", "wrong, %"]
    return "\n\n".join(
        [
            "# Without a word on the air",
            f"{result['seeds']} flights a row, tracker `{result['tracker']}`, one observer, teammates at "
            f"{RANGE_M[0]:g} to {RANGE_M[1]:g} m in a wind that moves them by {WIND_M:g} m; 95 % intervals "
            "over flights.",
            report.table(header, rows),
        ]
    )
