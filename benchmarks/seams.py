"""Tracks that go over from one camera of a drone to the next: how many are kept (docs/cameras.md).

The second camera is turned by `off` about an axis drawn by chance, of which the tracker is told so much sigma per
camera.

* kept: of all crossings, those after which a confirmed track of the same number is on the drone.
* doubles: s per minute in which a drone has another confirmed track beside its own.
* found: how far rays at the seam are off in the end (median and 95 % over flights), and after how many crossings. How
  the second camera is turned about such a ray itself does not show there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.benchmarks import harness
from swarmtrack.benchmarks.harness import PROCESSES, TRACKER, Flights, seeds, share
from swarmtrack.cameras.rig import Rig, RigCamera
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Array, Scan, Track, TrackStatus
from swarmtrack.motion.gyro import GyroHistory
from swarmtrack.tracking import AGENT_PARAMETERS, create_trackers

CAMERA = PinholeCamera(320.0, 320.0, 319.5, 239.5, 640, 480)
SECONDS, FPS, IMU_HZ = 60.0, 15.0, 200.0
SIGMA_PX, P_DETECTION, CLUTTER = 1.5, 0.95, 0.5
GYRO_NOISE = 2e-4  # rad/s/√Hz
# m, NED about the drone: azimuths 20° apart.
PLACES = np.array([[6.0, 4.0, -0.5], [3.5, 6.0, 0.5], [9.0, 1.0, 0.2]])
SPAN = 0.45
HIT_PX = 15.0
# m: of the second camera beside the first.
BASELINE = np.array([0.0, 0.12, 0.0])
# In the second camera's axes: where its picture begins, at the drones' elevations.
SEAM_RAYS = CAMERA.bearing_undistorted(np.array([[0.0, v] for v in (210.0, 240.0, 270.0)]))
# s before and after a crossing, when its track is looked for.
BEFORE_S, AFTER_S = 0.3, 0.6


@dataclass(frozen=True, slots=True)
class Row:
    """rate rad/s: of the yaw; gap_deg between the pictures, negative: overlap; off_deg: of the mounting; told_deg."""

    name: str
    rate: float
    gap_deg: float
    off_deg: float
    told_deg: float


ROWS = [
    Row(f"{name}, {'gap 10°' if gap > 0 else 'overlap 10°'}, {rate} rad/s", rate, gap, off, told)
    for name, off, told in (
        ("0.5° told", 0.5, 0.5),
        ("2° told", 2.0, 2.0),
        ("2° untold (1° assumed)", 2.0, 1.0),
    )
    for gap in (-10.0, 10.0)
    for rate in (0.5, 1.5)
]


class Flown(NamedTuple):
    """Of one flight. late: crossings from half of the flight on."""

    crossings: int
    kept: int
    late_crossings: int
    late_kept: int
    doubles: float
    error_deg: float
    learned_from: int


class Yawing:
    """The drone: it swings to and fro by as much as crosses the seam, at a steady rate but for the turns."""

    def __init__(self, row: Row, chance: np.random.Generator) -> None:
        self._period = 4.0 * math.radians(50.0) / row.rate
        self._phase = chance.uniform(0.0, 1.0)

    def yaw(self, t: float) -> float:
        """rad: a triangle wave of ±50° about where the seam is ahead, with its corners rounded."""
        x = (t / self._period + self._phase) % 1.0
        return math.radians(50.0) * math.asin(0.995 * math.sin(2.0 * math.pi * x)) / math.asin(0.995)

    def attitude(self, t: float) -> Array:
        return rotation.from_euler(0.0, 0.0, self.yaw(t))


def cameras(row: Row) -> list[Pose]:
    """body_from_camera of both, as they are told: each looks to one side of where the body does."""
    half = math.atan(0.5 * CAMERA.width / CAMERA.fx) + 0.5 * math.radians(row.gap_deg)
    return [
        Pose(rotation.from_euler(0.0, 0.0, side * half) @ rotation.BODY_FROM_FORWARD_CAMERA, place)
        for side, place in ((-1.0, np.zeros(3)), (1.0, BASELINE))
    ]


class Scene:
    """What both cameras see, and what the gyro says."""

    def __init__(self, row: Row, seed: int) -> None:
        self._chance = np.random.default_rng((seed, 22))
        self.flight = Yawing(row, self._chance)
        self.told = first, second = cameras(row)
        axis = self._chance.standard_normal(3)
        self.turn = math.radians(row.off_deg) * axis / np.linalg.norm(axis)
        self.true = [first, Pose(second.rotation @ rotation.exp(self.turn), second.position)]
        self.gyro = GyroHistory()
        self._imu = self._samples()
        self._next = next(self._imu)

    def _samples(self) -> Iterator[tuple[float, tuple[float, float, float]]]:
        axes = self.told[0].rotation.T
        for k in range(int((SECONDS + 1.0) * IMU_HZ)):
            t, dt = k / IMU_HZ, 0.5 / IMU_HZ
            turned = self.flight.attitude(t - dt).T @ self.flight.attitude(t + dt)
            rate = rotation.log(turned) / (2.0 * dt)
            rate = rate + GYRO_NOISE * math.sqrt(IMU_HZ) * self._chance.standard_normal(3)
            x, y, z = (axes @ rate).tolist()
            yield t, (x, y, z)

    def fly_to(self, t: float) -> None:
        """Feed the gyro's history up to just after t."""
        while self._next[0] <= t + 1.0 / IMU_HZ:
            self.gyro.append(*self._next)
            self._next = next(self._imu)

    def pixels(self, camera: int, t: float) -> tuple[Array, NDArray[np.bool_]]:
        """Where each drone is in the picture (n, 2) px, and whether it is inside (n,)."""
        pose = Pose(self.flight.attitude(t), np.zeros(3)) @ self.true[camera]
        pixel, _, ahead = CAMERA.project_undistorted(pose.inverse().transform(PLACES))
        low, high = CAMERA.ideal_bounds
        inside: NDArray[np.bool_] = ahead & ((pixel >= low) & (pixel <= high)).all(axis=1)
        return pixel, inside

    def scan(self, camera: int, t: float) -> Scan:
        pixel, inside = self.pixels(camera, t)
        seen = np.flatnonzero(inside & (self._chance.random(len(PLACES)) < P_DETECTION))
        z = pixel[seen] + SIGMA_PX * self._chance.standard_normal((len(seen), 2))
        low, high = CAMERA.ideal_bounds
        false = self._chance.uniform(low, high, (self._chance.poisson(CLUTTER), 2))
        width = SPAN * CAMERA.fx / np.linalg.norm(PLACES[seen], axis=1)
        own = np.column_stack([width, 0.5 * width])
        size = np.concatenate([own, self._chance.uniform(10.0, 40.0, false.shape)])
        score = np.concatenate([np.full(len(seen), 0.8), np.full(len(false), 0.5)])
        return Scan(t, np.concatenate([z, false]), size=size, score=score)


