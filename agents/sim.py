"""`swarmtrack sim`: a local swarm, one real agent process per drone, and a verdict against the truth."""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import signal
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from swarmtrack.arguments import (
    add_file,
    add_flag,
    add_folder,
    add_seconds,
    add_seed,
    one_of,
    page,
    port,
)
from swarmtrack.errors import SourceError

if TYPE_CHECKING:
    from rich.console import Console

    from swarmtrack.lab.scenarios.scenario import Scenario
    from swarmtrack.lab.score.swarm_verdict import SwarmReport
    from swarmtrack.lab.swarm.detail import Detail
    from swarmtrack.lab.swarm.flight import FlightPlan
    from swarmtrack.lab.swarm.machine_load import Capacity
    from swarmtrack.lab.swarm.page import FlightPage
    from swarmtrack.lab.swarm.table import Spectator

PASSED, FAILED, NOT_JUDGED = 0, 1, 3
DEFAULT_SCENARIO = "hover-triangle"
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class _ListScenarios(argparse.Action):
    """Prints and exits, as --help does."""

    def __call__(self, parser: argparse.ArgumentParser, *arguments: Any) -> None:
        from swarmtrack.lab.scenarios.files import load_scenario, scenario_names

        for name in scenario_names():
            scenario = load_scenario(name)
            print(f"{name:16} {len(scenario.members):3} drones, {scenario.seconds:3g} s: {scenario.about}")
        parser.exit()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported: its threads only cost here
    from swarmtrack.tracking import DEFAULT_TRACKER, TRACKERS

    parser.add_argument(
        "named",
        nargs="?",
        metavar="SCENARIO",
        help=f"scenario: a name from --list, or a file (default: {DEFAULT_SCENARIO})",
    )
    parser.add_argument("--scenario", metavar="NAME|FILE", help="same as SCENARIO")
    add_file(
        parser,
        "--world",
        "instead of a scenario: drones flown in ArduPilot's or PX4's own simulator ("
        + page("rehearse.md")
        + ")",
    )
    parser.add_argument("--list", nargs=0, action=_ListScenarios, help="list the scenarios, then exit")
    parser.add_argument(
        "--drones", type=_drones, metavar="N", help="size of the team (default: the scenario's)"
    )
    add_seconds(parser, "--seconds", "length of the flight (default: the scenario's)")
    add_seed(parser, "random seed (default: 1, or the world file's)", default=None)
    parser.add_argument(
        "--tracker",
        default=DEFAULT_TRACKER,
        type=one_of(TRACKERS, "tracker"),
        metavar="NAME",
        help=f"tracker of all agents: {', '.join(TRACKERS)} (default: %(default)s)",
    )
    parser.add_argument(
        "--detector",
        default="onnx",
        choices=["onnx", "oracle"],
        help="onnx: rendered images, the shipped network; oracle: synthetic detections, for large swarms "
        "(default: %(default)s)",
    )
    parser.add_argument("--team", metavar="NAME", help="name of the team (default: a new random one)")
    parser.add_argument(
        "--detail",
        choices=["auto", "full", "reduced", "low"],
        default="auto",
        help="level of detail: full, the scenario's rates of frames, gyro samples and tracks; reduced, lower rates; "
        "low, the lowest; auto, the highest that this machine can keep up with (default: %(default)s)",
    )
    _add_outputs(parser)


def _add_outputs(parser: argparse.ArgumentParser) -> None:
    """What is written, served and kept."""
    add_file(parser, "--json", "write the verdict and all figures to this file")
    add_folder(parser, "--record", "folder for recordings of all agents, with the truth and the verdict")
    add_flag(parser, "--monitor", "serve the monitor's web page during the flight")
    parser.add_argument(
        "--monitor-port",
        type=port,
        metavar="PORT",
        help="port of the monitor's page on this machine, 0: any free one (default: 0); implies --monitor",
    )
    parser.add_argument(
        "--stay",
        action=argparse.BooleanOptionalAction,
        help="keep the page, with the verdict, after the flight until Ctrl-C (default: only in a terminal); "
        "--stay implies --monitor",
    )
    add_flag(parser, "--keep", "keep the folder with the configs and logs")


def _drones(text: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text) > 1):
        raise argparse.ArgumentTypeError(f"found {text}, expected a whole number, 2 or more")
    return int(text)


def run(args: argparse.Namespace) -> int:
    from swarmtrack.clock import SystemClock
    from swarmtrack.lab.swarm.machine_load import MachineLoad, described, look_around

    clock = SystemClock()
    began, load = clock.now(), MachineLoad()

    from rich.console import Console

    from swarmtrack.errors import TransportError
    from swarmtrack.lab.swarm.outside import NoTruth
    from swarmtrack.lab.swarm.processes import ProcessDied
    from swarmtrack.lab.swarm.radio import RadioError
    from swarmtrack.lab.swarm.recording import check_empty
    from swarmtrack.lab.swarm.world_file import check_alone
    from swarmtrack.transport import settings
    from swarmtrack.transport.settings import NetworkSettings

    scenario = _scenario(args)
    if args.world is not None:
        check_alone(args.world, scenario=scenario, drones=args.drones, detail=args.detail)
    if args.team is not None:
        settings.check(NetworkSettings(team=args.team))
    if args.json is not None:
        check_writable(args.json)
    plan = _plan(args, scenario or DEFAULT_SCENARIO)
    console = Console()
    if plan.drones is not None:
        _check_memory(plan.drones, plan.detector)  # before they are prepared
    whole = plan.load().scenario
    _check_memory(len(whole.members), plan.detector)
    if plan.record is not None:
        check_empty(plan.record)
    capacity = look_around(load, began, clock)
    detail = _detail(args, plan, whole, capacity)
    spectator = _spectator(whole, plan.detector, console)
    spectator.print_line(described(whole, plan.detector, capacity, detail))
    stay = sys.stdout.isatty() if args.stay is None else args.stay
    landing = _Landing(console, args.json, stay=stay)
    try:
        asyncio.run(_fly(replace(plan, detail=detail), capacity, spectator, landing))
    except (NoTruth, RadioError, ProcessDied, TransportError) as error:
        spectator.close()
        print(f"swarmtrack sim: {error}", file=sys.stderr)
        print("FAILED")
        return FAILED
    except asyncio.CancelledError:
        spectator.close()
        print("swarmtrack sim: interrupted; every process has ended", file=sys.stderr)
        return FAILED
    finally:
        spectator.close()
    return landing.code


