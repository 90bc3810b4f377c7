"""`swarmtrack export MODEL --precision int8`: a detector in fewer bits, faster and smaller; or a checkpoint as ONNX."""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from swarmtrack.arguments import add_file, add_flag, add_folder, require_extra
from swarmtrack.errors import ModelError, SourceError

if TYPE_CHECKING:
    from swarmtrack.training.labelled_images import LabelledFrame

PICTURES = 64  # that 8 bits are calibrated on, by default


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "model", metavar="MODEL", help='an .onnx file in full precision, "default", or a checkpoint (.pt)'
    )
    add_file(parser, "--out", "the .onnx file to write", required=True)
    parser.add_argument(
        "--precision", choices=("fp32", "fp16", "int8"), default="int8", help="(default: %(default)s)"
    )
    add_folder(parser, "--data", "labelled images to calibrate int8 on, from scenes as in flight")
    parser.add_argument(
        "--pictures",
        type=int,
        default=PICTURES,
        metavar="N",
        help="how many of them to use, evenly spread (default: %(default)s)",
    )

    add_flag(
        parser,
        "--calibrate",
        "fit scores to the images of --data, so that a score is the probability of a drone",
    )


def run(args: argparse.Namespace) -> int:
    from swarmtrack.detection.model import model_path

    model = model_path(args.model)
    if not model.is_file():
        raise ModelError(f"{model}: no such model file")
    if not args.out.parent.is_dir():
        raise SourceError(f"--out {args.out}: its folder does not exist")
    require_extra("train", *(["torch"] if model.suffix == ".pt" else []), "onnx", of="writing a model")
    with TemporaryDirectory() as folder:
        if model.suffix == ".pt":
            model = _from_checkpoint(model, Path(folder) / "full.onnx")
        _write(args, model)
        if args.calibrate:
            _calibrate(args.out, _labelled(args))
        before, after = (path.stat().st_size / 1e6 for path in (model, args.out))
    print(f"{args.out}: {args.precision}, {after:.2f} MB, {before:.2f} MB in full precision")
    print(f"compare: swarmtrack bench detector {args.out} DATA")
    return 0


def _from_checkpoint(checkpoint: Path, out: Path) -> Path:
    from swarmtrack.training.export import export
    from swarmtrack.training.trainer import averaged_network, read_checkpoint

    found = read_checkpoint(checkpoint)
    export(averaged_network(found), out, found["metadata"])
    return out


def _labelled(args: argparse.Namespace) -> list[LabelledFrame]:
    from swarmtrack.training.labelled_images import load_frames

    if args.data is None:
        why = "8 bits and scores are calibrated on pictures"
        raise SourceError(f"--data is missing: {why}, expected a folder of labelled images")
    return load_frames(args.data)


def _calibrate(model: Path, frames: list[LabelledFrame]) -> None:
    """Write into the model how its scores become probabilities; its threshold lets through what it let through."""
    import numpy as np

    from swarmtrack.detection.detector import Detector
    from swarmtrack.lab.score.detector_score import by_centre, match
    from swarmtrack.lab.score.score_calibration import expected_error, fit
    from swarmtrack.training.annotation import annotate
    from swarmtrack.training.validation import look

    annotate(model, {"calibration": "[1.0, 0.0]"})
    matches = match(look(model, frames), by_centre)
    platt = fit(matches)
    threshold = float(platt(np.array([Detector(str(model)).description.score_threshold]))[0])
    annotate(model, {"calibration": json.dumps(list(platt)), "score_threshold": f"{threshold:.4f}"})
    before, after = (expected_error(p, matches.hit) for p in (matches.score, platt(matches.score)))
    print(
        f"{model}: scores were off by {before:.3f} on average, now by {after:.3f} (on the images fitted to)"
    )


def _write(args: argparse.Namespace, model: Path) -> None:
    from swarmtrack.training import precision

    if args.precision == "fp32":
        if args.model == str(args.out):
            raise SourceError(f"--out {args.out}: is the model itself, expected another file")
        shutil.copyfile(model, args.out)
    elif args.precision == "fp16":
        precision.half(model, args.out)
    else:
        frames = _labelled(args)
        step = max(1, len(frames) // max(args.pictures, 1))
        precision.eight_bits(model, args.out, [frame.image for frame in frames[::step]])
