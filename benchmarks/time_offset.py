"""How well the camera's time offset and the gyro's bias are found in flight (docs/time_offset.md).

Gyro, attitudes and detections go to the two estimators as Onboard feeds them; neither asks the tracker. In *looking
round* the observer of the crossing scenario turns to another heading every few seconds; it flies every seed with each
of five offsets. Of the other flights each seed has one of the five. The limit is that of an estimator that knew where
all targets truly are, so that the pixels' noise alone was left.
"""

from __future__ import annotations

import argparse
import math
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.harness import Benchmark, flown, seeds
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.scenario import Scenario
from swarmtrack.lab.score.intervals import bootstrap_interval, fraction_interval, mean_interval
from swarmtrack.lab.world.sensors import Ego, EgoParameters, Imu, ImuParameters, detect, visible
from swarmtrack.lab.world.trajectory import Hover, SteadyYaw, Trajectory, YawProfile
from swarmtrack.lab.world.world import World
from swarmtrack.messages import Array, Detections, EgoPose, ImuSample, Scan
from swarmtrack.motion.gyro import GyroHistory
from swarmtrack.motion.gyro_bias import GyroBias
from swarmtrack.motion.priors import BIAS_USED_SIGMA_RAD_S as SURE_BIAS
from swarmtrack.motion.priors import OFFSET_USED_SIGMA_S
from swarmtrack.motion.time_offset import CameraClock

NAME = "offset"
OFFSETS_S = (-0.080, -0.020, 0.0, 0.040, 0.080)
BEGINS_S = 5.0  # of the world's time: everybody has taken off
SECONDS = 30.0
LATENCY_S = 0.050  # from exposure to Onboard
ATTITUDES_HZ = 10.0
IMU_HZ = 100.0  # as slow as autopilots' links often are
WITHIN_S = 2e-3  # the claim, one sigma
WITHIN_RAD_S = 2e-3  # likewise of the gyro's bias, every axis


class Glances:
    """A `YawProfile`: every few seconds to another heading about `heading` [rad], which takes `TURN_S`."""

    TURN_S = 0.8
    EVERY_S = (2.5, 5.0)
    REACH = 0.4  # rad: the others stay in view

    def __init__(self, heading: float, rng: np.random.Generator) -> None:
        begins = BEGINS_S - 1.0 + np.cumsum(rng.uniform(*self.EVERY_S, 20))
        self._begins: list[float] = begins.tolist()
        later = heading + rng.uniform(-self.REACH, self.REACH, 20)
        self._headings: list[float] = [heading, *later.tolist()]

    def yaw(self, t: float, flat: Array) -> tuple[float, float]:
        k = bisect_right(self._begins, t)
        if k == 0:
            return self._headings[0], 0.0
        x = min((t - self._begins[k - 1]) / self.TURN_S, 1.0)
        turn = self._headings[k] - self._headings[k - 1]
        share, speed = x**3 * (10.0 - 15.0 * x + 6.0 * x**2), 30.0 * x**2 * (1.0 - x) ** 2
        return self._headings[k - 1] + share * turn, speed / self.TURN_S * turn


@dataclass(frozen=True, slots=True)
class Condition:
    """A shipped scenario, and how its observer looks and flies otherwise, if so."""

    scenario: str
    observer: Callable[[World, Trajectory], Trajectory] | None = None
    all_offsets: bool = False


def _looking_round(world: World, trajectory: Trajectory) -> Trajectory:
    profile: YawProfile = Glances(trajectory.yaw(0.0), world.chance("glances"))
    return Trajectory(trajectory.path, profile)


def _standing(world: World, trajectory: Trajectory) -> Trajectory:
    return Trajectory(Hover(trajectory.position(0.0)), SteadyYaw(trajectory.yaw(0.0)))


CONDITIONS = {
    "looking round": Condition("crossing", _looking_round, all_offsets=True),
    "fast-yaw": Condition("fast-yaw"),
    "yawing-observer": Condition("yawing-observer"),
    "crossing": Condition("crossing"),
    "hover-triangle": Condition("hover-triangle"),
    "standing still": Condition("hover-triangle", _standing),
}


FIRST = next(iter(CONDITIONS))


class Sensed(NamedTuple):
    """What one observer's sensors give, stamped right.

    bias (3,): the gyro's true one, in camera axes; limit_s: see the module.
    """

    scenario: Scenario
    imu: list[ImuSample]
    poses: list[EgoPose]
    scans: list[Detections]
    bias: Array
    limit_s: float


class Run(NamedTuple):
    """One flight, judged once a second. errors and sigmas (seconds,) s, NaN while nothing is claimed; likewise the
    bias's, rad/s: its worst axis, and the root mean square of its axes."""

    offset_s: float
    errors: Array
    sigmas: Array
    bias_worst: Array
    bias_rms: Array
    bias_sigmas: Array
    limit_s: float


