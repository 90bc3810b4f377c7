"""How far the shipped detector's boxes are off, by their size and by their score, and which pairs it tells apart.

Labels jitter, too, and drones shake, so the difference of the two is not the detector's noise. Third differences over
four frames in a row leave nothing of a smooth flight; what they hold of the shaking s is in detections d and labels l
alike, what they hold of the jitter in one of them only:

    var d = s² + σ_d²    var l = s² + σ_l²    cov(d, l) = s²    (each times 20, the sum of 1, 9, 9, 1)

So σ_d² = var d − cov(d, l), if detector and labels jitter independently. What stays for longer than a few frames (a box
that is centred beside the drone, a label that is loose) is in none of them: a tracker takes it for the target's place,
and so does its innovation.

How the noise depends on the score is judged box by box: the error against the label, less the median error of the
frames within 0.2 s; by its median, as the worst of doubtful boxes are those of something else.

Two drones are told apart where both labels are hit; their distance is in mean sides of their boxes, each axis in its
own.

The fit is that of the trackers' `measurement_noise`: σ² = floor² + side² (size_noise² + (score_noise (1 − s) / s)²).
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.clip_frames import look
from swarmtrack.benchmarks.harness import CLIPS, Benchmark
from swarmtrack.detection.detector import Detector
from swarmtrack.lab.score.clip_score import TrackPoints, TruthBoxes, match_hits
from swarmtrack.lab.score.intervals import Interval
from swarmtrack.messages import Array, Detections
from swarmtrack.training.labelled_clips import drone_clips, read_truth

QUICK_CLIPS = 2
THIRD = np.array([1.0, -3.0, 3.0, -1.0])
GAIN = float(THIRD @ THIRD)
SIDES = (0.0, 20.0, 27.0, 35.0, 45.0, 60.0, 80.0, 1000.0)  # px
SCORES = (0.33, 0.4, 0.45, 0.5, 0.55, 0.6, 0.7, 0.8, 0.9, 1.0)
APART = (0.0, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.5)  # distances of two drones, in mean sides of their boxes
SURE = 0.6  # score from which on a box counts as surely seen
NEAR_S = 0.2  # s within which slow errors are the same
FEWEST = 40  # boxes that make a figure
WORST = 5.0  # robust standard deviations beyond which a pair of box and label is of two things
RESAMPLES = 200
NORMAL_MAD = 1.4826  # standard deviation over median absolute value, of a normal distribution


class Sightings(NamedTuple):
    """One labelled drone and what was found of it. frame (n,); box, label (n, 2) px, their centres; size (n, 2) px of
    the box; score (n,)."""

    frame: Array
    box: Array
    label: Array
    size: Array
    score: Array
    fps: float


class Jitter(NamedTuple):
    """Third differences over four frames, an axis a row: of boxes and labels [px], beside the box's side there [px]."""

    box: Array
    label: Array
    side: Array

    def within(self, low: float, high: float) -> Jitter:
        rows = (self.side >= low) & (self.side < high)
        return Jitter(self.box[rows], self.label[rows], self.side[rows])


class Residuals(NamedTuple):
    """Errors less those around them, an axis a row: as a share of the box's side, beside its score."""

    share: Array
    score: Array


def pair(seen: Sequence[Detections], truth: dict[int, TruthBoxes], fps: float) -> list[Sightings]:
    """The boxes that hit a label, by labelled drone."""
    found: dict[int, list[tuple[float, ...]]] = {}
    for detections in seen:
        labelled = truth.get(detections.sequence)
        if labelled is None:
            continue
        boxes = TrackPoints(np.arange(len(detections)), detections.centre)
        for row, column, _ in zip(*match_hits(labelled, boxes), strict=True):
            entry = (
                detections.sequence, *detections.centre[column], *labelled.centre[row], *detections.size[column],
                detections.score[column],
            )  # fmt: skip
            found.setdefault(int(labelled.id[row]), []).append(entry)
    tables = [np.array(rows) for rows in found.values()]
    return [Sightings(t[:, 0], t[:, 1:3], t[:, 3:5], t[:, 5:7], t[:, 7], fps) for t in tables]


