"""How well the camera's time offset and the gyro's bias are found in flight, and how honest their sigmas are.

Simulated flights of thirty seconds: a gyro with bias and noise, attitudes, and detections with misses, clutter and
noise, stamped wrong by a known offset, go to the two estimators as Onboard feeds them (neither asks the tracker). In
*looking round* the observer of the crossing scenario turns to another heading every few seconds, as a pilot or a search
does; it flies every seed with each of five offsets. Of the scenarios as they are shipped, and of an observer that
stands still, each seed flies with one of the five.

Beside each stands what an estimator could reach that knew where all targets truly are, so that the pixels' noise
alone was left. Nobody can: a target moves as it likes, and slow turns look like a target's own motion.

    swarmtrack bench offset [--seeds 100] --out DIR
"""

from __future__ import annotations

import argparse
import math
from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.command_line import add_common, add_seeds
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.scenario import Scenario
from swarmtrack.lab.score.intervals import bootstrap_interval, fraction_interval, mean_interval
from swarmtrack.lab.world.sensors import Ego, EgoParameters, Imu, ImuParameters, detect, visible
from swarmtrack.lab.world.trajectory import Hover, SteadyYaw, Trajectory, YawProfile
from swarmtrack.lab.world.world import World
from swarmtrack.messages import Array, Detections, EgoPose, ImuSample, Scan
from swarmtrack.motion.gyro import GyroHistory
from swarmtrack.motion.gyro_bias import SURE as SURE_BIAS
from swarmtrack.motion.gyro_bias import GyroBias
from swarmtrack.motion.time_offset import SURE, CameraClock

NAME = "offset"
SEEDS, QUICK_SEEDS = 100, 4
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
        self._headings: list[float] = [
            heading,
            *(heading + rng.uniform(-self.REACH, self.REACH, 20)).tolist(),
        ]

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


class Sensed(NamedTuple):
    """What one observer's sensors give, stamped right.

    bias (3,): the gyro's true one, in camera axes; limit_s: see the module.
    """

    scenario: Scenario
    observer: int
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


def fly(name: str, seed: int, seconds: float) -> list[Run]:
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
        changed = condition.observer(world, planned)
        world = replace(world, drones={**world.drones, observer: changed})
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
    return Sensed(
        replace(scenario, world=world),
        observer,
        samples,
        poses,
        scans,
        scenario.body_from_camera.rotation.T @ imu.gyro_bias,
        limit,
    )


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
    for kind, index in _arrivals(sensed, seconds):
        if kind == "imu":
            x, y, z = rates[index].tolist()
            gyro.append(sensed.imu[index].t, (x, y, z))
            bias.settle()
        elif kind == "pose":
            pose = sensed.poses[index]
            bias.see(pose.t, pose.world_from_body @ body_from_camera, pose.attitude_sigma)
        elif kind == "scan":
            scan = sensed.scans[index]
            stamp = scan.t - offset_s
            exposure = clock.exposure(stamp, gyro)
            clock.see(stamp, Scan(exposure, camera.undistort(scan.centre)), camera)
        else:
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


def _arrivals(sensed: Sensed, seconds: float) -> Iterator[tuple[str, int]]:
    """What arrives, in order of arrival."""
    events = [(sample.t, 0, "imu", k) for k, sample in enumerate(sensed.imu)]
    events += [(pose.t, 1, "pose", k) for k, pose in enumerate(sensed.poses)]
    events += [(scan.t + LATENCY_S, 2, "scan", k) for k, scan in enumerate(sensed.scans)]
    events += [(BEGINS_S + k + 1.0, 3, "judge", k) for k in range(int(seconds))]
    for _, _, kind, index in sorted(events):
        yield kind, index


def _one_a_seed(runs: list[Run], seeds: int) -> list[Run]:
    """Of flights that were judged with every offset, one each: the same flight five times tells no more."""
    offsets = len(runs) // seeds
    return [runs[seed * offsets + seed % offsets] for seed in range(seeds)]


def summarise(runs: list[Run]) -> dict[str, Any]:
    """Of one condition and offset, at the end of the flights; 95 % intervals over them."""
    rng = np.random.default_rng(0)
    errors, sigmas = np.array([run.errors[-1] for run in runs]), np.array([run.sigmas[-1] for run in runs])
    claims = np.isfinite(errors)
    used = np.array([bool((run.sigmas < SURE).any()) for run in runs])  # NaN is not smaller
    first = [_first(run.sigmas < SURE) for run in runs]
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
    when_sure = np.array([_when_sure(run) for run in runs if (run.sigmas < SURE).any()]).reshape(-1, 2)
    if len(when_sure):
        result["worst_when_sure_ms"] = 1e3 * float(np.abs(when_sure[:, 0]).max())
        result["nees_when_sure"] = mean_interval((when_sure[:, 0] / when_sure[:, 1]) ** 2)._asdict()
    return result


def _when_sure(run: Run) -> tuple[float, float]:
    """Error and sigma at the worst of the moments in which it was sure enough to be used."""
    sure = np.flatnonzero(run.sigmas < SURE)
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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_common(parser)
    add_seeds(parser, SEEDS, QUICK_SEEDS)


def run(args: argparse.Namespace) -> None:
    publish(args.out, seeds=args.seeds or (QUICK_SEEDS if args.quick else SEEDS))


