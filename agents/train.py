"""`swarmtrack train --out MODEL.onnx`: train a detector on drawn images, and on labelled images of yours."""

from __future__ import annotations

import argparse
import sys

from swarmtrack.arguments import add_file, add_flag, add_seed, count, positive, require_extra
from swarmtrack.errors import ModelError, SourceError
from swarmtrack.training import IMAGE_MULTIPLE_PX
from swarmtrack.training.split_arguments import add_data, split_of

NETWORKS = ("plain", "nano", "resnet34")
MINUTES = 150.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    _add_files(parser)
    _add_start(parser)
    _add_settings(parser)


def _add_files(parser: argparse.ArgumentParser) -> None:
    """What is read and written."""
    add_file(
        parser,
        "--out",
        "the .onnx file to write; the checkpoint (.pt) and the report (folder .report) go next to it",
        required=True,
    )
    add_data(parser, every="use each N-th frame of --clips, and each 5N-th of held-out clips")


def _add_settings(parser: argparse.ArgumentParser) -> None:
    """How it is trained."""
    length = parser.add_mutually_exclusive_group()
    length.add_argument(
        "--minutes", type=positive, metavar="M", help=f"how long to train (default: {MINUTES:g})"
    )
    length.add_argument(
        "--iterations",
        type=count,
        metavar="N",
        help="how long to train, instead of --minutes: reproducible",
    )
    parser.add_argument(
        "--network", choices=NETWORKS, default="plain", help="architecture (default: %(default)s)"
    )
    parser.add_argument(
        "--device",
        choices=("auto", "cpu", "cuda"),
        default="auto",
        help="device to train on (default: %(default)s)",
    )
    add_seed(parser, "seed of samples and first weights (default: %(default)s)", default=0)
    parser.add_argument(
        "--batch", type=count, default=32, metavar="N", help="samples per step (default: %(default)s)"
    )
    parser.add_argument(
        "--crop",
        type=_crop,
        default=160,
        metavar="PX",
        help="side of a sample, a multiple of 32 (default: %(default)s)",
    )
    parser.add_argument(
        "--learning-rate", type=positive, default=2.5e-3, metavar="R", help="(default: %(default)s)"
    )
    parser.add_argument(
        "--generators",
        type=count,
        default=1,
        metavar="N",
        help="processes that generate samples; a GPU needs several (default: %(default)s)",
    )


def _add_start(parser: argparse.ArgumentParser) -> None:
    """With which weights it begins."""
    add_flag(parser, "--resume", "continue from the checkpoint next to --out, with the same options")
    add_file(parser, "--start", "initial weights: a checkpoint (.pt) or a swarmtrack model (.onnx)")


def _crop(text: str) -> int:
    if not (
        text.isascii()
        and text.isdigit()
        and int(text) >= 2 * IMAGE_MULTIPLE_PX
        and int(text) % IMAGE_MULTIPLE_PX == 0
    ):
        raise argparse.ArgumentTypeError(f"found {text}, expected a multiple of 32 from 64 on")
    return int(text)


def run(args: argparse.Namespace) -> int:
    require_extra("train", "torch", "onnx", of="training")
    from swarmtrack.training import trainer, training_report
    from swarmtrack.training.dataset import Recipe
    from swarmtrack.training.split import what_to_learn

    _check_files(args)
    frames, validation = what_to_learn(split_of(args), args.every)
    settings = trainer.Settings(
        minutes=None if args.iterations else args.minutes or MINUTES,
        iterations=args.iterations,
        seed=args.seed,
        batch=args.batch,
        learning_rate=args.learning_rate,
        network=args.network,
        generators=args.generators,
        device=_device(args.device),
    )
    print(
        f"training on {len(frames)} labelled images and on drawn ones, {len(validation)} to validate, "
        f"network {args.network}, {settings.device}",
        file=sys.stderr,
    )
    history = trainer.train(
        frames,
        Recipe(crop=args.crop),
        settings,
        args.out,
        licence=args.licence,
        validation=validation,
        start=args.start,
        resume=args.resume,
    ).history
    report = training_report.write(args.out, history, validation or frames, seen=not validation)
    print(f"{args.out}: {args.out.stat().st_size / 1e6:.2f} MB; report: {report}")
    return 0


def _check_files(args: argparse.Namespace) -> None:
    if not args.out.parent.is_dir():
        raise SourceError(f"--out {args.out}: its folder does not exist")
    if args.start is not None and not args.start.is_file():
        raise SourceError(f"--start {args.start}: no such file")
    if args.resume and args.start is not None:
        raise SourceError("--resume and --start: expected one of them, both set the initial weights")
    if args.resume and not args.out.with_suffix(".pt").is_file():
        raise SourceError(f"--resume: {args.out.with_suffix('.pt')}: no such checkpoint")


def _device(wanted: str) -> str:
    import torch

    present = torch.cuda.is_available()
    if wanted == "cuda" and not present:
        raise ModelError("--device cuda: PyTorch finds no GPU, expected one, or --device cpu")
    return "cuda" if wanted != "cpu" and present else "cpu"
