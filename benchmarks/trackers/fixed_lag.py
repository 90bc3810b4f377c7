"""What waiting is worth: the error of a tracker's estimates at once, and of its smoothed ones some scans later.

Both are judged at the same scans and targets of the scenes of `swarmtrack bench trackers`, so that the ratio tells of
nothing else.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from swarmtrack.arguments import count
from swarmtrack.benchmarks.harness import TRACKER, Flights, Row, amount, option
from swarmtrack.benchmarks.report import BenchmarkError
from swarmtrack.benchmarks.trackers.play import make_tracker
from swarmtrack.benchmarks.trackers.scenes import film, find_scene
from swarmtrack.lab.score.intervals import bootstrap_interval
from swarmtrack.messages import Array, Track

SCENES = ("noise.25", "noise.50", "noise.75", "pd.80", "mixedA", "mixedB", "crossing", "rotating")


def play(scene_name: str, tracker: str, scans: int, run: int) -> tuple[float, float]:
    """Mean squared errors px² of one run with known starts: at once, and so many scans later."""
    scene = find_scene(scene_name)
    take = film(scene, run)
    if take.start is None:
        raise BenchmarkError(f"--scene {scene_name}: nobody tells the starts there, expected one that does")
    player = make_tracker(scene, tracker, {"lag_s": scans / scene.rate_hz})
    ids = player.initiate(float(take.t[0]), take.start)
    at_once, later = np.full(take.truth.shape[:2], np.nan), np.full(take.truth.shape[:2], np.nan)
    for scan, _, rotation, variance in take.observations:
        player.predict(scan.t, rotation, variance)
        player.update(scan)
        _judge(player.tracks, ids, take.t, take.truth, at_once)
        _judge(player.smoothed, ids, take.t, take.truth, later)
    both = np.isfinite(at_once) & np.isfinite(later)
    return float(at_once[both].mean()), float(later[both].mean())


def _judge(tracks: Sequence[Track], ids: Sequence[int], t: Array, truth: Array, squared_error: Array) -> None:
    """Write the squared errors px² of these tracks to their scans and targets (k, n)."""
    for track in tracks:
        if track.id in ids:
            place = int(np.abs(t - track.t).argmin()), ids.index(track.id)
            squared_error[place] = float(((track.mean[::2] - truth[place]) ** 2).sum())


def summary(rng: np.random.Generator, errors: Sequence[tuple[float, float]]) -> dict[str, Any]:
    """RMSE px: root of the mean over runs."""
    squares = np.array(errors)
    ratio = bootstrap_interval(squares, lambda e: math.sqrt(e[:, 1].mean() / e[:, 0].mean()), rng)
    at_once, later = np.sqrt(squares.mean(axis=0)).tolist()
    return {"at_once_px": at_once, "smoothed_px": later, "ratio": ratio._asdict()}


def _rows(args: argparse.Namespace) -> list[Row]:
    rng = np.random.default_rng(0)
    return [
        Row(name, partial(play, name, args.tracker, args.scans), partial(summary, rng), {"scene": name})
        for name in args.scene or SCENES
    ]


BENCH = Flights(
    name="fixed-lag",
    title="Fixed lag",
    about="Tracker `{tracker}`, {runs} runs, RMSE; smoothed: {scans_later} scans later.",
    seeds=amount("--runs", 100, 4, "of every scene"),
    seeds_from=0,
    options=(
        TRACKER,
        option("--scans", "of delay (default: %(default)s)", type=count, default=5, metavar="N"),
        option("--scene", f"(default: {' '.join(SCENES)})", action="extend", nargs="+", metavar="NAME"),
    ),
    rows=_rows,
    facts=lambda args: {"tracker": args.tracker, "runs": args.runs, "scans_later": args.scans},
    columns=(
        ("scene", "{scene}"),
        ("at once, px", "{at_once_px:.2f}"),
        ("smoothed, px", "{smoothed_px:.2f}"),
        ("ratio, 95 %", "{ratio:.3f}"),
    ),
)
