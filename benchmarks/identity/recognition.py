"""Who is who over many flights: the Monte Carlo of `virtual_swarm`, judged as `swarmtrack sim` judges.

Crossing, hiding and swinging drones, each seed a flight of its own; shares with 95 % intervals over flights. In
`parted` the drones of `crossing` hear only their own side from `PARTED_S` on, and see only the other. What only
processes, clocks and radios can spoil is not in it: that is `swarmtrack bench swarm`.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from swarmtrack.benchmarks.harness import PROCESSES, TRACKER, Flights, Row, scenarios, seeds
from swarmtrack.benchmarks.virtual_swarm import ObservedScan, Said, VirtualSwarm
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.scenario import Scenario
from swarmtrack.lab.score.intervals import Interval, mean_interval
from swarmtrack.lab.score.swarm_score import SCORE_HZ, Glance, SwarmScore, SwarmScorer, confirmed_tracks
from swarmtrack.lab.score.swarm_truth import SwarmTruth
from swarmtrack.messages import Array, PeerArrived

SHARES = ("correct", "wrong", "unknown", "agreement")
PARTED = "parted"
SCENARIOS = ("hover-triangle", "crossing", PARTED, "occlusion", "fast-yaw", "late-joiner", "intruder")
DRONES = 4
SECONDS, QUICK_SECONDS = 20.0, 12.0
# s of flight: by then everybody in view has a name.
PARTED_S = 5.0


@dataclass(frozen=True, slots=True)
class Flight:
    """What came of one: the score, how many announcements a drone made, and `SwarmScorer.stated`."""

    score: SwarmScore
    announcements_per_drone: float
    stated: Array


def fly(scenario: str, drones: int, seconds: float, tracker: str, seed: int) -> Flight:
    """One flight, as fast as it computes; the same arguments give the same flight."""
    flown = load_scenario("crossing" if scenario == PARTED else scenario, seed=seed, drones=drones)
    swarm = (PartedSwarm if scenario == PARTED else VirtualSwarm)(flown, tracker=tracker)
    return judge(swarm, flown, seconds)


class PartedSwarm(VirtualSwarm):
    """From `PARTED_S` on the two halves of the team hear nothing of each other."""

    def _deliver(self, sender: int, receiver: int, said: PeerArrived | Said, now: float) -> None:
        half = sorted(self.scenario.members)[: len(self.scenario.members) // 2]
        if now < PARTED_S or (sender in half) == (receiver in half):
            super()._deliver(sender, receiver, said, now)


class SwarmJudge:
    """Judges a virtual swarm's scans as `swarmtrack sim` does, ten times a second of each observer, by the truth of
    `flown`."""

    def __init__(self, swarm: VirtualSwarm, flown: Scenario, seconds: float) -> None:
        self.truth = SwarmTruth(flown.world, flown.cameras)
        self.scorer = SwarmScorer(flown.members, start=0.0, end=seconds)
        self._swarm = swarm
        self._judged: dict[int, int] = {}

    def add_scan(self, scan: ObservedScan, t: float) -> Glance | None:
        """t: of the truth that the scan is compared with [s, world time]; None: this tenth of a second is judged."""
        for drone_id, announced_t in self._swarm.announced_at.items():
            self.scorer.announced(drone_id, announced_t)
            self.scorer.knows(scan.observer, "virtual", drone_id, announced_t)
        index = math.floor(t * SCORE_HZ)
        if self._judged.get(scan.observer) == index:
            return None
        self._judged[scan.observer] = index
        view, tracks = self.truth.view(scan.observer, t), confirmed_tracks(scan.tracks)
        glance = Glance(scan.observer, "virtual", index, t, view.in_view, view.hidden, tracks, view.cameras)
        self.scorer.add(glance)
        return glance


def judge(
    swarm: VirtualSwarm, flown: Scenario, seconds: float, see: Callable[[Glance], None] | None = None
) -> Flight:
    """Let the swarm fly, and judge it by the truth of `flown`. see: told of every glance, once it is judged."""
    judging = SwarmJudge(swarm, flown, seconds)
    for scan in swarm.fly(seconds):
        glance = judging.add_scan(scan, scan.t)
        if glance is not None and see is not None:
            see(glance)
    scorer, announcements = judging.scorer, swarm.announcements / len(flown.members)
    return Flight(scorer.score(), announcements, scorer.stated)


def summary(flights: Sequence[Flight]) -> dict[str, Any]:
    """The columns of one row of the table."""
    scores = [flight.score for flight in flights]
    return {
        **{name: _interval(getattr(score, name) for score in scores)._asdict() for name in SHARES},
        "flights_with_a_wrong_name": sum(score.wrong > 0.0 for score in scores),
        "slowest_to_identify_s": max(s for score in scores for s in score.time_to_identify_s.values()),
        "announcements_per_drone": float(np.mean([flight.announcements_per_drone for flight in flights])),
    }


def _interval(samples: Iterable[float]) -> Interval:
    return mean_interval(np.array([sample for sample in samples if np.isfinite(sample)]))


def _percent(name: str) -> Callable[[dict[str, Any]], str]:
    """An interval of means may reach beyond what a share can be."""

    def cell(row: dict[str, Any]) -> str:
        value, low, high = (100.0 * row[name][key] for key in ("value", "low", "high"))
        return f"{value:.2f} ({max(low, 0.0):.2f} … {min(high, 100.0):.2f})"

    return cell


def _seconds(args: argparse.Namespace) -> float:
    return QUICK_SECONDS if args.quick else SECONDS


BENCH = Flights(
    name="recognition",
    title="Who is who over many flights",
    about="{drones} drones (and strangers), {seconds:g} s, {seeds} seeds a scenario, synthetic detections, tracker "
    "`{tracker}`, no processes; shares of (observer, drone in view, tenth of a second) with 95 % intervals over "
    "flights.",
    seeds=seeds(100, quick=4),
    options=(TRACKER, scenarios(SCENARIOS), PROCESSES),
    rows=lambda args: [
        Row(n, partial(fly, n, DRONES, _seconds(args), args.tracker), summary, {"name": n}, ("scenarios", n))
        for n in args.scenarios
    ],
    facts=lambda args: {
        "tracker": args.tracker,
        "drones": DRONES,
        "seeds": args.seeds,
        "seconds": _seconds(args),
    },
    columns=(
        ("scenario", "{name}"),
        *((f"{share}, %", _percent(share)) for share in SHARES),
        ("flights with a wrong name", "{flights_with_a_wrong_name}"),
        ("slowest to identify, s", "{slowest_to_identify_s:.1f}"),
        ("announcements of a drone", "{announcements_per_drone:.1f}"),
    ),
)
