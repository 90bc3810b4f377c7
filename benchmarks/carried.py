"""Own place by teammates: real `Onboard`s with trackers and names, and everything that drones tell each other.

Scenario `gps-denied` in the virtual swarm: four drones, 6 to 12 m apart, tell their velocities; one, the victim, loses
its autopilot's position for a minute, or has one that drifts or is spoofed. In rows *by two*, *by one* and *by none* so
many teammates are in its view from the loss on; of these drone 3, 12 m away, always sees it, and drone 2, 7 m away, is
at the image's border, leaves it for seconds, and looks elsewhere. A liar states a place that leaves the true one by
0.5 m/s, from the loss on, and rays that are 20° off. Widths of boxes err as much as the detector's model says.

* place error: of the stated place against the truth, from 2 s after the loss to its end: median and 95 %, m.
* heading error: of the autopilot's heading as the filter corrects it: 95 %, rad.
* NEES / 3: of the place: median over all comparisons.
* said after: from the loss, or from when the drift began, until the drone says so: median and most, s. Of *by none*:
  until it says that nobody holds it.
* others: by how much the stated places of the others are off at most that do not lose theirs: 95 %, m; and how many of
  them say that they are carried.
* relative: error of named teammates' places as the victim states them: median, m.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from swarmtrack.benchmarks.harness import PROCESSES, Flights, Row, option, quantile, seeds
from swarmtrack.benchmarks.relative_flights import as_stated
from swarmtrack.benchmarks.virtual_swarm import Exposure, ObservedScan, Said, VirtualSwarm, oracle_eyes
from swarmtrack.geometry import rotation
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.scenario import Scenario
from swarmtrack.messages import Array, Detections, EgoPose, PeerArrived, SightingReport
from swarmtrack.relative.box_width import BoxWidth
from swarmtrack.relative.parameters import RelativeParameters

VICTIM, LIAR = 1, 3
LOST_S, FOUND_S = 12.0, 72.0
# s from the loss on that do not count: the autopilot's last place is good for as long.
BEGIN_S = 2.0
DRIFT_M_S = 0.3
SPOOFED_M, SPOOFED_S = 10.0, 20.0
LIE_M_S, LIE_RAD = 0.5, math.radians(20.0)
# px: a detection that is this near to a drone is one of it.
NEAR_PX = 25.0


class Kind(NamedTuple):
    """lost: whose autopilots lose their position; drift [m/s] and until: by which the victim's leaves the truth, and
    for how long [s]; by: the teammates in its view, and that see it, from LOST_S on; lies: whether one teammate does.
    """

    words: str
    lost: tuple[int, ...] = (VICTIM,)
    drift: float = 0.0
    until: float = math.inf
    by: tuple[int, ...] = (2, 3, 4)
    lies: bool = False


KINDS = (
    Kind("gps-denied, by three"),
    Kind("gps-denied, by two", by=(2, 3)),
    Kind("gps-denied, by one", by=(3,)),
    Kind("gps-denied, by one, which does not see it", by=(2,)),
    Kind("gps-denied, by none", by=()),
    Kind("drift of 0.3 m/s", lost=(), drift=DRIFT_M_S),
    Kind("spoofed by 10 m in 20 s", lost=(), drift=SPOOFED_M / SPOOFED_S, until=SPOOFED_S),
    Kind("nobody knows", lost=(1, 2, 3, 4)),
    Kind("gps-denied, and one lies", lies=True),
)


class _BoxErrors:
    """By how much boxes are too wide: each drone's for good, and each observer's of it within seconds."""

    def __init__(self, scenario: Scenario, model: BoxWidth) -> None:
        self._model, self._chance = model, scenario.world.chance("widths of boxes", 0)
        self._lasting = {d: model.drone_sigma * self._chance.standard_normal() for d in scenario.members}
        self._wandering: dict[tuple[int, int], tuple[float, float]] = {}
        """By observer and drone: when it was seen last, s, and the error then."""

    def of(self, observer: int, drone: int, t: float) -> float:
        """The width of a box at t [s], over the true one."""
        seen_t, error = self._wandering.get((observer, drone), (-math.inf, 0.0))
        kept = math.exp((seen_t - t) / self._model.wander_s)
        fresh = math.sqrt(1.0 - kept * kept) * self._model.wander_sigma * self._chance.standard_normal()
        self._wandering[observer, drone] = t, kept * error + fresh
        return math.exp(self._lasting[drone] + kept * error + fresh)


class CarriedSwarm(VirtualSwarm):
    """The virtual swarm in which a row happens."""

    def __init__(self, scenario: Scenario, kind: Kind, seed: int) -> None:
        self._kind = kind
        self._away = np.array([math.cos(seed), math.sin(seed), 0.0])
        self._sees = oracle_eyes(scenario)
        span = scenario.world.airframe(VICTIM).span
        # Simulated autopilots are better than agents are told that autopilots are.
        stated = {drone: as_stated(scenario.world, drone) for drone in scenario.members}
        relative = RelativeParameters(airframe_span_m=span)
        self._widths = _BoxErrors(scenario, relative.box_width)
        super().__init__(scenario, eyes=self._look, relative=relative, mistakes=stated)

    def _pose(self, drone_id: int, index: int) -> EgoPose:
        pose, kind = super()._pose(drone_id, index), self._kind
        if not LOST_S <= pose.t < FOUND_S:
            return pose
        if drone_id in kind.lost:
            return dataclasses.replace(pose, position=None)
        if drone_id == VICTIM and kind.drift:
            assert pose.position is not None
            off = kind.drift * min(pose.t - LOST_S, kind.until)
            return dataclasses.replace(pose, position=pose.position + off * self._away)
        return pose

    def _look(self, seen: Exposure) -> Detections:
        """Without the drones that are to be out of view, with boxes that err as the detector's model says."""
        found, by = self._sees(seen), self._kind.by
        members = self.scenario.members
        hidden = [d for d in members if d not in by] if seen.drone_id == VICTIM else [VICTIM]
        if seen.t < LOST_S or seen.drone_id in by:
            hidden = []
        keep, width = np.ones(len(found), bool), np.ones((len(found), 1))
        camera = self.scenario.cameras[seen.camera]
        own = self.scenario.world.pose(seen.drone_id, seen.t) @ camera.body_from_camera
        for other in members:
            there = own.rotation.T @ (self.scenario.world.pose(other, seen.t).position - own.position)
            if other == seen.drone_id or there[2] < 0.1:
                continue
            is_it = np.linalg.norm(found.centre - camera.lens.project(there[None])[0], axis=1) <= NEAR_PX
            keep &= ~is_it if other in hidden else True
            width[is_it] = self._widths.of(seen.drone_id, other, seen.t)
        return dataclasses.replace(
            found,
            centre=found.centre[keep],
            size=(found.size * width)[keep],
            score=found.score[keep],
            covariance=None if found.covariance is None else found.covariance[keep],
            likeness=None if found.likeness is None else found.likeness[keep],
        )

    def _deliver(self, sender: int, receiver: int, said: PeerArrived | Said, now: float) -> None:
        if self._kind.lies and sender == LIAR and isinstance(said, SightingReport) and said.t > LOST_S:
            turned = rotation.from_euler(0.0, 0.0, LIE_RAD)
            said = dataclasses.replace(
                said,
                position=said.position + LIE_M_S * (said.t - LOST_S) * self._away,
                sightings=tuple(
                    dataclasses.replace(one, direction=turned @ one.direction) for one in said.sightings
                ),
            )
        super()._deliver(sender, receiver, said, now)


