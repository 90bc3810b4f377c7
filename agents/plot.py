"""`swarmtrack plot PATH…`: a recorded flight on one page, of one's own drones or of a simulation."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from swarmtrack.arguments import add_file, require_extra


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(
        parser,
        "paths",
        "recordings, or folders of several, such as sim --record writes",
        metavar="FILE|DIR",
        nargs="+",
    )
    add_file(parser, "--out", "the picture, .png, .svg or .pdf (default: NAME.png in the current folder)")


def run(args: argparse.Namespace) -> int:
    require_extra("bench", "matplotlib", of="swarmtrack plot")
    from swarmtrack.monitor.flight_course import read_course
    from swarmtrack.monitor.flight_plot import plot_flight

    out: Path = args.out or Path(f"{args.paths[0].resolve().stem}.png")
    course = read_course(args.paths)
    for note in course.notes:
        print(f"swarmtrack plot: {note}", file=sys.stderr)
    plot_flight(course, out)
    truth = "" if course.truth else "; the truth is not in it, so there are no errors"
    print(f"{out}: {course.seconds:.0f} s, {len(course.places | course.seen)} drones{truth}")
    return 0
