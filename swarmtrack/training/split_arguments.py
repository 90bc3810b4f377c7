"""Arguments of the commands that train: what is learned from, and what is held out."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from swarmtrack.arguments import add_flag, add_folder, add_list, count

if TYPE_CHECKING:
    from swarmtrack.training.split import Split


def add_data(parser: argparse.ArgumentParser, *, every: str) -> None:
    """What is learned from, and what is held out. every: the help of --every."""
    add_folder(
        parser, "--data", "labelled images: CSV, COCO or YOLO; without them all training images are generated"
    )
    add_folder(
        parser, "--clips", "labelled videos: NAME.mp4 and NAME_gt.csv, with bird in the name where birds fly"
    )
    parser.add_argument(
        "--every",
        type=count,
        default=10,
        metavar="N",
        help=f"{every} (default: %(default)s)",
    )
    add_folder(parser, "--validate", "more labelled images, for validation only")
    add_list(parser, "--hold-out", "keep a scene for validation; may be repeated", "SCENE")
    add_flag(parser, "--hold-out-negatives", "keep a third of the clips without drones for validation")
    parser.add_argument(
        "--licence", default="", metavar="TEXT", help="licence of the training data, written into the model"
    )


def split_of(args: argparse.Namespace) -> Split:
    """What they say. Raises `SourceError` where they name what is not there."""
    from swarmtrack.training.split import split  # noqa: PLC0415  # a help page needs no OpenCV

    return split(
        args.data,
        args.clips,
        args.validate,
        hold_out=args.hold_out,
        hold_out_negatives=args.hold_out_negatives,
    )