@dataclasses.dataclass(slots=True)
class Flight:
    """What came of one: of the victim at each of its scans place error [m], heading error [rad] and NEES / 3; when it
    said so after the loss, s; of the others place errors [m], and how many say that they are carried."""

    places: list[float]
    headings: list[float]
    nees: list[float]
    said_after: float
    others: list[float]
    falsely: int
    relative: list[float]
    sigmas: list[float]


def fly(kind: Kind, seed: int) -> Flight:
    """One flight; the same arguments give the same."""
    scenario = load_scenario("gps-denied", seed=seed)
    swarm = CarriedSwarm(scenario, kind, seed)
    flight = Flight([], [], [], math.inf, [], 0, [], [])
    falsely: set[int] = set()
    for scan in swarm.fly(FOUND_S):
        onboard, t = swarm.onboard(scan.observer), scan.t
        carried = onboard.carried
        said = carried is not None and (not kind.drift or carried.off_m is not None)
        if not kind.by:
            said = carried is not None and not carried.by
        if scan.observer == VICTIM and said and t > LOST_S:
            flight.said_after = min(flight.said_after, t - LOST_S)
        if scan.observer != VICTIM and carried is not None and scan.observer not in kind.lost:
            falsely.add(scan.observer)
        if t < LOST_S + BEGIN_S:
            continue
        _judge(flight, swarm, scan, kind)
    flight.falsely = len(falsely)
    return flight


