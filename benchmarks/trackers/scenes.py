"""The scenes of `swarmtrack bench trackers`: where targets fly in the image, and what a sensor makes of them.

A scene and the number of a run give a *take*: the truth, the scans in which trackers see it, and which detection came
from which target, for the oracle. The take depends on nothing else, so all trackers are shown the very same scans.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.benchmarks.report import BenchmarkError
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.lab.score import paper_scenario
from swarmtrack.lab.score.paper_scenario import HERE, PAPER_STEP_S, PAPER_STEPS, THERE
from swarmtrack.messages import Array, Scan
from swarmtrack.motion.gyro import GyroHistory

SEED = 20_240_614
# From the authors' scripts.
PAPER_CAMERA = PinholeCamera(
    120.0, 120.0, 180.0, 120.0, paper_scenario.PAPER_WIDTH_PX, paper_scenario.PAPER_HEIGHT_PX
)
CAMERA = PinholeCamera(430.0, 430.0, 319.5, 239.5, 640, 480)
PAPER_HZ = 1.0 / PAPER_STEP_S

ACCELERATION_PSD = 600.0  # px²/s³: the white acceleration that fits the paper's drones (peak 65 px/s²)
LEAST_SIGMA_PX = 0.5  # told where there is no noise: no filter is told that its sensor is perfect
LEAST_CLUTTER = 0.01  # told where there is none
MOST_P_DETECTION = 0.999  # told where nothing is missed

Motion = Callable[[Array], Array]
"""t (k,) s -> (k, n, 2) px, NaN where a target is absent."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensor:
    """sigma_px: noise per axis; clutter: false detections, uniform in the image; merge_px: detections of targets that
    are chained by distances below this become one, at their mean.
    """

    sigma_px: float = 0.0
    p_detection: float = 1.0
    clutter: float = 0.0
    fixed_clutter: bool = True
    """Exactly so many in every scan, as in the paper; else Poisson with this mean."""
    merge_px: float = 0.0
    burst_scans: int = 0
    """Now and then a target is missed for so many scans on end."""
    burst_every_scans: float = 30.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Gyro:
    """Of an observer that turns: yaw and roll are sinusoids of these peak rates [rad/s] and frequencies [Hz]."""

    told: bool
    """Whether trackers are told of the rotation."""
    yaw_rate: float = 2.0
    yaw_hz: float = 1.0
    roll_rate: float = 2.0
    roll_hz: float = 0.7
    rate_hz: float = 100.0
    noise_density: float = 2e-3  # rad/s/√Hz


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    name: str
    family: str
    about: str
    motion: Callable[[np.random.Generator], Motion]
    sensor: Sensor
    camera: PinholeCamera = PAPER_CAMERA
    rate_hz: float = PAPER_HZ
    scans: int = PAPER_STEPS
    known_starts: bool = True
    start_speed_px_s: float = 10.0
    """One sigma per axis, told with the known starts; the paper's drones hover then."""
    gyro: Gyro | None = None
    runs: int = 100
    told: Mapping[str, float] = field(default_factory=dict)
    """Tracker parameters beside or instead of those that hold; what a tracker has no name for is left out."""
    untold: bool = False
    """Trackers are told `told` and no more, beside what agents tell theirs."""
    draws: str = ""
    """The scene whose random numbers this one shares: both show the same scans where their sensors agree."""
    latencies_s: tuple[float, ...] = ()
    """How late detections arrive where `at(now)` is judged, too."""

    def parameters(self) -> dict[str, float]:
        """What trackers are told: the numbers that hold, unless `told` says otherwise. Oracles and peers are told as
        much where `untold`."""
        sensor = self.sensor
        holds = {
            "measurement_sigma": max(sensor.sigma_px, LEAST_SIGMA_PX),
            "acceleration_psd": ACCELERATION_PSD,
            "p_detection": min(sensor.p_detection, MOST_P_DETECTION),
            "clutter_per_scan": max(sensor.clutter, LEAST_CLUTTER),
        }
        if self.known_starts:  # the number of targets is known, too: nobody comes or goes
            holds |= {"p_survival": 0.9999, "birth_per_scan": 1e-4, "max_coast_s": 3.0}
            holds |= {"birth_speed_sigma": self.start_speed_px_s}
        return holds | dict(self.told)


class Observation(NamedTuple):
    """One scan and its secret: made (n,) is the detection that each target made, those merged share one; −1 missed.

    rotation (3, 3): camera axes now from camera axes at the scan before, as the gyro tells it; None: still, or not
    told; rotation_variance rad².
    """

    scan: Scan
    made: NDArray[np.intp]
    rotation: Array | None = None
    rotation_variance: float = 0.0


