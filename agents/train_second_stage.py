"""`swarmtrack train-second-stage --out STAGE.onnx`: train what looks at each of a detector's candidates alone."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, TypeVar

from swarmtrack.arguments import add_file, add_seed, count, positive, require_extra
from swarmtrack.errors import SourceError
from swarmtrack.training.split_arguments import add_data, split_of

if TYPE_CHECKING:
    from swarmtrack.training.candidates import Candidate, CandidateSource
    from swarmtrack.training.labelled_clips import Clip, Origin
    from swarmtrack.training.labelled_images import LabelledFrame
    from swarmtrack.training.split import Split

T = TypeVar("T")

DRAWN = 20_000  # pictures
NEAR = 0.08  # of them: close-ups
SIMULATED = 6000  # pictures


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(parser, "--out", "the .onnx file to write", required=True)
    parser.add_argument(
        "--detector",
        default="default",
        metavar="MODEL",
        help='detector whose candidates it re-examines: an .onnx file or "default" (default: %(default)s)',
    )
    add_data(parser, every="use each N-th frame of --clips")
    parser.add_argument(
        "--drawn",
        type=count,
        default=DRAWN,
        metavar="N",
        help="rendered pictures to take candidates from (default: %(default)s)",
    )
    parser.add_argument(
        "--simulated",
        type=count,
        default=SIMULATED,
        metavar="N",
        help="pictures of simulated worlds to take candidates from (default: %(default)s)",
    )
    parser.add_argument(
        "--iterations", type=count, default=4500, metavar="N", help="steps (default: %(default)s)"
    )
    add_seed(parser, "seed of candidates and first weights (default: %(default)s)", default=0)
    parser.add_argument(
        "--batch", type=count, default=96, metavar="N", help="candidates per step (default: %(default)s)"
    )
    parser.add_argument(
        "--learning-rate", type=positive, default=2e-3, metavar="R", help="(default: %(default)s)"
    )


def run(args: argparse.Namespace) -> int:
    require_extra("train", "torch", "onnx", of="training")
    import numpy as np

    from swarmtrack.detection.detector import Detector
    from swarmtrack.training import second_stage
    from swarmtrack.training.candidates import CandidateSource
    from swarmtrack.training.dataset import data_hash
    from swarmtrack.training.split import what_to_learn

    if not args.out.parent.is_dir():
        raise SourceError(f"--out {args.out}: its folder does not exist")
    detector = Detector(args.detector, look="whole", second_stage="none")
    source = CandidateSource(detector.net, np.random.default_rng((args.seed, 1)))
    parts = split_of(args)
    windows, _ = what_to_learn(parts._replace(held_out_clips=[]), args.every)
    training = list(_candidates(args, source, parts, windows))
    held_out = list(source.of_whole_frames(_whole(parts.held_out_images, parts.held_out_clips, args.every)))
    print(f"{len(training)} candidates to train on, {len(held_out)} held out", file=sys.stderr)
    settings = second_stage.StageSettings(
        iterations=args.iterations, seed=args.seed, batch=args.batch, learning_rate=args.learning_rate
    )
    metadata = {
        "detector": detector.path.name,
        "data_sha256": data_hash(windows),
        "data_frames": str(len(windows)),
        "licence": args.licence,
    }
    trained = second_stage.train(training, held_out, settings, args.out, metadata)
    print(f"{args.out}: {args.out.stat().st_size / 1e6:.2f} MB")
    if trained.alone is not None:
        print(
            f"held-out candidates: average precision {trained.alone:.3f} by the detector alone, {trained.together:.3f} "
            f"with this stage (weight {trained.fusion.weight:.2f}, offset {trained.fusion.offset:.2f})"
        )
    print(f"compare: swarmtrack bench detector {args.detector} DATA --second-stage {args.out}")
    return 0


def _candidates(
    args: argparse.Namespace, source: CandidateSource, parts: Split, windows: list[LabelledFrame]
) -> Iterator[Candidate]:
    """Of images, of clips, and of pictures drawn with pieces of both."""
    import numpy as np

    from swarmtrack.training.dataset import Recipe, SampleSource
    from swarmtrack.training.simulated_pictures import simulated_pictures

    yield from source.of_frames(_whole(parts.images, parts.clips, args.every))
    simulated = simulated_pictures(args.simulated, args.seed)
    yield from source.of_frames(_counted(simulated, args.simulated, "simulated pictures"))
    rng = np.random.default_rng((args.seed, 2))
    recipe, near = Recipe(), round(NEAR * args.drawn)
    for name, how, pictures in (
        ("drawn pictures", recipe, args.drawn - near),
        ("close-ups", recipe.of_close_ups(), near),
    ):
        samples = SampleSource(windows, how, rng)
        drawn = (samples.sample() for _ in range(pictures))
        yield from source.of_drawn(_counted(drawn, pictures, name))


def _counted(some: Iterator[T], count: int, name: str) -> Iterator[T]:
    """The same, with a line of progress."""
    from swarmtrack.benchmarks.report import progress

    with progress(name, count) as advance:
        for each in some:
            yield each
            advance("")


def _whole(
    images: list[LabelledFrame], clips: list[tuple[Clip, Origin]], every: int
) -> Iterator[LabelledFrame]:
    """Images, and each so many-th frame of clips, with a line of progress."""
    from swarmtrack.benchmarks.report import progress
    from swarmtrack.training.labelled_clips import labelled_frames

    yield from images
    with progress("candidates of clips", len(clips)) as advance:
        for clip, origin in clips:
            yield from labelled_frames(clip, origin, every)
            advance(clip.name)
