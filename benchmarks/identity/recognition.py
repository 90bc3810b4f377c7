"""Who is who over many flights: the Monte Carlo of `virtual_swarm`, judged as `swarmtrack sim` judges.

Crossing, hiding and swinging drones, each seed a flight of its own; shares with 95 % intervals over flights. What only
processes, clocks and radios can spoil is not in it: that is `swarmtrack bench swarm`.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.command_line import add_common, add_tracker
from swarmtrack.benchmarks.virtual_swarm import VirtualSwarm
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.scenario import Scenario
from swarmtrack.lab.score.intervals import Interval, mean_interval
from swarmtrack.lab.score.swarm_score import RATE_HZ, Glance, SwarmScore, SwarmScorer, confirmed_tracks
from swarmtrack.lab.score.swarm_truth import SwarmTruth

NAME = "recognition"
SHARES = ("correct", "wrong", "unknown", "agreement")


@dataclass(frozen=True, slots=True, kw_only=True)
class Programme:
    """Which flights."""

    scenarios: Sequence[str] = (
        "hover-triangle",
        "crossing",
        "occlusion",
        "fast-yaw",
        "late-joiner",
        "intruder",
    )
    drones: int = 4
    seeds: int = 100
    seconds: float = 20.0


QUICK = Programme(seeds=4, seconds=12.0)


@dataclass(frozen=True, slots=True)
class Flight:
    """What came of one: the score, and how many announcements a drone made."""

    score: SwarmScore
    announcements_per_drone: float


def fly(scenario: str, drones: int, seconds: float, tracker: str, seed: int) -> Flight:
    """One flight, as fast as it computes; the same arguments give the same flight."""
    flown = load_scenario(scenario, seed=seed, drones=drones)
    return judge(VirtualSwarm(flown, tracker=tracker), flown, seconds)


def judge(
    swarm: VirtualSwarm, flown: Scenario, seconds: float, see: Callable[[Glance], None] | None = None
) -> Flight:
    """Let the swarm fly, and judge it by the truth of `flown`. see: told of every glance, once it is judged."""
    truth = SwarmTruth(flown.world, flown.cameras)
    scorer = SwarmScorer(flown.members, start=0.0, end=seconds)
    judged: dict[int, int] = {}
    for look in swarm.fly(seconds):
        for drone_id, t in swarm.announced_at.items():
            scorer.announced(drone_id, t)
            scorer.knows(look.observer, "virtual", drone_id, t)
        index = int(np.floor(look.t * RATE_HZ))
        if judged.get(look.observer) == index:
            continue
        judged[look.observer] = index
        view = truth.view(look.observer, look.t)
        tracks = confirmed_tracks(look.tracks)
        glance = Glance(
            look.observer, "virtual", index, look.t, view.in_view, view.hidden, tracks, view.cameras
        )
        scorer.add(glance)
        if see is not None:
            see(glance)
    return Flight(scorer.score(), swarm.announcements / len(flown.members))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_common(parser)
    add_tracker(parser)


def run(args: argparse.Namespace) -> None:
    publish(args.out, QUICK if args.quick else Programme(), tracker=args.tracker)


def publish(out: Path, p: Programme, *, tracker: str) -> dict[str, Any]:
    """Fly everything on all cores, write recognition.json and recognition.md into `out`."""
    found: dict[str, list[Flight]] = {name: [] for name in p.scenarios}
    total = len(p.scenarios) * p.seeds
    with (
        multiprocessing.get_context("spawn").Pool() as pool,
        report.progress(NAME, total) as advance,
    ):
        for name in p.scenarios:
            one = partial(fly, name, p.drones, p.seconds, tracker)
            for flight in pool.imap(one, range(1, p.seeds + 1)):
                found[name].append(flight)
                advance(name)
    result = {
        "tracker": tracker,
        "drones": p.drones,
        "seeds": p.seeds,
        "seconds": p.seconds,
        "scenarios": {name: _summary(flights) for name, flights in found.items()},
    }
    report.write(out, NAME, result, _markdown(result))
    return result


def _summary(flights: Sequence[Flight]) -> dict[str, Any]:
    shares = {name: _interval([getattr(flight.score, name) for flight in flights]) for name in SHARES}
    return {
        **{name: interval._asdict() for name, interval in shares.items()},
        "flights_with_a_wrong_name": sum(flight.score.wrong > 0.0 for flight in flights),
        "slowest_to_identify_s": max(
            seconds for flight in flights for seconds in flight.score.time_to_identify_s.values()
        ),
        "announcements_per_drone": float(np.mean([flight.announcements_per_drone for flight in flights])),
    }


def _interval(samples: Sequence[float]) -> Interval:
    return mean_interval(np.array([sample for sample in samples if np.isfinite(sample)]))


def _markdown(result: dict[str, Any]) -> str:
    def percent(interval: dict[str, float]) -> str:
        value, low, high = (100.0 * interval[key] for key in ("value", "low", "high"))
        return f"{value:.2f} ({max(low, 0.0):.2f} … {min(high, 100.0):.2f})"

    rows = [
        [
            name,
            *(percent(found[share]) for share in SHARES),
            str(found["flights_with_a_wrong_name"]),
            f"{found['slowest_to_identify_s']:.1f}",
            f"{found['announcements_per_drone']:.1f}",
        ]
        for name, found in result["scenarios"].items()
    ]
    header = [
        "scenario", *(f"{share}, %" for share in SHARES), "flights with a wrong name", "slowest to identify, s",
        "announcements of a drone",
    ]  # fmt: skip
    return "\n\n".join(
        [
            "# Who is who over many flights",
            f"{result['drones']} drones (and strangers), {result['seconds']:g} s, {result['seeds']} seeds a scenario, "
            f"synthetic detections, tracker `{result['tracker']}`, no processes; shares of (observer, drone in view, "
            "tenth of a second) with 95 % intervals over flights.",
            report.table(header, rows),
        ]
    )
