"""What the gyro is worth: the track error between detections, for an observer that stands still and one that swings.

Two drones fly gently ahead of an observer. Its camera gives detections at 7 Hz, which arrive 150 ms after their
exposure; its gyro gives 200 samples a second. The same flight is played with the observer still, swinging its view
sinusoidally at up to ±2 rad/s, and swinging without being told of its gyro: once as it is, once *agile*, its
acceleration_psd raised so far that it takes the swing for the targets' own motion. Every 10 ms the tracks are read
*for that instant* and compared with where the drones truly are in the image then.

The error of a condition is the root of the mean squared distance, over all instants and drones in view that have a
track; tracks and drones are matched one to one by the least total distance, without a limit, so a wild track is
not forgiven. What has no track at all is not in it, and stands beside it as the share not tracked.

    swarmtrack bench rotation [--seeds 100] [--tracker kalman] --out DIR
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.command_line import add_common, add_seeds, add_tracker
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.scenario import HOVER_S, Scenario
from swarmtrack.lab.score.intervals import Interval, bootstrap_interval
from swarmtrack.lab.world.sensors import DetectorParameters, Imu, ImuParameters, detect, visible
from swarmtrack.lab.world.trajectory import SteadyYaw, Trajectory
from swarmtrack.lab.world.world import World
from swarmtrack.messages import Array, Detections, ImuSample, TrackStatus
from swarmtrack.motion.ego import EgoHistory
from swarmtrack.motion.gyro import GyroHistory
from swarmtrack.motion.mounting import Mounting
from swarmtrack.onboard import Onboard, OnboardCamera
from swarmtrack.tracking import DEFAULT_TRACKER, create_tracker

NAME = "rotation"
SEEDS, QUICK_SEEDS = 100, 4
OBSERVER = 1
AGILE = {
    "acceleration_psd": 1e6,
    "birth_speed_sigma": 800.0,
}  # the least error of 1e4, 1e5, 1e6, 3e6 and 1e7 px²/s³
MAX_ROTATING = 2.0  # times the still observer's error: the claim
MIN_WITHOUT_GYRO = 5.0  # times the error with the gyro: the claim
READ_HZ = 100.0
DETECTOR = DetectorParameters(centre_sigma=1.5)


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """What the observer's sensors give, and when it is judged."""

    detections_hz: float = 7.0
    latency_s: float = 0.150
    """From the exposure to the arrival of its detections."""
    detector: DetectorParameters = DETECTOR
    imu_hz: float = 200.0
    begins_s: float = HOVER_S - 1.0
    """Of the world's time: the swing sets in at HOVER_S and is full a second later."""
    measured_from_s: float = HOVER_S + 1.0
    ends_s: float = HOVER_S + 9.0


QUICK = Experiment(ends_s=HOVER_S + 4.0)


class Condition(NamedTuple):
    """Whether the observer swings, whether Onboard is told of its gyro, what its tracker is told otherwise."""

    swings: bool
    gyro: bool
    parameters: dict[str, float]


CONDITIONS = {
    "still": Condition(swings=False, gyro=True, parameters={}),
    "rotating": Condition(swings=True, gyro=True, parameters={}),
    "rotating, no gyro": Condition(swings=True, gyro=False, parameters={}),
    "rotating, no gyro, agile": Condition(swings=True, gyro=False, parameters=AGILE),
}


class Run(NamedTuple):
    """One condition of one seed, at the instants measured. t (k,); error (k, drones) px, NaN where not in view or not
    tracked; in_view (k, drones).
    """

    t: Array
    error: Array
    in_view: Array

    @property
    def rmse_px(self) -> float:
        return math.sqrt(float(np.nanmean(self.error**2)))

    @property
    def untracked(self) -> float:
        """Share of the drones in view that have no track."""
        return 1.0 - float(np.isfinite(self.error).sum() / self.in_view.sum())


class Sensed(NamedTuple):
    """What an observer's sensors give in one flight, and the truth (k, drones, 2) px, NaN out of view, at t (k,)."""

    imu: list[ImuSample]
    scans: list[Detections]
    t: Array
    truth: Array


def fly(experiment: Experiment, seed: int, tracker: str, parameters: dict[str, Any]) -> dict[str, Run]:
    """All conditions of one seed; those that swing see the same samples and scans."""
    scenario = load_scenario("yawing-observer", seed=seed)
    swinging = _sense(scenario, experiment)
    still = _sense(replace(scenario, world=_without_yaw(scenario.world)), experiment)
    return {
        name: _track(
            scenario,
            swinging if condition.swings else still,
            experiment,
            tracker,
            parameters | condition.parameters,
            gyro=condition.gyro,
        )
        for name, condition in CONDITIONS.items()
    }


