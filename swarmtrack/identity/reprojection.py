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
    """Announced drones that lie before the camera: drone_id (k,), pixel (k, 2) undistorted, cov (k, 2, 2) px²."""

    drone_id: list[int]
    pixel: Array
    cov: Array


def reproject(
    announcements: Sequence[Announcement],
    observer: TeamPose,
    *,
    camera: PinholeCamera,
    body_from_camera: Pose,
    drift_speed: float,
) -> Reprojections:
    """Project announced positions into the observer's image at observer.t.

    The covariance is that of the announced position, of the observer's own, of its attitude, and of how far the drone
    may have gone since: drift_speed [m/s] times the age of the pose.
    """
    camera_from_team = (Pose(observer.world_from_body, observer.position) @ body_from_camera).inverse()
    positions = np.array([a.position for a in announcements]).reshape(-1, 3)
    pixel, jacobian, valid = camera.project_undistorted(camera_from_team.transform(positions))
    by_team = jacobian @ camera_from_team.rotation
    age = np.array([abs(observer.t - a.t) + a.t_sigma for a in announcements])
    isotropic = (drift_speed * age) ** 2 + observer.position_sigma**2
    spread = np.array([a.position_cov for a in announcements]).reshape(-1, 3, 3)
    spread = spread + isotropic[:, None, None] * np.eye(3)
    flow = optical_flow(pixel, camera)
    cov = by_team @ spread @ by_team.swapaxes(1, 2)
    cov += observer.attitude_sigma**2 * flow @ flow.swapaxes(1, 2)
    ids = [a.drone_id for a, before in zip(announcements, valid, strict=True) if before]
    return Reprojections(ids, pixel[valid], cov[valid])