def jitter(drone: Sightings) -> Jitter:
    """Of all that was surely seen in four frames in a row."""
    runs = np.lib.stride_tricks.sliding_window_view(np.arange(len(drone.frame)), len(THIRD))
    in_a_row = drone.frame[runs[:, -1]] - drone.frame[runs[:, 0]] == len(THIRD) - 1
    runs = runs[in_a_row & (drone.score[runs].min(axis=1) >= SURE)]
    box, label = (np.einsum("k,nka->na", THIRD, centre[runs]).ravel() for centre in (drone.box, drone.label))
    return Jitter(box, label, drone.size[runs].mean(axis=1).ravel())


def residuals(drone: Sightings) -> Residuals:
    error, reach = drone.box - drone.label, NEAR_S * drone.fps
    share, score = [], []
    for i, frame in enumerate(drone.frame):
        around = np.abs(drone.frame - frame) <= reach
        around[i] = False
        if around.sum() >= reach:
            usual = np.median(error[around], axis=0)
            share.append((error[i] - usual) / np.median(drone.size[around], axis=0))
            score.append([drone.score[i]] * 2)
    return Residuals(np.array(share).ravel(), np.array(score).ravel())


def separated(found: Jitter) -> tuple[float, float, float]:
    """Variances px² of boxes, of labels, and of what both show; without pairs of box and label of different things."""
    apart = np.abs(found.box - found.label)
    good = apart <= WORST * NORMAL_MAD * np.median(apart)
    box, label = found.box[good], found.label[good]
    shaking = float(np.mean(box * label))
    of_box, of_label = (float(np.mean(jitter**2)) - shaking for jitter in (box, label))
    return of_box / GAIN, of_label / GAIN, shaking / GAIN


def by_side(found: Jitter) -> list[dict[str, float]]:
    rows = []
    for low, high in pairwise(SIDES):
        part = found.within(low, high)
        if len(part.side) >= FEWEST:
            box, label, shaking = separated(part)
            roots = {"box_px": _root(box), "label_px": _root(label), "shaking_px": _root(shaking)}
            rows.append({"pairs": len(part.side), "side_px": float(part.side.mean()), **roots})
    return rows


def by_score(found: Residuals) -> list[dict[str, float]]:
    rows = []
    for low, high in pairwise(SCORES):
        within = (found.score >= low) & (found.score < high)
        share = found.share[within]
        if len(share) >= FEWEST:
            score = float(found.score[within].mean())
            noise = float(NORMAL_MAD * np.median(np.abs(share)))
            rows.append({"pairs": len(share), "score": score, "share_of_side": noise})
    return rows


def fit(sides: list[dict[str, float]], scores: list[dict[str, float]]) -> dict[str, float]:
    """floor px, size_noise and score_noise: the least squares of relative errors of the variances in both tables."""
    side = np.array([row["side_px"] for row in sides])
    variance = np.array([row["box_px"] ** 2 for row in sides])
    floor, size_noise = _two_terms(np.ones_like(side), side**2, variance, [row["pairs"] for row in sides])
    doubt = np.array([((1.0 - row["score"]) / row["score"]) ** 2 for row in scores])
    share = np.array([row["share_of_side"] ** 2 for row in scores])
    _, score_noise = _two_terms(np.ones_like(doubt), doubt, share, [row["pairs"] for row in scores])
    return {"floor_px": floor, "size_noise": size_noise, "score_noise": score_noise}


def _two_terms(a: Array, b: Array, variance: Array, count: Sequence[float]) -> tuple[float, float]:
    """The roots of x, y ≥ 0 with x a + y b ≈ variance, whose relative error goes as 1 / sqrt(count)."""
    weight = np.sqrt(np.asarray(count)) / np.maximum(variance, 1e-12)
    A = np.column_stack([a, b]) * weight[:, None]
    solution = np.linalg.lstsq(A, variance * weight, rcond=None)[0]
    return _root(float(solution[0])), _root(float(solution[1]))


def _root(value: float) -> float:
    return float(np.sqrt(max(value, 0.0)))


def told_apart(seen: Sequence[Detections], truth: dict[int, TruthBoxes]) -> Array:
    """(k, 2) of each two labelled drones in a frame: their distance in mean sides, and whether both are hit."""
    rows = []
    for detections in seen:
        labelled = truth.get(detections.sequence)
        if labelled is None:
            continue
        hits = match_hits(labelled, TrackPoints(np.arange(len(detections)), detections.centre))[0]
        i, j = np.triu_indices(len(labelled.id), 1)
        sides = 0.5 * (labelled.size[i] + labelled.size[j])
        apart = np.linalg.norm((labelled.centre[i] - labelled.centre[j]) / sides, axis=1)
        rows.append(np.column_stack([apart, np.isin(i, hits) & np.isin(j, hits)]))
    return np.concatenate([np.empty((0, 2)), *rows])


