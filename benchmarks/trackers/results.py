"""What `swarmtrack bench trackers` is asked to do, what comes of it, and the rows of `trackers.json`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.special import gammaincinv

from swarmtrack.benchmarks.harness import quantile
from swarmtrack.benchmarks.report import BenchmarkError
from swarmtrack.benchmarks.trackers.play import ORACLES, SMOOTHER, Score
from swarmtrack.benchmarks.trackers.scenes import SCENES, Scene, find_scene
from swarmtrack.benchmarks.trackers.timing import Cost, Enumeration
from swarmtrack.lab.score.intervals import Interval, fraction_interval, mean_interval
from swarmtrack.messages import Array
from swarmtrack.tracking import TRACKERS

FOUND_WITHIN_S = 0.5
DROPPED_WITHIN_S = 1.0
RESAMPLES = 1000
QUICK_RUNS = 2
QUICK_SCENES = (
    "control", "clutter10", "noise.75", "pd.80", "crossing", "crossing_merged", "slow", "slow_merged", "births",
    "rotating_still", "rotating", "latency_steady", "latency_manoeuvring", "told_wrong_R_x4_noise.50",
)  # fmt: skip

Row = dict[str, Any]
"""One scene and tracker, as it stands in the JSON."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Programme:
    """What to run. runs: in place of each scene's own; jobs: processes."""

    trackers: tuple[str, ...] = ()
    scenes: tuple[str, ...] = ()
    runs: int | None = None
    quick: bool = False
    peers: bool = False
    jobs: int = 1

    def __post_init__(self) -> None:
        for name in self.scenes:
            find_scene(name)
        known = [*TRACKERS, *ORACLES, SMOOTHER]
        for name in self.trackers:
            if name not in known:
                raise BenchmarkError(f"--tracker: found {name!r}, expected one of {', '.join(known)}")
        for name, value in (("runs", self.runs), ("jobs", self.jobs)):
            if value is not None and value < 1:
                raise BenchmarkError(f"--{name}: found {value}, expected a number above 0")

    @property
    def entrants(self) -> tuple[str, ...]:
        """The trackers asked for, else all; the oracles stand beside them in any case."""
        chosen = self.trackers or tuple(TRACKERS)
        limits = [name for name in (*ORACLES, SMOOTHER) if name not in chosen]
        return (*chosen, *limits)

    @property
    def own(self) -> tuple[str, ...]:
        return tuple(name for name in self.entrants if name in TRACKERS)

    def scenes_to_play(self) -> tuple[str, ...]:
        return self.scenes or (QUICK_SCENES if self.quick else tuple(SCENES))

    def runs_of(self, scene: str) -> int:
        return self.runs or (QUICK_RUNS if self.quick else SCENES[scene].runs)


Played = dict[tuple[str, str], list[Score]]
"""By scene and label, in the order of the runs."""


class Result(NamedTuple):
    """Everything that the page is made of."""

    programme: Programme
    rows: list[Row]
    played: Played
    ablation: list[Row]
    costs: list[Cost]
    enumeration: Enumeration | None
    reference_ms: float
    late_difference: dict[str, float]
    """By tracker: how much reading `at(now)` between scans changes the state at the scans."""
    wall_s: float
    plots: list[tuple[str, str]]
    """File name and caption of each."""


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
    # Of a Poisson count, exact.
    ends = gammaincinv(max(false, 1e-9), 0.025), gammaincinv(false + 1, 0.975)
    in_time = DROPPED_WITHIN_S + 1.0 / scene.rate_hz + 1e-6
    return {
        "tracked_fraction": float(np.mean([one.tracked for one in found])),
        "switches_per_run": float(np.mean([one.switches for one in found])),
        "false_tracks_per_min": {"mean": false / minutes, "ci95": [float(end) / minutes for end in ends]},
        "targets": len(find),
        "found_in_half_a_second_fraction": float(np.mean(find <= FOUND_WITHIN_S + 1e-9)),
        "find_s": _quantiles(find),
        "dropped_in_a_second_fraction": float(np.mean(drop <= in_time)) if len(drop) else math.nan,
        "drop_s": _quantiles(drop),
    }


def _quantiles(seconds: Array) -> dict[str, float]:
    """Infinite values are those that never came."""
    return {name: quantile(seconds, of) for name, of in (("median", 0.5), ("p95", 0.95), ("max", 1.0))}


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
