"""Our trackers and those of others by the field's metrics, all given the same detections (docs/tracking.md).

Sequences are our labelled clips, and boxes of drones seen from a flying drone (`mot_sequences.py`). No tracker is told
how the camera turns. Misses, noise and false boxes are drawn, with the same seed for all.

A track is where a drone is as clips are judged everywhere here: similarity is 1 − d / 2r for a distance d of the
centres and r = max(6 px, half the longer side), so that 0.5, from which on a match counts, is a hit. Overlaps say
little of boxes of ten pixels, and filters without boxes have none.

    pip install 'swarmtrack[mot]'; pip install --no-deps norfair filterpy
    swarmtrack bench mot --clips DATA --annotations FOLDER --out DIR
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from swarmtrack.benchmarks import mot_page, report
from swarmtrack.benchmarks.harness import Benchmark, amount, path
from swarmtrack.benchmarks.mot_sequences import (
    DetectedFrame,
    Faults,
    LabelledSequence,
    annotated_sequences,
    clip_sequences,
    detected,
)
from swarmtrack.benchmarks.report import BenchmarkError
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.lab.score.clip_score import TruthBoxes
from swarmtrack.messages import Array, Scan, TrackStatus
from swarmtrack.tracking import AGENT_PARAMETERS, TRACKERS, create_tracker

NAME = "mot"
STEPS = (1, 2, 5, 10)
SEED = 20_261_129
LARGER = (1.0, 4.0)
BY_OVERLAP = {
    "SORT": "SORTTracker",
    "ByteTrack": "ByteTrackTracker",
    "OC-SORT": "OCSORTTracker",
    "BoT-SORT": "BoTSORTTracker",
}
LEAST_RADIUS_PX = 6.0
FOCAL_PX = 430.0  # of the camera that the default parameters are for
USUAL_WIDTH_PX = 640


class Followed(NamedTuple):
    """What a tracker shows in one frame: id (m,), centre (m, 2) px."""

    id: NDArray[np.int64]
    centre: Array


class Follower(Protocol):
    def follow(self, t: float, found: DetectedFrame) -> Followed: ...


MakeFollower = Callable[[LabelledSequence], Follower]


class Ours:
    """One of our trackers, with an agent's parameters; those in pixels grow with the image."""

    def __init__(self, name: str, sequence: LabelledSequence) -> None:
        width, height = sequence.size
        larger = max(width / USUAL_WIDTH_PX, 1.0)
        focal = FOCAL_PX * larger
        camera = PinholeCamera(focal, focal, 0.5 * (width - 1), 0.5 * (height - 1), width, height)
        told = {"acceleration_psd": 1e4 * larger**2, "birth_speed_sigma": 100.0 * larger}
        self._tracker = create_tracker(name, camera=camera, **AGENT_PARAMETERS, **told)

    def follow(self, t: float, found: DetectedFrame) -> Followed:
        self._tracker.predict(t)
        self._tracker.update(Scan(t, found.centre, size=found.size, score=found.score))
        shown = [track for track in self._tracker.tracks if track.status is TrackStatus.CONFIRMED]
        return Followed(
            np.array([track.id for track in shown], np.int64),
            np.array([track.mean[::2] for track in shown]).reshape(-1, 2),
        )


class Boxed:
    """A tracker of the package `trackers`, with its own defaults, told the frame rate. larger: by which boxes are
    enlarged about their centres, for trackers that match by overlap."""

    def __init__(self, kind: Any, larger: float, sequence: LabelledSequence) -> None:
        # There are no images to measure the camera's motion in.
        told = {"enable_cmc": False} if kind.__name__ == BY_OVERLAP["BoT-SORT"] else {}
        self._tracker, self._half = kind(frame_rate=sequence.hz, **told), 0.5 * larger

    def follow(self, t: float, found: DetectedFrame) -> Followed:
        import supervision  # noqa: PLC0415

        half = self._half * found.size
        corners = np.hstack([found.centre - half, found.centre + half])
        given = supervision.Detections(
            xyxy=corners.astype(np.float32),
            confidence=found.score.astype(np.float32),
            class_id=np.zeros(len(corners), int),
        )
        shown = self._tracker.update(given)
        ids = np.asarray(shown.tracker_id if shown.tracker_id is not None else [], np.int64)
        boxes = np.asarray(shown.xyxy, float).reshape(-1, 4)[: len(ids)][ids >= 0]
        return Followed(ids[ids >= 0], 0.5 * (boxes[:, :2] + boxes[:, 2:]))


class Norfair:
    """The package norfair, by distances of centres: 0.2 s of delay, 1 s of patience, as its guide has it for videos."""

    def __init__(self, sequence: LabelledSequence) -> None:
        import norfair  # noqa: PLC0415

        self._detection = norfair.Detection
        self._tracker = norfair.Tracker(
            distance_function="euclidean",
            distance_threshold=50.0 * max(sequence.size[0] / USUAL_WIDTH_PX, 1.0),
            hit_counter_max=max(round(sequence.hz), 3),
            initialization_delay=min(max(round(0.2 * sequence.hz), 1), 2),
        )

    def follow(self, t: float, found: DetectedFrame) -> Followed:
        given = [
            self._detection(centre[None], np.array([score]))
            for centre, score in zip(found.centre, found.score, strict=True)
        ]
        shown = [one for one in self._tracker.update(given) if one.live_points.any()]
        return Followed(
            np.array([one.id for one in shown], np.int64),
            np.array([one.estimate[0] for one in shown]).reshape(-1, 2),
        )