class Take(NamedTuple):
    """One run of a scene. t (k,) s; truth (k, n, 2) px; start (n, 2) px at t[0] where it is told, before any scan.

    ahead: for each latency of the scene the truth (k, n, 2) px that much later.
    """

    t: Array
    truth: Array
    start: Array | None
    observations: list[Observation]
    ahead: dict[float, Array]


def film(scene: Scene, run: int) -> Take:
    """The take of one run: SEED, the scene's name and the run are all it depends on."""
    rng = np.random.default_rng([SEED, zlib.crc32((scene.draws or scene.name).encode()), run])
    motion = scene.motion(rng)
    t = np.arange(scene.scans) / scene.rate_hz
    truth = motion(t)
    told: list[tuple[Array | None, float]] = [(None, 0.0)] * len(t)
    # Drawn in every scene, so that those paired stay in step.
    gyro_rng = np.random.default_rng(rng.integers(2**63))
    if scene.gyro is not None:
        truth = _turned(truth, _orientation(t, scene.gyro), scene.camera)
        if scene.gyro.told:
            told = _integrated(t, scene.gyro, gyro_rng)
    start = truth[0] if scene.known_starts else None
    detected = _detected(scene.sensor, truth, rng)
    observations = []
    for k in range(len(t)):
        if k == 0 and start is not None:
            continue  # the known start stands in for the first scan
        z, made = _detections(scene, truth[k], detected[k], rng)
        observations.append(Observation(Scan(float(t[k]), z), made, *told[k]))
    ahead = {latency: motion(t + latency) for latency in scene.latencies_s}
    return Take(t, truth, start, observations, ahead)


def _detected(sensor: Sensor, truth: Array, rng: np.random.Generator) -> NDArray[np.bool_]:
    """(k, n): which targets are detected in which scans."""
    detected = np.asarray(rng.random(truth.shape[:2]) < sensor.p_detection)
    if sensor.burst_scans:
        begins = rng.random(truth.shape[:2]) < 1.0 / sensor.burst_every_scans
        for k, i in np.argwhere(begins):
            detected[k : k + sensor.burst_scans, i] = False
    return detected & np.isfinite(truth[:, :, 0])


def _detections(
    scene: Scene, truth: Array, detected: NDArray[np.bool_], rng: np.random.Generator
) -> tuple[Array, NDArray[np.intp]]:
    """z (m, 2) in random order, and which of them each target made."""
    sensor, camera = scene.sensor, scene.camera
    noisy = truth + rng.normal(0.0, 1.0, truth.shape) * sensor.sigma_px
    inside = (noisy >= 0.0) & (noisy <= [camera.width, camera.height])
    seen = np.flatnonzero(detected & inside.all(axis=1))
    blob = _chained(noisy[seen], sensor.merge_px)
    own = np.array([noisy[seen[blob == b]].mean(axis=0) for b in range(blob.max(initial=-1) + 1)])
    count = round(sensor.clutter) if sensor.fixed_clutter else rng.poisson(sensor.clutter)
    false = rng.uniform([0.0, 0.0], [camera.width, camera.height], (count, 2))
    z = np.concatenate([own.reshape(-1, 2), false])
    order = rng.permutation(len(z))
    made = np.full(len(truth), -1, np.intp)
    made[seen] = np.argsort(order)[blob]
    return z[order], made


def _chained(points: Array, limit: float) -> NDArray[np.intp]:
    """(n,) the number of each point's group: points closer than limit [px], directly or through others, are one."""
    group = np.arange(len(points))
    for i in range(len(points)):
        for j in range(i):
            if np.linalg.norm(points[i] - points[j]) < limit:
                group[group == group[i]] = group[j]
    return np.asarray(np.unique(group, return_inverse=True)[1].reshape(-1), np.intp)


# How targets move.


def _paper(_: np.random.Generator) -> Motion:
    return paper_scenario.truth


def _together(begins: tuple[float, ...], duration: float) -> Callable[[np.random.Generator], Motion]:
    """The paper's lines, but all three leave and arrive together: they meet within 7 px, drones 2 and 3 within 2.

    begins, duration in steps; every second way leads back.
    """

    def motion(t: Array) -> Array:
        step = 1.0 + t / PAPER_STEP_S
        share = np.zeros(len(t))
        for k, begin in enumerate(begins):
            share += (-1.0) ** k * paper_scenario.progress((step - begin) / duration)
        return np.asarray(HERE + share[:, None, None] * (THERE - HERE))

    return lambda rng: motion