def _judge(flight: Flight, swarm: CarriedSwarm, scan: ObservedScan, kind: Kind) -> None:
    onboard, world = swarm.onboard(scan.observer), swarm.scenario.world
    pose, true = onboard.ego_pose(scan.t), world.pose(scan.observer, scan.exposed_t)
    if pose is None:
        return
    off = pose.position - true.position
    if scan.observer != VICTIM:
        if scan.observer not in kind.lost:
            flight.others.append(float(np.linalg.norm(off)))
        return
    flight.places.append(float(np.linalg.norm(off)))
    flight.nees.append(float(off @ np.linalg.solve(pose.position_cov, off)) / 3.0)
    flight.sigmas.append(pose.position_sigma)
    turn = 0.0 if onboard.carried is None else onboard.carried.turn
    corrected = rotation.from_euler(0.0, 0.0, turn) @ pose.world_from_body
    flight.headings.append(abs(_heading(true.rotation.T @ corrected)))
    states = [one.relative for one in scan.tracks.tracks if one.relative is not None]
    for state in states:
        eye = true @ swarm.scenario.body_from_camera
        there = world.pose(state.drone_id, scan.exposed_t).position - eye.position
        flight.relative.append(float(np.linalg.norm(state.position - there)))


def summary(flights: Sequence[Flight]) -> dict[str, Any]:
    """The columns of one row of the table."""

    def all_of(name: str) -> list[float]:
        return [value for flight in flights for value in getattr(flight, name)]

    after = [flight.said_after for flight in flights]
    return {
        "place_m": {"p50": quantile(all_of("places"), 0.5), "p95": quantile(all_of("places"), 0.95)},
        "heading_p95": quantile(all_of("headings"), 0.95),
        "nees3": quantile(all_of("nees"), 0.5),
        "sigma_m": quantile(all_of("sigmas"), 0.5),
        "said": sum(math.isfinite(s) for s in after),
        "said_after_s": {"p50": quantile(after, 0.5), "most": quantile(after, 1.0)},
        "others_p95_m": quantile(all_of("others"), 0.95),
        "falsely": sum(flight.falsely for flight in flights),
        "relative_m": quantile(all_of("relative"), 0.5),
        "flights": len(flights),
    }


def _rows(args: argparse.Namespace) -> list[Row]:
    chosen = [kind for kind in KINDS if not args.rows or any(word in kind.words for word in args.rows)]
    return [Row(kind.words, partial(fly, kind), summary, {"kind": kind.words}) for kind in chosen]


BENCH = Flights(
    name="carried",
    title="Own place by teammates",
    about="{seeds} flights a row, four drones, velocities shared at 5 Hz, errors of autopilots and boxes as stated.",
    seeds=seeds(40, quick=1),
    options=(
        option(
            "--rows", "only rows whose name has one of these in it", nargs="+", metavar="WORD", default=[]
        ),
        PROCESSES,
    ),
    rows=_rows,
    facts=lambda args: {"seeds": args.seeds},
    columns=(
        ("what happens", "{kind}"),
        ("place error, m: median", "{place_m[p50]:.2f}"),
        ("95 %", "{place_m[p95]:.2f}"),
        ("stated sigma, m", "{sigma_m:.2f}"),
        ("heading error, 95 %, rad", "{heading_p95:.3f}"),
        ("NEES / 3", "{nees3:.2f}"),
        ("said", "{said} of {flights}"),
        ("after, s", "{said_after_s[p50]:.1f}, {said_after_s[most]:.1f}"),
        ("others, 95 %, m", "{others_p95_m:.2f}"),
        ("falsely carried", "{falsely}"),
        ("teammates, median, m", "{relative_m:.2f}"),
    ),
)


def _heading(matrix: Array) -> float:
    return math.atan2(matrix[1, 0], matrix[0, 0])
