"""How wide a detector draws its boxes: on drawn drones of known span and distance, and on labelled real ones.

The detector looks as an agent's does. Of each box its width is set beside that of the span at that distance, and
`calibration/box_width.py` fits width = factor · span + padding, with errors of its logarithm (docs/model.md).

Nobody measured the real drones of `--clips`. There the width of the label stands for the drone's, or what differs from
the sky where that is smooth (`dataset.cut_out`). The errors that a model should state are the larger ones of drawn
drones and of real ones beside what is visible (without `--clips`: those of the default).

Ranges by the width alone are off by a mean over drones, from drone to drone, and within a flight, all of their
logarithm. --write writes what is to be stated into the file that widths are of.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from swarmtrack.arguments import require_extra
from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.clip_frames import detected, frames
from swarmtrack.benchmarks.harness import PROCESSES, SECOND_STAGE, Benchmark, flag, flown, option, path, seeds
from swarmtrack.calibration.box_width import (
    FEWEST_BOXES_OF_DRONE,
    OTHER_THING,
    WidthFit,
    Widths,
    fit_box_width,
    level_width,
)
from swarmtrack.clock import SystemClock
from swarmtrack.config.drone import DetectorSection
from swarmtrack.detection.detector import Detector
from swarmtrack.detection.expectation import PixelMapping
from swarmtrack.detection.model import model_path
from swarmtrack.detection.second_stage import SecondStage
from swarmtrack.geometry import rotation
from swarmtrack.geometry.pose import Pose
from swarmtrack.lab.scenarios.scenario import BODY_FROM_CAMERA, CAMERA
from swarmtrack.lab.score.clip_score import TrackPoints, match_hits
from swarmtrack.lab.world.airframe import Airframe
from swarmtrack.lab.world.rendering import Renderer
from swarmtrack.lab.world.world import World
from swarmtrack.messages import Array, Frame, StampKind
from swarmtrack.relative.box_width import BoxWidth
from swarmtrack.relative.priors import LEAST_DRONE_SHARE
from swarmtrack.runtime.perception import detector_of
from swarmtrack.training.dataset import cut_out
from swarmtrack.training.labelled_clips import drone_clips, read_truth

NAME = "box-width"
USUAL = Airframe()
SHAPES = {
    "usual": USUAL,
    "racer": replace(
        USUAL, body_length=0.12, body_width=0.07, body_top=-0.04, body_bottom=0.035, legs_z=0.04
    ),
    "small rotors": replace(USUAL, rotor_radius=0.075),
    "tall": replace(USUAL, body_top=-0.08, body_bottom=0.09, legs_z=0.16),
    "long": replace(USUAL, body_length=0.32, body_width=0.08),
}
"""Of drawn drones, by turns."""
SECONDS, FPS = 20.0, 10.0
SPANS_M = (0.3, 0.8)
NEAREST_PX, NARROWEST_PX = 110.0, 10.0
HEIGHT_M = 20.0
OBSERVER, SEEN = 1, 2
# Of a box's longer side, and px: how far from where the drone is the middle of its box may be.
HIT, HIT_PX = 0.6, 8.0
# px: of a track's place, 3 σ.
EXPECTED_PX = 6.0


class Hovering:
    """The observer."""

    def pose(self, t: float) -> Pose:
        """world_from_body: level, looking north."""
        return Pose(np.eye(3), self.position(t))

    def position(self, t: float) -> Array:
        return np.array([0.0, 0.0, -HEIGHT_M])


class FlyingAway:
    """A drone that flies away from the observer, turning and banking."""

    def __init__(self, span: float, chance: np.random.Generator) -> None:
        near, far = (span * CAMERA.fx / px for px in (NEAREST_PX, NARROWEST_PX))
        self._near, self._rate = near, math.log(far / near) / SECONDS
        self._azimuth, self._elevation = chance.uniform(-0.45, 0.45), chance.uniform(-0.2, 0.2)
        self._yaw, self._turning = chance.uniform(0.0, 2.0 * math.pi), chance.uniform(-0.6, 0.6)

    def pose(self, t: float) -> Pose:
        """world_from_body."""
        roll, pitch = 0.1 * math.sin(1.1 * t), 0.1 * math.cos(0.9 * t)
        return Pose(rotation.from_euler(roll, pitch, self._yaw + self._turning * t), self.position(t))

    def position(self, t: float) -> Array:
        far, azimuth = self._near * math.exp(self._rate * t), self._azimuth + 0.08 * math.sin(0.5 * t)
        level = far * math.cos(self._elevation)
        down = -HEIGHT_M - far * math.sin(self._elevation)
        return np.array([level * math.cos(azimuth), level * math.sin(azimuth), down])


class LastBox:
    """What a tracker would expect: the drone where its last box was."""

    def __init__(self) -> None:
        self.box = np.empty((0, 6))

    def boxes(self, exposed: float) -> Array:
        return self.box

    def pixels_at(self, then: float, now: float) -> PixelMapping | None:
        """The camera does not turn."""
        return lambda pixels: pixels


def fly(model: str, second_stage: str, seed: int) -> Widths:
    """One flight of one drone."""
    chance = np.random.default_rng((seed, 18))
    shape = list(SHAPES.values())[seed % len(SHAPES)]
    span = math.exp(chance.uniform(*np.log(SPANS_M)))
    flown = FlyingAway(span, chance)
    world = World(seed, {OBSERVER: Hovering(), SEEN: flown}, {SEEN: shape.scaled(span)})
    renderer = Renderer(world, CAMERA, BODY_FROM_CAMERA)
    detector = detector_of(DetectorSection(model=model, second_stage=second_stage), SystemClock())
    expected, rows = LastBox(), []
    camera = world.pose(OBSERVER, 0.0) @ BODY_FROM_CAMERA
    for k in range(int(SECONDS * FPS)):
        t = k / FPS
        frame = Frame(t, 0.0, k, renderer.image(OBSERVER, t, k), StampKind.EXPOSURE)
        found = detected(detector, frame, expected)
        away = flown.position(t) - camera.position
        pixel = CAMERA.project_undistorted(away[None] @ camera.rotation)[0]
        off = np.linalg.norm(found.centre - pixel, axis=1)
        hit = np.flatnonzero(off < np.maximum(HIT * found.size.max(axis=1, initial=0.0), HIT_PX))
        expected.box = np.empty((0, 6))
        if len(hit):
            i = hit[off[hit].argmin()]
            expected.box = np.array([[*found.centre[i], EXPECTED_PX, EXPECTED_PX, *found.size[i]]])
            rows.append((t, level_width(away, span, CAMERA, camera.rotation), found.size[i, 0]))
    return Widths(*np.array(rows).reshape(-1, 3).T)


class RealWidths(NamedTuple):
    """Of the same drones, beside the widths of their labels, and beside what is visible of them."""

    labels: list[Widths]
    visible: list[Widths]


def on_clips(data: Path, detector: Detector, *, limit: int | None = None) -> RealWidths:
    """Real drones."""
    found = RealWidths([], [])
    for clip in drone_clips(data)[:limit]:
        labels: dict[int, list[tuple[float, float, float]]] = {}
        visible: dict[int, list[tuple[float, float, float]]] = {}
        truth = read_truth(clip.truth)
        for frame in frames(clip):
            labelled, seen = truth.get(frame.sequence), detector.detect(detector.plan(frame))
            if labelled is None or seen is None:
                continue
            boxes = TrackPoints(np.arange(len(seen)), seen.centre)
            for row, column, _ in zip(*match_hits(labelled, boxes), strict=True):
                drone, width = int(labelled.id[row]), float(seen.size[column, 0])
                labels.setdefault(drone, []).append((frame.t, float(labelled.size[row, 0]), width))
                cut = cut_out(frame.image, np.concatenate([labelled.centre[row], labelled.size[row]]))
                if cut is not None:
                    visible.setdefault(drone, []).append((frame.t, float(cut.tight[2]), width))
        for tables, kept in ((labels, found.labels), (visible, found.visible)):
            kept += [Widths(*np.array(table).T) for table in tables.values()]
    return found


def telling(detector: Detector) -> SecondStage | None:
    """What makes boxes as wide as spans; None where the detector draws them alone."""
    second = detector.second_stage
    return second if second is not None and second.tells_spans else None


def answered(detector: Detector, drones: Sequence[Widths]) -> list[Widths]:
    """The same with spans instead of boxes, as the second stage answers them, if it tells any."""
    if (second := telling(detector)) is None:
        return list(drones)
    drawn, told = detector.description.box_width or BoxWidth(), second.box_width
    spans = [(drone.box_px - drawn.padding_px) / drawn.factor for drone in drones]
    return [
        drone._replace(box_px=np.maximum(told.factor * span + told.padding_px, 1.0))
        for drone, span in zip(drones, spans, strict=True)
    ]


class RangeErrors(NamedTuple):
    """Of ln(distance) by the width of a box alone: the mean over drones, from drone to drone, within one."""

    bias: float
    drone: float
    within: float


def range_errors(drones: Sequence[Widths], believed: BoxWidth) -> RangeErrors:
    """Where boxes are believed to be so wide; without boxes of something else."""
    off = []
    for drone in drones:
        wide = np.maximum(drone.box_px - believed.padding_px, LEAST_DRONE_SHARE * drone.box_px)
        error = np.log(drone.span_px / (wide / believed.factor))
        off.append(error[np.abs(error) < OTHER_THING])
    off = [errors for errors in off if len(errors) >= FEWEST_BOXES_OF_DRONE]
    means = [float(errors.mean()) for errors in off]
    within = math.sqrt(float(np.mean([errors.var() for errors in off])))
    return RangeErrors(float(np.mean(means)), float(np.std(means)), within)


def stated(drawn: WidthFit, real: BoxWidth) -> BoxWidth:
    """What a model should say of itself: the widths of drawn drones, and errors as large as on any."""
    names = ("drone_sigma", "wander_sigma", "white_sigma")
    worse = {name: max(getattr(drawn.width, name), getattr(real, name)) for name in names}
    return replace(drawn.width, **worse, wander_s=real.wander_s)


def _measured(args: argparse.Namespace) -> dict[str, Any]:
    if args.write:
        require_extra("train", "onnx", of="--write")
    parts = [("", partial(fly, args.model, args.second_stage))]
    (flights,) = flown(NAME, parts, range(1, args.seeds + 1), processes=args.processes)
    detector = Detector(args.model, second_stage=args.second_stage)
    flights = answered(detector, flights)
    drawn = fit_box_width(flights)
    rows = {"drawn": _record(drawn, flights)}
    real = BoxWidth()
    if args.clips is not None:
        some = on_clips(args.clips, detector, limit=2 if args.quick else None)
        labels, visible = (answered(detector, drones) for drones in some)
        real = (by_sight := fit_box_width(visible)).width
        rows |= {"labels": _record(fit_box_width(labels), labels), "visible": _record(by_sight, visible)}
    says, second = asdict(stated(drawn, real)), detector.second_stage
    if args.write:
        # Only who writes models needs the package `onnx`.
        from swarmtrack.training.annotation import annotate  # noqa: PLC0415

        spans = telling(detector)
        annotate(detector.path if spans is None else spans.path, {"box_width": json.dumps(says)})
    return {
        "model": model_path(args.model).name,
        "second_stage": None if second is None else second.path.name,
        "of": "a box" if telling(detector) is None else "a span as the second stage answers it",
        "rows": rows,
        "stated": says,
    }


def _record(found: WidthFit, drones: Sequence[Widths]) -> dict[str, Any]:
    return {
        "boxes": found.boxes,
        "drones": found.drones,
        **asdict(found.width),
        "ranges": range_errors(drones, found.width)._asdict(),
    }


COLUMNS: report.Columns = (
    ("", "{name}"),
    ("drones", "{drones}"),
    ("boxes", "{boxes}"),
    ("factor", "{factor:.2f}"),
    ("padding, px", "{padding_px:.1f}"),
    ("drone to drone, %", "{drone_sigma:.0p}"),
    ("wandering, %", "{wander_sigma:.0p}"),
    ("within, s", "{wander_s:.1f}"),
    ("white, %", "{white_sigma:.0p}"),
    ("ranges: bias, %", "{ranges[bias]:.1p}"),
    ("drone to drone, %", "{ranges[drone]:.1p}"),
    ("within one, %", "{ranges[within]:.1p}"),
)
ROW_NAMES = {
    "drawn": "drawn drones, beside the span",
    "labels": "real drones, beside the label",
    "visible": "… beside what is visible",
    "stated": "for the metadata",
}
NOT_STATED = {"drones": None, "boxes": None, "ranges": dict.fromkeys(RangeErrors._fields)}


def _page(result: dict[str, Any]) -> str:
    rows = {**result["rows"], "stated": NOT_STATED | result["stated"]}
    rows = {ROW_NAMES[key]: row for key, row in rows.items()}
    return report.page(
        "# How wide boxes are",
        f"`{result['model']}`, second stage `{result['second_stage']}`, looking as an agent does at drawn drones of "
        f"{len(SHAPES)} shapes, and at whole frames of real ones. Width of {result['of']} = factor · width + padding; "
        "errors of its logarithm, and of that of the distance that it tells.",
        report.table_by_name(COLUMNS, rows),
    )


BENCH = Benchmark(
    NAME,
    _measured,
    _page,
    options=(
        seeds(30, quick=5),
        PROCESSES,
        option(
            "--model", '"default" or an .onnx file (default: %(default)s)', default="default", metavar="FILE"
        ),
        SECOND_STAGE,
        path("--clips", "labelled clips of real drones: pairs of NAME.mp4 and NAME_gt.csv"),
        flag("--write", "write what was found into the model's metadata"),
    ),
)