def _swaying(
    centres: Callable[[np.random.Generator], Array], reach_px: float, slowest_hz: float, fastest_hz: float
) -> Callable[[np.random.Generator], Motion]:
    """Targets that sway about their centres (n, 2) px, each in its own way: two sinusoids an axis."""

    def draw(rng: np.random.Generator) -> Motion:
        home = centres(rng)
        size = (*home.shape, 2)
        hz = rng.uniform(slowest_hz, fastest_hz, size)
        phase = rng.uniform(0.0, 2.0 * np.pi, size)
        amplitude = reach_px * rng.uniform(0.3, 0.5, size)

        def motion(t: Array) -> Array:
            swing = amplitude * np.sin(2.0 * np.pi * hz * t[:, None, None, None] + phase)
            return np.asarray(home + swing.sum(axis=3))

        return motion

    return draw


def _ball(rng: np.random.Generator) -> Array:
    return np.array([200.0, 150.0]) + rng.normal(0.0, 15.0, (8, 2))


def _flock(rng: np.random.Generator) -> Array:
    u, v = np.meshgrid(np.linspace(120.0, 520.0, 6), np.linspace(100.0, 380.0, 5))
    return np.stack([u.ravel(), v.ravel()], axis=1) + rng.normal(0.0, 10.0, (30, 2))


def _spread(rng: np.random.Generator) -> Array:
    u, v = np.meshgrid([240.0, 400.0], [180.0, 300.0])
    return np.stack([u.ravel(), v.ravel()], axis=1) + rng.normal(0.0, 10.0, (4, 2))


def _steady(rng: np.random.Generator) -> Motion:
    """Four targets that keep their motion."""
    centre = _spread(rng)
    velocity = rng.uniform(4.0, 10.0, (4, 1)) * _unit(rng, 4)
    return lambda t: np.asarray(centre + (t[:, None, None] - 10.0) * velocity)


def _visitors(rng: np.random.Generator) -> Motion:
    """Six targets, each there for 5 to 9 of 20 s: they appear anywhere, fly straight with a sway, and vanish."""
    n = 6
    begin, stay = rng.uniform(0.5, 10.0, n), rng.uniform(5.0, 9.0, n)
    middle = rng.uniform([170.0, 150.0], [470.0, 330.0], (n, 2))
    velocity = rng.uniform(10.0, 30.0, (n, 1)) * _unit(rng, n)
    sway = rng.uniform(2.0, 8.0, (n, 2))
    phase = rng.uniform(0.0, 2.0 * np.pi, (n, 2))

    def motion(t: Array) -> Array:
        since = t[:, None] - begin
        path = middle + (since - 0.5 * stay)[:, :, None] * velocity
        path = path + sway * np.sin(2.0 * np.pi * 0.3 * t[:, None, None] + phase)
        return np.where(((since >= 0.0) & (since < stay))[:, :, None], path, np.nan)

    return motion


def _unit(rng: np.random.Generator, n: int) -> Array:
    angle = rng.uniform(0.0, 2.0 * np.pi, n)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


# An observer that turns.


def _orientation(t: Array, gyro: Gyro) -> Array:
    """camera_from_start (k, 3, 3): first yaw about the camera's y axis, then roll about its z axis."""
    yaw = gyro.yaw_rate / (2.0 * np.pi * gyro.yaw_hz) * np.sin(2.0 * np.pi * gyro.yaw_hz * t)
    roll = gyro.roll_rate / (2.0 * np.pi * gyro.roll_hz) * np.sin(2.0 * np.pi * gyro.roll_hz * t)
    zero = np.zeros_like(t)
    about_y = rotation.exp(np.stack([zero, -yaw, zero], axis=1))
    about_z = rotation.exp(np.stack([zero, zero, -roll], axis=1))
    return np.asarray(about_z @ about_y)


def _turned(points: Array, camera_from_start: Array, camera: PinholeCamera) -> Array:
    """Points (k, n, 2) px of a camera at rest as the turned one sees them."""
    ideal = np.concatenate([points, np.ones((*points.shape[:2], 1))], axis=2)
    M = camera.K @ camera_from_start @ camera.K_inverse
    h = ideal @ M.swapaxes(1, 2)
    return np.asarray(h[:, :, :2] / h[:, :, 2:])


