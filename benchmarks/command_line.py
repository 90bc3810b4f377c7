"""Arguments that several benchmarks take. `swarmtrack bench` hands what was told to the `run` of a benchmark."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from swarmtrack.arguments import add_flag, add_folder, count
from swarmtrack.tracking import DEFAULT_TRACKER, TRACKERS

DEFAULT_OUT = Path("bench")


def add_common(parser: argparse.ArgumentParser) -> None:
    """What every benchmark takes."""
    add_folder(parser, "--out", "for the results (default: %(default)s)", default=DEFAULT_OUT)
    add_flag(parser, "--quick", "a fraction of the work, for orientation")


def add_tracker(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--tracker", default=DEFAULT_TRACKER, choices=list(TRACKERS), help="(default: %(default)s)"
    )


def add_seeds(parser: argparse.ArgumentParser, usual: int, quick: int) -> None:
    """--seeds: how many flights; None where nobody said."""
    parser.add_argument(
        "--seeds",
        type=count,
        metavar="N",
        help=f"flights of each kind (default: {usual}; with --quick {quick})",
    )


def add_processes(parser: argparse.ArgumentParser) -> None:
    """--processes: how many fly at once; None where nobody said."""
    parser.add_argument(
        "--processes", type=count, metavar="N", help="how many fly at once (default: one per core)"
    )


def add_scenarios(parser: argparse.ArgumentParser, usual: Sequence[str]) -> None:
    """--scenarios: which are flown, one after the other."""
    parser.add_argument(
        "--scenarios",
        nargs="+",
        default=list(usual),
        metavar="NAME",
        help=f"shipped ones, or files (default: {' '.join(usual)})",
    )


def add_second_stage(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--second-stage",
        default="auto",
        metavar="STAGE",
        help='what looks at candidates again: "auto", "none", "default", or an .onnx file (default: %(default)s)',
    )


def add_clips(parser: argparse.ArgumentParser, **more: Any) -> None:
    """DATA: labelled clips."""
    add_folder(parser, "data", "a folder with pairs of NAME.mp4 and NAME_gt.csv", "DATA", **more)
