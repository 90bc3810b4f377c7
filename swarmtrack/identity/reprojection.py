"""A drone's camera at the time of a scan, and the rays on which it sees its teammates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Array, Track
from swarmtrack.motion.ego import TeamPose

# s over which a track's velocity becomes a turn of its ray.
AHEAD_S = 0.1
# m: no teammate is closer, so the way between two cameras turns no bearing by more than one at it.
NEAREST_M = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class LastSeen:
    """An identified drone that went out of sight at t.

    direction (3,): unit vector from the observer's camera, team frame; rate (3,) rad/s: its derivative; sigma [rad];
    origin (3,) m: where the camera was.
    """

    drone_id: int
    t: float
    direction: Array
    rate: Array
    sigma: float
    origin: Array


@dataclass(frozen=True, slots=True)
class ObserverCamera:
    """An observer's camera at the time of a scan."""

    observer: TeamPose
    camera: PinholeCamera
    team_from_camera: Pose
    number: int = 0
    """Which of the observer's cameras it is."""

    @classmethod
    def of(
        cls, observer: TeamPose, camera: PinholeCamera, body_from_camera: Pose, number: int = 0
    ) -> ObserverCamera:
        pose = Pose(observer.world_from_body, observer.position) @ body_from_camera
        return cls(observer, camera, pose, number)

    def rays(self, pixel: Array) -> Array:
        """Unit vectors (n, 3) in the team frame of undistorted pixels (n, 2)."""
        ray = self.camera.bearing_undistorted(pixel)
        return np.asarray(ray @ self.team_from_camera.rotation.T)


def rays_to(named: Sequence[tuple[int, Track]], view: ObserverCamera) -> list[LastSeen]:
    """The rays to tracks, each with the ID of the drone that it is, and how these rays turn."""
    if not named:
        return []
    mean = np.array([track.mean for _, track in named])
    soon = mean[:, ::2] + AHEAD_S * mean[:, 1::2]
    here, there = np.split(view.rays(np.concatenate([mean[:, ::2], soon])), 2)
    focal = view.camera.per_radian(mean[:, ::2])[..., 0]
    sigma = np.sqrt([np.trace(track.cov[::2, ::2]) / 2.0 for _, track in named]) / focal
    origin = view.team_from_camera.position
    return [
        LastSeen(drone, track.t, here[i], (there[i] - here[i]) / AHEAD_S, float(sigma[i]), origin)
        for i, (drone, track) in enumerate(named)
    ]


def seen_from(ray: LastSeen, place: Array, view: ObserverCamera) -> LastSeen:
    """What another camera of the observer saw a moment ago, as if this one saw it now: less surely by as far as it has
    gone on since. place (3,) m: where the drone says it is, which tells its distance well enough for the way between
    two cameras."""
    t, origin = view.observer.t, view.team_from_camera.position
    on = (t - ray.t) * ray.rate
    direction = ray.direction + on
    distance = max(float(np.linalg.norm(place - ray.origin)), NEAREST_M)
    apart = ray.origin - origin
    towards = distance * direction / np.linalg.norm(direction) + apart
    beside = float(np.linalg.norm(apart)) / distance
    return LastSeen(
        ray.drone_id,
        t,
        towards / np.linalg.norm(towards),
        ray.rate,
        math.hypot(ray.sigma, 0.5 * beside, float(np.linalg.norm(on))),
        origin,
    )
