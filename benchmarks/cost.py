"""What parts of a drone cost, beside the budgets of the design; or all of it beside another checkout.

    swarmtrack bench cost [--of agent metres command monitor ros2] [--quick] --out DIR
    swarmtrack bench cost --beside ../swarmtrack-before [--quick] --out DIR

Beside another checkout tracking and an agent are timed by turns, in processes of their own. Machines are shared and
their clocks vary, so a figure of yesterday says little; the ratio of two figures from one run says much. Of each figure
the least of the rounds is shown: whatever disturbs a round only adds to it. Who is first changes from round to round.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import swarmtrack
from swarmtrack.arguments import require_extra
from swarmtrack.benchmarks import cost_probe, figures, report
from swarmtrack.benchmarks.figures import Figure
from swarmtrack.benchmarks.harness import TRACKER, Benchmark, amount, path, some_of
from swarmtrack.benchmarks.report import BenchmarkError

NAME = "cost"
HERE = Path(swarmtrack.__file__).resolve().parents[1]
PARTS = {
    "agent": ("agent_budget", "An agent"),
    "metres": ("relative_cost", "Places in metres"),
    "command": ("formation.command", "A command in formation"),
    "monitor": ("monitor_cost", "Being watched"),
    "ros2": ("ros2_cost", "Being seen by ROS 2"),
}
"""By name the module whose `measured` gives its figures, and whose docstring says what they are of."""
# What is probed, and how much of it: scans, repetitions, and seconds of flight.
USUAL, QUICK = {"trackers": 200, "parts": 200, "agent": 10}, {"trackers": 30, "parts": 30, "agent": 3}
ROUNDS = 6

Probed = dict[str, float]


def _measured(args: argparse.Namespace) -> dict[str, Any]:
    if args.beside is not None:
        return beside(args.beside, QUICK if args.quick else USUAL, 1 if args.quick else ROUNDS)
    if "monitor" in args.of:
        require_extra("dev", "playwright", of="the page in a browser")
    found: dict[str, list[Figure]] = {}
    with report.progress(NAME, len(args.of)) as advance:
        for part in args.of:
            found[part] = import_module(f"swarmtrack.benchmarks.{PARTS[part][0]}").measured(args)
            advance(part)
    return found


def beside(other: Path, amounts: dict[str, int], rounds: int) -> dict[str, Probed]:
    """The figures of this checkout and of another one."""
    checkouts = [other, HERE]
    found: dict[Path, list[Probed]] = {path: [] for path in checkouts}
    with report.progress(NAME, rounds * len(amounts) * len(checkouts)) as advance:
        for turn in range(rounds):
            for kind, much in amounts.items():
                for checkout in checkouts if turn % 2 == 0 else checkouts[::-1]:
                    found[checkout].append(probed(checkout, kind, much))
                    advance(kind)
    return {"here": _least(found[HERE]), "beside": _least(found[other])}


def probed(checkout: Path, kind: str, amount: int) -> Probed:
    """What `cost_probe` finds in a checkout."""
    command = [sys.executable, "-P", cost_probe.__file__, kind, str(amount)]
    environment = os.environ | {"PYTHONPATH": str(checkout.resolve())}
    answer = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if answer.returncode:
        raise BenchmarkError(f"cost: {kind} of {checkout} failed: {answer.stderr.strip()[-500:]}")
    found: Probed = json.loads(answer.stdout.splitlines()[-1])
    return found


def _least(rounds: list[Probed]) -> Probed:
    names = dict.fromkeys(name for found in rounds for name in found)
    return {name: min(found[name] for found in rounds if name in found) for name in names}


def _page(found: dict[str, Any]) -> str:
    if "here" in found:
        pairs = [(name, found["beside"][name], here) for name, here in found["here"].items()]
        rows = [[what, f"{then:.3g}", f"{now:.3g}", f"{now / then:.2f}"] for what, then, now in pairs]
        return report.page("# Cost", report.table(["", "beside", "here", "here / beside"], rows))
    sections = [f"## {PARTS[part][1]}\n\n{figures.table(of_part)}" for part, of_part in found.items()]
    return report.page("# Cost", *sections)


def _record(found: dict[str, Any]) -> dict[str, Any]:
    if "here" in found:
        return found
    return {part: [one.record() for one in of_part] for part, of_part in found.items()}


BENCH = Benchmark(
    NAME,
    _measured,
    _page,
    options=(
        some_of("--of", PARTS),
        TRACKER,
        amount("--states", 1_000_000, 20_000, "random ones that a command is to be sound in"),
        path("--beside", "another checkout, timed by turns with this one"),
    ),
    record=_record,
)
