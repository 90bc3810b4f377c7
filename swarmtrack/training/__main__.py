"""`python -m swarmtrack.training`: train a detector."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from swarmtrack.errors import SwarmtrackError


def main(arguments: list[str] | None = None) -> int:
    options = _parser().parse_args(arguments)
    try:
        return _train(options)
    except SwarmtrackError as error:
        print(error, file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m swarmtrack.training", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)

    train = commands.add_parser("train", help="train a net and write it as ONNX")
    train.add_argument("--data", type=Path, help="directory of labelled images; without it all is procedural")
    train.add_argument(
        "--out", type=Path, required=True, help="the ONNX file to write; weights go beside it (.pt)"
    )
    length = train.add_mutually_exclusive_group(required=True)
    length.add_argument("--minutes", type=float)
    length.add_argument("--iterations", type=int, help="instead of minutes: the same weights each time")
    train.add_argument("--seed", type=int, default=0)
    train.add_argument("--network", default="plain", help="plain (default) or nano")
    train.add_argument("--batch", type=int, default=32)
    train.add_argument("--crop", type=int, default=160, help="px, a multiple of 32")
    train.add_argument("--learning-rate", type=float, default=2.5e-3)
    train.add_argument("--generators", type=int, default=1, help="processes that draw samples")
    train.add_argument("--start", type=Path, help="weights (.pt) to go on from")
    train.add_argument("--hold-out", action="append", default=[], metavar="SCENE", help="keep a scene unseen")
    train.add_argument(
        "--hold-out-negatives", action="store_true", help="keep a third of the drone-free clips unseen"
    )
    train.add_argument("--licence", default="", help="of the training data, written into the model")
    return parser


def _train(options: argparse.Namespace) -> int:
    try:
        from swarmtrack.training import trainer  # noqa: PLC0415 - torch is an extra
    except ImportError as error:
        print(f"{error}: training needs the extra `train`: pip install 'swarmtrack[train]'", file=sys.stderr)
        return 2
    from swarmtrack.training import dataset  # noqa: PLC0415
    from swarmtrack.training.labelled_images import held_out, load_frames  # noqa: PLC0415
    from swarmtrack.training.network import COARSEST, NETWORKS  # noqa: PLC0415

    problems = [
        (
            options.network not in NETWORKS,
            f"--network {options.network}: expected one of {', '.join(NETWORKS)}",
        ),
        (
            options.crop % COARSEST or options.crop < 64,
            f"--crop {options.crop}: expected a multiple of 32 from 64 on",
        ),
        (not options.out.parent.is_dir(), f"--out {options.out}: the directory does not exist"),
        (options.start and not options.start.is_file(), f"--start {options.start}: no such file"),
        (min(options.batch, options.generators) < 1, "--batch and --generators: expected at least 1"),
    ]
    for wrong, sentence in problems:
        if wrong:
            print(sentence, file=sys.stderr)
            return 2
    frames = load_frames(options.data) if options.data else []
    scenes = {frame.scene for frame in frames}
    for name in options.hold_out:
        if name not in scenes:
            print(f"--hold-out {name}: expected one of {', '.join(sorted(scenes))}", file=sys.stderr)
            return 2
    frames = [
        frame
        for frame in frames
        if frame.scene not in options.hold_out and not (options.hold_out_negatives and held_out(frame))
    ]
    recipe = replace(dataset.Recipe(), crop=options.crop)
    settings = trainer.Settings(
        minutes=options.minutes,
        iterations=options.iterations,
        seed=options.seed,
        batch=options.batch,
        learning_rate=options.learning_rate,
        network=options.network,
        generators=options.generators,
    )
    trainer.train(frames, recipe, settings, options.out, licence=options.licence, start=options.start)
    return 0


if __name__ == "__main__":
    sys.exit(main())