def fly(name: str, seconds: float, seed: int) -> list[Run]:
    """All runs of one seed."""
    condition = CONDITIONS[name]
    sensed = _sense(condition, seed, seconds)
    offsets = OFFSETS_S if condition.all_offsets else (OFFSETS_S[seed % len(OFFSETS_S)],)
    return [_play(sensed, offset, seconds) for offset in offsets]


def _sense(condition: Condition, seed: int, seconds: float) -> Sensed:
    scenario = load_scenario(condition.scenario, seed=seed)
    world = scenario.world
    # The yawing observer is the first; elsewhere every place of the formation has its turn.
    observer = 1 if condition.scenario == "yawing-observer" else list(world.drones)[seed % len(world.drones)]
    if condition.observer is not None:
        planned = world.drones[observer]
        assert isinstance(planned, Trajectory)
        world = replace(world, drones={**world.drones, observer: condition.observer(world, planned)})
    imu, begins, ends = (
        Imu(world, observer, ImuParameters(rate_hz=IMU_HZ)),
        BEGINS_S - 0.5,
        BEGINS_S + seconds,
    )
    times = np.arange(int(begins * IMU_HZ), int((ends + 0.5) * IMU_HZ)) / IMU_HZ
    # All noise from one generator: one for each sample, as `Imu.sample` has it, takes longer than the rest of it.
    white = world.chance("imu", observer).standard_normal((len(times), 2, 3))
    delay = imu.parameters.delay_s
    samples = [ImuSample(t - delay, *imu.measure(t, w)) for t, w in zip(times.tolist(), white, strict=True)]
    ego = Ego(world, observer, EgoParameters(rate_hz=ATTITUDES_HZ))
    poses = [ego.pose(k) for k in range(int(begins * ATTITUDES_HZ), int(ends * ATTITUDES_HZ))]
    scans, information = [], 0.0
    for k in range(int(BEGINS_S * scenario.fps), int(ends * scenario.fps)):
        t = k / scenario.fps
        boxes = visible(world, observer, scenario.camera, scenario.body_from_camera, t)
        rng = world.chance("detector", observer, k)
        scans.append(detect(boxes, scenario.camera, scenario.detector, rng, t=t, sequence=k))
        information += _information(scenario, world, observer, boxes, t)
    limit = 1.0 / math.sqrt(information) if information > 0.0 else math.inf
    bias = scenario.body_from_camera.rotation.T @ imu.gyro_bias
    return Sensed(scenario, samples, poses, scans, bias, limit)


def _information(scenario: Scenario, world: World, observer: int, boxes: dict[int, Array], t: float) -> float:
    """1/s², that one scan would bring of the offset if the targets' places were known."""
    if not boxes:
        return 0.0
    camera, detector = scenario.camera, scenario.detector
    rate = scenario.body_from_camera.rotation.T @ world.body_rate(observer, t)
    bearings = camera.bearing(np.array([box[:2] for box in boxes.values()]))
    speed = np.cross(bearings, rate)
    sigma = detector.centre_sigma / math.sqrt(camera.fx * camera.fy) * bearings[:, 2] ** 1.5
    return detector.p_detection * float(((speed**2).sum(axis=1) / sigma**2).sum())


def _play(sensed: Sensed, offset_s: float, seconds: float) -> Run:
    camera, body_from_camera = sensed.scenario.camera, sensed.scenario.body_from_camera.rotation
    gyro = GyroHistory()
    clock, bias = CameraClock(0.0), GyroBias(gyro)
    rates = np.array([sample.gyro for sample in sensed.imu]) @ body_from_camera
    judged = []
    # At one instant the gyro comes first, then poses, then scans.
    events: list[tuple[float, int, Any]] = [(sample.t, 0, k) for k, sample in enumerate(sensed.imu)]
    events += [(pose.t, 1, pose) for pose in sensed.poses]
    events += [(scan.t + LATENCY_S, 2, scan) for scan in sensed.scans]
    events += [(BEGINS_S + k + 1.0, 3, None) for k in range(int(seconds))]
    for _, _, what in sorted(events, key=lambda event: event[:2]):
        match what:
            case int():
                x, y, z = rates[what].tolist()
                gyro.append(sensed.imu[what].t, (x, y, z))
                bias.settle()
            case EgoPose():
                bias.add_attitude(what.t, what.world_from_body @ body_from_camera, what.attitude_sigma)
            case Detections():
                stamp = what.t - offset_s
                exposure = clock.exposure(stamp, gyro)
                clock.add_scan(stamp, Scan(exposure, camera.undistort(what.centre)), camera)
            case None:
                judged.append(_judge(clock, bias, offset_s, sensed.bias))
    errors, sigmas, worst, rms, bias_sigmas = np.array(judged).T
    return Run(offset_s, errors, sigmas, worst, rms, bias_sigmas, sensed.limit_s)


