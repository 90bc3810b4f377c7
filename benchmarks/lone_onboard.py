"""The `Onboard` of a drone with one camera and nobody to talk to."""

from __future__ import annotations

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import BODY_FROM_FORWARD_CAMERA
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.motion.ego import EgoHistory
from swarmtrack.motion.gyro import GyroHistory
from swarmtrack.motion.mounting import Mounting
from swarmtrack.onboard import Onboard, OnboardCamera
from swarmtrack.relative.parameters import RelativeParameters
from swarmtrack.tracking.base import Tracker

LOOKS_AHEAD = Pose(BODY_FROM_FORWARD_CAMERA, np.zeros(3))


def lone_onboard(
    camera: PinholeCamera,
    tracker: Tracker,
    body_from_camera: Pose = LOOKS_AHEAD,
    *,
    drone_id: int = 1,
    ego: EgoHistory | None = None,
    relative: RelativeParameters | None = None,
) -> Onboard:
    """With an agent's parameters where nothing else is said."""
    return Onboard(
        drone_id,
        cameras=[OnboardCamera(camera, Mounting(body_from_camera), tracker)],
        gyro=GyroHistory(),
        ego=ego or EgoHistory(),
        identity=IdentityParameters(),
        relative=relative,
    )
