"""Mounting of the camera on the drone."""

from __future__ import annotations

from dataclasses import dataclass, field

from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Array


@dataclass(slots=True)
class Mounting:
    """A camera's place on the drone, and its clock: exposure on the IMU's clock = stamp + time_offset_s.

    estimate_time_offset: find the offset in flight; `time_offset_s` is then where the search begins. sigma [rad]: how
    exactly its rotation is known, per axis; it counts where targets go over to another camera.
    """

    body_from_camera: Pose
    time_offset_s: float = 0.0
    estimate_time_offset: bool = True
    sigma: float = 0.0
    camera_from_body: Array = field(init=False)

    def __post_init__(self) -> None:
        self.camera_from_body = self.body_from_camera.rotation.T