def make_rig(row: Row, tracker: str, told: list[Pose]) -> Rig:
    trackers = create_trackers(tracker, cameras=[CAMERA] * len(told), **AGENT_PARAMETERS)
    sigma = math.radians(row.told_deg)
    return Rig([RigCamera(CAMERA, pose, each, sigma) for pose, each in zip(told, trackers, strict=True)])


def fly(row: Row, tracker: str, seed: int) -> Flown:
    """One flight."""
    scene = Scene(row, seed)
    rig = make_rig(row, tracker, scene.told)
    # Neither in step nor at one rate.
    due = [0.5, 0.5 + 0.4 / FPS]
    seen: list[tuple[float, list[set[int]]]] = []
    inside: list[list[int | None]] = []
    while min(due) < SECONDS:
        camera = due.index(min(due))
        t = due[camera]
        due[camera] += 1.0 / FPS
        scene.fly_to(t)
        orientation = scene.gyro.orientation(t)
        rig.update(camera, scene.scan(camera, t), orientation)
        seen.append((t, on_drones(rig.tracks(orientation), scene, t)))
        shown = [scene.pixels(each, t)[1] for each in (0, 1)]
        inside.append([next((c for c in (0, 1) if shown[c][n]), None) for n in range(len(PLACES))])
    found = rig.found_turns.get((0, 1))
    # The rays turn against the camera.
    error = scene.turn + (found.angle if found else 0.0)
    crossings = [crossing for n in range(len(PLACES)) for crossing in _crossings(n, seen, inside)]
    doubles = sum(max(len(ids) - 1, 0) for _, drones in seen for ids in drones) / len(seen) * 60.0
    kept, late = [kept for _, kept in crossings], [kept for t, kept in crossings if t > SECONDS / 2.0]
    off_deg = math.degrees(float(np.linalg.norm(np.cross(error, SEAM_RAYS), axis=1).max()))
    learned_from = found.crossings if found else 0
    return Flown(len(kept), sum(kept), len(late), sum(late), doubles, off_deg, learned_from)