def _integrated(t: Array, gyro: Gyro, rng: np.random.Generator) -> list[tuple[Array | None, float]]:
    """(rotation, variance) from scan to scan, as a noisy gyro of rate_hz tells it."""
    history = GyroHistory(noise_density=gyro.noise_density)
    told: list[tuple[Array | None, float]] = [(None, 0.0)]
    stamps = np.arange(round(t[-1] * gyro.rate_hz) + 2) / gyro.rate_hz
    step = 1e-4  # s
    before, after = _orientation(stamps - step, gyro), _orientation(stamps + step, gyro)
    rates = rotation.log(before @ after.swapaxes(1, 2)) / (2.0 * step)  # start_from_camera turns by +ω dt
    rates = rates + rng.normal(0.0, gyro.noise_density * np.sqrt(gyro.rate_hz), rates.shape)
    fed = 0
    for then, now in pairwise(t.tolist()):
        while fed < len(stamps) and stamps[fed] <= now + 1.0 / gyro.rate_hz:
            x, y, z = rates[fed].tolist()
            history.append(float(stamps[fed]), (x, y, z))
            fed += 1
        turned = history.rotation(then, now)
        told.append((turned.matrix, turned.variance))
    return told


# The table of scenes.

_HARD = Sensor(sigma_px=1.5, p_detection=0.9, clutter=5.0)
_MEET = _together((14.0, 64.0, 114.0), 34.0)
_MEET_SLOWLY = _together((14.0,), 102.0)
_PRESENT = Sensor(sigma_px=1.5, p_detection=0.95, clutter=1.0, fixed_clutter=False)
_WRONG: dict[str, tuple[str, Callable[[float], float]]] = {
    "R_x4": ("measurement_sigma", lambda sigma: 2.0 * sigma),
    "R_quarter": ("measurement_sigma", lambda sigma: 0.5 * sigma),
    "clutter_x5": ("clutter_per_scan", lambda rate: 5.0 * rate),
    "clutter_fifth": ("clutter_per_scan", lambda rate: 0.2 * rate),
    "pd_plus.20": ("p_detection", lambda p: min(p + 0.2, MOST_P_DETECTION)),
    "pd_minus.20": ("p_detection", lambda p: p - 0.2),
}
_WRONGLY_TOLD = {
    "noise.50": ("R_x4", "R_quarter"),
    "clutter5": ("clutter_x5", "clutter_fifth"),
    "pd.90": ("pd_minus.20",),
    "pd.80": ("pd_plus.20", "pd_minus.20"),
    "mixedA": ("R_x4", "R_quarter", "clutter_x5", "clutter_fifth"),
}
_LATENCIES_S = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)


def _paper_scenes() -> list[Scene]:
    return [
        Scene(
            name=name,
            family="paper",
            about=f"noise σ {c.sigma_px:g} px, {c.clutter} false detections, P_D {c.p_detection:g}",
            motion=_paper,
            sensor=Sensor(sigma_px=c.sigma_px, p_detection=c.p_detection, clutter=float(c.clutter)),
        )
        for name, c in paper_scenario.CONDITIONS.items()
    ]


def _crossings() -> list[Scene]:
    meeting = partial(Scene, family="crossing", sensor=_HARD, runs=300)
    hard = "clutter 5, σ 1.5 px, P_D 0.9"
    thrice = f"three drones meet in one place three times; {hard}"
    slowly = f"three drones meet once, three times slower; {hard}"
    plain = (
        meeting(name="crossing", about=thrice, motion=_MEET, scans=160),
        meeting(name="slow", about=slowly, motion=_MEET_SLOWLY, scans=130),
    )
    return [scene for one in plain for scene in (one, _merged(one))]


def _merged(scene: Scene) -> Scene:
    told, about = {"resolution_px": 8.0}, f"{scene.about}; detections within 8 px merge"
    sensor = replace(scene.sensor, merge_px=8.0)
    return replace(scene, name=f"{scene.name}_merged", about=about, sensor=sensor, told=told)


def _untold(scene: Scene) -> Scene:
    about = f"{scene.name}; of it trackers know where it begins, and by how much detections merge"
    untold = replace(scene, name=f"untold_{scene.name}", about=about, draws=scene.name)
    return replace(untold, family="untold", untold=True)


