"""Names with several cameras per drone: whole flights in virtual time, and what seams cost.

Everybody's real `Onboard` flies `all-round` (four cameras each) and `two-cameras`, judged as `swarmtrack sim` judges. A
drone is *at a seam* of an observer while two of its cameras see it, and for `SEAM_S` after the one that saw it no
longer does and another one sees it: a crossing. It is *nameless* where no confirmed track has its name, from `GRACE`
after it came into view.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.command_line import (
    add_common,
    add_processes,
    add_scenarios,
    add_seeds,
    add_tracker,
)
from swarmtrack.benchmarks.identity import recognition
from swarmtrack.benchmarks.virtual_swarm import VirtualSwarm
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.scenario import Scenario
from swarmtrack.lab.score.intervals import fraction_interval
from swarmtrack.lab.score.swarm_score import GRACE, Glance, SwarmScore

NAME = "all-round"
SCENARIOS = ("all-round", "two-cameras")
SEEDS, QUICK_SEEDS = 20, 2
# s: of a flight; at a seam after a crossing.
SECONDS, QUICK_SECONDS = 30.0, 12.0
SEAM_S = 1.0


@dataclass(frozen=True, slots=True)
class Flight:
    """What came of one. at_seams, elsewhere: of so many (observer, drone in view, tenth of a second), and nameless of
    these."""

    score: SwarmScore
    crossings: int
    at_seams: tuple[int, int]
    elsewhere: tuple[int, int]


@dataclass(slots=True)
class _InView:
    """One drone, as an observer's cameras see it. Times are world seconds. camera: that which has seen it for
    longest."""

    since: float
    camera: int
    crossed_at: float = -np.inf


@dataclass(slots=True)
class SeamWatch:
    """Takes glances as they come, each observer's in order, and counts who has no name, at seams and elsewhere."""

    scenario: Scenario
    crossings: int = 0
    samples: dict[bool, int] = field(default_factory=lambda: {True: 0, False: 0})
    """At seams, and elsewhere."""
    nameless: dict[bool, int] = field(default_factory=lambda: {True: 0, False: 0})
    _views: dict[tuple[int, int], _InView] = field(default_factory=dict)

    def see(self, glance: Glance) -> None:
        names = {track.identity for track in glance.tracks or ()}
        for key in [key for key in self._views if key[0] == glance.observer]:
            if key[1] not in glance.in_view:
                del self._views[key]
        for drone_id in glance.in_view:
            cameras = self.seen_by(glance, drone_id)
            first = min(cameras, default=0)
            view = self._views.setdefault((glance.observer, drone_id), _InView(glance.t, first))
            if cameras and view.camera not in cameras:
                self.crossings += 1
                view.camera, view.crossed_at = first, glance.t
            if glance.t - view.since < GRACE or glance.t < GRACE:
                continue
            at_seam = len(cameras) > 1 or glance.t - view.crossed_at < SEAM_S
            self.samples[at_seam] += 1
            self.nameless[at_seam] += drone_id not in names

    def seen_by(self, glance: Glance, drone_id: int) -> frozenset[int]:
        """Which cameras have the drone's centre in their pictures."""
        found = set()
        for number, camera in enumerate(self.scenario.cameras):
            box = glance.box(drone_id, number)
            low, high = camera.lens.ideal_bounds
            if box is not None and ((box[:2] > low) & (box[:2] < high)).all():
                found.add(number)
        return frozenset(found)


def fly(scenario: str, seconds: float, tracker: str, seed: int) -> Flight:
    """One flight, as fast as it computes; the same arguments give the same flight."""
    flown = load_scenario(scenario, seed=seed)
    watch = SeamWatch(flown)
    swarm = VirtualSwarm(flown, tracker=tracker)
    score = recognition.judge(swarm, flown, seconds, watch.see).score
    at_seams, elsewhere = ((watch.samples[where], watch.nameless[where]) for where in (True, False))
    return Flight(score, watch.crossings, at_seams, elsewhere)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_common(parser)
    add_tracker(parser)
    add_seeds(parser, SEEDS, QUICK_SEEDS)
    add_scenarios(parser, SCENARIOS)
    add_processes(parser)


