"""Conversion of one frame's detections to the scan that a tracker takes."""

from __future__ import annotations

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Detections, Scan
from swarmtrack.tracking.base import Tracker


def make_scan(detections: Detections, t: float, camera: PinholeCamera, tracker: Tracker) -> Scan:
    """The detections, exposed at t [s, IMU clock], in undistorted pixels; what cannot be undistorted is left out."""
    z = camera.undistort(detections.centre)
    good = np.isfinite(z).all(axis=1)
    R = detections.covariance
    if R is None and camera.distortion is not None:
        # Towards the border of a wide image one of its pixels is several undistorted ones.
        R = tracker.measurement_noise(detections.size, detections.score)
    if R is not None:
        J = camera.undistort_jacobian(detections.centre[good])
        R = J @ R[good] @ J.swapaxes(1, 2)
    likeness = None if detections.likeness is None else detections.likeness[good]
    return Scan(t, z[good], R, detections.size[good], detections.score[good], detections.coverage, likeness)
