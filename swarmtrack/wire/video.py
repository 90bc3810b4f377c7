"""`video/<id>`: what a drone's camera sees, for people, and the lens it sees through."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from msgspec import Meta

from swarmtrack.geometry.camera import Equidistant, PinholeCamera, RadTan
from swarmtrack.wire.checks import DecodeError, check_unit
from swarmtrack.wire.fields import (
    MAX_JPEG,
    Pixels,
    Position,
    Quantity,
    Quaternion,
    Record,
    Seconds,
    Side,
    UtcSeconds,
)


class LensMessage(Record, frozen=True):
    """A calibrated lens, in pixels of the calibrated image; coefficients: of the distortion, empty without one."""

    what: ClassVar[str] = "lens"
    width: Side
    height: Side
    fx: Pixels
    fy: Pixels
    cx: Pixels
    cy: Pixels
    distortion: Literal["radtan", "equidistant"] | None
    coefficients: Annotated[tuple[Quantity, ...], Meta(max_length=8)]


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


def lens_message(camera: PinholeCamera) -> LensMessage:
    """A lens as it goes on the wire."""
    c, distortion = camera, camera.distortion
    name: Literal["radtan", "equidistant"] | None = None
    coefficients: tuple[float, ...] = ()
    if distortion is not None:
        name = "radtan" if isinstance(distortion, RadTan) else "equidistant"
        coefficients = tuple(map(float, distortion.coefficients))
    return LensMessage(c.width, c.height, c.fx, c.fy, c.cx, c.cy, name, coefficients)


def camera_from(message: LensMessage) -> PinholeCamera:
    """The camera a message tells of. Raises DecodeError where there is no such lens."""
    m = message
    kinds: dict[str, type[RadTan] | type[Equidistant]] = {"radtan": RadTan, "equidistant": Equidistant}
    try:
        distortion = None if m.distortion is None else kinds[m.distortion](m.coefficients)
        return PinholeCamera(m.fx, m.fy, m.cx, m.cy, m.width, m.height, distortion)
    except ValueError as error:
        raise DecodeError(f"video: lens: {error}") from None


def check(message: VideoMessage) -> None:
    """Raises DecodeError."""
    m = message
    if m.quaternion_wxyz is not None:
        check_unit("video: quaternion_wxyz", m.quaternion_wxyz, "a unit quaternion")
    if not (m.lens.fx > 0.0 and m.lens.fy > 0.0):
        raise DecodeError(f"video: lens: focal lengths are {m.lens.fx:g} and {m.lens.fy:g}, expected above 0")
