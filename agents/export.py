"""`swarmtrack export MODEL --precision int8`: a detector in fewer bits, faster and smaller."""

from __future__ import annotations

import argparse
from pathlib import Path

from swarmtrack.errors import ModelError, SourceError

PICTURES = 64  # that 8 bits are calibrated on, by default


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("model", metavar="MODEL", help='an .onnx file in full precision, or "default"')
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="the .onnx file to write")
    parser.add_argument(
        "--precision", choices=("fp16", "int8"), default="int8", help="(default: %(default)s)"
    )
    parser.add_argument(
        "--data",
        type=Path,
        metavar="DIR",
        help="labelled images that int8 is calibrated on, of scenes as in flight",
    )
    parser.add_argument(
        "--pictures",
        type=int,
        default=PICTURES,
        metavar="N",
        help="of them, evenly spread (default: %(default)s)",
    )


def run(args: argparse.Namespace) -> int:
    try:
        from swarmtrack.training import precision
    except ImportError as error:
        raise ModelError(f"export: {error.name} is missing, install swarmtrack[train]") from error
    from swarmtrack.detection.model import model_path
    from swarmtrack.training.labelled_images import load_frames

    model = model_path(args.model)
    if not model.is_file():
        raise ModelError(f"{model}: no such model file")
    if not args.out.parent.is_dir():
        raise SourceError(f"--out {args.out}: its folder does not exist")
    if args.precision == "fp16":
        precision.half(model, args.out)
    else:
        if args.data is None:
            raise SourceError(
                "--data is missing: int8 is calibrated on pictures, expected a folder of labelled images"
            )
        frames = load_frames(args.data)
        step = max(1, len(frames) // max(args.pictures, 1))
        precision.eight_bits(model, args.out, [frame.image for frame in frames[::step]])
    before, after = (path.stat().st_size / 1e6 for path in (model, args.out))
    print(f"{args.out}: {args.precision}, {after:.2f} MB, was {before:.2f} MB")
    print(f"compare: swarmtrack bench detector {args.out} DATA")
    return 0
