"""`stranger/<id>`: strangers in view of a drone, the ray to each, and where it finds them."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Final

import numpy as np
from msgspec import Meta

from swarmtrack.messages import LocatedStranger, StrangerRay, StrangerReport
from swarmtrack.wire.checks import DecodeError, check_covariances, check_unit, symmetric, upper_triangle
from swarmtrack.wire.fields import (
    Direction,
    DroneId,
    Length,
    Moment,
    Name,
    PeerMessage,
    Position,
    Record,
    Seconds,
    Velocity,
    peer_fields,
)

MAX_STRANGERS: Final = 16
StrangerNumber = Annotated[int, Meta(ge=1, le=2**31 - 1)]
Angle = Annotated[float, Meta(ge=0.0, le=math.pi)]
"""rad."""


class StrangerRayMessage(Record, frozen=True):
    """Unit vector to one stranger in view from the observer's camera, in the team's NED frame. sigma_rad: of what
    changes from scan to scan; width_rad: of what its box is around, 0 where it does not tell.
    """

    what: ClassVar[str] = "stranger's ray"
    number: StrangerNumber
    direction: Direction
    sigma_rad: Angle
    width_rad: Angle


class StrangerPlaceMessage(Record, frozen=True):
    """Where the observer finds one stranger at the exposure, by the rays of all; for readers, it is no evidence."""

    what: ClassVar[str] = "stranger's place"
    number: StrangerNumber
    position_m: Position
    velocity_m_s: Velocity
    cov: Annotated[tuple[Moment, ...], Meta(min_length=21, max_length=21)]
    observers: Annotated[tuple[DroneId, ...], Meta(max_length=MAX_STRANGERS)]
    remote_id: Name


class StrangersMessage(PeerMessage, frozen=True):
    """`stranger/<id>`: strangers in view of one drone and its camera's position at the exposure, `age_s` before
    sending. The sigmas are of what lasts of its errors, per axis.
    """

    what: ClassVar[str] = "strangers"
    age_s: Seconds
    position_m: Position
    position_sigma_m: Length
    tilt_sigma_rad: Angle
    heading_sigma_rad: Angle
    rays: Annotated[tuple[StrangerRayMessage, ...], Meta(max_length=MAX_STRANGERS)]
    located: Annotated[tuple[StrangerPlaceMessage, ...], Meta(max_length=MAX_STRANGERS)]


def strangers_message(report: StrangerReport, utc_offset: float, now: float) -> StrangersMessage:
    """The own report as sent at `now`."""
    r = report
    return StrangersMessage(
        *peer_fields(r.observer, r, utc_offset),
        age_s=max(0.0, float(now - r.t)),
        position_m=tuple(r.position.tolist()),
        position_sigma_m=float(r.position_sigma),
        tilt_sigma_rad=float(r.tilt_sigma),
        heading_sigma_rad=float(r.heading_sigma),
        rays=tuple(
            StrangerRayMessage(s.number, tuple(s.direction.tolist()), float(s.sigma), float(s.width))
            for s in r.rays
        ),
        located=tuple(map(_place, r.located)),
    )


def _place(one: LocatedStranger) -> StrangerPlaceMessage:
    return StrangerPlaceMessage(
        one.number,
        tuple(one.position.tolist()),
        tuple(one.velocity.tolist()),
        upper_triangle(one.cov),
        one.observers,
        one.remote_id,
    )


def check(message: StrangersMessage) -> None:
    """Raise DecodeError for an invalid message."""
    for ray in message.rays:
        check_unit("strangers: direction", ray.direction, "a unit vector")
    for name, records in (("rays", message.rays), ("located", message.located)):
        if len({record.number for record in records}) < len(records):
            raise DecodeError(f"strangers: {name}: names a stranger twice, expected each once")
    if message.located:
        check_covariances("strangers: cov", [place.cov for place in message.located], 6)


def located_in(message: StrangersMessage, t: float) -> tuple[LocatedStranger, ...]:
    """Where the observer finds strangers. t: the exposure, on our monotonic clock."""
    return tuple(
        LocatedStranger(
            place.number,
            t,
            np.array(place.position_m),
            np.array(place.velocity_m_s),
            symmetric(np.array([place.cov]), 6)[0],
            place.observers,
            place.remote_id,
        )
        for place in message.located
    )


def strangers_from(message: StrangersMessage, t: float, t_sigma: float) -> StrangerReport:
    """A teammate's report as the core takes it, without its estimates. t: the exposure, on our monotonic clock."""
    m = message
    return StrangerReport(
        observer=m.drone_id,
        boot=m.boot,
        sequence=m.sequence,
        t=t,
        t_sigma=t_sigma,
        position=np.array(m.position_m),
        position_sigma=m.position_sigma_m,
        tilt_sigma=m.tilt_sigma_rad,
        heading_sigma=m.heading_sigma_rad,
        rays=tuple(StrangerRay(s.number, np.array(s.direction), s.sigma_rad, s.width_rad) for s in m.rays),
    )
