"""Names when a drone is configured wrongly before it takes off: who is wrong, how surely, and who says so.

Four drones in the virtual swarm, the real `Onboard`. One thing is wrong in each row: two drones stand on each other's
pads, everybody stands on the next one's, a compass or a camera's mounting is turned, a start was measured wrongly. Of
these the team knows nothing. Its configs state `--sigma` metres for every start and nothing for the heading.

* right, wrong, unknown: as `swarmtrack sim` counts them; wrong with a 95 % interval over flights.
* later: right from `LATER_S` of flight on, once each drone has had the time to find out.
* surest: the highest probability that was stated with a wrong name.
* said: of the drones concerned, those that said that their own start or heading is wrong; after: seconds from when the
  first teammate came into their view, median and most. Falsely: drones that said so and are right.
* of names stated with 0.95 to 0.99, how many are right; `reliability.md` has that of all rows together, by probability.
* `--plot`: the probability of each kind of fault, of every drone in each row's first flight.
"""

from __future__ import annotations

import argparse
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from swarmtrack.arguments import positive
from swarmtrack.benchmarks import harness, report
from swarmtrack.benchmarks.harness import (
    PROCESSES,
    TRACKER,
    Flights,
    flag,
    option,
    quantile,
    seeds,
    shares,
    some_of,
)
from swarmtrack.benchmarks.identity import recognition
from swarmtrack.benchmarks.virtual_swarm import Mistake, VirtualSwarm
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.scenario import AnnouncedStart, Scenario
from swarmtrack.lab.score.swarm_score import Glance, SwarmScore, SwarmScorer
from swarmtrack.messages import Array

DRONES = 4
SECONDS = {"crossing": 20.0, "hover-triangle": 20.0, "errand": 30.0}
# m: what the shipped configs state.
SIGMA = 0.1
VICTIM = 1
# s of flight: from then on a drone has had the time to find out; in `errand` the last one takes off at 12 s.
LATER_S = {"crossing": 10.0, "hover-triangle": 10.0, "errand": 13.0}
COMPASS_DEG = (5.0, 10.0, 20.0, 30.0, 90.0, 180.0)
MOUNTING_DEG = (2.0, 5.0, 10.0, 20.0)
# In the order of `own_errors.ConfigFault`.
FAULT_COLOURS = ("#dddddd", "#cc6677", "#4477aa", "#88ccee", "#ddcc77", "#aa4499")
START_M = (0.3, 0.5, 1.0, 1.5, 3.0, 5.0)
# Of stated probabilities, %: where the rows of the reliability table begin and end.
STATED_PERCENT = (50, 80, 90, 95, 99, 100)


@dataclass(frozen=True, slots=True)
class Row:
    """One thing that is wrong. pads: who stands on whose pad; compass, mounting [rad], start [m]: by how much it is
    off with the drones `of`."""

    name: str
    of: tuple[int, ...] = ()
    pads: Mapping[int, int] = field(default_factory=dict)
    compass: float = 0.0
    mounting: float = 0.0
    start_m: float = 0.0


def rows() -> list[Row]:
    """All of them, first the one in which nothing is wrong."""
    everybody = tuple(range(1, DRONES + 1))
    who = {"one": (VICTIM,), "all": everybody}
    rad = math.radians
    return [
        Row("nothing"),
        Row("pads, two swapped", (1, 2), pads={1: 2, 2: 1}),
        Row("pads, moved on by one", everybody, pads={d: d % DRONES + 1 for d in everybody}),
        *(Row(f"compass, {n} {d:g}°", of, compass=rad(d)) for n, of in who.items() for d in COMPASS_DEG),
        *(Row(f"mounting, one {d:g}°", (VICTIM,), mounting=rad(d)) for d in MOUNTING_DEG),
        *(Row(f"start, {n} {m:g} m", of, start_m=m) for n, of in who.items() for m in START_M),
        *two_at_once(),
    ]


def two_at_once() -> list[Row]:
    """Two things are wrong with one drone, or with one and another."""
    swapped = {1: 2, 2: 1}
    return [
        Row("two: compass 30° and start 3 m of one", (1,), compass=math.radians(30.0), start_m=3.0),
        Row("two: pads swapped, and compasses 30°", (1, 2), pads=swapped, compass=math.radians(30.0)),
        Row("two: pads swapped, and mountings 10°", (1, 2), pads=swapped, mounting=math.radians(10.0)),
        Row("two: pads swapped, and starts 1 m", (1, 2), pads=swapped, start_m=1.0),
    ]