def publish(
    out: Path,
    *,
    seeds: int = 100,
    seconds: float = SECONDS,
    names: tuple[str, ...] = (),
) -> dict[str, Any]:
    """Fly all, write offset.json, offset.md and offset.png into `out`, and return what is in the JSON."""
    report.pyplot()  # before the work, not after it, should it be missing
    names = names or tuple(CONDITIONS)
    runs: dict[str, list[Run]] = {name: [] for name in names}
    with report.progress("time offset", seeds * len(names)) as advance:
        for name in names:
            for seed in range(seeds):
                runs[name] += fly(name, seed, seconds)
                advance(f"{name}, seed {seed}")
    first = runs[names[0]]
    ordinary = {
        f"{1e3 * offset:+.0f} ms": summarise([one for one in first if one.offset_s == offset])
        for offset in sorted({one.offset_s for one in first})
    }
    result = {
        "seeds": seeds,
        "seconds": seconds,
        "by_offset": {"condition": names[0], **ordinary},
        "by_condition": {name: summarise(_one_a_seed(runs[name], seeds)) for name in names},
    }
    report.write(out, NAME, result, _markdown(result))
    _plot(out / f"{NAME}.png", runs)
    return result


def _markdown(result: dict[str, Any]) -> str:
    by_offset = {key: value for key, value in result["by_offset"].items() if key != "condition"}
    header = [
        "",
        "runs",
        "mean error, ms",
        "RMS, ms",
        "within 2 ms, %",
        "σ claimed, ms",
        "NEES",
        "σ < 3 ms in, %",
    ]
    header += ["after, s", "worst then, ms", "known targets' limit, ms"]
    bias_header = [
        "",
        "RMS, rad/s",
        "worst axis",
        "within 0.002 rad/s, %",
        "σ claimed",
        "NEES",
        "σ < 0.001 after, s",
    ]
    biases = [
        [
            *(name, f"{b['rms_rad_s']:.5f}", f"{b['worst_rad_s']:.5f}", f"{100 * b['within']:.0f}"),
            *(f"{b['sigma_rad_s']:.5f}", f"{b['nees']:.2f}", report.number(b["seconds_until_sure"], 0)),
        ]
        for name, entry in result["by_condition"].items()
        for b in [entry["bias"]]
    ]
    return "\n\n".join(
        [
            "# The camera's time offset and the gyro's bias, found in flight",
            f"After {result['seconds']:g} s of simulated flight, {result['seeds']} seeds; 95 % intervals. NEES: mean"
            " squared error over claimed variance, 1 where σ is honest, less where it is modest.",
            f"## Time offset, {result['by_offset']['condition']}",
            report.table(header, [_row(name, entry) for name, entry in by_offset.items()]),
            "## Time offset by flight, one of the offsets each",
            report.table(header, [_row(name, entry) for name, entry in result["by_condition"].items()]),
            "## Gyro bias",
            report.table(bias_header, biases),
        ]
    )


def _row(name: str, entry: dict[str, Any]) -> list[str]:
    def with_interval(key: str, factor: float = 1.0, digits: int = 2) -> str:
        if key not in entry:
            return "–"
        value, low, high = (factor * entry[key][part] for part in ("value", "low", "high"))
        return f"{value:.{digits}f} ({low:.{digits}f} … {high:.{digits}f})"

    return [
        name,
        str(entry["runs"]),
        with_interval("error_ms"),
        with_interval("rms_ms"),
        with_interval("within_2ms", 100.0, 0),
        report.number(entry["sigma_ms"]),
        with_interval("nees"),
        f"{100 * entry['sure']:.0f}",
        report.number(entry["seconds_until_sure"], 0),
        report.number(entry.get("worst_when_sure_ms", math.nan)),
        report.number(entry["limit_ms"]),
    ]


def _plot(path: Path, runs: dict[str, list[Run]]) -> None:
    """Each flight's error over time, one flight with its band of two sigmas, and the sigmas claimed."""
    pyplot = report.pyplot()
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(12.0, 4.5), layout="constrained")
    name, flights = next(iter(runs.items()))
    t = np.arange(len(flights[0].errors)) + 1.0
    for one in flights[:60]:
        left.plot(t, 1e3 * one.errors, color="0.75", linewidth=0.6)
    shown = next((one for one in flights if one.offset_s == max(OFFSETS_S)), flights[0])
    band = 2e3 * shown.sigmas
    left.fill_between(
        t, 1e3 * shown.errors - band, 1e3 * shown.errors + band, alpha=0.3, label="±2σ of one flight"
    )
    left.plot(t, 1e3 * shown.errors, label=f"that flight, offset {1e3 * shown.offset_s:+.0f} ms")
    for limit in (-1e3 * WITHIN_S, 1e3 * WITHIN_S):
        left.axhline(limit, color="0.3", linestyle=":", linewidth=0.8)
    left.set(xlabel="time, s", ylabel="error of the offset, ms", ylim=(-20.0, 20.0), title=name)
    left.legend(loc="upper right")
    for name, flights in runs.items():
        sigmas, errors = (np.array([getattr(one, key) for one in flights]) for key in ("sigmas", "errors"))
        some = np.isfinite(errors).mean(axis=0) >= 0.5
        if some.any():
            (line,) = right.plot(t[some], 1e3 * np.sqrt(np.nanmean(errors[:, some] ** 2, axis=0)), label=name)
            right.plot(
                t[some], 1e3 * np.nanmedian(sigmas[:, some], axis=0), color=line.get_color(), linestyle="--"
            )
    right.axhline(1e3 * SURE, color="0.3", linestyle=":", linewidth=0.8)
    right.set(xlabel="time, s", ylabel="RMS error (dashed: median σ claimed), ms", yscale="log")
    right.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(path, dpi=130)
    pyplot.close(figure)
