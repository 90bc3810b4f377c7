"""What tracking and an agent cost, beside another checkout: both are timed by turns, in processes of their own.

Machines are shared and their clocks vary, so a figure of yesterday says little; the ratio of two figures from one run
says much. Of each figure the least of the rounds is shown: whatever disturbs a round only adds to it.
Who is first changes from round to round.

    swarmtrack bench cost --beside ../swarmtrack-before [--quick] --out DIR
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import swarmtrack
from swarmtrack.arguments import add_folder
from swarmtrack.benchmarks import cost_probe, report
from swarmtrack.benchmarks.command_line import add_common
from swarmtrack.benchmarks.report import BenchmarkError

NAME = "cost"
HERE = Path(swarmtrack.__file__).resolve().parents[1]
# What is probed, and how much of it: scans, and seconds of flight.
USUAL, QUICK = {"trackers": 200, "agent": 10}, {"trackers": 30, "agent": 3}
ROUNDS = 6

Figures = dict[str, float]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_common(parser)
    add_folder(parser, "--beside", "another checkout, timed by turns with this one")


def run(args: argparse.Namespace) -> None:
    publish(args.out, args.beside, USUAL if not args.quick else QUICK, 1 if args.quick else ROUNDS)


def publish(out: Path, beside: Path | None, amounts: dict[str, int], rounds: int) -> dict[str, Any]:
    """cost.json and cost.md into `out`; returns what is in the first."""
    checkouts = [path for path in (beside, HERE) if path is not None]
    found: dict[Path, list[Figures]] = {path: [] for path in checkouts}
    with report.progress(NAME, rounds * len(amounts) * len(checkouts)) as advance:
        for turn in range(rounds):
            for kind, amount in amounts.items():
                for path in checkouts if turn % 2 == 0 else checkouts[::-1]:
                    found[path].append(probed(path, kind, amount))
                    advance(kind)
    of_each = [_least(found[path]) for path in checkouts]
    here, before = of_each[-1], of_each[0] if beside is not None else None
    result: dict[str, Any] = {"here": here, "beside": before}
    report.write(out, NAME, result, _markdown(here, before))
    return result


def probed(checkout: Path, kind: str, amount: int) -> Figures:
    """What `cost_probe` finds in a checkout."""
    command = [sys.executable, "-P", cost_probe.__file__, kind, str(amount)]
    environment = os.environ | {"PYTHONPATH": str(checkout.resolve())}
    answer = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if answer.returncode:
        raise BenchmarkError(f"cost: {kind} of {checkout} failed: {answer.stderr.strip()[-500:]}")
    figures: Figures = json.loads(answer.stdout.splitlines()[-1])
    return figures


def _least(rounds: list[Figures]) -> Figures:
    names = dict.fromkeys(name for figures in rounds for name in figures)
    return {name: min(figures[name] for figures in rounds if name in figures) for name in names}


def _markdown(here: Figures, before: Figures | None) -> str:
    if before is None:
        rows = [[name, f"{value:.3g}"] for name, value in here.items()]
        return "\n\n".join(["# Cost", report.table(["", "here"], rows)])
    rows = [
        [name, f"{before[name]:.3g}", f"{value:.3g}", f"{value / before[name]:.2f}"]
        for name, value in here.items()
    ]
    return "\n\n".join(["# Cost", report.table(["", "beside", "here", "here / beside"], rows)])
