"""What waiting is worth: the error of a tracker's estimates at once, and of its smoothed ones some scans later.

Both are judged at the same scans and targets of the scenes of `swarmtrack bench trackers`, so that the ratio tells of
nothing else.

    swarmtrack bench fixed-lag [--runs 100] [--scans 5] [--tracker mbm] [--scene NAME …] --out DIR
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from swarmtrack.arguments import count
from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.command_line import add_common, add_tracker
from swarmtrack.benchmarks.report import number
from swarmtrack.benchmarks.trackers.play import make_tracker
from swarmtrack.benchmarks.trackers.scenes import Scene, film, find_scene
from swarmtrack.lab.score.intervals import bootstrap_interval
from swarmtrack.messages import Array, Track

NAME = "fixed-lag"
RUNS, QUICK_RUNS = 100, 4
SCENES = ("noise.25", "noise.50", "noise.75", "pd.80", "mixedA", "mixedB", "crossing", "rotating")


def play(scene: Scene, tracker: str, run: int, scans: int) -> tuple[float, float]:
    """Mean squared errors px² of one run with known starts: at once, and so many scans later."""
    take = film(scene, run)
    if take.start is None:
        raise report.BenchmarkError(
            f"--scene {scene.name}: nobody tells the starts there, expected one that does"
        )
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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_common(parser)
    add_tracker(parser)
    parser.add_argument(
        "--runs", type=count, metavar="N", help=f"of every scene (default: {RUNS}; with --quick {QUICK_RUNS})"
    )
    parser.add_argument("--scans", type=count, default=5, metavar="N", help="of delay (default: %(default)s)")
    parser.add_argument(
        "--scene", action="extend", nargs="+", metavar="NAME", help=f"(default: {' '.join(SCENES)})"
    )


def run(args: argparse.Namespace) -> None:
    publish(
        args.out,
        runs=args.runs or (QUICK_RUNS if args.quick else RUNS),
        scans=args.scans,
        tracker=args.tracker,
        scenes=args.scene or SCENES,
    )


def publish(
    out: Path, *, runs: int = 100, scans: int = 5, tracker: str = "mbm", scenes: Sequence[str] = SCENES
) -> dict[str, Any]:
    """fixed-lag.json and fixed-lag.md into `out`; returns what is in the JSON. RMSE px: root of the mean over runs."""
    rng, rows = np.random.default_rng(0), []
    with report.progress("fixed lag", len(scenes)) as advance:
        for name in scenes:
            scene = find_scene(name)
            errors = np.array([play(scene, tracker, k, scans) for k in range(runs)])
            ratio = bootstrap_interval(errors, lambda e: math.sqrt(e[:, 1].mean() / e[:, 0].mean()), rng)
            at_once, later = np.sqrt(errors.mean(axis=0)).tolist()
            rows.append(
                {"scene": name, "at_once_px": at_once, "smoothed_px": later, "ratio": ratio._asdict()}
            )
            advance(name)
    result = {"tracker": tracker, "runs": runs, "scans_later": scans, "rows": rows}
    table = [
        [
            row["scene"],
            number(row["at_once_px"]),
            number(row["smoothed_px"]),
            f"{row['ratio']['value']:.3f} ({row['ratio']['low']:.3f} … {row['ratio']['high']:.3f})",
        ]
        for row in rows
    ]
    header = ["scene", "at once, px", f"{scans} scans later, px", "ratio, 95 %"]
    title = f"# Fixed lag\n\nTracker `{tracker}`, {runs} runs, RMSE.\n\n"
    report.write(out, NAME, result, title + report.table(header, table))
    return result