def _judge(clock: CameraClock, gyro_bias: GyroBias, offset_s: float, truth: Array) -> tuple[float, ...]:
    """The numbers of a `Run` at one instant. truth (3,): the gyro's bias in camera axes."""
    found, bias = clock.found, gyro_bias.found
    error, sigma = (found.offset_s - offset_s, found.sigma_s) if found else (math.nan, math.nan)
    if bias is None:
        return error, sigma, math.nan, math.nan, math.nan
    wrong = bias.bias - truth
    return error, sigma, float(np.abs(wrong).max()), math.sqrt(float(wrong @ wrong) / 3.0), bias.sigma


def _one_a_seed(runs: list[Run], seeds: int) -> list[Run]:
    """Of flights that were judged with every offset, one each: the same flight five times tells no more."""
    offsets = len(runs) // seeds
    return [runs[seed * offsets + seed % offsets] for seed in range(seeds)]


def summarise(runs: list[Run]) -> dict[str, Any]:
    """Of one condition and offset, at the end of the flights; 95 % intervals over them."""
    rng = np.random.default_rng(0)
    errors, sigmas = np.array([run.errors[-1] for run in runs]), np.array([run.sigmas[-1] for run in runs])
    claims = np.isfinite(errors)
    first = [_first(run.sigmas < OFFSET_USED_SIGMA_S) for run in runs]  # NaN is not smaller
    used = np.isfinite(first)
    result: dict[str, Any] = {
        "runs": len(runs),
        "limit_ms": 1e3 * float(np.median([run.limit_s for run in runs])),
        "claimed": float(claims.mean()),
        "sure": float(used.mean()),
        "seconds_until_sure": _median(first),
        "sigma_ms": 1e3 * float(np.median(sigmas[claims])) if claims.any() else math.nan,
        "bias": _bias(runs),
    }
    if claims.sum() > 1:
        e, ratio = 1e3 * errors[claims], (errors[claims] / sigmas[claims]) ** 2
        within = (np.abs(errors) < WITHIN_S).astype(float)
        result |= {
            "error_ms": mean_interval(e)._asdict(),
            "rms_ms": bootstrap_interval(e, _rms, rng)._asdict(),
            "within_2ms": fraction_interval(within, np.ones(len(runs)))._asdict(),
            "nees": mean_interval(ratio)._asdict(),
        }
    if used.any():
        when_sure = np.array([_when_sure(run) for run, sure in zip(runs, used, strict=True) if sure])
        result["worst_when_sure_ms"] = 1e3 * float(np.abs(when_sure[:, 0]).max())
        result["nees_when_sure"] = mean_interval((when_sure[:, 0] / when_sure[:, 1]) ** 2)._asdict()
    return result


def _when_sure(run: Run) -> tuple[float, float]:
    """Error and sigma at the worst of the moments in which it was sure enough to be used."""
    sure = np.flatnonzero(run.sigmas < OFFSET_USED_SIGMA_S)
    worst = sure[np.abs(run.errors[sure]).argmax()]
    return float(run.errors[worst]), float(run.sigmas[worst])


def _bias(runs: list[Run]) -> dict[str, Any]:
    worst, rms = np.array([run.bias_worst[-1] for run in runs]), np.array([run.bias_rms[-1] for run in runs])
    sigma = np.array([run.bias_sigmas[-1] for run in runs])
    return {
        "rms_rad_s": _rms(rms),
        "worst_rad_s": float(worst.max()),
        "within": float((worst < WITHIN_RAD_S).mean()),
        "sigma_rad_s": float(np.median(sigma)),
        "nees": float(np.mean((rms / sigma) ** 2)),
        "seconds_until_sure": _median([_first(run.bias_sigmas < SURE_BIAS) for run in runs]),
    }


def _first(sure: NDArray[np.bool_]) -> float:
    """Seconds until it first was; NaN if never."""
    return float(np.argmax(sure) + 1) if sure.any() else math.nan


def _median(seconds: list[float]) -> float:
    """Of those that are numbers; NaN if none is."""
    known = [s for s in seconds if not math.isnan(s)]
    return float(np.median(known)) if known else math.nan


def _rms(values: Array) -> float:
    return math.sqrt(float(np.mean(values**2)))


def _measured(args: argparse.Namespace) -> dict[str, Any]:
    """Fly all; offset.png into `args.out`, too."""
    parts = [(name, partial(fly, name, SECONDS)) for name in CONDITIONS]
    flights = zip(CONDITIONS, flown(NAME, parts, range(args.seeds), processes=1), strict=True)
    runs = {name: [one for of_seed in many for one in of_seed] for name, many in flights}
    first = runs[FIRST]
    _plot(args.out / f"{NAME}.png", runs)
    return {
        "seeds": args.seeds,
        "seconds": SECONDS,
        "by_offset": {
            "condition": FIRST,
            **{
                f"{1e3 * offset:+.0f} ms": summarise([one for one in first if one.offset_s == offset])
                for offset in sorted({one.offset_s for one in first})
            },
        },
        "by_condition": {name: summarise(_one_a_seed(many, args.seeds)) for name, many in runs.items()},
    }


