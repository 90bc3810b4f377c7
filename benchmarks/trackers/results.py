"""From the scores of many runs to the rows of `trackers.json`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.special import gammaincinv

from swarmtrack.benchmarks.trackers.play import Score
from swarmtrack.benchmarks.trackers.scenes import Scene
from swarmtrack.lab.score.intervals import Interval, fraction_interval, mean_interval
from swarmtrack.messages import Array

FOUND_WITHIN_S = 0.5
DROPPED_WITHIN_S = 1.0
RESAMPLES = 1000

Row = dict[str, Any]
"""One scene and tracker, as it stands in the JSON."""


def row(scene: Scene, tracker: str, scores: Sequence[Score]) -> Row:
    rmse = np.array([score.rmse_px for score in scores])
    rmse = rmse[np.isfinite(rmse)]  # not of runs in which nothing was tracked: `tracked` tells of those
    mean = mean_interval(rmse) if len(rmse) else Interval(math.nan, math.nan, math.nan)
    swapped = np.array([score.swapped for score in scores], float)
    lost = np.array([score.lost for score in scores], float)
    failed = fraction_interval(np.maximum(swapped, lost), np.ones(len(scores)))
    entry: Row = {
        "scene": scene.name,
        "tracker": tracker,
        "runs": len(scores),
        "rmse_px": {
            "mean": mean.value,
            "ci95": [mean.low, mean.high],
            "median": float(np.median(rmse)) if len(rmse) else math.nan,
        },
        "swap_fraction": float(swapped.mean()),
        "lost_fraction": float(lost.mean()),
        "failed_fraction": {"value": failed.value, "ci95": [failed.low, failed.high]},
        "gospa_px": float(np.mean([score.gospa_px for score in scores])),
        "ms_per_scan": float(np.median([score.ms_per_scan for score in scores])),
    }
    if scores[0].found is not None:
        entry |= _unannounced(scene, scores)
    if scores[0].at_px:
        entry["at_rmse_px"] = {
            f"{1e3 * latency:.0f}": float(np.mean([score.at_px[latency] for score in scores]))
            for latency in sorted(scores[0].at_px)
        }
    return entry


def _unannounced(scene: Scene, scores: Sequence[Score]) -> Row:
    """Of targets that nobody announced. A drop is in time when it comes no later than the scan after the second."""
    found = [score.found for score in scores if score.found is not None]
    find = np.array([seconds for one in found for seconds in one.find_s])
    drop = np.array([seconds for one in found for seconds in one.drop_s])
    minutes = len(found) * scene.scans / scene.rate_hz / 60.0
    false = sum(one.false_tracks for one in found)
    low, high = (
        gammaincinv(max(false, 1e-9), 0.025),
        gammaincinv(false + 1, 0.975),
    )  # of a Poisson count, exact
    in_time = DROPPED_WITHIN_S + 1.0 / scene.rate_hz + 1e-6
    return {
        "tracked_fraction": float(np.mean([one.tracked for one in found])),
        "switches_per_run": float(np.mean([one.switches for one in found])),
        "false_tracks_per_min": {
            "mean": false / minutes,
            "ci95": [float(low) / minutes, float(high) / minutes],
        },
        "targets": len(find),
        "found_in_half_a_second_fraction": float(np.mean(find <= FOUND_WITHIN_S + 1e-9)),
        "find_s": _quantiles(find),
        "dropped_in_a_second_fraction": float(np.mean(drop <= in_time)) if len(drop) else math.nan,
        "drop_s": _quantiles(drop),
    }


def _quantiles(seconds: Array) -> dict[str, float]:
    """Infinite values are those that never came."""
    if not len(seconds):
        return {"median": math.nan, "p95": math.nan, "max": math.nan}
    ordered = np.sort(seconds)
    at = {"median": 0.5, "p95": 0.95, "max": 1.0}
    return {name: float(ordered[math.ceil(q * len(ordered)) - 1]) for name, q in at.items()}


def paired_ratio(above: Sequence[Score], below: Sequence[Score], *, median: bool = False) -> Interval:
    """Of the mean (or median) RMSE of one tracker over that of another in the same runs; bootstrap over runs."""
    n = min(len(above), len(below))
    rmse = np.array([[a.rmse_px, b.rmse_px] for a, b in zip(above[:n], below[:n], strict=True)])
    rmse = rmse[np.isfinite(rmse).all(axis=1)]
    if not len(rmse):
        return Interval(math.nan, math.nan, math.nan)
    middle = np.median if median else np.mean
    drawn = rmse[np.random.default_rng(0).integers(len(rmse), size=(RESAMPLES, len(rmse)))]
    ratios = np.divide(*np.moveaxis(middle(drawn, axis=1), 1, 0))
    value = np.divide(*middle(rmse, axis=0))
    low, high = np.percentile(ratios, [2.5, 97.5])
    return Interval(float(value), float(low), float(high))


def by_cell(rows: Sequence[Row]) -> Mapping[tuple[str, str], Row]:
    return {(entry["scene"], entry["tracker"]): entry for entry in rows}
