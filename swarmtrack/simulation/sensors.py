"""What a drone's sensors say of a simulated world: gyro, ego pose, and detections as a detector would give them.

Every sample is a function of the world's seed and the sample's index alone. So the same seed gives the same
bits, whatever was asked for before.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Array, Detections, EgoPose, ImuSample
from swarmtrack.simulation.world import World

OCCLUDED = 0.7  # share of a box that nearer boxes must cover for its drone to count as hidden


@dataclass(frozen=True, slots=True)
class ImuParameters:
    """Errors of an IMU. Biases and scale errors are drawn once for each drone, with these standard deviations.

    White noise of a sample has the standard deviation density · √rate, as in Kalibr's IMU noise model.
    """

    rate_hz: float = 200.0
    gyro_noise_density: float = 2e-4  # rad/s/√Hz: a MEMS gyro on a vibrating frame
    gyro_bias_sigma: float = 0.01  # rad/s: what is left after the autopilot's own calibration
    gyro_scale_sigma: float = 0.0  # relative
    accel_noise_density: float = 3e-3  # m/s²/√Hz
    accel_bias_sigma: float = 0.05  # m/s²


class Imu:
    """The IMU of one drone."""

    def __init__(self, world: World, drone_id: int, parameters: ImuParameters | None = None) -> None:
        self.parameters = p = parameters or ImuParameters()
        self.gyro_bias: Array = p.gyro_bias_sigma * world.chance("gyro bias", drone_id).standard_normal(3)
        """(3,) rad/s in body axes."""
        self._gyro_scale = 1.0 + p.gyro_scale_sigma * world.chance("gyro scale", drone_id).standard_normal(3)
        self._accel_bias = p.accel_bias_sigma * world.chance("accel bias", drone_id).standard_normal(3)
        self._world = world
        self._drone_id = drone_id

    def sample(self, index: int) -> ImuSample:
        """Sample number `index`, at world time index / rate."""
        p = self.parameters
        t = index / p.rate_hz
        white = math.sqrt(p.rate_hz) * self._world.chance("imu", self._drone_id, index).standard_normal(
            (2, 3)
        )
        body_rate, specific_force = self._world.drones[self._drone_id].inertial(t)
        gyro = self._gyro_scale * body_rate + self.gyro_bias
        accel = specific_force + self._accel_bias
        return ImuSample(t, gyro + p.gyro_noise_density * white[0], accel + p.accel_noise_density * white[1])


@dataclass(frozen=True, slots=True)
class EgoParameters:
    """Errors of the autopilot's own estimate: white, one standard deviation per axis."""

    rate_hz: float = 50.0
    position_sigma: float = 0.02  # m
    attitude_sigma: float = 0.005  # rad


def ego_pose(world: World, drone_id: int, index: int, parameters: EgoParameters) -> EgoPose:
    """Estimate number `index` of the drone's autopilot, at world time index / rate.

    As of an autopilot without GPS, the origin is where it started (world time 0); the axes are north, east, down.
    """
    t = index / parameters.rate_hz
    truth = world.pose(drone_id, t)
    error = world.chance("ego", drone_id, index).standard_normal((2, 3))
    return EgoPose(
        t=t,
        position=truth.position - world.pose(drone_id, 0.0).position + parameters.position_sigma * error[0],
        world_from_body=truth.rotation @ rotation.exp(parameters.attitude_sigma * error[1]),
        position_sigma=parameters.position_sigma,
        attitude_sigma=parameters.attitude_sigma,
    )


def visible(
    world: World, drone_id: int, camera: PinholeCamera, body_from_camera: Pose, t: float
) -> dict[int, Array]:
    """True boxes (4,) [u, v, w, h] px (centre and size) of the drones that `drone_id` can see, nearest first.

    Whoever's box has its centre outside the image, or is covered by a nearer one's, is not seen.
    """
    camera_from_world = (world.pose(drone_id, t) @ body_from_camera).inverse()
    candidates = []
    for other in world.drones:
        if other == drone_id:
            continue
        camera_from_body = camera_from_world @ world.pose(other, t)
        pixels, _, valid = camera.project(camera_from_body.transform(world.airframe(other).outline()))
        if valid.all():
            low, high = pixels.min(axis=0), pixels.max(axis=0)
            box = np.concatenate([(low + high) / 2.0, high - low])
            candidates.append((float(np.linalg.norm(camera_from_body.position)), other, box))
    return shown({other: box for _, other, box in sorted(candidates, key=lambda c: c[:2])}, camera)


def shown(boxes: Mapping[int, Array], camera: PinholeCamera) -> dict[int, Array]:
    """Of all boxes (4,) [u, v, w, h] px ahead of a camera, nearest first, those of `visible`."""
    seen: dict[int, Array] = {}
    for drone_id, box in boxes.items():
        inside = -0.5 <= box[0] < camera.width - 0.5 and -0.5 <= box[1] < camera.height - 0.5
        if inside and all(_covered(box, nearer) < OCCLUDED for nearer in seen.values()):
            seen[drone_id] = box
    return seen


def _covered(box: Array, nearer: Array) -> float:
    """The share of `box` inside `nearer`; both (4,) [u, v, w, h]."""
    low = np.maximum(box[:2] - box[2:] / 2.0, nearer[:2] - nearer[2:] / 2.0)
    high = np.minimum(box[:2] + box[2:] / 2.0, nearer[:2] + nearer[2:] / 2.0)
    return float(np.prod(np.maximum(high - low, 0.0)) / np.prod(box[2:]))


@dataclass(frozen=True, slots=True)
class DetectorParameters:
    """A detector as the tracking literature has it: misses, Gaussian errors, Poisson clutter."""

    p_detection: float = 0.95
    centre_sigma: float = 1.0  # px
    size_sigma: float = 0.05  # relative
    clutter_per_frame: float = 0.1


def detect(
    boxes: Mapping[int, Array],
    camera: PinholeCamera,
    parameters: DetectorParameters,
    rng: np.random.Generator,
    *,
    t: float,
    sequence: int,
) -> Detections:
    """What such a detector finds in the frame exposed at t, of which `boxes` are true. The order tells nothing."""
    p = parameters
    truth = np.array(list(boxes.values()), dtype=float).reshape(-1, 4)
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