def followers() -> dict[str, MakeFollower]:
    """Ours, and the peers that are installed."""
    found: dict[str, MakeFollower] = {name: partial(Ours, name) for name in TRACKERS}
    try:
        import trackers  # noqa: PLC0415

        for name, kind in BY_OVERLAP.items():
            make = getattr(trackers, kind, None)
            for larger in LARGER if make is not None else ():
                found[name if larger == 1.0 else f"{name}, boxes × {larger:g}"] = partial(Boxed, make, larger)
    except ImportError:
        pass
    try:
        import norfair  # noqa: F401, PLC0415

        found["norfair"] = Norfair
    except ImportError:
        pass
    return found


def similarity(truth: TruthBoxes, shown: Followed) -> Array:
    """(n, m) of boxes and tracks, 0 … 1; see the module."""
    distance = np.linalg.norm(truth.centre[:, None] - shown.centre[None], axis=2)
    radius = np.maximum(LEAST_RADIUS_PX, 0.5 * truth.size.max(axis=1, initial=0.0))
    return np.asarray(np.maximum(1.0 - distance / (2.0 * radius[:, None]), 0.0))


def as_given(frames: Sequence[TruthBoxes], shown: Sequence[Followed]) -> dict[str, Any]:
    """One sequence in the form that TrackEval's metrics take."""
    labels, label = np.unique(np.concatenate([frame.id for frame in frames]), return_inverse=True)
    tracks, track = np.unique(np.concatenate([one.id for one in shown]), return_inverse=True)
    of_frames = np.cumsum([len(frame.id) for frame in frames])[:-1]
    of_shown = np.cumsum([len(one.id) for one in shown])[:-1]
    return {
        "gt_ids": np.split(label, of_frames),
        "tracker_ids": np.split(track, of_shown),
        "similarity_scores": [similarity(a, b) for a, b in zip(frames, shown, strict=True)],
        "num_gt_dets": len(label),
        "num_tracker_dets": len(track),
        "num_gt_ids": len(labels),
        "num_tracker_ids": len(tracks),
        "num_timesteps": len(frames),
    }


def _metrics() -> dict[str, Any]:
    try:
        from trackeval.metrics import CLEAR, HOTA, Identity  # noqa: PLC0415
    except ImportError as error:
        raise BenchmarkError(
            "bench mot: the package trackeval is missing, expected: pip install 'swarmtrack[mot]'"
        ) from error
    quiet = {"PRINT_CONFIG": False}
    return {"HOTA": HOTA(), "CLEAR": CLEAR(quiet), "Identity": Identity(quiet)}


def scored(results: Mapping[str, dict[str, Any]], metrics: Mapping[str, Any]) -> dict[str, float]:
    """The field's figures over sequences, by their names, each with a result of `as_given`."""
    total = {
        name: metric.combine_sequences({key: metric.eval_sequence(given) for key, given in results.items()})
        for name, metric in metrics.items()
    }
    return {
        "HOTA": float(np.mean(total["HOTA"]["HOTA"])),
        "AssA": float(np.mean(total["HOTA"]["AssA"])),
        "IDF1": float(total["Identity"]["IDF1"]),
        "MOTA": float(total["CLEAR"]["MOTA"]),
        "switches": float(total["CLEAR"]["IDSW"]),
    }


def follow_all(
    make: MakeFollower, sequence: LabelledSequence, frames: Sequence[DetectedFrame]
) -> list[Followed]:
    follower = make(sequence)
    return [follower.follow(k / sequence.hz, found) for k, found in enumerate(frames)]


def _sources(args: argparse.Namespace) -> Iterator[tuple[str, list[LabelledSequence]]]:
    if args.clips is None and args.annotations is None:
        raise BenchmarkError("bench mot: expected --clips DATA, --annotations FOLDER, or both")
    if args.clips is not None:
        yield "clips", clip_sequences(args.clips)
    if args.annotations is not None:
        every = annotated_sequences(args.annotations)
        yield "from a flying drone", every[args.every - 1 :: args.every]


def _measured(args: argparse.Namespace) -> dict[str, Any]:
    metrics, faults, found = _metrics(), Faults(), followers()
    tables: dict[str, dict[str, dict[str, dict[str, float]]]] = {}
    sources = list(_sources(args))
    with report.progress(NAME, len(sources) * len(STEPS) * len(found)) as advance:
        for source, sequences in sources:
            for step in STEPS:
                thinned = [one.every(step) for one in sequences]
                given = [
                    detected(one, faults, np.random.default_rng([SEED, step, k]))
                    for k, one in enumerate(thinned)
                ]
                row = tables.setdefault(source, {}).setdefault(f"{thinned[0].hz:g} Hz", {})
                for name, make in found.items():
                    began = time.thread_time()
                    shown = [follow_all(make, *pair) for pair in zip(thinned, given, strict=True)]
                    ms = 1e3 * (time.thread_time() - began) / sum(len(one.frames) for one in thinned)
                    pairs = zip(thinned, shown, strict=True)
                    results = {one.name: as_given(one.frames, tracks) for one, tracks in pairs}
                    row[name] = scored(results, metrics) | {"ms": ms}
                    advance(f"{source}, {thinned[0].hz:g} Hz, {name}")
    about = {
        source: {
            "sequences": len(sequences),
            "frames": sum(len(one.frames) for one in sequences),
            "boxes": sum(len(frame.id) for one in sequences for frame in one.frames),
        }
        for source, sequences in sources
    }
    mot_page.draw(args.out / f"{NAME}.png", tables)
    return {"seed": SEED, "about": about, "tables": tables}


BENCH = Benchmark(
    NAME,
    _measured,
    mot_page.page,
    options=(
        path("--clips", "a folder with pairs of NAME.mp4 and NAME_gt.csv", "DATA"),
        path("--annotations", "a folder with Video_*_gt.txt"),
        amount("--every", 5, 25, "of the annotated videos, every Nth"),
    ),
    draws=True,
)
