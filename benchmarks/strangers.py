"""Strangers that a team locates together, in whole flights: real `Onboard`s with trackers, names and each other's rays.

Scenario `visitor` in the virtual swarm. Every place of a stranger that two or more drones see is compared with the
truth at the exposure, for each drone that knows of it. Two claims by Remote ID reach all drones: a true one from
`TRUE_CLAIM_S` on, and from `FALSE_CLAIM_S` on one that flies where nothing is, in view.

In the row *errors as stated* each drone has lasting errors of heading, tilt and place as large as it states them
(`relative_flights.as_stated`); simulated autopilots are better.

* error: of the position, as a share of its distance, median and 95 %.
* NEES / 3: median and mean.
* one number: flights in which from `AGREED_S` on all drones have one stranger, and all the same.
* teammate called stranger: the longest time that a track of a teammate has had a stranger's number, or a stranger that
  several drones see has been at the place of a teammate; and in how many flights that was longer than a second.
* true, false claim: in how many flights it was found to be a stranger's, or false; and after how many s by the first
  drone, median and most. Misjudged: by any drone.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from swarmtrack.benchmarks.harness import PROCESSES, Flights, Row, quantile, seeds
from swarmtrack.benchmarks.relative_flights import as_stated
from swarmtrack.benchmarks.virtual_swarm import ObservedScan, VirtualSwarm
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.scenario import Scenario
from swarmtrack.lab.score.swarm_truth import SwarmTruth
from swarmtrack.messages import Array, RemoteIdClaim

SCENARIO, SECONDS = "visitor", 36.0
AGREED_S, TRUE_CLAIM_S, FALSE_CLAIM_S = 20.0, 14.0, 22.0
# From the true stranger, m: in view of all three, and nearer to none of them.
FALSE_CLAIM_OFF_M = (2.0, 7.0, 0.5)
CLAIM_SIGMA_M, CLAIM_PERIOD_S = 1.5, 1.0
# m: a stranger within this of a teammate, and not of the true one, is taken for it; px: so a track is of a drone.
AT_MATE_M, OF_DRONE_PX = 1.0, 15.0
LONGEST_CALLED_S = 1.0


@dataclass(slots=True)
class Flight:
    """What came of one: errors as a share of the distance, NEES / 3, the numbers in use from `AGREED_S` on, the longest
    time [s] that a teammate was called a stranger, and by claim after how many s each drone judged it how."""

    errors: list[float] = field(default_factory=list)
    nees3: list[float] = field(default_factory=list)
    numbers: set[int] = field(default_factory=set)
    called_s: float = 0.0
    fits_after: list[float] = field(default_factory=list)
    false_after: list[float] = field(default_factory=list)
    misjudged: int = 0


class _Called:
    """Since when which teammate is called a stranger by which drone, s."""

    def __init__(self) -> None:
        self.longest = 0.0
        self._since: dict[tuple[int, int], float] = {}

    def add(self, observer: int, mates: set[int], t: float) -> None:
        self._since = {
            key: since for key, since in self._since.items() if key[0] != observer or key[1] in mates
        }
        for mate in mates:
            self.longest = max(self.longest, t - self._since.setdefault((observer, mate), t))


def fly(stated: bool, seed: int) -> Flight:
    """One flight; the same arguments give the same."""
    scenario = load_scenario(SCENARIO, seed=seed)
    wrong = {d: as_stated(scenario.world, d) for d in scenario.members} if stated else {}
    swarm, truth = VirtualSwarm(scenario, mistakes=wrong), SwarmTruth(scenario.world, scenario.cameras)
    found, called, claimed_t = Flight(), _Called(), -math.inf
    for scan in swarm.fly(SECONDS):
        if scan.t - claimed_t >= CLAIM_PERIOD_S:
            claimed_t = scan.t
            for claim in _claims(scenario, scan.t):
                for drone_id in scenario.members:
                    swarm.onboard(drone_id).tell(claim)
        _compare(found, scenario, scan)
        called.add(scan.observer, _mates_called(swarm, truth, scan), scan.t)
    found.called_s = called.longest
    for _, news in swarm.remote_ids:
        begun = TRUE_CLAIM_S if news.uas_id == "true" else FALSE_CLAIM_S
        right = (news.number is not None) == (news.uas_id == "true")
        (found.fits_after if news.uas_id == "true" else found.false_after).append(news.t - begun)
        found.misjudged += not right
    return found


def _stranger(scenario: Scenario, t: float) -> tuple[Array, Array]:
    """(3,) m and (3,) m/s."""
    motion = scenario.world.flown(min(scenario.strangers)).motion(t)
    return motion.position, motion.velocity


def _claims(scenario: Scenario, t: float) -> list[RemoteIdClaim]:
    position, velocity = _stranger(scenario, t)
    off = scenario.world.chance("claims", round(t)).normal(0.0, CLAIM_SIGMA_M, 3)
    claims = []
    if t >= TRUE_CLAIM_S:
        claims.append(RemoteIdClaim(t, "true", position + off, velocity, CLAIM_SIGMA_M, CLAIM_SIGMA_M))
    if t >= FALSE_CLAIM_S:
        there = position + np.array(FALSE_CLAIM_OFF_M) * [1.0, -np.sign(position[1]), 1.0]
        claims.append(RemoteIdClaim(t, "false", there, velocity, CLAIM_SIGMA_M, CLAIM_SIGMA_M))
    return claims


def _compare(found: Flight, scenario: Scenario, scan: ObservedScan) -> None:
    position, _ = _stranger(scenario, scan.exposed_t)
    observer = scenario.world.pose(scan.observer, scan.exposed_t).position
    for one in scan.strangers:
        if len(one.observers) < 2:
            continue
        off = one.position - position
        found.errors.append(float(np.linalg.norm(off) / np.linalg.norm(position - observer)))
        found.nees3.append(float(off @ np.linalg.solve(one.cov[:3, :3], off)) / 3.0)
        if scan.t >= AGREED_S:
            found.numbers.add(one.number)


def _mates_called(swarm: VirtualSwarm, truth: SwarmTruth, scan: ObservedScan) -> set[int]:
    """The teammates that a drone calls strangers."""
    scenario = swarm.scenario
    numbers = swarm.onboard(scan.observer).stranger_numbers
    boxes = truth.view(scan.observer, scan.exposed_t).in_view
    called = set()
    for entry in scan.tracks.tracks:
        if entry.track.id in numbers:
            apart = {d: float(np.linalg.norm(box[:2] - entry.track.mean[::2])) for d, box in boxes.items()}
            drone = min(apart, key=lambda d: apart[d], default=0)
            if drone in scenario.members and apart[drone] < OF_DRONE_PX:
                called.add(drone)
    position, _ = _stranger(scenario, scan.exposed_t)
    for one in scan.strangers:
        if len(one.observers) > 1 and np.linalg.norm(one.position - position) > AT_MATE_M:
            for drone in scenario.members:
                there = scenario.world.pose(drone, scan.exposed_t).position
                if np.linalg.norm(one.position - there) < AT_MATE_M:
                    called.add(drone)
    return called


def summary(flights: Sequence[Flight]) -> dict[str, Any]:
    """The columns of one row."""
    errors = np.concatenate([flight.errors for flight in flights])
    nees = np.concatenate([flight.nees3 for flight in flights])
    judged = [min(flight.false_after) for flight in flights if flight.false_after]
    fits = [min(flight.fits_after) for flight in flights if flight.fits_after]
    return {
        "places": len(errors),
        "error": {"p50": quantile(errors, 0.5), "p95": quantile(errors, 0.95)},
        "nees3": {"median": quantile(nees, 0.5), "mean": float(nees.mean())},
        "one_number": sum(len(flight.numbers) == 1 for flight in flights),
        "flights": len(flights),
        "called_s": max(flight.called_s for flight in flights),
        "called": sum(flight.called_s > LONGEST_CALLED_S for flight in flights),
        "true_found": sum(bool(flight.fits_after) for flight in flights),
        "true_after_s": {"p50": quantile(fits, 0.5), "most": quantile(fits, 1.0)},
        "false_found": sum(bool(flight.false_after) for flight in flights),
        "false_after_s": {"p50": quantile(judged, 0.5), "most": quantile(judged, 1.0)},
        "misjudged": sum(flight.misjudged for flight in flights),
    }


def _rows(args: argparse.Namespace) -> list[Row]:
    del args
    words = {"as simulated": False, "errors as stated": True}
    return [Row(word, partial(fly, stated), summary, {"errors_of": word}) for word, stated in words.items()]


BENCH = Flights(
    name="strangers",
    title="Strangers located by the team",
    about="{seeds} flights a row, scenario `visitor`, {seconds:g} s, three drones, velocities told.",
    seeds=seeds(40, quick=2),
    options=(PROCESSES,),
    rows=_rows,
    facts=lambda args: {"seeds": args.seeds, "seconds": SECONDS},
    columns=(
        ("autopilots' errors", "{errors_of}"),
        ("places", "{places}"),
        ("error, % of the distance: median, 95 %", "{error[p50]:.1p}, {error[p95]:.1p}"),
        ("NEES / 3: median, mean", "{nees3[median]:.2f}, {nees3[mean]:.2f}"),
        ("one number", "{one_number} of {flights}"),
        ("teammate called stranger, at most s", "{called_s:.1f}"),
        ("… in flights longer than 1 s", "{called}"),
        ("true claim found", "{true_found} of {flights}"),
        ("after, s", "{true_after_s[p50]:.1f}, {true_after_s[most]:.1f}"),
        ("false claim found", "{false_found} of {flights}"),
        ("after, s", "{false_after_s[p50]:.1f}, {false_after_s[most]:.1f}"),
        ("claims misjudged", "{misjudged}"),
    ),
)
