"""How good a detector is: on labelled images and clips, by scene, size and distractor, and what a frame costs.

DATA holds labelled images (see `swarmtrack.training.labelled_images`), or pairs NAME.mp4 and NAME_gt.csv in it or in
`tracks/`, or both. With --frames-of, frames of other clips count as images: of the scenes of --scene, and with
--held-out-negatives of drone-free clips that a training holds out. The images count as one set, the clips as another,
and with them the flights of --scenario, rendered as `swarmtrack sim` renders them: not as training pictures are drawn.
What a hit is: see `swarmtrack.lab.score.detector_score`. With --motion the scores of clips count what moved
(`detection.motion_cue`), as in an agent whose camera stands still; the clips must be such. Of scenarios the true turn
is known.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from swarmtrack.arguments import count
from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.clip_frames import detected, frames
from swarmtrack.benchmarks.figures import spent_s
from swarmtrack.benchmarks.harness import SECOND_STAGE, Benchmark, flag, listed, option, path
from swarmtrack.benchmarks.report import BenchmarkError
from swarmtrack.detection.detector import Detector
from swarmtrack.detection.expectation import PixelMapping
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.scenario import Scenario
from swarmtrack.lab.score import detector_score
from swarmtrack.lab.score.detector_score import EMPTY, ScoredImage, by_centre, match
from swarmtrack.lab.score.swarm_truth import SwarmTruth
from swarmtrack.lab.world.rendering import Renderer
from swarmtrack.messages import Array, Frame, StampKind
from swarmtrack.training.labelled_clips import (
    Clip,
    drone_clips,
    find_clips,
    labelled_frames,
    origins,
    read_truth,
)
from swarmtrack.training.labelled_images import DataError, LabelledFrame, held_out, load_frames
from swarmtrack.training.validation import LOWEST_SCORE, SURE_RECALL

NAME = "detector"
KEPT_UNSEEN = "`train --hold-out-negatives` kept unseen"
TIMED = ((320, 256), (640, 480))  # px
REPEATS, QUICK_REPEATS = 60, 10
QUICK_EVERY = 16
OBSERVERS, FLIGHT_FROM_S, FLIGHT_S = 2, 4.0, 8.0  # of a scenario: who looks, from when on, for how long


class Sets(NamedTuple):
    """What was looked at, by scene and by clip."""

    images: dict[str, list[ScoredImage]]
    clips: dict[str, list[ScoredImage]]


def _measured(args: argparse.Namespace) -> dict[str, Any]:
    detector = Detector(
        args.model,
        score_threshold=LOWEST_SCORE,
        input_scale=args.input_scale,
        second_stage=args.second_stage,
        look="whole",
        motion=args.motion,
    )
    threshold, every = detector.own_threshold, QUICK_EVERY if args.quick else args.every
    scenarios = [load_scenario(name) for name in args.scenario]
    sets = _look(detector, _frames(args, every), _clips(args.data), scenarios, every)
    images = [look for looks in sets.images.values() for look in looks]
    clips = [look for looks in sets.clips.values() for look in looks]
    main = images if any(len(look.drones) for look in images) else clips
    matches = match(main, by_centre)
    sure = matches.threshold_of(SURE_RECALL)
    return {
        "model": args.model,
        "source": detector.description.source,
        "head": detector.description.head,
        "data": args.data.name,
        "input_scale": args.input_scale,
        "second_stage": args.second_stage,
        "motion": args.motion,
        **detector_score.summary(main, threshold),
        "threshold_of_090_recall": round(sure, 4),
        "distractor_images_fired": _share(detector_score.fired_on(main, sure).get("anything")),
        "by_scene": _summaries(sets.images, threshold),
        "by_clip": _summaries(sets.clips, threshold),
        "by_size": [entry._asdict() for entry in detector_score.by_size(matches, threshold)],
        "by_distractor": _fired(main, {"threshold": threshold, "at_090_recall": sure}),
        "ms_per_frame": _times(args.model, args.second_stage, QUICK_REPEATS if args.quick else REPEATS),
        "file_mb": _size_mb(detector),
    }


def _size_mb(detector: Detector) -> float:
    """Of all files that are looked with."""
    second = detector.second_stage
    files = [detector.path] if second is None else [detector.path, second.path]
    return round(sum(file.stat().st_size for file in files) / 1e6, 3)


# --- looking ------------------------------------------------------------------------------------------


def _look(
    detector: Detector,
    frames: Sequence[LabelledFrame],
    clips: Sequence[Clip],
    scenarios: Sequence[Scenario],
    every: int,
) -> Sets:
    by_scene: dict[str, list[ScoredImage]] = {}
    with report.progress(NAME, len(frames) + len(clips) + len(scenarios)) as advance:
        for frame in frames:
            seen = detected(detector, Frame(0.0, 0.0, 0, frame.image, StampKind.MEDIA))
            look = ScoredImage(seen, frame.drones, frame.distractors, frame.kinds)
            by_scene.setdefault(frame.scene, []).append(look)
            advance(frame.scene)
        by_clip = {}
        for clip in clips:
            by_clip[clip.name] = list(look_at_clip(detector, clip, every))
            advance(clip.name)
        for scenario in scenarios:
            by_clip[f"scenario {scenario.name}"] = list(look_at_flight(detector, scenario, every))
            advance(scenario.name)
    return Sets(by_scene, by_clip)


def _clips(data: Path) -> list[Clip]:
    """Those of the folder itself, or of its `tracks/`: other folders below hold clips to train on."""
    try:
        return drone_clips(data / "tracks" if (data / "tracks").is_dir() else data)
    except DataError:
        return []


def _frames(args: argparse.Namespace, every: int) -> list[LabelledFrame]:
    data, scenes = args.data, args.scene
    has_images = any((data / name).exists() for name in ("images.csv", "data.yaml", "images"))
    if _clips(data) and not has_images:
        return []
    frames = load_frames(data)
    clips = find_clips(args.frames_of) if args.frames_of else []
    places = origins(clips, frames)
    known = {frame.scene for frame in frames} | {place.scene for place in places.values()}
    if set(scenes) - known:
        unknown = ", ".join(sorted(set(scenes) - known))
        raise BenchmarkError(f"--scene {unknown}: expected some of {', '.join(sorted(known))}")

    def is_wanted(scene: str, source: str) -> bool:
        return scene in scenes or (args.held_out_negatives and held_out(scene, source))

    wanted = [frame for frame in frames if is_wanted(frame.scene, frame.source) or not scenes]
    for clip in clips:
        if is_wanted(places[clip.name].scene, places[clip.name].source):
            wanted += labelled_frames(clip, places[clip.name], every)
    return wanted


class _StandsStill:
    """What a detector may expect of a camera that does, and tracks nothing."""

    def boxes(self, exposed: float) -> Array:
        return np.empty((0, 6))

    def pixels_at(self, then: float, now: float) -> PixelMapping | None:
        return lambda pixels: pixels


class _TurnsKnown(_StandsStill):
    """The same of one whose turns are known."""

    def __init__(self, scenario: Scenario, observer: int) -> None:
        self._scenario = scenario
        self._observer = observer

    def pixels_at(self, then: float, now: float) -> PixelMapping | None:
        world, mount, camera = self._scenario.world, self._scenario.body_from_camera, self._scenario.camera
        looked, looks = (world.pose(self._observer, t) @ mount for t in (then, now))
        then_from_now = looked.rotation.T @ looks.rotation
        return lambda pixels: camera.project(camera.bearing(pixels) @ then_from_now.T)[0]


def look_at_flight(detector: Detector, scenario: Scenario, every: int) -> Iterator[ScoredImage]:
    """What the first drones of a scenario see, and what they should, once the others have left their places."""
    camera, mount = scenario.camera, scenario.body_from_camera
    renderer = Renderer(scenario.world, camera, mount)
    truth = SwarmTruth(scenario.world, scenario.cameras[:1])
    for observer in list(scenario.members)[:OBSERVERS]:
        expectation = _TurnsKnown(scenario, observer)
        for frame in range(0, int(FLIGHT_S * scenario.fps), every):
            t = FLIGHT_FROM_S + frame / scenario.fps
            picture = Frame(t, 0.0, 0, renderer.image(observer, t, frame), StampKind.MEDIA)
            found = detected(detector, picture, expectation)
            # Truth is undistorted, detections are not.
            boxes = np.array(list(truth.view(observer, t).in_view.values())).reshape(-1, 4)
            boxes[:, :2] = camera.distort(boxes[:, :2])
            yield ScoredImage(found, boxes)


def look_at_clip(detector: Detector, clip: Clip, every: int) -> Iterator[ScoredImage]:
    """Each `every`-th frame of a clip, with its labels."""
    truth = read_truth(clip.truth)
    for frame in frames(clip):
        if frame.sequence % every == 0:
            seen, boxes = detected(detector, frame, _StandsStill()), truth.get(frame.sequence)
            drones = EMPTY if boxes is None else np.concatenate([boxes.centre, boxes.size], axis=1)
            yield ScoredImage(seen, drones)


# --- counting -----------------------------------------------------------------------------------------


def _summaries(sets: dict[str, list[ScoredImage]], threshold: float) -> dict[str, Any]:
    if not sets:
        return {}
    everything = [look for looks in sets.values() for look in looks]
    named = {**dict(sorted(sets.items())), "all": everything}
    return {name: detector_score.summary(looks, threshold) for name, looks in named.items()}


def _fired(looks: Sequence[ScoredImage], thresholds: dict[str, float]) -> list[dict[str, Any]]:
    """For each kind of distractor the share of them that is taken for a drone, at each threshold."""
    counted = {name: detector_score.fired_on(looks, threshold) for name, threshold in thresholds.items()}
    return [
        {"kind": kind, "count": counted["threshold"][kind][1]}
        | {name: _share(fired[kind]) for name, fired in counted.items()}
        for kind in sorted({kind for fired in counted.values() for kind in fired})
    ]


def _share(fired: tuple[int, int] | None) -> float | None:
    return None if fired is None else round(fired[0] / fired[1], 4)


def _times(model: str, second_stage: str, repeats: int) -> dict[str, dict[str, float]]:
    """Milliseconds of a frame of noise, one thread: a picture that is neither empty nor kind to a cache."""
    times = {}
    for width, height in TIMED:
        detector = Detector(model, second_stage=second_stage, look="whole")
        image = np.random.default_rng(0).integers(0, 255, (height, width, 3)).astype(np.uint8)
        detector.warm_up(width, height)
        look = partial(detected, detector, Frame(0.0, 0.0, 0, image, StampKind.MEDIA))
        spent = 1e3 * np.array(spent_s(look, repeats, time.perf_counter))
        at = zip(("least", "p50", "p95"), np.percentile(spent, [0, 50, 95]).tolist(), strict=True)
        times[f"{width}x{height}"] = {name: round(ms, 2) for name, ms in at}
    return times


# --- telling ------------------------------------------------------------------------------------------

SET_COLUMNS: report.Columns = (
    ("", "{name}"),
    ("images", "{images:.0f}"),
    ("drones", "{drones:.0f}"),
    ("centre-AP", "{centre_ap:.3f}"),
    ("AP@0.5", "{ap50:.3f}"),
    ("recall at 1 false / image", "{recall_1fppi:.3f}"),
    ("at 0.1", "{recall_01fppi:.3f}"),
    ("recall at the threshold", "{recall:.3f}"),
    ("false / image", "{false_per_image:.2f}"),
    ("centre error px, median", "{centre_error_median_px:.2f}"),
    ("p90", "{centre_error_p90_px:.2f}"),
)
SIZE_COLUMNS = (("px", "{low:g} … {high:g}"), ("drones", "{drones}"), ("recall", "{recall:.3f}"))
TIME_COLUMNS = (("input", "{size}"), ("least", "{least:.2f}"), ("median", "{p50:.2f}"), ("p95", "{p95:.2f}"))
ANYTHING = "it takes for a drone (anything: images without a drone)"
# What nobody knows of a set without drones.
OF_DRONES = (
    "centre_ap", "ap50", "recall_1fppi", "recall_01fppi", "recall", "centre_error_median_px", "centre_error_p90_px"
)  # fmt: skip


def _page(result: dict[str, Any]) -> str:
    def sets(by: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
        unknown = dict.fromkeys(OF_DRONES)
        return [{**one, "name": name, **({} if one["drones"] else unknown)} for name, one in by.items()]

    sure = result["threshold_of_090_recall"]
    distractor_columns = (
        ("", "{kind}"),
        ("there are", "{count}"),
        (f"fired at {result['threshold']:g}", "{threshold:.0p%}"),
        (f"at {sure:g}, where recall is 0.9", "{at_090_recall:.0p%}"),
    )
    times = [{"size": size, **entry} for size, entry in result["ms_per_frame"].items()]
    tables: dict[str, tuple[report.Columns, list[dict[str, Any]]]] = {
        "Images": (SET_COLUMNS, sets(result["by_scene"])),
        "Clips": (SET_COLUMNS, sets(result["by_clip"])),
        "By size of the label's longer side, px": (SIZE_COLUMNS, result["by_size"]),
        f"What else {ANYTHING}": (distractor_columns, result["by_distractor"]),
        "Milliseconds a frame, one thread": (TIME_COLUMNS, times),
    }
    moved = "; clips with what moved" if result["motion"] else ""
    return report.page(
        f"# Detector {result['model']} on {result['data']}",
        f"Head {result['head']}, understood by {result['source']}; {result['file_mb']} MB; whole frames, input scale"
        f" {result['input_scale']:g}{moved}; threshold {result['threshold']:g}. A hit: the centre within max(6 px, half"
        " the longer side of the label). False / image: at that threshold.",
        *(f"## {title}\n\n{report.table_of(*table)}" for title, table in tables.items() if table[1]),
    )


BENCH = Benchmark(
    NAME,
    _measured,
    _page,
    options=(
        option("model", 'an .onnx file, or "default" for the one that is shipped', metavar="MODEL"),
        path("data", "a folder of labelled images (CSV, COCO or YOLO), of clips, or both", "DATA"),
        option("--input-scale", "input px per image px", type=float, default=1.0, metavar="S"),
        listed("--scene", "of the images only this one", "NAME"),
        option("--every", "of the clips each N-th frame", type=count, default=1, metavar="N"),
        SECOND_STAGE,
        flag("--motion", "of clips count what moved; their camera must stand"),
        listed("--scenario", "also a flight of the simulation, rendered", "NAME"),
        path("--frames-of", "clips of which each N-th frame counts as an image, if held out"),
        flag("--held-out-negatives", f"beside the scenes, the drone-free clips that {KEPT_UNSEEN}"),
    ),
)
