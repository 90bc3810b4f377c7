"""Errands over many flights: is the camera's clock found, who is who among ghosts, and how soon again?

The scenario `errand` in the virtual swarm. Each seed flies with a team of another size, at another frame rate, and each
camera stamps late by another time, −80 … 80 ms. Every `TWIN_EVERY`th flight is flown again by drones that are told how
late their cameras stamp: what the price of not knowing it is. `--rendered` flies small teams at few frames per second,
once: every frame is drawn, with houses, poles and trees all around, and the agent's own detector looks at it.

* adopted: each value that a camera clock settled on because it was found. Off: further than 3 of its own σ then.
* found: seconds from the drone's first turn until what is used is within 3 ms of the truth, and stays so to the end.
* turning, calm: distance of the true drone to the nearest track within `NEAR_PX`, root mean square, by whether the
  drone moves by more than 100 px/s in the image; after the offset has been found for good, and over the whole flight.
* named again: a teammate that had been named was out of view for `AWAY_S` and is in view again: seconds from its first
  detection to its name. One that leaves earlier is no chance missed if it stayed below `GRACE`.
* wrong names: as `swarmtrack sim` counts them, ten times a second, by what was there when the camera exposed.
  Elsewhere: of all names on tracks, scan by scan, those that are more than `NEAR_PX` from their drone: on a house, or
  on a track that coasts out of view. On something that is detected: on a house, or on another drone. These are no wrong
  names to the scorer as long as their drone has no track of its own.
* NIS: over what the filter expects, every `NIS_EVERY_S` seconds in the air.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from swarmtrack.arguments import count
from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.errands.judge import FlightJudge, FlightRecord
from swarmtrack.benchmarks.harness import (
    PROCESSES,
    TRACKER,
    Benchmark,
    flag,
    flown,
    option,
    quantile,
    seeds,
    share,
    shares,
)
from swarmtrack.benchmarks.virtual_swarm import Eyes, VirtualSwarm
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.scenario import Scenario

NAME = "errand"
SEEDS = 100
DRONES = (2, 3, 4)
LATEST_S = 0.080  # of a camera's stamps
FPS = (6.0, 15.0)
RENDERED_DRONES, RENDERED_FPS = (2, 3), (5.0, 7.0)  # drawing and detecting cost 30 ms per frame
IMU_HZ = 100.0  # as slow as autopilots' links often are
TWIN_EVERY = 4  # flights
IN_TIME_S = 30.0  # from the first turns


@dataclass(frozen=True, slots=True, kw_only=True)
class Programme:
    """Which flights."""

    seeds: int = SEEDS
    drones: tuple[int, ...] = DRONES
    ghosts: bool = True
    rendered: bool = False
    tracker: str = "mbm"


def scenario_of_seed(p: Programme, seed: int) -> Scenario:
    """The team's size, the frame rate and the cameras' offsets are the seed's."""
    scenario = load_scenario(NAME, seed=seed, drones=p.drones[seed % len(p.drones)])
    chance = scenario.world.chance("errand bench")
    late = {d: float(chance.uniform(-LATEST_S, LATEST_S)) for d in scenario.members}
    fps = float(chance.uniform(*(RENDERED_FPS if p.rendered else FPS)))
    return replace(
        scenario,
        camera_offset_s=late,
        cameras=tuple(replace(camera, fps=fps) for camera in scenario.cameras),
        imu_rate_hz=IMU_HZ,
        ghosts=scenario.ghosts if p.ghosts and not p.rendered else (),
    )


def fly(p: Programme, told: bool, seed: int) -> FlightRecord:
    """One flight, as fast as it computes; the same arguments give the same flight. told: see `VirtualSwarm`."""
    scenario = scenario_of_seed(p, seed)
    eyes = _eyes(scenario) if p.rendered else None
    swarm = VirtualSwarm(scenario, tracker=p.tracker, eyes=eyes, camera_clocks_told=told)
    judge = FlightJudge(scenario, swarm)
    for scan in swarm.fly(scenario.seconds):
        judge.add_scan(scan)
    return judge.record(seed, scenario.fps)


def _eyes(scenario: Scenario) -> Eyes:
    # What draws and detects takes 80 MB, which flights without pictures do not pay.
    from swarmtrack.benchmarks.rendered_eyes import rendered_eyes  # noqa: PLC0415

    return rendered_eyes(scenario)


