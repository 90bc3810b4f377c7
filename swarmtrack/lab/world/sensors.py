"""What a drone's sensors say of a simulated world: gyro, ego pose, and detections as a detector would give them.

Every sample is a function of the world's seed and the sample's index alone. So the same seed gives the same
bits, whatever was asked for before.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import compress

import numpy as np

from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.lab.world.airframe import Airframe
from swarmtrack.lab.world.trajectory import Motion, wander
from swarmtrack.lab.world.world import World
from swarmtrack.messages import Array, Detections, EgoPose, FlightState, ImuSample
from swarmtrack.motion.smooth import smooth_step

SENSOR_NOISE_BLOCK = (
    256  # samples whose noise is drawn at once: a generator costs as much as a hundred of its numbers
)
SMALLEST_SHOWN_PX = 4.0  # larger side of a box that a detector can find at all
OCCLUDED = 0.7  # share of a box that nearer boxes must cover for its drone to count as hidden
MERGING = 0.3  # share of a box that a nearer one must cover for a detector to take both for one thing


@dataclass(frozen=True, slots=True)
class ImuParameters:
    """Errors of an IMU. Biases and scale errors are drawn once for each drone, with these standard deviations.

    White noise of a sample has the standard deviation density · √rate, as in Kalibr's IMU noise model. filter_hz: of
    the autopilot's two-pole low-pass (ArduPilot's INS_GYRO_FILTER), 0: none. window_s: a sample is the mean of so long
    (PX4's integration interval).
    """

    rate_hz: float = 200.0
    filter_hz: float = 20.0
    window_s: float = 0.0
    gyro_noise_density: float = 2e-4  # rad/s/√Hz: a MEMS gyro on a vibrating frame
    gyro_bias_sigma: float = 0.01  # rad/s: what is left after the autopilot's own calibration
    gyro_scale_sigma: float = 0.0  # relative
    accel_noise_density: float = 3e-3  # m/s²/√Hz
    accel_bias_sigma: float = 0.05  # m/s²

    @property
    def delay_s(self) -> float:
        """By which a sample is older than its stamp [s]: the filter's and the window's delay.

        A two-pole Butterworth filter H(s) = 1 / (1 + √2 s/ω + s²/ω²) has log H = −√2 s/ω + O(s³): to second order it
        is a pure delay of √2/ω. A drone turns at a few hertz, so of a filter of 20 Hz nothing else is left to see.
        """
        return (
            math.sqrt(2.0) / (2.0 * math.pi * self.filter_hz) if self.filter_hz else 0.0
        ) + self.window_s / 2.0


class Imu:
    """The IMU of one drone."""

    def __init__(self, world: World, drone_id: int, parameters: ImuParameters | None = None) -> None:
        self.parameters = p = parameters or ImuParameters()
        self.gyro_bias: Array = p.gyro_bias_sigma * world.chance("gyro bias", drone_id).standard_normal(3)
        """(3,) rad/s in body axes."""
        self._gyro_scale = 1.0 + p.gyro_scale_sigma * world.chance("gyro scale", drone_id).standard_normal(3)
        self._accel_bias = p.accel_bias_sigma * world.chance("accel bias", drone_id).standard_normal(3)
        self._world = world
        self._drone = world.flown(drone_id)
        self._drone_id = drone_id
        self._block: int | None = None
        self._noise = np.zeros((0, 2, 3))

    def sample(self, index: int) -> ImuSample:
        """Sample number `index`, at world time index / rate, stamped by somebody who knows the filter's delay."""
        t = index / self.parameters.rate_hz
        block, row = divmod(index, SENSOR_NOISE_BLOCK)
        if block != self._block:
            rng = self._world.chance("imu", self._drone_id, block)
            self._block, self._noise = block, rng.standard_normal((SENSOR_NOISE_BLOCK, 2, 3))
        delay = self.parameters.delay_s
        return ImuSample(t - delay, *self.measure(t, self._noise[row]), delay)

    def measure(self, t: float, white: Array) -> tuple[Array, Array]:
        """Gyro (3,) rad/s and accelerometer (3,) m/s² of the sample that the autopilot stamps t.

        white (2, 3): unit normal numbers of its own.
        """
        p = self.parameters
        motion = self._drone.motion(t - p.delay_s)
        wide = math.sqrt(p.rate_hz)
        gyro = self._gyro_scale * motion.body_rate + self.gyro_bias
        accel = motion.specific_force + self._accel_bias
        return (
            gyro + wide * p.gyro_noise_density * white[0],
            accel + wide * p.accel_noise_density * white[1],
        )


@dataclass(frozen=True, slots=True)
class EgoParameters:
    """Errors of the autopilot's own estimate: white ones, with one standard deviation per axis, and lasting ones.

    heading_error_deg: on the ground, from … to, either sign. Some seconds after take-off, from … to, the autopilot
    aligns itself in flight; from then on the error is at most aligned_error_deg. As ArduCopter's was measured.
    swings_deg: of the heading to either side while it wakes, from … to. hover_heading_deg: instead of aligning after a
    time, the heading drifts in hover to an error from … to, either sign, and aligns by flying; as PX4's was measured.
    height_error_m: from … to, either sign, as barometers and GPS have it. walks_m: RMS per axis of a slow walk of the
    position, from … to.
    """

    rate_hz: float = 50.0
    position_sigma: float = 0.02  # m
    attitude_sigma: float = 0.005  # rad
    heading_error_deg: tuple[float, float] = (1.5, 3.0)
    swings_deg: tuple[float, float] = (2.0, 4.0)
    aligned_error_deg: float = 1.0
    aligns_after_s: tuple[float, float] = (10.0, 25.0)
    hover_heading_deg: tuple[float, float] | None = None
    height_error_m: tuple[float, float] = (0.05, 0.12)
    walks_m: tuple[float, float] = (0.0, 0.0)


ARDUPILOT_EGO = EgoParameters()
PX4_EGO = EgoParameters(heading_error_deg=(0.0, 3.6), hover_heading_deg=(3.0, 9.0), walks_m=(0.05, 0.18))
# s from being switched on until the heading stands, and a drone arms; and of its swing's period, from … to.
WAKES_S, SWING_PERIOD_S = 40.0, (8.0, 20.0)
# A heading is observed by flying: m since the take-off until it is. Then it takes s; and the drift in hover before, s.
OBSERVED_M, ALIGNING_S, DRIFTS_S = 10.0, 5.0, 15.0
WALK_BAND_HZ = (0.004, 0.05)  # slower than any flight of a drone, and than its sway


class Ego:
    """What one drone's autopilot believes of its pose. on_since: world time at which it was switched on."""

    def __init__(
        self,
        world: World,
        drone_id: int,
        parameters: EgoParameters | None = None,
        *,
        on_since: float = -math.inf,
    ) -> None:
        self.parameters = p = parameters or EgoParameters()
        self.on_since = on_since
        chance = world.chance("ego errors", drone_id)
        signs = chance.choice((-1.0, 1.0), 2)
        self._heading = math.radians(signs[0] * chance.uniform(*p.heading_error_deg))
        self._aligned = math.radians(chance.uniform(-p.aligned_error_deg, p.aligned_error_deg))
        self._aligns_after_s = chance.uniform(*p.aligns_after_s)
        self.height_error: float = signs[1] * chance.uniform(*p.height_error_m)
        """m, down, as long as it flies."""
        chance = world.chance("ego manners", drone_id)
        self._swing = math.radians(chance.uniform(*p.swings_deg))
        self._swing_rate = 2.0 * math.pi / chance.uniform(*SWING_PERIOD_S)
        self._swing_phase = chance.uniform(0.0, 2.0 * math.pi)
        self._hover_heading = math.radians(
            chance.choice((-1.0, 1.0)) * chance.uniform(*(p.hover_heading_deg or (0.0, 0.0)))
        )
        walk_m = chance.uniform(*p.walks_m)
        self._walk = wander(chance, walk_m, band_hz=WALK_BAND_HZ) if walk_m else None
        self._world = world
        self._drone = world.flown(drone_id)
        self._drone_id = drone_id
        self.origin = self._drone.position(0.0)
        """(3,) m: where its local frame begins, as without GPS: where it was at world time 0."""

    def is_awake(self, t: float) -> bool:
        """Whether it has been switched on for long enough to arm."""
        return t >= self.on_since + WAKES_S

    def heading_error(self, t: float) -> float:
        """Rad, at world time t. Of a drone that was in the air before, small all the time."""
        since = t - self._drone.takes_off_s
        if since < 0.0:
            return self._heading + self._swinging(t - self.on_since)
        if self.parameters.hover_heading_deg is None or math.isinf(since):
            return self._aligned if since >= self._aligns_after_s else self._heading
        drifted = self._heading + (self._hover_heading - self._heading) * -math.expm1(-since / DRIFTS_S)
        share = float(smooth_step((t - self._drone.flown_from(OBSERVED_M)) / ALIGNING_S)[0])
        return drifted + share * (self._aligned - drifted)

    def _swinging(self, on_for: float) -> float:
        """Rad, about the error on the ground, less and less until it is awake."""
        if not on_for < WAKES_S:
            return 0.0
        calm = float(smooth_step(on_for / WAKES_S)[0])
        return (1.0 - calm) * self._swing * math.sin(self._swing_rate * on_for + self._swing_phase)

    def walk(self, t: float) -> Array:
        """By how much its position is off besides, (3,) m, and how that changes, (3,) m/s."""
        return np.zeros((2, 3)) if self._walk is None else self._walk.derivatives(t)[:2]

    def flight_state(self, t: float) -> FlightState:
        """Whether it flies at world time t, as heartbeats tell it."""
        takes_off = self._drone.takes_off_s
        return FlightState(t, takes_off if t >= takes_off else None)

    def estimate(self, motion: Motion, t: float, white: Array) -> tuple[Array, Array]:
        """Position (3,) m in its local frame and world_from_body (3, 3) at t. white (2, 3): unit normal numbers."""
        p = self.parameters
        position = motion.position - self.origin + self.walk(t)[0] + p.position_sigma * white[0]
        position[2] += self.height_error
        turned = rotation.exp(np.array([0.0, 0.0, self.heading_error(t)])) @ motion.attitude
        return position, turned @ rotation.exp(p.attitude_sigma * white[1])

    def pose(self, index: int) -> EgoPose:
        """Estimate number `index`, at world time index / rate, with the errors that an agent assumes of autopilots."""
        t = index / self.parameters.rate_hz
        white = self._world.chance("ego", self._drone_id, index).standard_normal((2, 3))
        position, attitude = self.estimate(self._drone.motion(t), t, white)
        return EgoPose(t=t, position=position, world_from_body=attitude)


@cache
def _outline(airframe: Airframe) -> Array:
    return airframe.outline()


class Instant:
    """Where all drones of a world are at one time; what each of them sees then is asked of it."""

    def __init__(self, world: World, t: float) -> None:
        self._ids = list(world.drones)
        self._poses = [world.pose(drone_id, t) for drone_id in self._ids]
        self._positions = np.stack([pose.position for pose in self._poses])
        self._outlines = np.stack(
            [
                pose.transform(_outline(world.airframe(drone_id)))
                for drone_id, pose in zip(self._ids, self._poses, strict=True)
            ]
        )  # (n, points, 3) m in the world

    def boxes(self, drone_id: int, camera: PinholeCamera, body_from_camera: Pose) -> dict[int, Array]:
        """True boxes (4,) [u, v, w, h] px (centre and size) of all that is wholly ahead of it, nearest first."""
        observer = self._ids.index(drone_id)
        world_from_camera = self._poses[observer] @ body_from_camera
        in_camera = (self._outlines - world_from_camera.position) @ world_from_camera.rotation
        pixels, _, valid = camera.project(in_camera.reshape(-1, 3))
        shape = in_camera.shape[:2]
        pixels, ahead = pixels.reshape(*shape, 2), np.asarray(valid.reshape(shape).all(axis=1))
        ahead[observer] = False
        low, high = pixels.min(axis=1), pixels.max(axis=1)
        boxes = np.concatenate([(low + high) / 2.0, high - low], axis=1)
        distances = np.linalg.norm(self._positions - world_from_camera.position, axis=1)
        nearest_first = np.lexsort((self._ids, distances))
        return {self._ids[n]: boxes[n] for n in nearest_first[ahead[nearest_first]]}

    def visible(self, drone_id: int, camera: PinholeCamera, body_from_camera: Pose) -> dict[int, Array]:
        """Of these the ones that `drone_id` can see.

        Whoever's box has its centre outside the image, or is covered by a nearer one's, is not seen.
        """
        return shown(self.boxes(drone_id, camera, body_from_camera), camera)


def visible(
    world: World, drone_id: int, camera: PinholeCamera, body_from_camera: Pose, t: float
) -> dict[int, Array]:
    """True boxes (4,) [u, v, w, h] px of the drones that `drone_id` can see at t, nearest first: see `Instant`."""
    return Instant(world, t).visible(drone_id, camera, body_from_camera)


def shown(boxes: Mapping[int, Array], camera: PinholeCamera) -> dict[int, Array]:
    """Of all boxes (4,) [u, v, w, h] px ahead of a camera, nearest first, those of `visible`."""
    table = np.array(list(boxes.values())).reshape(-1, 4)
    beyond = (camera.width - 0.5, camera.height - 0.5)
    inside = np.asarray(((table[:, :2] >= -0.5) & (table[:, :2] < beyond)).all(axis=1))
    inside &= table[:, 2:].max(axis=1, initial=0.0) >= SMALLEST_SHOWN_PX
    ids, table = list(compress(boxes, inside.tolist())), table[inside]
    hides = _coverage(table) >= OCCLUDED
    seen: list[int] = []
    for n in range(len(ids)):
        if not hides[n, seen].any():
            seen.append(n)
    return {ids[n]: table[n] for n in seen}


def _coverage(boxes: Array) -> Array:
    """The share of each of the boxes (n, 4) [u, v, w, h] that lies in each other one, (n, n)."""
    low, high = boxes[:, :2] - boxes[:, 2:] / 2.0, boxes[:, :2] + boxes[:, 2:] / 2.0
    overlap = np.minimum(high[:, None], high) - np.maximum(low[:, None], low)
    share: Array = np.maximum(overlap, 0.0).prod(axis=2) / boxes[:, 2:].prod(axis=1)[:, None]
    return share


@dataclass(frozen=True, slots=True)
class DetectorParameters:
    """A detector as the tracking literature has it: misses, Gaussian errors, Poisson clutter; and boxes that merge."""

    p_detection: float = 0.95
    """Probability that a drone in view is found in a frame."""
    centre_sigma: float = 1.0
    """Error of a box's centre, px per axis."""
    size_sigma: float = 0.05
    """Error of a box's sides, relative."""
    clutter_per_frame: float = 0.1
    """Mean number of false detections per frame."""
    p_merged: float = 0.3
    """Probability that two drones that overlap heavily are found as one box around both."""

    def __post_init__(self) -> None:
        for name, most in (("p_detection", 1.0), ("p_merged", 1.0), ("clutter_per_frame", 1000.0)):
            if not 0.0 <= getattr(self, name) <= most:
                raise ValueError(f"detector.{name}: found {getattr(self, name)}, expected 0 to {most:g}")
        for name in ("centre_sigma", "size_sigma"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"detector.{name}: found {getattr(self, name)}, expected a number from 0")


def detect(
    boxes: Mapping[int, Array],
    camera: PinholeCamera,
    parameters: DetectorParameters,
    rng: np.random.Generator,
    *,
    t: float,
    sequence: int,
) -> Detections:
    """What such a detector finds in the frame exposed at t, of which `boxes` are true, the nearest first.

    The order of what it finds tells nothing.
    """
    p = parameters
    truth = _merged(np.array(list(boxes.values()), dtype=float).reshape(-1, 4), p.p_merged, rng)
    truth = truth[rng.random(len(truth)) < p.p_detection]
    n = len(truth)
    n_clutter = int(rng.poisson(p.clutter_per_frame))
    centre = np.concatenate(
        [
            truth[:, :2] + p.centre_sigma * rng.standard_normal((n, 2)),
            rng.uniform((-0.5, -0.5), (camera.width - 0.5, camera.height - 0.5), (n_clutter, 2)),
        ]
    )
    size = np.concatenate(
        [
            truth[:, 2:] * np.exp(p.size_sigma * rng.standard_normal((n, 2))),
            rng.uniform(8.0, 60.0, (n_clutter, 2)),
        ]
    )
    score = np.concatenate([rng.uniform(0.5, 1.0, n), rng.uniform(0.2, 0.6, n_clutter)])
    order = rng.permutation(n + n_clutter)
    return Detections(t=t, sequence=sequence, centre=centre[order], size=size[order], score=score[order])


def _merged(boxes: Array, p_merged: float, rng: np.random.Generator) -> Array:
    """What is left, (m, 4), of boxes (n, 4), nearest first, when one that is partly hidden may join its hider's."""
    covered = np.tril(_coverage(boxes), -1) >= MERGING  # of each, by which nearer ones
    group = np.arange(len(boxes))
    for farther in np.flatnonzero(covered.any(axis=1)):
        if rng.random() < p_merged:
            group[farther] = group[covered[farther].argmax()]
    if (group == np.arange(len(boxes))).all():
        return boxes
    low, high = boxes[:, :2] - boxes[:, 2:] / 2.0, boxes[:, :2] + boxes[:, 2:] / 2.0
    around = [(low[group == g].min(axis=0), high[group == g].max(axis=0)) for g in np.unique(group)]
    return np.array([[*(a + b) / 2.0, *(b - a)] for a, b in around]).reshape(-1, 4)
