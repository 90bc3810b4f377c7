"""`swarmtrack train --out MODEL.onnx`: train a detector on drawn images, and on labelled images of yours."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING, NamedTuple

from swarmtrack.arguments import add_file, add_flag, add_folder, add_list, add_seed, count, positive
from swarmtrack.errors import ModelError, SourceError
from swarmtrack.training import COARSEST

if TYPE_CHECKING:
    from swarmtrack.training.labelled_clips import Clip, Origin
    from swarmtrack.training.labelled_images import LabelledFrame

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
    add_data(parser, every="of --clips, each N-th frame; of those held out, a fifth of these")


def add_data(parser: argparse.ArgumentParser, *, every: str) -> None:
    """What is learned from, and what is held out. every: the help of --every."""
    add_folder(parser, "--data", "labelled images: CSV, COCO or YOLO; without it all is procedural")
    add_folder(parser, "--clips", "labelled videos: NAME.mp4 and NAME_gt.csv, birds if the name says bird")
    parser.add_argument(
        "--every",
        type=count,
        default=10,
        metavar="N",
        help=f"{every} (default: %(default)s)",
    )
    add_folder(parser, "--validate", "more labelled images, looked at but never trained on")
    add_list(parser, "--hold-out", "keep a scene for validation; may be repeated", "SCENE")
    add_flag(parser, "--hold-out-negatives", "keep a third of the clips without drones for validation")
    parser.add_argument(
        "--licence", default="", metavar="TEXT", help="licence of the training data, written into the model"
    )


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
        help="how long to train, instead of --minutes: gives the same weights each time",
    )
    parser.add_argument(
        "--network", choices=NETWORKS, default="plain", help="its kind (default: %(default)s)"
    )
    parser.add_argument(
        "--device",
        choices=("auto", "cpu", "cuda"),
        default="auto",
        help="where to train (default: %(default)s)",
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
        help="processes that draw samples; a GPU needs several (default: %(default)s)",
    )


def _add_start(parser: argparse.ArgumentParser) -> None:
    """With which weights it begins."""
    add_flag(parser, "--resume", "continue from the checkpoint next to --out, with the same options")
    add_file(parser, "--start", "begin with the weights of a checkpoint (.pt) or of a model of ours (.onnx)")


def _crop(text: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text) >= 2 * COARSEST and int(text) % COARSEST == 0):
        raise argparse.ArgumentTypeError(f"found {text}, expected a multiple of 32 from 64 on")
    return int(text)


def run(args: argparse.Namespace) -> int:
    try:
        from swarmtrack.training import trainer
    except ImportError as error:
        raise ModelError(f"train: {error.name} is missing, install swarmtrack[train]") from error
    from swarmtrack.training import training_report
    from swarmtrack.training.dataset import Recipe

    _check_files(args)
    frames, validation = what_to_learn(split(args), args.every)
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
        raise SourceError("--resume and --start: expected one of them, both say where to begin")
    if args.resume and not args.out.with_suffix(".pt").is_file():
        raise SourceError(f"--resume: {args.out.with_suffix('.pt')}: no such checkpoint")


class Split(NamedTuple):
    """Labelled images and clips to train on, and those held out; and where each clip was taken."""

    images: list[LabelledFrame]
    held_out_images: list[LabelledFrame]
    clips: list[tuple[Clip, Origin]]
    held_out_clips: list[tuple[Clip, Origin]]


def split(args: argparse.Namespace) -> Split:
    """What --data, --clips and --validate hold, as --hold-out and --hold-out-negatives part it."""
    from swarmtrack.training import labelled_clips
    from swarmtrack.training.labelled_images import held_out, load_frames

    frames = load_frames(args.data) if args.data else []
    clips = labelled_clips.find_clips(args.clips) if args.clips else []
    origins = labelled_clips.origins(clips, frames)
    scenes = {frame.scene for frame in frames} | {origin.scene for origin in origins.values()}
    for name in args.hold_out:
        if name not in scenes:
            known = ", ".join(sorted(scenes)) or "--data, which is missing"
            raise SourceError(f"--hold-out {name}: expected one of {known}")

    def is_kept(scene: str, source: str) -> bool:
        return scene in args.hold_out or (args.hold_out_negatives and held_out(scene, source))

    parts = Split([], list(load_frames(args.validate)) if args.validate else [], [], [])
    for frame in frames:
        kept = is_kept(frame.scene, frame.source)
        (parts.held_out_images if kept else parts.images).append(frame)
    for clip in clips:
        origin = origins[clip.name]
        kept = is_kept(origin.scene, origin.source)
        (parts.held_out_clips if kept else parts.clips).append((clip, origin))
    return parts


def what_to_learn(parts: Split, every: int) -> tuple[list[LabelledFrame], list[LabelledFrame]]:
    """What to train on, and what to validate on: of clips windows, and whole frames."""
    from swarmtrack.training.labelled_clips import labelled_frames, window

    training, validation = list(parts.images), list(parts.held_out_images)
    for clip, origin in parts.held_out_clips:
        validation += labelled_frames(clip, origin, 5 * every)
    for clip, origin in parts.clips:
        training += (window(frame) for frame in labelled_frames(clip, origin, every))
    return training, validation


def _device(wanted: str) -> str:
    import torch

    present = torch.cuda.is_available()
    if wanted == "cuda" and not present:
        raise ModelError("--device cuda: PyTorch finds no GPU, expected one, or --device cpu")
    return "cuda" if wanted != "cpu" and present else "cpu"