def _measured(args: argparse.Namespace) -> dict[str, Any]:
    drones = tuple(args.drones or (RENDERED_DRONES if args.rendered else DRONES))
    p = Programme(
        seeds=args.seeds,
        drones=drones,
        ghosts=not args.no_ghosts,
        rendered=args.rendered,
        tracker=args.tracker,
    )
    found: list[list[FlightRecord]] = []
    for told, numbers in ((False, range(1, p.seeds + 1)), (True, twins_of(p))):
        words = "clocks told" if told else "clocks to be found"
        found += flown(NAME, [(words, partial(fly, p, told))], numbers, processes=args.processes)
    return {**asdict(p), **summary(*found)}


def twins_of(p: Programme) -> range:
    """The seeds that are flown again."""
    return range(0) if p.rendered else range(1, p.seeds + 1, TWIN_EVERY)


def summary(flights: Sequence[FlightRecord], twins: Sequence[FlightRecord]) -> dict[str, Any]:
    """All figures; twins: the flights of some of these seeds with clocks that were told."""
    clocks = [list(flight.clocks.values()) for flight in flights]
    every = [clock for of_flight in clocks for clock in of_flight]
    adopted = [a for clock in every for a in clock.adopted]
    off = [[a.off for clock in of_flight for a in clock.adopted] for of_flight in clocks]
    after = [clock.found_after_s for clock in every]
    again = [s for flight in flights for s in flight.named_again_s]
    nis = np.array([value for flight in flights for value in flight.nis])
    scores = [flight.score for flight in flights]
    samples, names = [score.samples for score in scores], [flight.names for flight in flights]
    return {
        "offset": {
            "adopted": len(adopted),
            "off_by_3_sigma": share(
                [sum(of_flight) for of_flight in off], [len(of_flight) for of_flight in off]
            ),
            "largest_error_ms": 1e3 * max((abs(a.error_s) for a in adopted), default=math.nan),
            "rms_error_ms": 1e3 * _root([a.error_s**2 for a in adopted]),
            "never_adopted": sum(not clock.adopted for clock in every) / len(every),
            "found_within_30_s": float(np.mean([s <= IN_TIME_S for s in after])),
            "found_after_s": {"p50": quantile(after, 0.5), "p90": quantile(after, 0.9)},
        },
        "turning": _ratios(flights, twins),
        "names": {
            "right": float(np.nansum([score.correct * score.samples for score in scores]) / sum(samples)),
            **shares(scores, "wrong"),
            "elsewhere": share([flight.names_elsewhere for flight in flights], names),
            "on_others": share([flight.names_on_others for flight in flights], names),
            "on_others_max_probability": float(
                np.fmax.reduce([flight.surest_on_others for flight in flights])
            ),
            "wrong_max_probability": float(np.fmax.reduce([score.wrong_max_probability for score in scores])),
            # Also those with a name on a thing while its drone is behind: to be flown again by themselves.
            "seeds_with_a_wrong_name": [
                f.seed for f in flights if not math.isnan(f.score.wrong_max_probability)
            ],
            "announcements_per_drone": float(np.mean([f.announcements_per_drone for f in flights])),
        },
        "named_again": {
            "times": len(again),
            "p50_s": quantile(again, 0.5),
            "p95_s": quantile(again, 0.95),
            "never": sum(math.isinf(s) for s in again),
        },
        "nis": {
            "p5": quantile(nis, 0.05),
            "p50": quantile(nis, 0.5),
            "p95": quantile(nis, 0.95),
            "within_0.7_to_1.4": float(np.mean((nis > 0.7) & (nis < 1.4))),
        },
    }


def _ratios(flights: Sequence[FlightRecord], twins: Sequence[FlightRecord]) -> dict[str, Any]:
    """Root mean squares of the flights that were flown twice, and of their twins."""
    by_seed = {flight.seed: flight for flight in flights}
    pairs = [(by_seed[twin.seed], twin) for twin in twins]
    found: dict[str, Any] = {"flights": len(pairs)}
    for name in ("turning", "calm"):
        mine = _root([s for flight, _ in pairs for s in getattr(flight.settled, name)])
        all_of_mine = _root([s for flight, _ in pairs for s in getattr(flight.whole, name)])
        theirs = _root([s for _, twin in pairs for s in getattr(twin.whole, name)])
        found[name] = {
            "told_px": theirs,
            "found_px": mine,
            "whole_px": all_of_mine,
            "ratio": mine / theirs,
            "whole_ratio": all_of_mine / theirs,
        }
    return found


