"""`video/<id>`: images of a drone's camera, for people."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from msgspec import Meta

from swarmtrack.wire.checks import check_unit
from swarmtrack.wire.fields import (
    MAX_JPEG,
    Position,
    Quaternion,
    Record,
    Seconds,
    Side,
    UtcSeconds,
)
from swarmtrack.wire.lens import LensMessage, check_lens


class VideoMessage(Record, frozen=True):
    """`video/<id>`: one frame for people, sent only while there is a subscriber.

    t_utc_s: of the exposure; frame: the camera's count. width, height: of the picture, which is the whole image of
    `lens`, reduced. jpeg is empty where the camera delivers no pictures. position_m and quaternion_wxyz: of the camera
    (x right, y down, z forward) in the team's NED frame, null while unknown.
    """

    what: ClassVar[str] = "video"
    version: Literal[1]
    t_utc_s: UtcSeconds
    t_sigma_s: Seconds
    frame: Annotated[int, Meta(ge=0, le=2**53)]
    width: Side
    height: Side
    jpeg: Annotated[bytes, Meta(max_length=MAX_JPEG)]
    lens: LensMessage
    position_m: Position | None
    quaternion_wxyz: Quaternion | None


def check(message: VideoMessage) -> None:
    """Raise DecodeError for an invalid message."""
    m = message
    if m.quaternion_wxyz is not None:
        check_unit("video: quaternion_wxyz", m.quaternion_wxyz, "a unit quaternion")
    check_lens("video", m.lens)