def _without_yaw(world: World) -> World:
    observer = world.drones[OBSERVER]
    assert isinstance(observer, Trajectory)
    return replace(
        world, drones={**world.drones, OBSERVER: Trajectory(observer.path, SteadyYaw(observer.yaw(0.0)))}
    )


def _sense(scenario: Scenario, e: Experiment) -> Sensed:
    world, camera = scenario.world, scenario.camera
    imu = Imu(world, OBSERVER, ImuParameters(rate_hz=e.imu_hz))
    samples = [imu.sample(k) for k in range(int(e.begins_s * e.imu_hz), int(e.ends_s * e.imu_hz) + 1)]
    scans = []
    for k in range(int(e.begins_s * e.detections_hz) + 1, int(e.ends_s * e.detections_hz) + 1):
        t = k / e.detections_hz
        boxes = visible(world, OBSERVER, camera, scenario.body_from_camera, t)
        scans.append(detect(boxes, camera, e.detector, world.chance("detector", k), t=t, sequence=k))
    times = np.arange(round(e.measured_from_s * READ_HZ), round(e.ends_s * READ_HZ)) / READ_HZ
    others = [drone_id for drone_id in world.drones if drone_id != OBSERVER]
    truth = np.full((len(times), len(others), 2), np.nan)
    for i, t in enumerate(times):
        boxes = visible(world, OBSERVER, camera, scenario.body_from_camera, float(t))
        for j, drone_id in enumerate(others):
            if drone_id in boxes:
                truth[i, j] = boxes[drone_id][:2]
    return Sensed(samples, scans, times, truth)


def _track(
    scenario: Scenario,
    sensed: Sensed,
    e: Experiment,
    tracker: str,
    parameters: dict[str, Any],
    *,
    gyro: bool,
) -> Run:
    """Feed one Onboard in the order of arrival, and ask it at every instant what holds now."""
    onboard = Onboard(
        OBSERVER,
        cameras=[
            OnboardCamera(
                scenario.camera,
                Mounting(scenario.body_from_camera),
                create_tracker(tracker, camera=scenario.camera, **parameters),
            )
        ],
        gyro=GyroHistory(),
        ego=EgoHistory(),
        identity=IdentityParameters(),
    )
    errors = np.full(sensed.truth.shape[:2], np.nan)
    for kind, index in _arrivals(sensed, e.latency_s):
        if kind == "imu":
            if gyro:
                onboard.tell(sensed.imu[index])
        elif kind == "scan":
            onboard.tell(sensed.scans[index])
        else:
            tracks = onboard.tracks(float(sensed.t[index])).tracks
            alive = [entry.track for entry in tracks if entry.track.status is not TrackStatus.TENTATIVE]
            centres = np.array([track.mean[::2] for track in alive]).reshape(-1, 2)
            errors[index] = _errors(sensed.truth[index], centres)
    return Run(sensed.t, errors, np.isfinite(sensed.truth[:, :, 0]))


def _arrivals(sensed: Sensed, latency_s: float) -> Iterator[tuple[str, int]]:
    """What arrives, in order of arrival; at one instant samples first, then scans, then the question."""
    events = [(sample.t, 0, "imu", index) for index, sample in enumerate(sensed.imu)]
    events += [(scan.t + latency_s, 1, "scan", index) for index, scan in enumerate(sensed.scans)]
    events += [(float(t), 2, "read", index) for index, t in enumerate(sensed.t)]
    for _, _, kind, index in sorted(events):
        yield kind, index


def _errors(truth: Array, centres: Array) -> Array:
    """Distances (drones,) px of the tracks (m, 2) from the truth (drones, 2); NaN where either is missing."""
    errors = np.full(len(truth), np.nan)
    in_view = np.flatnonzero(np.isfinite(truth[:, 0]))
    distance = np.linalg.norm(truth[in_view][:, None] - centres[None], axis=2)
    rows, columns = linear_sum_assignment(distance)
    errors[in_view[rows]] = distance[rows, columns]
    return errors


