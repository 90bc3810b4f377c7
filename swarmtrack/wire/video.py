"""`video/<id>`: what a drone's camera sees, for people."""

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
    """`video/<id>`: one frame for people, said only while somebody listens.

    t_utc_s: of the exposure; frame: as the camera counts them. width, height: of the picture, which is the whole image
    of `lens` made smaller. jpeg is empty where the camera sends no pictures. position_m and quaternion_wxyz: of the
    camera (x right, y down, z forward) in the team's NED frame, null where the drone does not know.
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
    """Raises DecodeError."""
    m = message
    if m.quaternion_wxyz is not None:
        check_unit("video: quaternion_wxyz", m.quaternion_wxyz, "a unit quaternion")
    check_lens("video", m.lens)