def _root(squares: Sequence[float]) -> float:
    return math.sqrt(float(np.mean(squares))) if len(squares) else math.nan


# What was found, and what is to hold.
ROWS: tuple[tuple[str, str, str], ...] = (
    ("adopted offsets further off than 3 of their own σ", "{offset[off_by_3_sigma]:.2p%}", "≤ 1 %"),
    ("largest error of an adopted offset, ms", "{offset[largest_error_ms]:.1f}", "≤ 15"),
    ("root mean square of them, ms", "{offset[rms_error_ms]:.2f}", ""),
    ("clocks that adopted nothing", "{offset[never_adopted]:.0p} %", ""),
    ("right to 3 ms within 30 s of the first turns, to the end", "{offset[found_within_30_s]:.0p} %", ""),
    ("seconds until then, median", "{offset[found_after_s][p50]:.1f}", "30"),
    ("turning, px: found, told", "{turning[turning][found_px]:.2f}, {turning[turning][told_px]:.2f}", ""),
    (
        "turning, ratio once found, over all",
        "{turning[turning][ratio]:.2f}, {turning[turning][whole_ratio]:.2f}",
        "≤ 1.5",
    ),
    ("calm, ratio once found", "{turning[calm][ratio]:.2f}", ""),
    ("right names", "{names[right]:.1p} %", ""),
    ("wrong names", "{names[wrong]:.3p%}", "≤ 0.1 %"),
    ("names more than 35 px from their drone", "{names[elsewhere]:.3p%}", ""),
    ("of these on something that is detected", "{names[on_others]:.3p%}", ""),
    ("highest probability of one of these", "{names[on_others_max_probability]:.4f}", ""),
    ("highest probability of a wrong name", "{names[wrong_max_probability]:.4f}", ""),
    ("seeds with a wrong name", "{seeds}", ""),
    ("announcements of a drone", "{names[announcements_per_drone]:.1f}", ""),
    ("named again after, s: median", "{named_again[p50_s]:.2f}", "≤ 0.5"),
    ("named again after, s: p95", "{named_again[p95_s]:.2f}", "≤ 1.5"),
    ("came back, never named again", "{named_again[times]}, {named_again[never]}", ""),
    (
        "NIS over its expectation: p5, median, p95",
        "{nis[p5]:.2f}, {nis[p50]:.2f}, {nis[p95]:.2f}",
        "0.7 … 1.4",
    ),
)


def _page(result: dict[str, Any]) -> str:
    ghosts = "oracle, with ghosts" if result["ghosts"] else "oracle, without ghosts"
    seen = "drawn pictures, shipped detector" if result["rendered"] else ghosts
    wrong = ", ".join(map(str, result["names"]["seeds_with_a_wrong_name"])) or "none"
    # None of turning where no flight has a twin to be compared with.
    shown = [row for row in ROWS if result["turning"]["flights"] or "turning[" not in row[1]]
    cells = [[what, report.filled(found, {**result, "seeds": wrong}), hold] for what, found, hold in shown]
    return report.page(
        "# Errands over many flights",
        f"{result['seeds']} flights, teams of {', '.join(map(str, result['drones']))} drones, {seen}, tracker "
        f"`{result['tracker']}`; cameras that stamp late by −80 … 80 ms. 95 % intervals over flights.",
        report.table(["", "found", "to hold"], cells),
    )


BENCH = Benchmark(
    NAME,
    _measured,
    _page,
    options=(
        TRACKER,
        seeds(SEEDS, quick=4),
        option(
            "--drones", "in turn (default: 2 3 4, or 2 3 where rendered)", type=count, nargs="+", metavar="N"
        ),
        flag("--no-ghosts", "a detector that takes nothing for a drone twice"),
        flag("--rendered", "drawn pictures and the shipped detector; no ghosts but houses, poles and trees"),
        PROCESSES,
    ),
)
add_arguments, run = BENCH.add_arguments, BENCH.run