def summarise(runs: list[dict[str, Run]]) -> dict[str, Any]:
    """RMSE of every condition over all seeds, the two ratios, and whether the claims hold; 95 % intervals over seeds.

    The gyro is compared with the better of the two trackers that go without.
    """
    squared = np.array([[np.nanmean(run[name].error ** 2) for name in CONDITIONS] for run in runs])
    rng = np.random.default_rng(0)

    def interval(statistic: Callable[[Array], float]) -> Interval:
        """statistic: of the RMSE of every condition."""
        return bootstrap_interval(squared, lambda drawn: statistic(np.sqrt(drawn.mean(axis=0))), rng)

    def of(condition: int) -> Callable[[Array], float]:
        return lambda rmse: float(rmse[condition])

    rotating = interval(lambda rmse: float(rmse[1] / rmse[0]))
    ablation = interval(lambda rmse: float(min(rmse[2], rmse[3]) / rmse[1]))
    return {
        "rmse_px": {name: interval(of(k))._asdict() for k, name in enumerate(CONDITIONS)},
        "median_px": {name: float(np.nanmedian([run[name].error for run in runs])) for name in CONDITIONS},
        "untracked_share": {
            name: float(np.mean([run[name].untracked for run in runs])) for name in CONDITIONS
        },
        "rotating_over_still": rotating._asdict()
        | {"at_most": MAX_ROTATING, "ok": rotating.high <= MAX_ROTATING},
        "no_gyro_over_gyro": ablation._asdict()
        | {"at_least": MIN_WITHOUT_GYRO, "ok": ablation.low >= MIN_WITHOUT_GYRO},
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_common(parser)
    add_tracker(parser)
    add_seeds(parser, SEEDS, QUICK_SEEDS)


def run(args: argparse.Namespace) -> None:
    publish(
        args.out,
        seeds=args.seeds or (QUICK_SEEDS if args.quick else SEEDS),
        tracker=args.tracker,
        experiment=QUICK if args.quick else Experiment(),
    )


def publish(
    out: Path,
    *,
    seeds: int = 100,
    tracker: str = DEFAULT_TRACKER,
    parameters: dict[str, Any] | None = None,
    experiment: Experiment | None = None,
) -> dict[str, Any]:
    """Fly all seeds, write rotation.json, rotation.md and rotation.png into `out`, and return what is in the JSON."""
    report.pyplot()  # before the work, not after it, should it be missing
    experiment, parameters = experiment or Experiment(), parameters or {}
    runs = []
    with report.progress("rotating observer", seeds) as advance:
        for seed in range(seeds):
            runs.append(fly(experiment, seed, tracker, parameters))
            advance(f"seed {seed}")
    result = {
        "seeds": seeds,
        "tracker": tracker,
        "parameters": parameters,
        "experiment": asdict(experiment),
        **summarise(runs),
    }
    report.write(out, NAME, result, _markdown(result))
    _plot(out / f"{NAME}.png", runs, experiment)
    return result


def _markdown(result: dict[str, Any]) -> str:
    e = result["experiment"]
    rows = []
    for name in CONDITIONS:
        error, untracked = result["rmse_px"][name], result["untracked_share"][name]
        rows.append(
            [name, _with_interval(error), f"{result['median_px'][name]:.1f}", f"{100 * untracked:.1f} %"]
        )
    rotating, ablation = result["rotating_over_still"], result["no_gyro_over_gyro"]
    claims = [
        ["rotating / still", _with_interval(rotating), f"≤ {MAX_ROTATING:g}", _verdict(rotating)],
        [
            "better one without gyro / with it",
            _with_interval(ablation),
            f"≥ {MIN_WITHOUT_GYRO:g}",
            _verdict(ablation),
        ],
    ]
    return "\n\n".join(
        [
            "# Rotating observer",
            f"Yaw ±2 rad/s, {e['detections_hz']:g} Hz detections {1e3 * e['latency_s']:.0f} ms late,"
            f" σ {e['detector']['centre_sigma']:g} px, tracker `{result['tracker']}`, {result['seeds']} seeds, tracks"
            f" read at {READ_HZ:g} Hz for the instant of reading; 95 % intervals over seeds.",
            report.table(
                ["observer", "error between detections, px RMSE", "median, px", "in view, not tracked"], rows
            ),
            report.table(["ratio", "found", "claim", ""], claims),
        ]
    )


def _with_interval(entry: dict[str, float]) -> str:
    return f"{entry['value']:.2f} ({entry['low']:.2f} … {entry['high']:.2f})"


def _verdict(entry: dict[str, Any]) -> str:
    return "holds" if entry["ok"] else "**fails**"


def _plot(path: Path, runs: list[dict[str, Run]], e: Experiment) -> None:
    """RMSE over the seeds at every instant of three seconds; detections arrive at the dotted lines."""
    pyplot = report.pyplot()
    figure, axes = pyplot.subplots(figsize=(8.0, 4.0), layout="constrained")
    t = runs[0]["still"].t
    shown = t < t[0] + 3.0
    for name in CONDITIONS:
        error = np.concatenate([run[name].error[shown] for run in runs], axis=1)
        axes.plot(t[shown] - t[0], np.sqrt(np.nanmean(error**2, axis=1)), label=name)
    period = 1.0 / e.detections_hz
    first = math.ceil((t[0] - e.latency_s) / period) * period + e.latency_s
    for arrival in np.arange(first, t[shown][-1], period):
        axes.axvline(arrival - t[0], color="0.7", linestyle=":", linewidth=0.8)
    axes.set(xlabel="time, s", ylabel="track error now, px RMSE", yscale="log")
    axes.legend(loc="center right")
    figure.savefig(path, dpi=130)
    pyplot.close(figure)
