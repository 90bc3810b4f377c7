"""Where the announced drones should appear in this drone's image."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Announcement, Array
from swarmtrack.motion.ego import TeamPose
from swarmtrack.tracking.motion_model import optical_flow


class Reprojections(NamedTuple):
    """Announced drones that lie before the camera: drone_id (k,), pixel (k, 2) undistorted.

    A drone is still where it announced itself, with probability p_still (k,) and covariance cov_still (k, 2, 2) px², or
    has flown off since, with covariance cov_flown (k, 2, 2) px².
    """

    drone_id: list[int]
    pixel: Array
    p_still: Array
    cov_still: Array
    cov_flown: Array


def reproject(
    announcements: Sequence[Announcement],
    observer: TeamPose,
    *,
    camera: PinholeCamera,
    body_from_camera: Pose,
    drift_speed: float,
    stay_s: float,
) -> Reprojections:
    """Project announced positions into the observer's image at observer.t.

    The covariance is that of the announced position, of the observer's own and of its attitude; for a drone that has
    flown off also of how far it may be, drift_speed [m/s] times the age of the pose. One that waits on its pad is as
    sure after a minute as at once, so age alone must not blur it: after stay_s [s] half of them are still there.
    """
    camera_from_team = (Pose(observer.world_from_body, observer.position) @ body_from_camera).inverse()
    positions = np.array([a.position for a in announcements]).reshape(-1, 3)
    pixel, jacobian, valid = camera.project_undistorted(camera_from_team.transform(positions))
    by_team = jacobian @ camera_from_team.rotation
    age = np.array([abs(observer.t - a.t) + a.t_sigma for a in announcements])
    spread = np.array([a.position_cov for a in announcements]).reshape(-1, 3, 3)
    spread = spread + observer.position_sigma**2 * np.eye(3)
    flow = optical_flow(pixel, camera)
    cov_still = by_team @ spread @ by_team.swapaxes(1, 2)
    cov_still += observer.attitude_sigma**2 * flow @ flow.swapaxes(1, 2)
    flown = ((drift_speed * age) ** 2)[:, None, None] * by_team @ by_team.swapaxes(1, 2)
    ids = [a.drone_id for a, before in zip(announcements, valid, strict=True) if before]
    p_still = stay_s / (stay_s + age)
    return Reprojections(ids, pixel[valid], p_still[valid], cov_still[valid], (cov_still + flown)[valid])