def by_distance(pairs: Array) -> list[dict[str, float]]:
    """pairs (k, 2): see `told_apart`."""
    rows = []
    for low, high in pairwise(APART):
        part = pairs[(pairs[:, 0] >= low) & (pairs[:, 0] < high)]
        if len(part):
            apart, both = part.mean(axis=0).tolist()
            rows.append({"pairs": len(part), "sides_apart": apart, "both_found": both})
    return rows


def measure(drones: Sequence[Sightings]) -> dict[str, Any]:
    """Both tables and the fit, with 95 % intervals over drones drawn with replacement."""
    jitters, rests = [jitter(drone) for drone in drones], [residuals(drone) for drone in drones]

    def joined(parts: Sequence[Any], drawn: Sequence[int]) -> list[Array]:
        return [np.concatenate(part) for part in zip(*(parts[i] for i in drawn), strict=True)]

    def tables(drawn: Sequence[int]) -> tuple[list[dict[str, float]], list[dict[str, float]]]:
        return by_side(Jitter(*joined(jitters, drawn))), by_score(Residuals(*joined(rests, drawn)))

    n, rng = len(drones), np.random.default_rng(0)
    sides, scores = tables(range(n))
    drawn = [fit(*tables(rng.integers(n, size=n).tolist())) for _ in range(RESAMPLES)]
    fitted = {}
    for name, value in fit(sides, scores).items():
        low, high = np.percentile([each[name] for each in drawn], [2.5, 97.5])
        fitted[name] = Interval(value, float(low), float(high))._asdict()
    return {"sides": sides, "scores": scores, **fitted}


def _measured(args: argparse.Namespace) -> dict[str, Any]:
    """Look at every clip."""
    clips = drone_clips(args.data)[: QUICK_CLIPS if args.quick else None]
    detector = Detector()
    drones: list[Sightings] = []
    pairs = []
    with report.progress("detection noise", len(clips)) as advance:
        for clip in clips:
            seen, truth = look(clip, detector), read_truth(clip.truth)
            drones += pair(seen, truth, clip.fps)
            pairs.append(told_apart(seen, truth))
            advance(clip.name)
    return {
        "clips": [clip.name for clip in clips],
        "drones": len(drones),
        **measure(drones),
        "apart": by_distance(np.concatenate(pairs)),
    }


SIDE_COLUMNS = (
    ("side, px", "{side_px:.0f}"),
    ("pairs", "{pairs}"),
    ("σ of boxes, px", "{box_px:.2f}"),
    ("σ of labels, px", "{label_px:.2f}"),
    ("shaking of both, px", "{shaking_px:.2f}"),
)
SCORE_COLUMNS = (("score", "{score:.2f}"), ("pairs", "{pairs}"), ("σ, % of the side", "{share_of_side:.1p}"))
FIT_COLUMNS = (("", "{name}"), ("fit", "{value:.4f}"), ("from", "{low:.4f}"), ("to", "{high:.4f}"))
APART_COLUMNS = (
    ("mean sides apart", "{sides_apart:.2f}"),
    ("pairs", "{pairs}"),
    ("both found, %", "{both_found:.0p}"),
)


def _page(result: dict[str, Any]) -> str:
    fitted = [{"name": name, **result[name]} for name in ("floor_px", "size_noise", "score_noise")]
    return report.page(
        "# Detection noise",
        f"{result['drones']} labelled drones in {len(result['clips'])} clips, frame to frame, per axis.",
        f"By the box's side, of score {SURE:g} and more:",
        report.table_of(SIDE_COLUMNS, result["sides"]),
        "By score, all sizes, beside the error of the frames around:",
        report.table_of(SCORE_COLUMNS, result["scores"]),
        "σ² = floor² + side² (size_noise² + (score_noise (1 − s) / s)²), 95 % over drones:",
        report.table_of(FIT_COLUMNS, fitted),
        "Of two labelled drones, by their distance, both found:",
        report.table_of(APART_COLUMNS, result["apart"]),
    )


BENCH = Benchmark("detection-noise", _measured, _page, options=(CLIPS,))
