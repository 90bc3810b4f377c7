"""Who is who without a word on the air, by the team's file, by codes, and by both (docs/silent.md).

Everybody's place in the file is off by `slots` metres per axis, or nobody's place is known. Where codes are flown, they
begin `CODE_S` after the observer began to look.

* all named: seconds from the beginning of the code (of the look, where there is none) until each teammate has had its
  right name; infinite where one had not within `SECONDS`. named: the share of teammates that bear it at the end.
* wrong: teammates that ever bore another's name, or were called foreign.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from swarmtrack.benchmarks.harness import (
    PROCESSES,
    TRACKER,
    Flights,
    Row,
    quantile,
    seeds,
    several,
    share,
)
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
from swarmtrack.lab.score.swarm_score import SCORE_HZ, Glance, NamedTrack, SwarmScorer, confirmed_tracks
from swarmtrack.lab.score.swarm_truth import SwarmTruth
from swarmtrack.lab.world.sensors import DetectorParameters
from swarmtrack.lab.world.trajectory import SteadyYaw
from swarmtrack.lab.world.world import World
from swarmtrack.messages import Array
from swarmtrack.runtime.filed import SOMEWHERE_M

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


class Flight(NamedTuple):
    """What came of one: seconds until each teammate was named (inf: never), who was at the end, who was ever wrong."""

    all_named_s: float
    named: int
    wrong: int


def scenario_of_seed(n: int, mode: Mode, seed: int) -> Scenario:
    """An observer, and n teammates that it sees."""
    chance = World(seed, {}).chance("silent layout", n)
    eye = np.array([0.0, 0.0, -HEIGHT_M])
    plans = {OBSERVER: Plan(eye, SteadyYaw(0.0))}
    for drone_id, place in enumerate(_places(n, chance), start=OBSERVER + 1):
        plans[drone_id] = Plan(eye + place, SteadyYaw(math.pi))
    codes_s = (CODE_S,) if mode.code else ()
    world = fly(seed, plans, WIND_M, codes_s=codes_s, team=tuple(plans))
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
    angle = math.atan2(float(np.linalg.norm(np.cross(one, other))), float(one @ other))
    return float(np.linalg.norm(one - other)) > APART_M and angle > APART_RAD


def look(n: int, mode: Mode, tracker: str, seed: int) -> Flight:
    """One flight, as fast as it computes; the same arguments give the same flight."""
    scenario = scenario_of_seed(n, mode, seed)
    swarm = VirtualSwarm(scenario, tracker=tracker, observers=[OBSERVER])
    judge = _Judge(scenario)
    begins = CODE_S if mode.code else 0.0
    for scan in swarm.fly(begins + SECONDS):
        judge.add_scan(scan.exposed_t, confirmed_tracks(scan.tracks))
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

    def add_scan(self, t: float, tracks: tuple[NamedTrack, ...]) -> None:
        view = self._truth.view(OBSERVER, t)
        glance = Glance(OBSERVER, "virtual", math.floor(t * SCORE_HZ), t, view.in_view, view.hidden, tracks)
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


def summary(n: int, flights: Sequence[Flight]) -> dict[str, Any]:
    """Of one row, with n teammates."""
    times = [flight.all_named_s for flight in flights]
    named, wrong = ([getattr(flight, what) for flight in flights] for what in ("named", "wrong"))
    trials = [n] * len(flights)
    return {
        "all_named_s": {"p50": quantile(times, 0.5), "p95": quantile(times, 0.95)},
        "named": share(named, trials),
        "wrong": share(wrong, trials),
        "wrong_names": sum(wrong),
        "names": sum(trials),
    }


def _rows(args: argparse.Namespace) -> list[Row]:
    def row(mode: Mode, n: int) -> Row:
        fly, facts = partial(look, n, mode, args.tracker), {"mode": mode.words, "drones": n}
        return Row(f"{mode.words}, {n} drones", fly, partial(summary, n), facts)

    return [row(mode, n) for mode in MODES for n in args.drones]


BENCH = Flights(
    name="silent",
    title="Without a word on the air",
    about="{seeds} flights a row, tracker `{tracker}`, one observer, teammates at "
    f"{RANGE_M[0]:g} to {RANGE_M[1]:g} m in a wind that moves them by {WIND_M:g} m; 95 % intervals over flights.",
    seeds=seeds(60, quick=4),
    options=(
        TRACKER,
        several("--drones", "teammates in view (default: 3 5 10)", DRONES),
        PROCESSES,
    ),
    rows=_rows,
    facts=lambda args: {"tracker": args.tracker, "seeds": args.seeds},
    columns=(
        ("known", "{mode}"),
        ("drones", "{drones}"),
        ("all named, s: median", "{all_named_s[p50]:.1f}"),
        ("95 %", "{all_named_s[p95]:.1f}"),
        ("named, %", "{named:.1p}"),
        ("wrong", "{wrong_names} of {names}"),
        ("wrong, %", "{wrong:.1p}"),
    ),
)
