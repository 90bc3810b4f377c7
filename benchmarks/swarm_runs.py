"""Whole local swarms, flown and judged as by `swarmtrack sim`: do they know each other, and what does it cost?

Two experiments, every run with real processes, one run after the other because two would share the cores:

* recognition: four drones that cross, hide behind each other and swing their views; many seeds, oracle detector.
* size: the same scenario and the same rates with 3, 10 and 30 drones: how long from the last agent's start until all
  have everybody's announcement, and what an agent sends for it, its memory and its share of a core.

    swarmtrack bench swarm [--seeds 20] [--scenarios NAME …] --out DIR
"""

from __future__ import annotations

import argparse
import asyncio
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.command_line import add_common, add_seeds, add_tracker
from swarmtrack.errors import SwarmtrackError
from swarmtrack.lab.score.swarm_verdict import SwarmReport
from swarmtrack.lab.swarm.flight import FlightPlan, fly
from swarmtrack.lab.swarm.table import NoTable

NAME = "swarm"
MAX_WRONG = 0.001  # of all judged views of a scenario: the claim
MAX_ALL_KNOWN_S = 5.0  # after the last start: the claim


@dataclass(frozen=True, slots=True, kw_only=True)
class Programme:
    """Which swarms fly, for how long."""

    scenarios: Sequence[str] = ("crossing", "occlusion", "fast-yaw")
    drones: int = 4
    seeds: int = 20
    seconds: float = 20.0
    size_scenario: str = "thirty"
    sizes: Sequence[int] = (3, 10, 30)
    size_seconds: float = 15.0


QUICK = Programme(seeds=1, seconds=8.0, sizes=(3, 10), size_seconds=8.0)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_common(parser)
    add_tracker(parser)
    add_seeds(parser, Programme().seeds, QUICK.seeds)
    scenarios = Programme().scenarios
    parser.add_argument(
        "--scenarios", nargs="+", choices=scenarios, metavar="NAME",
        help=f"which of {', '.join(scenarios)}, and no other swarms (default: all, and swarms of many sizes)",
    )  # fmt: skip


def run(args: argparse.Namespace) -> None:
    programme = QUICK if args.quick else Programme()
    if args.seeds is not None:
        programme = replace(programme, seeds=args.seeds)
    if args.scenarios is not None:
        programme = replace(programme, scenarios=args.scenarios, sizes=())
    publish(args.out, programme, tracker=args.tracker)


def publish(out: Path, p: Programme, *, tracker: str) -> dict[str, Any]:
    """Fly everything, write swarm.json and swarm.md into `out`, and return what is in the JSON."""
    flights = len(p.scenarios) * p.seeds + len(p.sizes)
    with report.progress("swarms", flights) as advance:
        lost: list[str] = []

        def fly_all(plans: Iterable[FlightPlan]) -> list[SwarmReport]:
            return [one for plan in plans if (one := _fly(plan, advance, lost)) is not None]

        recognition = {
            name: fly_all(
                FlightPlan(name, p.drones, p.seconds, seed, tracker, "oracle")
                for seed in range(1, p.seeds + 1)
            )
            for name in p.scenarios
        }
        sized = fly_all(FlightPlan(p.size_scenario, n, p.size_seconds, 1, tracker, "oracle") for n in p.sizes)
        sizes = {one.drones: one for one in sized}
    result = {
        "tracker": tracker,
        "seconds": p.seconds,
        "lost": lost,
        "recognition": {name: _recognition(runs) for name, runs in recognition.items()},
        "sizes": {str(n): _size(one) for n, one in sizes.items()},
        "runs": [one.as_record() for runs in recognition.values() for one in runs]
        + [one.as_record() for one in sizes.values()],
    }
    report.write(out, NAME, result, _markdown(p, result))
    return result


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


def _markdown(p: Programme, result: dict[str, Any]) -> str:
    sizes = [
        f"Scenario `{p.size_scenario}` with its rates, {p.size_seconds:g} s; means over the agents.",
        _size_table(result["sizes"]),
    ]
    return "\n\n".join(
        [
            "# Local swarms",
            f"{p.drones} drones, {p.seconds:g} s, {p.seeds} seeds a scenario, `--detector oracle`, tracker"
            f" `{result['tracker']}`; shares of all (observer, drone in view, tenth of a second).",
            _recognition_table(result["recognition"]),
            *(sizes if p.sizes else []),
            *(f"Lost: {line}" for line in result["lost"]),
        ]
    )


def _recognition_table(by_scenario: dict[str, dict[str, Any]]) -> str:
    header = [
        "scenario", "passed", "correct", "wrong", "unknown", "agreement, worst run", "slowest to identify, s",
        "worst RMSE, px", "switches a run", f"wrong ≤ {MAX_WRONG:g}",
    ]  # fmt: skip
    rows = [
        [
            name,
            f"{found['passed']} of {found['runs']}",
            f"{found['correct']:.4f}",
            f"{found['wrong']:.5f}",
            f"{found['unknown']:.4f}",
            report.number(found["worst_run_agreement"], 4),
            report.number(found["slowest_to_identify_s"], 1),
            report.number(found["worst_rmse_px"]),
            f"{found['switches_per_run']:.1f}",
            "holds" if found["ok"] else "**fails**",
        ]
        for name, found in by_scenario.items()
    ]
    return report.table(header, rows)


def _size_table(by_size: dict[str, dict[str, Any]]) -> str:
    header = [
        "drones", "all announcements known, s after the last start", "bytes of one announcement",
        "bytes announced by a drone", "RSS, MB", "CPU, % of a core", "correct", "wrong",
        f"known ≤ {MAX_ALL_KNOWN_S:g} s",
    ]  # fmt: skip
    rows = [
        [
            n,
            report.number(found["all_known_s"], 1),
            str(found["announcement_bytes"]),
            f"{found['announced_bytes_per_drone']:.0f}",
            f"{found['rss_mb']:.0f}",
            f"{found['cpu_percent']:.1f}",
            f"{found['correct']:.4f}",
            f"{found['wrong']:.5f}",
            "holds" if found["ok"] else "**fails**",
        ]
        for n, found in by_size.items()
    ]
    return report.table(header, rows)