@dataclass(frozen=True, slots=True)
class Flight:
    """What came of one. later: of the end of it alone; said_after: by drone that is wrong and saw others, s, inf where
    it never said so; falsely: how many drones said so that are right."""

    score: SwarmScore
    later: SwarmScore
    said_after: Mapping[int, float]
    falsely: int
    faults: Mapping[int, Sequence[tuple[float, Mapping[str, float]]]]
    """By drone: at each glance, s, the probability of each kind of fault; empty unless it is to be drawn."""
    stated: Array
    """`SwarmScorer.stated`."""


class _Watch:
    """When each drone saw the first teammate, and when it said that it is wrong itself; the score of what comes after
    `LATER_S`; and the faults of which it thinks, if these are to be drawn."""

    def __init__(self, swarm: VirtualSwarm, later_s: float, seconds: float, *, draws: bool) -> None:
        self._swarm = swarm
        self._draws = draws
        self.later = SwarmScorer(swarm.scenario.members, start=later_s, end=seconds)
        self.first_seen: dict[int, float] = {}
        self.said: dict[int, float] = {}
        self.faults: defaultdict[int, list[tuple[float, Mapping[str, float]]]] = defaultdict(list)

    def add_glance(self, glance: Glance) -> None:
        if glance.in_view:
            self.first_seen.setdefault(glance.observer, glance.t)
        onboard = self._swarm.onboard(glance.observer)
        if self._draws:
            self.faults[glance.observer].append((glance.t, onboard.by_fault()))
        if onboard.self_doubt:
            self.said.setdefault(glance.observer, glance.t)
        for drone_id, t in self._swarm.announced_at.items():
            self.later.announced(drone_id, t)
        self.later.add(glance)


def misplaced(scenario: Scenario, row: Row) -> Scenario:
    """The scenario with the starts that the drones' configs state; its world stays what it is."""

    def stated(drone_id: int) -> AnnouncedStart:
        told = scenario.announced[row.pads.get(drone_id, drone_id)]
        if drone_id not in row.of or not row.start_m:
            return told
        bearing = scenario.world.chance("misplaced", drone_id).uniform(0.0, 2.0 * math.pi)
        off = row.start_m * np.array([math.cos(bearing), math.sin(bearing), 0.0])
        return replace(told, position_m=np.asarray(told.position_m) + off)

    return replace(scenario, announced={drone_id: stated(drone_id) for drone_id in scenario.announced})


def fly(
    row: Row,
    scenario: str,
    sigma_m: float,
    tracker: str,
    seed: int,
    *,
    share_hz: float | None = None,
    draws: bool = False,
) -> Flight:
    """One flight, as fast as it computes; the same arguments give the same flight. share_hz: how often each says how it
    moves, None: never. draws: keep what is drawn."""
    flown = load_scenario(scenario, seed=seed, drones=DRONES)
    told = {d: replace(start, position_sigma_m=sigma_m) for d, start in flown.announced.items()}
    flown = misplaced(replace(flown, announced=told), row)
    mistakes = dict.fromkeys(row.of, Mistake(row.compass, row.mounting))
    swarm = VirtualSwarm(flown, tracker=tracker, mistakes=mistakes, share_hz=share_hz)
    watch = _Watch(swarm, LATER_S[scenario], SECONDS[scenario], draws=draws)
    judged = recognition.judge(swarm, flown, SECONDS[scenario], watch.add_glance)
    after = {
        d: max(watch.said.get(d, math.inf) - max(watch.first_seen[d], swarm.announced_at[d]), 0.0)
        for d in row.of
        if d in watch.first_seen
    }
    falsely = len(watch.said.keys() - set(row.of))
    return Flight(judged.score, watch.later.score(), after, falsely, watch.faults, judged.stated)


def summary(flights: Sequence[Flight]) -> dict[str, Any]:
    """The columns of one row of the table."""
    after = [after for flight in flights for after in flight.said_after.values()]
    surest = [flight.score.wrong_max_probability for flight in flights]
    return {
        **shares([flight.score for flight in flights], "correct", "wrong", "unknown"),
        "later_correct": shares([flight.later for flight in flights], "correct")["correct"],
        "wrong_max_probability": float(np.fmax.reduce(surest)),
        "concerned": len(after),
        "said": sum(math.isfinite(s) for s in after),
        "said_after_s": {"p50": quantile(after, 0.5), "most": quantile(after, 1.0)},
        "falsely": sum(flight.falsely for flight in flights),
        "sure_right": _reliability(flights, 95, 99)["right"],
    }


