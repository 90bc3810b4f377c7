"""Where teammates are in metres, in whole flights: real `Onboard`s with trackers, names and all that teammates say.

Scenarios in the virtual swarm. Every state that bears a name is compared with the truth at the exposure, whether the
name is right or not.

Simulated autopilots are better than agents are told that autopilots are: their headings are within 1° in flight where
1.5° (one sigma) is stated. In rows *errors as stated* each drone has lasting errors of heading, tilt and place beside,
drawn such that all together they are as large as what is stated. In rows *a start 2 m off* the last drone starts 2 m
from where it says.

* range error: |range / truth − 1|, median and 95 %.
* NEES / 6: median and mean over all states, and the mean of its parts: along and across the ray, place and velocity.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from swarmtrack.benchmarks.harness import PROCESSES, Flights, Row, seeds, some_of
from swarmtrack.benchmarks.virtual_swarm import Mistake, VirtualSwarm
from swarmtrack.geometry.pose import Pose
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.score.relative_score import PlaceError, error_of, relative_score
from swarmtrack.lab.world.sensors import EgoParameters
from swarmtrack.lab.world.world import World
from swarmtrack.messages import Array, EgoPose, RelativeState
from swarmtrack.motion.heading import HeadingSigma
from swarmtrack.relative.log_range import across
from swarmtrack.relative.parameters import RelativeParameters

SECONDS = {"crossing": 25.0, "errand": 60.0, "occlusion": 25.0}
DRONES = 3
BEGIN_S = 1.0


class Kind(NamedTuple):
    """share_hz: of the velocities that all tell; 0: none do. stated: errors are drawn as large as they are stated;
    start_off: where the last drone says that it starts less where it does, m."""

    scenario: str
    words: str
    span_known: bool = True
    share_hz: float = 0.0
    stated: bool = False
    start_off: tuple[float, float, float] = (0.0, 0.0, 0.0)


KINDS = tuple(
    kind
    for scenario in SECONDS
    for kind in (
        Kind(scenario, "span unknown", span_known=False),
        Kind(scenario, "span"),
        Kind(scenario, "span, velocities at 5 Hz", share_hz=5.0),
        Kind(scenario, "span, errors as stated", stated=True),
        Kind(scenario, "span, a start 2 m off", start_off=(1.6, -1.2, 0.0)),
    )
)


class Compared(NamedTuple):
    """A state and the truth: error of place, |velocity error| [m/s], and NEES of its parts (4,): place along and across
    the ray, velocity along and across."""

    place: PlaceError
    velocity_m_s: float
    parts: Array


def fly(kind: Kind, seed: int) -> list[Compared]:
    """One flight; the same arguments give the same."""
    scenario = load_scenario(kind.scenario, seed=seed, drones=DRONES)
    wrong = {scenario.members[-1]: Mistake(place_m=kind.start_off)} if any(kind.start_off) else {}
    if kind.stated:
        wrong = {d: as_stated(scenario.world, d) for d in scenario.members}
    span = scenario.world.airframe(scenario.members[0]).span if kind.span_known else None
    swarm = VirtualSwarm(
        scenario,
        share_hz=kind.share_hz or None,
        relative=RelativeParameters(airframe_span_m=span),
        mistakes=wrong,
    )
    found = []
    for scan in swarm.fly(SECONDS[kind.scenario]):
        states = [entry.relative for entry in scan.tracks.tracks if entry.relative is not None]
        if scan.t >= BEGIN_S:
            seen = scenario.world, scan.observer, scenario.body_from_camera, scan.exposed_t
            found += [compared(state, true_state(*seen, state.drone_id)) for state in states]
    return found


def as_stated(world: World, drone_id: int) -> Mistake:
    """Lasting errors, drawn: with those that the simulated autopilot has, as large as agents are told."""
    flown = EgoParameters()
    # An aligned heading's error is uniform between its limits.
    heading = _beside(HeadingSigma().flight, math.radians(flown.aligned_error_deg) / math.sqrt(3.0))
    tilt = _beside(RelativeParameters().tilt_sigma, flown.attitude_sigma)
    place = _beside(EgoPose(0.0, None, np.eye(3)).position_sigma, flown.position_sigma)
    compass, *others = world.chance("errors as stated", drone_id).standard_normal(6).tolist()
    north, east, *off = others
    x, y, z = (place * each for each in off)
    return Mistake(compass=heading * compass, tilt=(tilt * north, tilt * east), place_m=(x, y, z))


def _beside(stated: float, flown: float) -> float:
    """One sigma of what is missing for the stated one."""
    return math.sqrt(stated**2 - flown**2)


def true_state(world: World, observer: int, body_from_camera: Pose, t: float, drone_id: int) -> Array:
    """(6,): where a drone is from the observer's camera, and its velocity less the observer's."""
    own, other = world.flown(observer).motion(t), world.flown(drone_id).motion(t)
    camera = own.position + own.attitude @ body_from_camera.position
    return np.concatenate([other.position - camera, other.velocity - own.velocity])


def compared(state: RelativeState, truth: Array) -> Compared:
    """truth (6,)"""
    stated = np.concatenate([state.position, state.velocity])
    error = stated - truth
    along = truth[None, :3] / np.linalg.norm(truth[:3])
    axes = np.concatenate([along.T, across(along)[0]], axis=1)
    parts = []
    for of in (slice(0, 3), slice(3, 6)):
        e, variance = axes.T @ error[of], np.diag(axes.T @ state.cov[of, of] @ axes)
        squares = e * e / variance
        parts += [squares[0], squares[1:].mean()]
    return Compared(error_of(stated, state.cov, truth), float(np.linalg.norm(error[3:])), np.array(parts))


def summary(flights: Sequence[Sequence[Compared]]) -> dict[str, Any]:
    """Of one row."""
    states = [state for flight in flights for state in flight]
    if not states:
        return {"states": 0}
    score = relative_score([state.place for state in states])
    return {
        "states": score.samples,
        "range_error": {"p50": score.range_p50, "p95": score.range_p95},
        "rmse_m": score.rmse_m,
        "velocity_rmse_m_s": float(np.sqrt(np.mean([state.velocity_m_s**2 for state in states]))),
        "nees6": {"median": score.nees6_median, "mean": score.nees6_mean},
        "nees_parts": np.mean([state.parts for state in states], axis=0).tolist(),
    }


def _rows(args: argparse.Namespace) -> list[Row]:
    kinds = [kind for kind in KINDS if kind.scenario in args.scenarios]
    facts = [{"scenario": kind.scenario, "known": kind.words} for kind in kinds]
    words = [f"{kind.scenario}, {kind.words}" for kind in kinds]
    return [Row(w, partial(fly, kind), summary, f) for w, kind, f in zip(words, kinds, facts, strict=True)]


BENCH = Flights(
    name="relative-flights",
    title="Where teammates are, in whole flights",
    about="{seeds} flights a row, {drones} drones. Truth against every state that bears a name.",
    seeds=seeds(20, quick=2),
    options=(some_of("--scenarios", SECONDS), PROCESSES),
    rows=_rows,
    facts=lambda args: {"seeds": args.seeds, "drones": DRONES},
    columns=(
        ("scenario", "{scenario}"),
        ("known", "{known}"),
        ("states", "{states}"),
        ("range error, %: median", "{range_error[p50]:.1p}"),
        ("95 %", "{range_error[p95]:.1p}"),
        ("RMSE, m", "{rmse_m:.2f}"),
        ("velocity, m/s", "{velocity_rmse_m_s:.2f}"),
        ("NEES / 6: median", "{nees6[median]:.2f}"),
        ("mean", "{nees6[mean]:.2f}"),
        (
            "of place along, across, velocity along, across",
            " ".join(f"{{nees_parts[{k}]:.2f}}" for k in range(4)),
        ),
    ),
)