def _crowds() -> list[Scene]:
    swaying = partial(Scene, family="crowd", start_speed_px_s=20.0, rate_hz=15.0)
    return [
        swaying(
            name="ball",
            about="eight drones in a ball of some 60 px; clutter 2, σ 1 px, P_D 0.95, 15 Hz",
            motion=_swaying(_ball, 30.0, 0.05, 0.25),
            sensor=Sensor(sigma_px=1.0, p_detection=0.95, clutter=2.0, fixed_clutter=False),
            scans=225,
        ),
        swaying(
            name="flock",
            about="thirty drones, 70 to 80 px apart, each swaying by up to 30 px; clutter 5, σ 1.5 px, P_D 0.9, 15 Hz",
            motion=_swaying(_flock, 30.0, 0.05, 0.25),
            sensor=replace(_HARD, fixed_clutter=False),
            camera=CAMERA,
            scans=150,
        ),
        Scene(
            name="misses",
            family="crowd",
            about="the paper's ways; clutter 5, σ 1.5 px, P_D 0.95, and each drone is missed for 5 scans on end, once"
            " in 30",
            motion=_paper,
            sensor=replace(_HARD, p_detection=0.95, burst_scans=5),
        ),
    ]


def _unannounced() -> list[Scene]:
    births = Scene(
        name="births",
        family="births",
        about="six targets come and go in 20 s, nobody tells; clutter 5, σ 1.5 px, P_D 0.9, 15 Hz",
        motion=_visitors,
        sensor=replace(_HARD, fixed_clutter=False),
        camera=CAMERA,
        rate_hz=15.0,
        scans=300,
        known_starts=False,
    )
    slower = births.about.replace("15 Hz", f"{PAPER_HZ:.1f} Hz")
    return [
        births,
        replace(births, name="births_8hz", about=slower, rate_hz=PAPER_HZ, scans=166),
    ]


def _turning() -> list[Scene]:
    still = Scene(
        name="rotating_still",
        start_speed_px_s=20.0,
        family="rotating",
        about="four swaying targets, the observer at rest; σ 1.5 px, P_D 0.95, clutter 1, 15 Hz",
        motion=_swaying(_spread, 15.0, 0.1, 0.3),
        sensor=_PRESENT,
        camera=CAMERA,
        rate_hz=15.0,
        scans=150,
        draws="rotating",
    )
    turning = "the same, the observer yaws and rolls by ±2 rad/s"
    return [
        still,
        replace(still, name="rotating", about=f"{turning}, 100 Hz gyro", gyro=Gyro(told=True)),
        replace(still, name="rotating_no_gyro", about=f"{turning}, nobody tells", gyro=Gyro(told=False)),
    ]


def _late() -> list[Scene]:
    steady = Scene(
        name="latency_steady",
        family="latency",
        about="four targets of constant velocity, trackers told so (acceleration_psd 1e-4 px²/s³)",
        motion=_steady,
        sensor=_PRESENT,
        camera=CAMERA,
        rate_hz=15.0,
        scans=240,
        told={"acceleration_psd": 1e-4},
        latencies_s=_LATENCIES_S,
        draws="latency",
    )
    untold = "the same targets, trackers told that they may manoeuvre (600 px²/s³)"
    swaying = "four targets that sway by up to 15 px at 0.1 to 0.3 Hz"
    motion = _swaying(_spread, 15.0, 0.1, 0.3)
    return [
        steady,
        replace(steady, name="latency_steady_untold", about=untold, told={}),
        replace(steady, name="latency_manoeuvring", about=swaying, motion=motion, told={}),
    ]


def _wrongly_told(rightly: dict[str, Scene]) -> list[Scene]:
    scenes = []
    for base, wrongs in _WRONGLY_TOLD.items():
        for wrong in wrongs:
            right, (parameter, falsify) = rightly[base], _WRONG[wrong]
            told = {parameter: falsify(right.parameters()[parameter])}
            name, about = f"told_wrong_{wrong}_{base}", f"{base}, told {parameter} {told[parameter]:g}"
            scenes.append(replace(right, name=name, family="told_wrong", about=about, told=told, draws=base))
    return scenes


def _all() -> dict[str, Scene]:
    paper, crossings = _paper_scenes(), _crossings()
    scenes = [
        *paper,
        *crossings,
        *map(_untold, crossings),
        *_crowds(),
        *_unannounced(),
        *_turning(),
        *_late(),
    ]
    scenes += _wrongly_told({scene.name: scene for scene in paper})
    return {scene.name: scene for scene in scenes}


SCENES: dict[str, Scene] = _all()


def find_scene(name: str) -> Scene:
    if name not in SCENES:
        raise BenchmarkError(f"--scene: found {name!r}, expected one of {', '.join(SCENES)}")
    return SCENES[name]
