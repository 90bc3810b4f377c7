"""`swarmtrack config`: a first config, checks of one or of a whole team's, and all keys for editors and people."""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from swarmtrack.arguments import add_action, add_file, add_flag
from swarmtrack.errors import ConfigError, SwarmtrackError

if TYPE_CHECKING:
    from swarmtrack.config.drone import DroneConfig

EXAMPLE = """\
for example:
  swarmtrack config new                            # prompts
  swarmtrack config new --id 2 --autopilot ardupilot-uart --calibration cam2.yaml --start 0 3 0 -90
  swarmtrack config new --ids 11-15 --grid 3       # five alike, three metres apart
  swarmtrack config new --example                  # every key in one file, explained
  swarmtrack config check drone-1.toml drone-2.toml drone-3.toml
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    from swarmtrack.setup import wizard

    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EXAMPLE
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")

    new = add_action(actions, "new", "write a commented config for a drone and its team")
    wizard.add_arguments(new)

    check = add_action(
        actions,
        "check",
        "check a config, as swarmtrack-agent --check does; several files are also checked as a team",
    )
    add_file(check, "files", "a drone's config", nargs="+")
    add_file(check, "--drawing", "draw the first config's formation into FILE, as SVG")
    add_flag(
        check,
        "--autopilot",
        "also read the limits of each drone's autopilot over its link (fence, time-outs, speeds); nothing is written "
        "to it",
    )

    for action, text in (
        ("schema", "all keys as a JSON schema"),
        ("reference", "all keys as a page in Markdown"),
    ):
        writing = add_action(actions, action, text)
        add_file(writing, "--out", "write to this file (default: print it)")
    add_flag(writing, "--scenario", "those of a scenario instead, for swarmtrack sim")


def run(args: argparse.Namespace) -> int:
    """Raises SwarmtrackError."""
    return ACTIONS[args.action](args)


def _new(args: argparse.Namespace) -> int:
    from swarmtrack.setup.wizard import create, write_example

    if args.example:
        write_example(args)
    else:
        create(args)
    return 0


def _check(args: argparse.Namespace) -> int:
    from swarmtrack.config.drone import load_config
    from swarmtrack.runtime.check import check, draw_formation
    from swarmtrack.setup.team_check import contradictions, doubts

    configs, code = [], 0
    for path in args.files:
        try:
            check(path)
            configs.append(load_config(path))
        except SwarmtrackError as error:
            code = 2
            print(error if isinstance(error, ConfigError) else f"{path}: {error}", file=sys.stderr)
    problems = contradictions(configs)
    for problem in problems:
        print(problem, file=sys.stderr)
    for doubt in doubts(configs):
        print(f"warning: {doubt}")
    if len(configs) > 1 and not problems:
        print(f"drones {', '.join(str(config.drone.id) for config in configs)} agree with each other")
    code = 2 if problems else code
    if args.drawing is not None and code == 0:
        _write(draw_formation(args.files[0]), args.drawing, "--drawing")
    if args.autopilot:
        code = max([code, *map(_ask_autopilot, configs)])
    return code


def _ask_autopilot(config: DroneConfig) -> int:
    """Prints what its own limits are like; 1 where it could not be asked."""
    from swarmtrack.clock import SystemClock
    from swarmtrack.diagnosis.findings import Level, as_line, worst
    from swarmtrack.doctor.limits import read_limits

    print(f"drone {config.drone.id}: asking {config.autopilot.link} …", file=sys.stderr)
    findings = asyncio.run(read_limits(config, SystemClock()))
    for finding in findings:
        print(as_line(finding))
    return int(worst(findings) is Level.FAILURE)


def _schema(args: argparse.Namespace) -> int:
    from swarmtrack.setup.reference import json_schema

    return _write(json.dumps(json_schema(), indent=2, ensure_ascii=False) + "\n", args.out)


def _reference(args: argparse.Namespace) -> int:
    if args.scenario:
        from swarmtrack.lab.scenarios.reference import scenario_reference

        return _write(scenario_reference(), args.out)
    from swarmtrack.setup.reference import reference

    return _write(reference(), args.out)


def _write(text: str, out: Path | None, flag: str = "--out") -> int:
    if out is None:
        print(text, end="")
        return 0
    try:
        out.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(
            [f"{flag}: {out}: {error.strerror}, expected a file that can be written"]
        ) from error
    return 0


ACTIONS: dict[str, Callable[[argparse.Namespace], int]] = {
    "new": _new,
    "check": _check,
    "schema": _schema,
    "reference": _reference,
}
