"""A camera's lens, as a part of other messages."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from msgspec import Meta

from swarmtrack.geometry.camera import Equidistant, PinholeCamera, RadTan
from swarmtrack.wire.checks import DecodeError
from swarmtrack.wire.fields import Pixels, Quantity, Record, Side

LEAST_FOCAL = 1e-3
"""px: as with other bounds, so that no arithmetic overflows."""


class LensMessage(Record, frozen=True):
    """Calibrated lens, in pixels of the calibrated image; coefficients: of the distortion, empty without one."""

    what: ClassVar[str] = "lens"
    width: Side
    height: Side
    fx: Pixels
    fy: Pixels
    cx: Pixels
    cy: Pixels
    distortion: Literal["radtan", "equidistant"] | None
    coefficients: Annotated[tuple[Quantity, ...], Meta(max_length=8)]


def lens_message(camera: PinholeCamera) -> LensMessage:
    """The message of a camera's lens."""
    c, distortion = camera, camera.distortion
    name: Literal["radtan", "equidistant"] | None = None
    coefficients: tuple[float, ...] = ()
    if distortion is not None:
        name = "radtan" if isinstance(distortion, RadTan) else "equidistant"
        coefficients = tuple(map(float, distortion.coefficients))
    return LensMessage(c.width, c.height, c.fx, c.fy, c.cx, c.cy, name, coefficients)


def camera_from(message: LensMessage) -> PinholeCamera:
    """Camera model from a lens message. Raises DecodeError for an impossible lens."""
    m = message
    kinds: dict[str, type[RadTan] | type[Equidistant]] = {"radtan": RadTan, "equidistant": Equidistant}
    try:
        distortion = None if m.distortion is None else kinds[m.distortion](m.coefficients)
        return PinholeCamera(m.fx, m.fy, m.cx, m.cy, m.width, m.height, distortion)
    except ValueError as error:
        raise DecodeError(f"lens: {error}") from None


def check_lens(where: str, message: LensMessage) -> None:
    """Raise DecodeError for an impossible lens."""
    if min(message.fx, message.fy) < LEAST_FOCAL:
        raise DecodeError(
            f"{where}: lens: focal lengths are {message.fx:g} and {message.fy:g}, expected {LEAST_FOCAL:g} or more"
        )
    camera_from(message)
