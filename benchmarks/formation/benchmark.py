"""Flying in formation by what each drone sees, the loop closed: how far off slots, how near to each other, who is lost.

Whole flights in one process (`flights.py`): real trackers, names, places in metres, law and barrier; an ArduPilot's
measured response; oracle detections at 6.7 Hz, 150 ms late, with misses, noise and clutter. The leader flies a
square, then off, a quarter turn, and stops.

    swarmtrack bench formation [--flights NAME …] [--seeds N] [--quick] --out DIR
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.command_line import add_common, add_processes, add_seeds
from swarmtrack.benchmarks.formation.flights import (
    COMMAND_HZ,
    DEPARTS_S,
    LAST_S,
    LOST_M,
    NEAR_M,
    FlightPlan,
    FlightSample,
    FormationFlight,
)
from swarmtrack.formation.setpoint import Why
from swarmtrack.messages import Array

NAME = "formation"
SEEDS, QUICK_SEEDS = 100, 2
# s that an intruder is in view before it counts.
SEEN_S = 1.0
GONE_S, GONE_ENDS_S = 22.0, 32.0
INTRUDED_ENDS_S = 32.0
SIZE = {"share_hz": 0.0, "size_drone": 0.10, "sure": 0.95}
FLIGHTS = {
    plan.name: plan
    for plan in (
        FlightPlan(name="star-3", drones=3),
        FlightPlan(name="star-5", drones=5),
        FlightPlan(name="star-8", drones=8, gap_m=7.0),
        FlightPlan(name="star-3-size", drones=3, **SIZE),
        FlightPlan(name="star-5-size", drones=5, **SIZE),
        FlightPlan(name="star-5-late", drones=5, latency_s=0.3),
        FlightPlan(name="star-5-flat", drones=5, layer_m=0.0),
        FlightPlan(name="leader-lost", drones=4, gone_s=GONE_S, ends_s=GONE_ENDS_S),
        FlightPlan(
            name="intruder-1", drones=3, speed_m_s=0.0, intruder_m_s=1.0, ends_s=INTRUDED_ENDS_S + 8.0
        ),
        FlightPlan(name="intruder-2", drones=3, speed_m_s=0.0, intruder_m_s=2.0, ends_s=INTRUDED_ENDS_S),
    )
}


@dataclass(frozen=True, slots=True)
class FlownFormation:
    """One flight. errors (m, n - 1) m: of the places relative to the leader's, while it flies; last (n - 1,) m: their
    means at the end; nearest [m]: of all pairs at any time; held: share of the time in which a follower held; gone: how
    fast the fastest follower was 1, 2, 3, 4 s after the leader vanished [m/s], and how far the farthest flew on [m]."""

    seed: int
    errors: Array
    last: Array
    nearest: float
    held: float
    gone: tuple[float, ...] = ()


def fly(name: str, seed: int) -> FlownFormation:
    """One flight, from its name in `FLIGHTS`."""
    plan = FLIGHTS[name]
    flight = FormationFlight(plan, seed)
    samples = flight.run()
    positions, t = np.array([sample.positions for sample in samples]), np.array([s.t for s in samples])
    slots = np.array(list(flight.slots.values()))
    off = positions[:, : plan.drones] - slots
    errors = np.linalg.norm(off[:, 1:] - off[:, :1], axis=2)
    flying = (t >= DEPARTS_S) & (t < plan.gone_s)
    pairs = combinations(range(plan.drones), 2)
    nearest = min(float(np.linalg.norm(positions[:, i] - positions[:, j], axis=1).min()) for i, j in pairs)
    if plan.intruder_m_s:
        # It meets the first follower. Who has not seen it for a second, because somebody hid it, cannot keep clear.
        met = np.linalg.norm(positions[:, 1] - positions[:, plan.drones], axis=1)
        seen = np.cumsum([sample.intruder_seen for sample in samples]) > SEEN_S * COMMAND_HZ
        nearest = min(nearest, float(met[seen].min(initial=math.inf)))
    whys = [why for sample, flies in zip(samples, flying, strict=True) if flies for why in sample.whys]
    return FlownFormation(
        seed,
        errors[flying],
        errors[t > t[-1] - LAST_S].mean(axis=0),
        nearest,
        sum(why is not Why.FOLLOW for why in whys) / max(len(whys), 1),
        _after_it_vanished(samples, plan.gone_s) if math.isfinite(plan.gone_s) else (),
    )


def _after_it_vanished(samples: Sequence[FlightSample], gone_s: float) -> tuple[float, ...]:
    t = np.array([sample.t for sample in samples])
    speeds = [
        float(samples[int(np.searchsorted(t, gone_s + later))].speeds[1:].max())
        for later in (1.0, 2.0, 3.0, 4.0)
    ]
    begun = samples[int(np.searchsorted(t, gone_s))].positions[1:]
    flown_on = float(np.linalg.norm(samples[-1].positions[1:] - begun, axis=1).max())
    return (*speeds, flown_on)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_common(parser)
    add_seeds(parser, SEEDS, QUICK_SEEDS)
    add_processes(parser)
    parser.add_argument(
        "--flights", nargs="+", choices=list(FLIGHTS), default=list(FLIGHTS), metavar="NAME",
        help=f"which of {', '.join(FLIGHTS)} (default: all)",
    )  # fmt: skip


def run(args: argparse.Namespace) -> None:
    seeds = args.seeds or (QUICK_SEEDS if args.quick else SEEDS)
    publish(args.out, args.flights, seeds, args.processes or os.cpu_count() or 1)


def publish(out: Path, names: Sequence[str], seeds: int, processes: int) -> dict[str, Any]:
    """Fly, write formation.json and .md into `out`, and return what is in the JSON."""
    rows = []
    with report.progress(NAME, len(names) * seeds) as advance, ProcessPoolExecutor(processes) as pool:
        for name in names:
            flown = []
            for flight in pool.map(fly, [name] * seeds, range(seeds)):
                flown.append(flight)
                advance(name)
            rows.append(_row(name, flown))
            # As far as it has come: hours of flights are not lost with the last of them.
            report.write(out, NAME, {"rows": rows}, _markdown(rows))
    return {"rows": rows}


def _row(name: str, flown: Sequence[FlownFormation]) -> dict[str, Any]:
    errors = np.concatenate([flight.errors.ravel() for flight in flown])
    last = np.array([flight.last for flight in flown])
    nearest = np.array([flight.nearest for flight in flown])
    row: dict[str, Any] = {
        "flight": name,
        "drones": FLIGHTS[name].drones,
        "runs": len(flown),
        "error_m": {
            "p50": _percentile(errors, 50),
            "p95": _percentile(errors, 95),
            "end_p95": _percentile(last, 95),
        },
        "min_separation_m": float(nearest.min()),
        "runs_below_1.5_m": int((nearest < NEAR_M).sum()),
        "runs_with_a_lost_follower": int((last > LOST_M).any(axis=1).sum()),
        "held_share": float(np.mean([flight.held for flight in flown])),
    }
    gone = np.array([flight.gone for flight in flown if flight.gone])
    if len(gone):
        row["leader_gone"] = {
            "worst_speed_m_s_after_1_2_3_4_s": gone[:, :4].max(axis=0).tolist(),
            "flown_on_m": {"p50": _percentile(gone[:, 4], 50), "max": float(gone[:, 4].max())},
        }
    return row


def _percentile(values: Array, share: float) -> float:
    return float(np.percentile(values, share)) if values.size else math.nan


def _markdown(rows: Iterable[dict[str, Any]]) -> str:
    rows = list(rows)
    header = [
        "flight", "runs", "error p50, p95 m", "end p95 m", "smallest separation m", "runs below 1.5 m",
        "runs with a lost follower", "held",
    ]  # fmt: skip
    cells = [
        [
            row["flight"],
            str(row["runs"]),
            f"{row['error_m']['p50']:.2f}, {row['error_m']['p95']:.2f}",
            f"{row['error_m']['end_p95']:.2f}",
            f"{row['min_separation_m']:.2f}",
            str(row["runs_below_1.5_m"]),
            str(row["runs_with_a_lost_follower"]),
            f"{row['held_share']:.1%}",
        ]
        for row in rows
    ]
    lines = [
        f"{row['flight']}: the fastest follower after 1, 2, 3, 4 s: "
        + ", ".join(f"{speed:.2f}" for speed in row["leader_gone"]["worst_speed_m_s_after_1_2_3_4_s"])
        + f" m/s; flown on {row['leader_gone']['flown_on_m']['p50']:.1f} m, at most "
        f"{row['leader_gone']['flown_on_m']['max']:.1f} m."
        for row in rows
        if "leader_gone" in row
    ]
    return "\n\n".join(["# Formation by sight", report.table(header, cells), *lines])