def _plan(args: argparse.Namespace, scenario: str) -> FlightPlan:
    """As the command line asks for it."""
    from swarmtrack.lab.swarm.flight import FlightPlan

    wanted = args.monitor or args.stay
    monitor_port = args.monitor_port if args.monitor_port is not None else 0 if wanted else None
    return FlightPlan(
        scenario,
        args.drones,
        args.seconds,
        args.seed,
        args.tracker,
        args.detector,
        args.keep,
        args.record,
        monitor_port,
        args.world,
        args.team,
    )


def _detail(args: argparse.Namespace, plan: FlightPlan, scenario: Scenario, capacity: Capacity) -> Detail:
    from swarmtrack.lab.swarm.detail import Detail
    from swarmtrack.lab.swarm.machine_load import choose_detail

    if plan.world is not None:
        return Detail.FULL
    if args.detail == "auto":
        return choose_detail(scenario, plan.detector, capacity)
    return Detail(args.detail)


class _Landing:
    """After the flight: the verdict, and the page, that stays until Ctrl-C."""

    def __init__(self, console: Console, file: Path | None, *, stay: bool) -> None:
        self.code = FAILED
        self._console = console
        self._file = file
        self._stay = stay

    async def __call__(self, report: SwarmReport, page: FlightPage | None) -> None:
        self.code = conclude(report, self._console, self._file)
        if page is None or not self._stay:
            return
        self._console.print(f"{page.said}: it stays until Ctrl-C", highlight=False, soft_wrap=True)
        stopped = asyncio.Event()
        for number in ENDING:
            asyncio.get_running_loop().add_signal_handler(number, stopped.set)
        waits = [asyncio.create_task(wait) for wait in (stopped.wait(), page.gone())]
        await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
        for task in waits:
            task.cancel()


def _check_memory(drones: int, detector: str) -> None:
    from swarmtrack.lab.swarm.machine_load import too_large

    problem = too_large(drones, detector)
    if problem:
        raise SourceError(problem)


def _scenario(args: argparse.Namespace) -> str | None:
    if args.named is not None and args.scenario is not None:
        raise SourceError(f"{args.named} and --scenario {args.scenario}, expected one scenario")
    named: str | None = args.named or args.scenario
    return named


def conclude(report: SwarmReport, console: Console, file: Path | None) -> int:
    """Write the report where it is wanted, print the verdict; returns the exit code."""
    if file is not None:
        text = json.dumps(report.as_record(), indent=1, allow_nan=False)
        file.write_text(f"{text}\n", encoding="utf-8")
    print_verdict(report, console)
    return exit_code(report)


def exit_code(report: SwarmReport) -> int:
    """Of a verdict."""
    from swarmtrack.lab.score.swarm_verdict import Verdict

    codes = {
        Verdict.PASSED: PASSED,
        Verdict.FAILED: FAILED,
        Verdict.NOT_JUDGED: NOT_JUDGED,
    }
    return codes[report.verdict]


def check_writable(path: Path) -> None:
    """Now, not when the flight is over."""
    if not path.parent.is_dir() or path.is_dir() or not os.access(path.parent, os.W_OK):
        raise SourceError(f"--json {path}: cannot be written, expected a file in a folder that exists")


def _spectator(scenario: Scenario, detector: str, console: Console) -> Spectator:
    from swarmtrack.lab.swarm.table import LiveTable, PlainLines

    title = f"{scenario.name}: {scenario.about} ({len(scenario.members)} drones, detector {detector})"
    if console.is_terminal:
        return LiveTable(console, title)
    lines = PlainLines(console)
    lines.note(title)
    return lines


async def _fly(plan: FlightPlan, capacity: Capacity, spectator: Spectator, landing: _Landing) -> None:
    """Ctrl-C, SIGTERM and a terminal that goes cancel the flight; everything is ended in order."""
    from swarmtrack.lab.swarm.flight import fly

    task = asyncio.current_task()
    assert task is not None
    for number in ENDING:
        asyncio.get_running_loop().add_signal_handler(number, task.cancel)
    await fly(plan, spectator, landing, capacity)


def print_verdict(report: SwarmReport, console: Console) -> None:
    """The tables, then the headline."""
    from swarmtrack.lab.swarm.table import advice, agents_table, headline, team_table

    console.print(agents_table(report))
    console.print(team_table(report))
    colour = {PASSED: "green", FAILED: "red", NOT_JUDGED: "yellow"}[exit_code(report)]
    console.print(headline(report), style=f"bold {colour}", highlight=False, soft_wrap=True)
    if hint := advice(report):
        console.print(f"  {hint}", highlight=False, soft_wrap=True)