def run(args: argparse.Namespace) -> None:
    publish(
        args.out,
        seeds=args.seeds or (QUICK_SEEDS if args.quick else SEEDS),
        seconds=QUICK_SECONDS if args.quick else SECONDS,
        scenarios=args.scenarios,
        tracker=args.tracker,
        processes=args.processes,
    )


def publish(
    out: Path,
    *,
    seeds: int,
    seconds: float,
    scenarios: Sequence[str],
    tracker: str,
    processes: int | None = None,
) -> dict[str, Any]:
    """Fly everything, write all-round.json and all-round.md into `out` after each scenario."""
    found: dict[str, Any] = {}
    result = {"seeds": seeds, "seconds": seconds, "tracker": tracker, "scenarios": found}
    with (
        multiprocessing.get_context("spawn").Pool(processes) as pool,
        report.progress(NAME, len(scenarios) * seeds) as advance,
    ):
        for scenario in scenarios:
            flights = []
            for flight in pool.imap(partial(fly, scenario, seconds, tracker), range(1, seeds + 1)):
                flights.append(flight)
                advance(scenario)
            found[scenario] = summary(flights)
            report.write(out, NAME, result, _markdown(result))
    return result


def summary(flights: Sequence[Flight]) -> dict[str, Any]:
    """The columns of one row of the table."""
    scores = [flight.score for flight in flights]
    samples = np.array([score.samples for score in scores], dtype=float)

    def share(of: str) -> dict[str, float]:
        hits = np.nan_to_num([getattr(score, of) for score in scores]) * samples
        return fraction_interval(hits, samples)._asdict()

    def nameless(where: str) -> dict[str, float]:
        trials, hits = np.array([getattr(flight, where) for flight in flights], dtype=float).T
        return fraction_interval(hits, trials)._asdict()

    return {
        **{of: share(of) for of in ("correct", "wrong", "unknown")},
        "samples": int(samples.sum()),
        "crossings": sum(flight.crossings for flight in flights),
        "nameless_at_seams": nameless("at_seams"),
        "nameless_elsewhere": nameless("elsewhere"),
        "false_tracks_per_s": float(np.mean([score.false_tracks_per_s for score in scores])),
        "switches": sum(score.switches for score in scores),
        "worst_rmse_px": max(px for score in scores for px in score.rmse_px.values()),
    }


def _markdown(result: dict[str, Any]) -> str:
    def percent(interval: dict[str, float]) -> str:
        value, low, high = (100.0 * interval[key] for key in ("value", "low", "high"))
        return f"{value:.3f} ({low:.3f} … {high:.3f})"

    rows = [
        [
            name,
            percent(found["correct"]),
            percent(found["wrong"]),
            percent(found["unknown"]),
            str(found["crossings"]),
            percent(found["nameless_at_seams"]),
            percent(found["nameless_elsewhere"]),
            report.number(found["false_tracks_per_s"], 4),
            str(found["switches"]),
            report.number(found["worst_rmse_px"], 2),
        ]
        for name, found in result["scenarios"].items()
    ]
    header = [
        "scenario", "right, %", "wrong, %", "unknown, %", "crossings", "nameless at seams, %",
        "nameless elsewhere, %", "false tracks per s", "switches", "worst RMSE, px",
    ]  # fmt: skip
    return "\n\n".join(
        [
            "# Names with several cameras",
            f"{result['seeds']} flights of {result['seconds']:g} s per row, synthetic detections, tracker "
            f"`{result['tracker']}`, no processes; shares with 95 % intervals over flights.",
            report.table(header, rows),
        ]
    )
