"""Whole local swarms, flown and judged as by `swarmtrack sim`: do they know each other, and what does it cost?

Two experiments, every run with real processes, one run after the other because two would share the cores:

* recognition: four drones that cross, hide behind each other and swing their views; many seeds, oracle detector.
* size: the same scenario and the same rates with 3, 10 and 30 drones: how long from the last agent's start until all
  have everybody's announcement, and what an agent sends for it, its memory and its share of a core.
"""

from __future__ import annotations

import argparse
import asyncio
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.harness import TRACKER, Benchmark, option, seeds
from swarmtrack.errors import SwarmtrackError
from swarmtrack.lab.score.swarm_verdict import SwarmReport
from swarmtrack.lab.swarm.flight import FlightPlan, fly
from swarmtrack.lab.swarm.table import NoTable

NAME = "swarm"
MAX_WRONG = 0.001  # of all judged views of a scenario: the claim
MAX_ALL_KNOWN_S = 5.0  # after the last start: the claim


SCENARIOS, DRONES = ("crossing", "occlusion", "fast-yaw"), 4
SIZED = "thirty"


# How long flights of the first experiment are, s; how long those of the second, and of how many drones.
USUAL, QUICK = (20.0, 15.0, (3, 10, 30)), (8.0, 8.0, (3, 10))


def _measured(args: argparse.Namespace) -> dict[str, Any]:
    seconds, size_seconds, teams = QUICK if args.quick else USUAL
    names: Sequence[str] = args.scenarios or SCENARIOS
    sizes: Sequence[int] = () if args.scenarios else teams
    with report.progress("swarms", len(names) * args.seeds + len(sizes)) as advance:
        lost: list[str] = []

        def fly_all(plans: Iterable[FlightPlan]) -> list[SwarmReport]:
            return [one for plan in plans if (one := _fly(plan, advance, lost)) is not None]

        recognition = {
            name: fly_all(
                FlightPlan(name, DRONES, seconds, seed, args.tracker, "oracle")
                for seed in range(1, args.seeds + 1)
            )
            for name in names
        }
        sized = fly_all(FlightPlan(SIZED, n, size_seconds, 1, args.tracker, "oracle") for n in sizes)
    return {
        "tracker": args.tracker,
        "seconds": seconds,
        "seeds": args.seeds,
        "size_seconds": size_seconds,
        "lost": lost,
        "recognition": {name: _recognition(runs) for name, runs in recognition.items()},
        "sizes": {str(one.drones): _size(one) for one in sized},
        "runs": [one.as_record() for runs in [*recognition.values(), sized] for one in runs],
    }


def _fly(plan: FlightPlan, advance: Callable[[str], None], lost: list[str]) -> SwarmReport | None:
    """None, and a line in `lost`, where a process died: the other flights are not lost with it."""
    flight = None
    try:
        flight = asyncio.run(fly(plan, NoTable()))
    except SwarmtrackError as error:
        lost.append(f"{plan.scenario}, {plan.drones} drones, seed {plan.seed}: {error}")
    advance(f"{plan.scenario}, seed {plan.seed}")
    return flight


def _recognition(runs: Sequence[SwarmReport]) -> dict[str, Any]:
    """Shares are of the judged views of all runs together."""
    scores = [one.score for one in runs]
    samples = sum(score.samples for score in scores)

    def pooled(name: str) -> float:
        parts = [getattr(score, name) * score.samples for score in scores if score.samples]
        return sum(parts) / samples if samples else math.nan

    times = [seconds for score in scores for seconds in score.time_to_identify_s.values()]
    errors = [rmse for score in scores for rmse in score.rmse_px.values()]
    agreements = [score.agreement for score in scores if math.isfinite(score.agreement)]
    return {
        "runs": len(runs),
        "passed": sum(one.passed for one in runs),
        "samples": samples,
        "correct": pooled("correct"),
        "wrong": pooled("wrong"),
        "unknown": pooled("unknown"),
        "worst_run_wrong": max((score.wrong for score in scores if score.samples), default=math.nan),
        "worst_run_agreement": min(agreements, default=math.nan),
        "slowest_to_identify_s": max(times, default=math.nan),
        "worst_rmse_px": max(errors, default=math.nan),
        "switches_per_run": sum(score.switches for score in scores) / max(len(scores), 1),
        "ok": pooled("wrong") <= MAX_WRONG,
    }


def _size(flight: SwarmReport) -> dict[str, Any]:
    """Means over the agents."""
    agents = flight.agents
    sent = [(agent.announcement_bytes or 0) * agent.announcements_sent for agent in agents]
    return {
        "all_known_s": flight.all_known_s,
        "announcement_bytes": max(agent.announcement_bytes or 0 for agent in agents),
        "announced_bytes_per_drone": sum(sent) / len(sent),
        "rss_mb": sum(agent.rss_mb for agent in agents) / len(agents),
        "cpu_percent": sum(agent.cpu_percent for agent in agents) / len(agents),
        "correct": flight.score.correct,
        "wrong": flight.score.wrong,
        "ok": flight.all_known_s <= MAX_ALL_KNOWN_S,
    }


COLUMNS: report.Columns = (
    ("scenario", "{name}"),
    ("passed", "{passed} of {runs}"),
    ("correct", "{correct:.4f}"),
    ("wrong", "{wrong:.5f}"),
    ("unknown", "{unknown:.4f}"),
    ("agreement, worst run", "{worst_run_agreement:.4f}"),
    ("slowest to identify, s", "{slowest_to_identify_s:.1f}"),
    ("worst RMSE, px", "{worst_rmse_px:.2f}"),
    ("switches a run", "{switches_per_run:.1f}"),
    (f"wrong ≤ {MAX_WRONG:g}", lambda row: report.verdict(row["ok"])),
)
SIZE_COLUMNS: report.Columns = (
    ("drones", "{name}"),
    ("all announcements known, s after the last start", "{all_known_s:.1f}"),
    ("bytes of one announcement", "{announcement_bytes}"),
    ("bytes announced by a drone", "{announced_bytes_per_drone:.0f}"),
    ("RSS, MB", "{rss_mb:.0f}"),
    ("CPU, % of a core", "{cpu_percent:.1f}"),
    ("correct", "{correct:.4f}"),
    ("wrong", "{wrong:.5f}"),
    (f"known ≤ {MAX_ALL_KNOWN_S:g} s", lambda row: report.verdict(row["ok"])),
)


def _page(result: dict[str, Any]) -> str:
    sizes = [
        f"Scenario `{SIZED}` with its rates, {result['size_seconds']:g} s; means over the agents.",
        report.table_by_name(SIZE_COLUMNS, result["sizes"]),
    ]
    return report.page(
        "# Local swarms",
        f"{DRONES} drones, {result['seconds']:g} s, {result['seeds']} seeds a scenario, `--detector oracle`, tracker"
        f" `{result['tracker']}`; shares of all (observer, drone in view, tenth of a second).",
        report.table_by_name(COLUMNS, result["recognition"]),
        *(sizes if result["sizes"] else []),
        *(f"Lost: {line}" for line in result["lost"]),
    )


BENCH = Benchmark(
    NAME,
    _measured,
    _page,
    options=(
        TRACKER,
        seeds(20, quick=1),
        option(
            "--scenarios",
            f"which of {', '.join(SCENARIOS)}, and no other swarms (default: all, and swarms of many sizes)",
            nargs="+",
            choices=SCENARIOS,
            metavar="NAME",
        ),
    ),
)
