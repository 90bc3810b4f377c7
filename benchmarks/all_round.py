"""Names with several cameras per drone: whole flights in virtual time, and what seams cost (docs/cameras.md).

A drone is *at a seam* of an observer while two of its cameras see it, and for `SEAM_S` after a crossing: the one that
saw it no longer does, and another one sees it. It is *nameless* where no confirmed track has its name, from `GRACE`
after it came into view.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from swarmtrack.benchmarks.harness import PROCESSES, TRACKER, Flights, Row, scenarios, seeds, share, shares
from swarmtrack.benchmarks.identity import recognition
from swarmtrack.benchmarks.virtual_swarm import VirtualSwarm
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.scenario import Scenario
from swarmtrack.lab.score.swarm_score import GRACE, Glance, SwarmScore

SCENARIOS = ("all-round", "two-cameras")
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

    def add_glance(self, glance: Glance) -> None:
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
    score = recognition.judge(swarm, flown, seconds, watch.add_glance).score
    at_seams, elsewhere = ((watch.samples[where], watch.nameless[where]) for where in (True, False))
    return Flight(score, watch.crossings, at_seams, elsewhere)


def summary(flights: Sequence[Flight]) -> dict[str, Any]:
    """The columns of one row of the table."""
    scores = [flight.score for flight in flights]
    at_seams, elsewhere = (
        np.array([getattr(flight, where) for flight in flights]) for where in ("at_seams", "elsewhere")
    )
    return {
        **shares(scores, "correct", "wrong", "unknown"),
        "samples": sum(score.samples for score in scores),
        "crossings": sum(flight.crossings for flight in flights),
        "nameless_at_seams": share(at_seams[:, 1], at_seams[:, 0]),
        "nameless_elsewhere": share(elsewhere[:, 1], elsewhere[:, 0]),
        "false_tracks_per_s": float(np.mean([score.false_tracks_per_s for score in scores])),
        "switches": sum(score.switches for score in scores),
        "worst_rmse_px": max(px for score in scores for px in score.rmse_px.values()),
    }


def _seconds(args: argparse.Namespace) -> float:
    return QUICK_SECONDS if args.quick else SECONDS


BENCH = Flights(
    name="all-round",
    title="Names with several cameras",
    about="{seeds} flights of {seconds:g} s per row, synthetic detections, tracker `{tracker}`, no processes; "
    "shares with 95 % intervals over flights.",
    seeds=seeds(20, quick=2),
    options=(TRACKER, scenarios(SCENARIOS), PROCESSES),
    rows=lambda args: [
        Row(n, partial(fly, n, _seconds(args), args.tracker), summary, {"name": n}, ("scenarios", n))
        for n in args.scenarios
    ],
    facts=lambda args: {"seeds": args.seeds, "seconds": _seconds(args), "tracker": args.tracker},
    columns=(
        ("scenario", "{name}"),
        ("right, %", "{correct:.3p}"),
        ("wrong, %", "{wrong:.3p}"),
        ("unknown, %", "{unknown:.3p}"),
        ("crossings", "{crossings}"),
        ("nameless at seams, %", "{nameless_at_seams:.3p}"),
        ("nameless elsewhere, %", "{nameless_elsewhere:.3p}"),
        ("false tracks per s", "{false_tracks_per_s:.4f}"),
        ("switches", "{switches}"),
        ("worst RMSE, px", "{worst_rmse_px:.2f}"),
    ),
)
