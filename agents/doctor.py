"""`swarmtrack doctor --config FILE`: why does it not work? One line per check, with what to do."""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from swarmtrack.arguments import add_file, add_flag, add_seconds, page, with_pages
from swarmtrack.log_lines import log_to_stderr

if TYPE_CHECKING:
    from swarmtrack.diagnosis.findings import Finding

DONE, FAILED = 0, 1
SECONDS = 8.0
COLOURS = {"ok": "green", "skipped": "dim", "warning": "yellow", "failure": "bold red"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Find out why a drone does not work: camera, autopilot, calibration, detector, network, keys, disk and heat, "
        "one line each, with the remedy. Turn the drone by hand while the doctor runs: it then compares the camera "
        "with the gyro. Exit code 0: no failure. 1: a failure. 2: the config is wrong."
    )
    add_file(parser, "--config", "the drone's config, TOML", required=True)
    add_seconds(parser, "--seconds", "how long to measure rates (default: %(default)g)", default=SECONDS)
    add_flag(parser, "--json", "print a JSON list of findings instead of lines")


def run(args: argparse.Namespace) -> int:
    from swarmtrack.clock import SystemClock
    from swarmtrack.config.drone import load_config
    from swarmtrack.diagnosis.findings import Level, worst
    from swarmtrack.doctor.examination import examine

    config = load_config(args.config)
    # What sources log as it happens, the findings say at the end.
    log_to_stderr(logging.CRITICAL)
    if not args.json and sys.stderr.isatty():
        print(
            f"Watching for {args.seconds:g} s. Turn the drone by hand about all axes.",
            file=sys.stderr,
        )
    findings = asyncio.run(examine(config, SystemClock(), args.seconds))
    if args.json:
        print(json.dumps([as_record(finding) for finding in findings], indent=1, ensure_ascii=False))
    else:
        show(findings)
    return FAILED if worst(findings) is Level.FAILURE else DONE


def as_record(finding: Finding) -> dict[str, str | None]:
    return {
        "check": finding.check,
        "level": str(finding.level),
        "fault": finding.fault or None,
        "found": finding.found,
        "remedy": finding.remedy or None,
    }


def show(findings: Sequence[Finding]) -> None:
    """Lines for people; in colour, and wrapped, on a terminal only."""
    findings = [replace(one, found=with_pages(one.found), remedy=with_pages(one.remedy)) for one in findings]
    from swarmtrack.diagnosis.findings import as_line

    if not sys.stdout.isatty():
        for finding in findings:
            print(as_line(finding))
        print(verdict(findings))
        return
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2))
    for finding in findings:
        colour = COLOURS[str(finding.level)]
        words = Text(finding.found, style="dim" if finding.level == "skipped" else "")
        if finding.remedy:
            words.append(f"\n→ {finding.remedy}", style="cyan")
        table.add_row(Text(str(finding.level), style=colour), finding.check, words)
    console = Console()
    console.print(table)
    console.print(verdict(findings), style="bold", highlight=False)


def verdict(findings: Sequence[Finding]) -> str:
    """The last line."""
    failures = sum(finding.level == "failure" for finding in findings)
    warnings = sum(finding.level == "warning" for finding in findings)
    if failures == warnings == 0:
        return "All is well."
    counted = [
        f"{n} {word}{'s' if n > 1 else ''}" for n, word in ((failures, "failure"), (warnings, "warning")) if n
    ]
    return f"{' and '.join(counted)}. More on each: {page('troubleshooting.md')}"
