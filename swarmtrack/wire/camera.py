"""`camera/<id>`: what whoever reads `tracks/<id>` must know to make directions of pixels."""

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
    """One more camera of the same drone: fields as in `CameraMessage`."""

    what: ClassVar[str] = "camera"
    lens: LensMessage
    position_m: Position
    quaternion_wxyz: Quaternion


class CameraMessage(Record, frozen=True, forbid_unknown_fields=False):
    """`camera/<id>`: a drone's lens and how it is mounted, the same for the whole life of a process (`boot`).

    position_m, quaternion_wxyz: body (FRD) from camera (x right, y down, z forward). others: its second camera, its
    third and so on; of a drone with one this field is not on the wire (`shortened`). Like a health message it may grow
    at its end.
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
    """Ours as it goes on the wire: of each camera its lens, and body_from_camera."""
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
    """The bytes of a message without the field at its end where that is empty."""
    assert data[0] == _ARRAY | _FIELDS, "as encode makes it"
    if message.others:
        return data
    assert data[-1] == _EMPTY, "as encode makes it"
    return bytes([_ARRAY | (_FIELDS - 1)]) + data[1:-1]


def check(message: CameraMessage) -> None:
    """Raises DecodeError."""
    cameras: tuple[CameraMessage | OtherCamera, ...] = (message, *message.others)
    for one in cameras:
        check_lens("camera", one.lens)
        check_unit("camera: quaternion_wxyz", one.quaternion_wxyz, "a unit quaternion")


def mounting_from(message: CameraMessage | OtherCamera) -> Pose:
    """body_from_camera: body FRD, camera x right, y down, z forward [m]."""
    return Pose(from_quaternion(message.quaternion_wxyz), np.array(message.position_m))
