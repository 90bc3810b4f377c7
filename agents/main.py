"""`swarmtrack`: everything around the agents."""

from __future__ import annotations

import argparse
import sys
from importlib import import_module

from swarmtrack import __version__
from swarmtrack.arguments import add_commands, unknown
from swarmtrack.ending import end_at_once_if_stuck, print_in_any_encoding, reader_may_leave
from swarmtrack.errors import SwarmtrackError
from swarmtrack.log_lines import plain_warnings
from swarmtrack.plain_text import plain

GROUPS = {
    "try it": {
        "sim": ("swarmtrack.agents.sim", "fly a local swarm: simulator, one agent per drone, a verdict"),
        "video": ("swarmtrack.agents.video", "track drones in a video file, and write an annotated video"),
    },
    "set up": {
        "config": ("swarmtrack.agents.config", "write, check and explain configs"),
        "calibrate": ("swarmtrack.agents.calibrate", "calibrate a camera and its mounting on the drone"),
        "keys": ("swarmtrack.agents.keys", "make and list the team's keys and certificates"),
        "mission": (
            "swarmtrack.agents.mission",
            "write trajectories by which teammates recognise each other",
        ),
    },
    "fly": {
        "doctor": ("swarmtrack.agents.doctor", "find out why a drone does not work, and what to do"),
        "healthy": ("swarmtrack.agents.healthy", "check an agent's health: exit code 0 or 1"),
        "router": ("swarmtrack.agents.router", "relay between drones that cannot reach each other"),
    },
    "look": {
        "monitor": ("swarmtrack.agents.monitor", "serve the web page of a running swarm"),
        "echo": ("swarmtrack.agents.echo", "show the messages of a running swarm as JSON lines"),
        "ros2": ("swarmtrack.agents.ros2", "publish a running swarm as ROS 2 topics (rmw_zenoh)"),
        "record": ("swarmtrack.agents.record", "record the messages of a running swarm"),
    },
    "afterwards": {
        "replay": (
            "swarmtrack.agents.replay",
            "run recorded flights through perception again, at full speed",
        ),
        "plot": ("swarmtrack.agents.plot", "draw a recorded flight: map, distances, names, errors"),
        "review": ("swarmtrack.agents.review", "review a recorded flight: what went wrong, on one page"),
        "log": ("swarmtrack.agents.log", "show, repair, merge and convert recordings"),
        "import": ("swarmtrack.agents.import_flight", "make a recording from a telemetry log and a video"),
    },
    "develop": {
        "bench": ("swarmtrack.agents.bench", "reproduce the published figures and tables"),
        "train": ("swarmtrack.agents.train", "train a detector"),
        "train-second-stage": (
            "swarmtrack.agents.train_second_stage",
            "train the second stage, which re-examines a detector's candidates",
        ),
        "label": ("swarmtrack.agents.label", "make training labels from a recorded flight"),
        "export": ("swarmtrack.agents.export", "export a detector at lower precision"),
        "judge": (
            "swarmtrack.agents.judge",
            "judge a simulated swarm that is already running",
        ),
    },
}
COMMANDS = {name: command for group in GROUPS.values() for name, command in group.items()}

EXAMPLES = """where to begin:
  swarmtrack sim                           # three drones, without any hardware
  swarmtrack video clip.mp4                # drones in your own video
  swarmtrack config new                    # a config for your own drone, by questions
  swarmtrack doctor --config drone-1.toml  # why it does not work, and what to do
"""


def main(argv: list[str] | None = None) -> int:
    """The console script. Exit codes: 0 done, 2 wrong usage, 1 anything else."""
    code = 0
    print_in_any_encoding()
    with reader_may_leave():
        arguments = parse(sys.argv[1:] if argv is None else argv)
        plain_warnings()
        code = _run(arguments)
    if argv is None:
        end_at_once_if_stuck(code)
    return code


def parse(words: list[str]) -> argparse.Namespace:
    """What a command line asks for; ends the program with a usage message where it is wrong."""
    parser = argparse.ArgumentParser(
        prog="swarmtrack",
        usage="swarmtrack [-h] [--version] COMMAND ...",
        description="Relative perception for drone swarms. Each drone runs swarmtrack-agent.\n\n" + _listed(),
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"swarmtrack {__version__}")
    # The list of commands stands above, in groups.
    add_commands(
        parser, COMMANDS, dest="command", metavar="COMMAND", help=argparse.SUPPRESS, prog="swarmtrack"
    )
    named = words[0] if words and not words[0].startswith("-") else None
    if named is not None and named not in COMMANDS:
        parser.error(f"there is no command {plain(named, 40)}, {unknown('command', named, COMMANDS)}")
    return parser.parse_args(words)


def _listed() -> str:
    lines, width = [], max(map(len, COMMANDS))
    for group, commands in GROUPS.items():
        lines += [
            f"{group}:",
            *(f"  {name:{width}} {summary}" for name, (_, summary) in commands.items()),
            "",
        ]
    return "\n".join(lines)


def _run(arguments: argparse.Namespace) -> int:
    try:
        return int(import_module(COMMANDS[arguments.command][0]).run(arguments))
    except SwarmtrackError as error:
        print(f"swarmtrack {arguments.command}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 0


if __name__ == "__main__":
    sys.exit(main())
