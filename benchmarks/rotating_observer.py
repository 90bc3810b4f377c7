"""What the gyro is worth: the track error between detections, for an observer that stands still and one that swings.

The same flight (docs/benchmarks.md) is played with the observer still, swinging its view, and swinging without being
told of its gyro: once as it is, once *agile*, its acceleration_psd raised so far that it takes the swing for the
targets' own motion. Every 10 ms the tracks are read *for that instant* and compared with the truth.

Tracks and drones are matched one to one by the least total distance, without a limit, so a wild track is not forgiven.
What has no track at all is not in the error, and stands beside it as the share not tracked.

Beside it, slower swings of the same peak rate, in which the drones leave the view and come back. Of all scans of the
swing and all drones in view: recall, a track within GOSPA's cut-off; own number: of the number that the drone had
first; and GOSPA of the tracks in the image.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.harness import TRACKER, Benchmark, flown, seeds, share
from swarmtrack.benchmarks.virtual_swarm import lone_onboard
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.scenario import HOVER_S, Scenario
from swarmtrack.lab.score.gospa import gospa
from swarmtrack.lab.score.intervals import Interval, bootstrap_interval
from swarmtrack.lab.world.sensors import DetectorParameters, Imu, ImuParameters, detect, visible
from swarmtrack.lab.world.trajectory import SteadyYaw, SwingingYaw, Trajectory
from swarmtrack.lab.world.world import World
from swarmtrack.messages import Array, Detections, ImuSample, ScanReport, TrackList, TrackStatus
from swarmtrack.tracking import AGENT_PARAMETERS, create_tracker

NAME = "rotation"
OBSERVER = 1
# The least error of 1e4, 1e5, 1e6, 3e6 and 1e7 px²/s³.
AGILE = {"acceleration_psd": 1e6, "birth_speed_sigma": 800.0}
EDGE_PEAK_RAD_S = 2.0
EDGE_PERIODS_S = (1.4, 3.0, 4.0, 5.0)
EDGE_SEEDS = 10
EDGE_SECONDS = 15.0
CUT_OFF_PX = 20.0
LEAST_OWN, MOST_GOSPA_PX = 0.9, 5.0  # the claims
PER_CONDITION = ("rmse_px", "median_px", "untracked_share")
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


def fly(experiment: Experiment, tracker: str, seed: int) -> dict[str, Run]:
    """All conditions of one seed; those that swing see the same samples and scans."""
    scenario = load_scenario("yawing-observer", seed=seed)
    swinging = _sense(scenario, experiment)
    still = _sense(replace(scenario, world=_without_yaw(scenario.world)), experiment)
    return {
        name: _track(scenario, swinging if condition.swings else still, experiment, tracker, condition)
        for name, condition in CONDITIONS.items()
    }


def _without_yaw(world: World) -> World:
    observer = world.drones[OBSERVER]
    assert isinstance(observer, Trajectory)
    steady = Trajectory(observer.path, SteadyYaw(observer.yaw(0.0)))
    return replace(world, drones={**world.drones, OBSERVER: steady})


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


def _track(scenario: Scenario, sensed: Sensed, e: Experiment, tracker: str, condition: Condition) -> Run:
    """Feed one Onboard in the order of arrival, and ask it at every instant what holds now."""
    follower = create_tracker(tracker, camera=scenario.camera, **condition.parameters)
    onboard = lone_onboard(scenario.camera, follower, scenario.body_from_camera, drone_id=OBSERVER)
    errors = np.full(sensed.truth.shape[:2], np.nan)
    # At one instant samples come first, then scans, then the question.
    events: list[tuple[float, int, Any]] = [(sample.t, 0, sample) for sample in sensed.imu if condition.gyro]
    events += [(scan.t + e.latency_s, 1, scan) for scan in sensed.scans]
    events += [(float(t), 2, index) for index, t in enumerate(sensed.t)]
    for t, _, what in sorted(events, key=lambda event: event[:2]):
        if not isinstance(what, int):
            onboard.tell(what)
            continue
        tracks = onboard.tracks(t).tracks
        alive = [entry.track for entry in tracks if entry.track.status is not TrackStatus.TENTATIVE]
        centres = np.array([track.mean[::2] for track in alive]).reshape(-1, 2)
        errors[what] = _errors(sensed.truth[what], centres)
    return Run(sensed.t, errors, np.isfinite(sensed.truth[:, :, 0]))


def _errors(truth: Array, centres: Array) -> Array:
    """Distances (drones,) px of the tracks (m, 2) from the truth (drones, 2); NaN where either is missing."""
    errors = np.full(len(truth), np.nan)
    in_view = np.flatnonzero(np.isfinite(truth[:, 0]))
    distance = np.linalg.norm(truth[in_view][:, None] - centres[None], axis=2)
    rows, columns = linear_sum_assignment(distance)
    errors[in_view[rows]] = distance[rows, columns]
    return errors


class Edge(NamedTuple):
    """in_view: drones in scans; recall, own: how many of them have a track, and one of their number; gospa_px: mean."""

    in_view: int
    recall: int
    own: int
    gospa_px: float


def over_the_edge(tracker: str, period_s: float, seed: int) -> Edge:
    """A swing of so long a period that drones leave the view."""
    scenario = load_scenario("yawing-observer", seed=seed)
    observer = scenario.world.drones[OBSERVER]
    assert isinstance(observer, Trajectory)
    swing = SwingingYaw(observer.yaw(0.0), EDGE_PEAK_RAD_S, period_s, HOVER_S)
    drones = {**scenario.world.drones, OBSERVER: Trajectory(observer.path, swing)}
    scenario = replace(scenario, world=replace(scenario.world, drones=drones))
    e = Experiment(ends_s=HOVER_S + EDGE_SECONDS)
    sensed = _sense(scenario, e)
    follower = create_tracker(tracker, camera=scenario.camera, **AGENT_PARAMETERS)
    onboard = lone_onboard(scenario.camera, follower, scenario.body_from_camera, drone_id=OBSERVER)
    events: list[ImuSample | Detections] = sorted([*sensed.imu, *sensed.scans], key=lambda event: event.t)
    first: dict[int, int] = {}
    found, costs = np.zeros(3, int), []
    for event in events:
        onboard.tell(event)
        for said in onboard.events():
            if isinstance(said, ScanReport):
                counted, cost = _judge(scenario, said.tracks, first)
                if said.tracks.t >= HOVER_S:
                    found += counted
                    costs.append(cost)
    in_view, recall, own = found.tolist()
    return Edge(in_view, recall, own, float(np.mean(costs)))


def _judge(scenario: Scenario, stated: TrackList, first: dict[int, int]) -> tuple[list[int], float]:
    """Drones in view, with a track, and with one of their first number; and GOSPA. first: grows by what is found."""
    boxes = visible(scenario.world, OBSERVER, scenario.camera, scenario.body_from_camera, stated.t)
    tracks = [entry.track for entry in stated.tracks if entry.track.status is not TrackStatus.TENTATIVE]
    ids = [track.id for track in tracks]
    centres = np.array([track.mean[::2] for track in tracks]).reshape(-1, 2)
    counted = [len(boxes), 0, 0]
    for drone_id, box in boxes.items():
        near = np.flatnonzero(np.linalg.norm(centres - box[:2], axis=1) < CUT_OFF_PX)
        if near.size:
            own = first.setdefault(drone_id, ids[near[0]])
            counted[1] += 1
            counted[2] += own in [ids[k] for k in near]
    low, high = scenario.camera.ideal_bounds
    inside = centres[((centres > low) & (centres < high)).all(axis=1)]
    truth = np.array([box[:2] for box in boxes.values()]).reshape(-1, 2)
    return counted, gospa(truth, inside, c=CUT_OFF_PX).distance


def _edges(args: argparse.Namespace) -> dict[str, Any]:
    chosen = range(1 if args.quick else min(args.seeds, EDGE_SEEDS))
    periods = EDGE_PERIODS_S[1:2] if args.quick else EDGE_PERIODS_S
    parts = [(f"{period:g} s", partial(over_the_edge, args.tracker, period)) for period in periods]
    rows = {}
    for (name, _), runs in zip(parts, flown(NAME, parts, chosen, processes=1), strict=True):
        in_view = [run.in_view for run in runs]
        cost = float(np.mean([run.gospa_px for run in runs]))
        own = share([run.own for run in runs], in_view)
        rows[name] = {
            "recall": share([run.recall for run in runs], in_view),
            "own_number": own,
            "gospa_px": cost,
            "ok": own["value"] >= LEAST_OWN and cost <= MOST_GOSPA_PX,
        }
    return rows


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
        "rotating_over_still": {
            **rotating._asdict(),
            "at_most": MAX_ROTATING,
            "ok": rotating.high <= MAX_ROTATING,
        },
        "no_gyro_over_gyro": {
            **ablation._asdict(),
            "at_least": MIN_WITHOUT_GYRO,
            "ok": ablation.low >= MIN_WITHOUT_GYRO,
        },
    }


def _measured(args: argparse.Namespace) -> dict[str, Any]:
    experiment = QUICK if args.quick else Experiment()
    (runs,) = flown(NAME, [("", partial(fly, experiment, args.tracker))], range(args.seeds), processes=1)
    about = {"seeds": args.seeds, "tracker": args.tracker, "experiment": asdict(experiment)}
    return {**about, **summarise(runs), "edge": _edges(args)}


def _page(result: dict[str, Any]) -> str:
    rows = [{"name": name, **{what: result[what][name] for what in PER_CONDITION}} for name in CONDITIONS]
    ratios = (
        ("rotating / still", result["rotating_over_still"], f"≤ {MAX_ROTATING:g}"),
        ("better one without gyro / with it", result["no_gyro_over_gyro"], f"≥ {MIN_WITHOUT_GYRO:g}"),
    )
    return report.page(
        "# Rotating observer",
        report.filled(
            "Yaw ±2 rad/s, {experiment[detections_hz]:g} Hz detections {experiment[latency_s]:.0m} ms late, "
            "σ {experiment[detector][centre_sigma]:g} px, tracker `{tracker}`, {seeds} seeds, tracks "
            f"read at {READ_HZ:g} Hz for the instant of reading; 95 % intervals over seeds.",
            result,
        ),
        report.table_of(
            (
                ("observer", "{name}"),
                ("error between detections, px RMSE", "{rmse_px:.2f}"),
                ("median, px", "{median_px:.1f}"),
                ("in view, not tracked", "{untracked_share:.1p} %"),
            ),
            rows,
        ),
        report.table(
            ["ratio", "found", "claim", ""],
            [
                [w, report.filled("{found:.2f}", {"found": f}), c, report.verdict(f["ok"])]
                for w, f, c in ratios
            ],
        ),
        f"Slower swings of ±{EDGE_PEAK_RAD_S:g} rad/s, over the edge of the view; {EDGE_SECONDS:g} s, an agent's "
        f"parameters, own number ≥ {LEAST_OWN:g} and GOSPA ≤ {MOST_GOSPA_PX:g} px:",
        report.table_by_name(
            (
                ("period", "{name}"),
                ("recall, %", "{recall:.1p}"),
                ("own number, %", "{own_number:.1p}"),
                ("GOSPA, px", "{gospa_px:.2f}"),
                ("", lambda row: report.verdict(row["ok"])),
            ),
            result["edge"],
        ),
    )


BENCH = Benchmark(NAME, _measured, _page, options=(TRACKER, seeds(100, quick=4)))