def _rows(args: argparse.Namespace) -> list[harness.Row]:
    if args.plot:
        report.pyplot()

    def made(scenario: str, row: Row) -> harness.Row:
        one = partial(fly, row, scenario, args.sigma, args.tracker, share_hz=args.share, draws=args.plot)
        place = ("scenarios", scenario, row.name)
        return harness.Row(f"{scenario}: {row.name}", one, summary, {"name": row.name}, place, scenario)

    chosen = [row for row in rows() if not args.rows or any(word in row.name for word in args.rows)]
    return [made(scenario, row) for scenario in args.scenarios for row in chosen]


def _about(result: dict[str, Any]) -> str:
    hz = result["share_hz"]
    return (
        f"{DRONES} drones, {result['seeds']} seeds per row, synthetic detections, tracker `{result['tracker']}`; "
        f"starts stated as ±{result['sigma_m']:g} m; "
        f"{f'motion told {hz:g} times per second' if hz else 'nobody tells how it moves'}."
    )


def _finish(args: argparse.Namespace, flights: dict[str, list[Flight]]) -> None:
    _write_reliability(args.out, [flight for row in flights.values() for flight in row])
    if args.plot:
        _plot(args, flights)


def _write_reliability(out: Path, flights: Sequence[Flight]) -> None:
    table = report.table_of(RELIABILITY, [_reliability(flights, *ends) for ends in pairwise(STATED_PERCENT)])
    (out / "reliability.md").write_text(report.page("# Are names as sure as they are stated?", table))


def _reliability(flights: Sequence[Flight], low: int, high: int) -> dict[str, Any]:
    """Of names stated with low to high %."""
    named, right = np.sum([flight.stated[low:high] for flight in flights], axis=(0, 1)).tolist()
    return {"low": low, "high": high, "named": named, "right": right / named if named else math.nan}


RELIABILITY = (
    ("stated, %", "{low} … {high}"),
    ("names, by drone and tenth of a second", "{named}"),
    ("right, %", "{right:.2p}"),
)


def _plot(args: argparse.Namespace, flights: dict[str, list[Flight]]) -> None:
    size, shared = (
        (2.6 * DRONES, 2.0 * len(flights) + 0.8),
        {"sharex": True, "sharey": True, "squeeze": False},
    )
    figure, axes = report.pyplot().subplots(
        len(flights), DRONES, figsize=size, layout="constrained", **shared
    )
    for line, (name, (first, *_)) in zip(axes, flights.items(), strict=True):
        for axis, (drone, faults) in zip(line, sorted(first.faults.items()), strict=False):
            t, p = [t for t, _ in faults], [list(by_fault.values()) for _, by_fault in faults]
            axis.stackplot(t, np.array(p).T, labels=list(faults[0][1]), colors=FAULT_COLOURS)
            axis.set_title(f"{name}: drone {drone}", fontsize=9)
    axes[0, 0].set_xlim(left=0.0)
    axes[0, 0].set_ylim(0.0, 1.0)
    for axis in axes[-1]:
        axis.set_xlabel("t, s")
    for line in axes:
        line[0].set_ylabel("probability")
    labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(*labels, loc="outside lower center", ncols=len(FAULT_COLOURS))
    report.save(figure, args.out / "misconfigured.png")


BENCH = Flights(
    name="misconfigured",
    title="Names when the configuration is wrong",
    about=_about,
    seeds=seeds(100, quick=2),
    options=(
        TRACKER,
        some_of("--scenarios", SECONDS),
        option(
            "--rows", "only rows whose name has one of these in it", nargs="+", metavar="WORD", default=[]
        ),
        option(
            "--sigma", "of every start, m (default: %(default)s)", type=positive, metavar="M", default=SIGMA
        ),
        option(
            "--share", "every drone says so often how it moves (default: never)", type=positive, metavar="HZ"
        ),
        flag("--plot", "draw the probability of each kind of fault: misconfigured.png"),
        PROCESSES,
    ),
    rows=_rows,
    finish=_finish,
    facts=lambda args: {
        "seeds": args.seeds,
        "sigma_m": args.sigma,
        "tracker": args.tracker,
        "share_hz": args.share,
    },
    columns=(
        ("what is wrong", "{name}"),
        ("right, %", "{correct[value]:.1p}"),
        ("later, %", "{later_correct[value]:.1p}"),
        ("wrong, %", "{wrong:.2p}"),
        ("unknown, %", "{unknown[value]:.1p}"),
        ("surest wrong name", "{wrong_max_probability:.4f}"),
        ("said", "{said} of {concerned}"),
        ("after, s", "{said_after_s[p50]:.1f}, {said_after_s[most]:.1f}"),
        ("falsely", "{falsely}"),
        ("of 0.95 … 0.99 right, %", "{sure_right:.1p}"),
    ),
)
