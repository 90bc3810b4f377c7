"""`camera/<id>`: what a reader of `tracks/<id>` needs to turn pixels into directions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal

import numpy as np
from msgspec import Meta

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import from_quaternion, to_quaternion
from swarmtrack.messages import MOST_CAMERAS
from swarmtrack.wire.checks import check_unit
from swarmtrack.wire.fields import WIRE_VERSION, Boot, DroneId, Position, Quaternion, Record
from swarmtrack.wire.lens import LensMessage, check_lens, lens_message


class OtherCamera(Record, frozen=True):
    """A further camera of the same drone; fields as in `CameraMessage`."""

    what: ClassVar[str] = "camera"
    lens: LensMessage
    position_m: Position
    quaternion_wxyz: Quaternion


class CameraMessage(Record, frozen=True, forbid_unknown_fields=False):
    """`camera/<id>`: a drone's lens and mounting, constant for the life of a process (`boot`).

    position_m, quaternion_wxyz: body (FRD) from camera (x right, y down, z forward). others: its second camera, its
    third and so on; with one camera this field is not on the wire (`shortened`). Like a health message it may grow at
    its end.
    """

    what: ClassVar[str] = "camera"
    version: Literal[1]
    drone_id: DroneId
    boot: Boot
    lens: LensMessage
    position_m: Position
    quaternion_wxyz: Quaternion
    others: Annotated[tuple[OtherCamera, ...], Meta(max_length=MOST_CAMERAS - 1)] = ()


def camera_message(
    drone_id: int, boot: str, lenses: Sequence[PinholeCamera], mountings: Sequence[Pose]
) -> CameraMessage:
    """The own camera message: lens and body_from_camera of each camera."""
    first, *others = (
        OtherCamera(
            lens_message(lens),
            position_m=tuple(pose.position.tolist()),
            quaternion_wxyz=tuple(to_quaternion(pose.rotation).tolist()),
        )
        for lens, pose in zip(lenses, mountings, strict=True)
    )
    return CameraMessage(
        WIRE_VERSION, drone_id, boot, first.lens, first.position_m, first.quaternion_wxyz, tuple(others)
    )


# The head of a message of seven fields, without its length; and an empty array, as its last one may be.
_ARRAY, _FIELDS, _EMPTY = 0x90, 7, 0x90


def shortened(data: bytes, message: CameraMessage) -> bytes:
    """Bytes of a message without its last field where that is empty."""
    assert data[0] == _ARRAY | _FIELDS, "as encode makes it"
    if message.others:
        return data
    assert data[-1] == _EMPTY, "as encode makes it"
    return bytes([_ARRAY | (_FIELDS - 1)]) + data[1:-1]


def check(message: CameraMessage) -> None:
    """Raise DecodeError for an invalid message."""
    cameras: tuple[CameraMessage | OtherCamera, ...] = (message, *message.others)
    for one in cameras:
        check_lens("camera", one.lens)
        check_unit("camera: quaternion_wxyz", one.quaternion_wxyz, "a unit quaternion")


def mounting_from(message: CameraMessage | OtherCamera) -> Pose:
    """body_from_camera: body FRD, camera x right, y down, z forward [m]."""
    return Pose(from_quaternion(message.quaternion_wxyz), np.array(message.position_m))