def on_drones(tracks: tuple[Track, ...], scene: Scene, t: float) -> list[set[int]]:
    """By drone, the numbers of the confirmed tracks that are on it."""
    pixels = [scene.pixels(camera, t)[0] for camera in (0, 1)]
    found: list[set[int]] = [set() for _ in PLACES]
    for track in tracks:
        away = np.linalg.norm(pixels[track.camera] - track.mean[::2], axis=1)
        n = int(np.nanargmin(away)) if np.isfinite(away).any() else -1
        if n >= 0 and away[n] < HIT_PX and track.status is TrackStatus.CONFIRMED:
            found[n].add(track.id)
    return found


def _crossings(
    n: int, seen: list[tuple[float, list[set[int]]]], inside: list[list[int | None]]
) -> Iterator[tuple[float, bool]]:
    """Of one drone: when it is in another picture than before, and whether its track is the same a moment later."""
    last: tuple[int, float] | None = None
    for k, (t, _) in enumerate(seen):
        shown = inside[k][n]
        if shown is None:
            continue
        if last is not None and shown != last[0]:
            before = {id for at, drones in seen if last[1] - BEFORE_S < at <= last[1] for id in drones[n]}
            after = {id for at, drones in seen if t < at < t + AFTER_S for id in drones[n]}
            if before and t + AFTER_S < SECONDS:
                yield t, bool(before & after)
        last = (shown, t)


def summary(flown: Sequence[Flown]) -> dict[str, Any]:
    """Of one row."""
    crossings, kept, late, late_kept, doubles, errors, learned = np.array(flown, float).T
    interval = share(kept, crossings)
    return {
        "crossings": int(crossings.sum()),
        "kept": float(kept.sum() / max(crossings.sum(), 1.0)),
        "interval": [interval["low"], interval["high"]],
        "kept_late": float(late_kept.sum() / max(late.sum(), 1.0)),
        "doubles_per_minute": float(np.mean(doubles)),
        "turn_error_deg": float(np.median(errors)),
        "turn_error_p95_deg": float(np.percentile(errors, 95.0)),
        "learned_from": float(np.median(learned)),
    }


BENCH = Flights(
    name="seams",
    title="From one camera to the next",
    about=f"`{{tracker}}`, {{seeds}} flights of {SECONDS:g} s per row.",
    seeds=seeds(40, quick=2),
    options=(TRACKER, PROCESSES),
    rows=lambda args: [
        harness.Row(row.name, partial(fly, row, args.tracker), summary, {"name": row.name}) for row in ROWS
    ],
    facts=lambda args: {"tracker": args.tracker, "seeds": args.seeds},
    columns=(
        ("", "{name}"),
        ("crossings", "{crossings}"),
        ("kept, %", "{kept:.2p}"),
        ("95 %", "{interval[0]:.2p} … {interval[1]:.2p}"),
        ("kept in the second half, %", "{kept_late:.2p}"),
        ("doubles, s per minute", "{doubles_per_minute:.2f}"),
        ("turn found to, °", "{turn_error_deg:.2f}"),
        ("95 % to, °", "{turn_error_p95_deg:.2f}"),
        ("from crossings", "{learned_from:.0f}"),
    ),
)