COLUMNS: report.Columns = (
    ("", "{name}"),
    ("runs", "{runs}"),
    ("mean error, ms", "{error_ms:.2f}"),
    ("RMS, ms", "{rms_ms:.2f}"),
    ("within 2 ms, %", "{within_2ms:.0p}"),
    ("σ claimed, ms", "{sigma_ms:.2f}"),
    ("NEES", "{nees:.2f}"),
    ("σ < 3 ms in, %", "{sure:.0p}"),
    ("after, s", "{seconds_until_sure:.0f}"),
    ("worst then, ms", "{worst_when_sure_ms:.2f}"),
    ("known targets' limit, ms", "{limit_ms:.2f}"),
)
BIAS_COLUMNS: report.Columns = (
    ("", "{name}"),
    ("RMS, rad/s", "{rms_rad_s:.5f}"),
    ("worst axis", "{worst_rad_s:.5f}"),
    ("within 0.002 rad/s, %", "{within:.0p}"),
    ("σ claimed", "{sigma_rad_s:.5f}"),
    ("NEES", "{nees:.2f}"),
    ("σ < 0.001 after, s", "{seconds_until_sure:.0f}"),
)
# Of a condition in which hardly anything is claimed.
UNKNOWN = dict.fromkeys(("error_ms", "rms_ms", "within_2ms", "nees", "worst_when_sure_ms"))


def _page(result: dict[str, Any]) -> str:
    by_offset, by_condition = (
        {name: UNKNOWN | entry for name, entry in result[by].items() if name != "condition"}
        for by in ("by_offset", "by_condition")
    )
    return report.page(
        "# The camera's time offset and the gyro's bias, found in flight",
        f"After {result['seconds']:g} s of simulated flight, {result['seeds']} seeds; 95 % intervals. NEES: mean"
        " squared error over claimed variance, 1 where σ is honest, less where it is modest.",
        f"## Time offset, {FIRST}",
        report.table_by_name(COLUMNS, by_offset),
        "## Time offset by flight, one of the offsets each",
        report.table_by_name(COLUMNS, by_condition),
        "## Gyro bias",
        report.table_by_name(BIAS_COLUMNS, {name: row["bias"] for name, row in by_condition.items()}),
    )


def _plot(path: Path, runs: dict[str, list[Run]]) -> None:
    """Each flight's error over time, one flight with its band of two sigmas, and the sigmas claimed."""
    figure, (left, right) = report.pyplot().subplots(1, 2, figsize=(12.0, 4.5), layout="constrained")
    name, flights = next(iter(runs.items()))
    t = np.arange(len(flights[0].errors)) + 1.0
    for one in flights[:60]:
        left.plot(t, 1e3 * one.errors, color="0.75", linewidth=0.6)
    shown = next((one for one in flights if one.offset_s == max(OFFSETS_S)), flights[0])
    error, band = 1e3 * shown.errors, 2e3 * shown.sigmas
    left.fill_between(t, error - band, error + band, alpha=0.3, label="±2σ of one flight")
    left.plot(t, error, label=f"that flight, offset {1e3 * shown.offset_s:+.0f} ms")
    for limit in (-1e3 * WITHIN_S, 1e3 * WITHIN_S):
        left.axhline(limit, color="0.3", linestyle=":", linewidth=0.8)
    left.set(xlabel="time, s", ylabel="error of the offset, ms", ylim=(-20.0, 20.0), title=name)
    left.legend(loc="upper right")
    for name, flights in runs.items():
        sigmas, errors = (np.array([getattr(one, key) for one in flights]) for key in ("sigmas", "errors"))
        some = np.isfinite(errors).mean(axis=0) >= 0.5
        if some.any():
            (line,) = right.plot(t[some], 1e3 * np.sqrt(np.nanmean(errors[:, some] ** 2, axis=0)), label=name)
            claimed = 1e3 * np.nanmedian(sigmas[:, some], axis=0)
            right.plot(t[some], claimed, color=line.get_color(), linestyle="--")
    right.axhline(1e3 * OFFSET_USED_SIGMA_S, color="0.3", linestyle=":", linewidth=0.8)
    right.set(xlabel="time, s", ylabel="RMS error (dashed: median σ claimed), ms", yscale="log")
    right.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    report.save(figure, path)


BENCH = Benchmark(NAME, _measured, _page, options=(seeds(100, quick=4),), draws=True)
