"""`camera/<id>`: what whoever reads `tracks/<id>` must know to make directions of pixels."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import from_quaternion, to_quaternion
from swarmtrack.wire.checks import check_unit
from swarmtrack.wire.fields import VERSION, Boot, DroneId, Position, Quaternion, Record
from swarmtrack.wire.lens import LensMessage, camera_from, check_lens, lens_message


class CameraMessage(Record, frozen=True, forbid_unknown_fields=False):
    """`camera/<id>`: a drone's lens and how it is mounted, the same for the whole life of a process (`boot`).

    position_m, quaternion_wxyz: body (FRD) from camera (x right, y down, z forward). Like a health message it may grow
    at its end.
    """

    what: ClassVar[str] = "camera"
    version: Literal[1]
    drone_id: DroneId
    boot: Boot
    lens: LensMessage
    position_m: Position
    quaternion_wxyz: Quaternion


def camera_message(drone_id: int, boot: str, camera: PinholeCamera, body_from_camera: Pose) -> CameraMessage:
    """Ours as it goes on the wire."""
    return CameraMessage(
        VERSION,
        drone_id,
        boot,
        lens_message(camera),
        position_m=tuple(body_from_camera.position.tolist()),
        quaternion_wxyz=tuple(to_quaternion(body_from_camera.rotation).tolist()),
    )


def check(message: CameraMessage) -> None:
    """Raises DecodeError."""
    check_lens("camera", message.lens)
    camera_from(message.lens)
    check_unit("camera: quaternion_wxyz", message.quaternion_wxyz, "a unit quaternion")


def mounting_from(message: CameraMessage) -> Pose:
    """body_from_camera: body FRD, camera x right, y down, z forward [m]."""
    return Pose(from_quaternion(message.quaternion_wxyz), np.array(message.position_m))
