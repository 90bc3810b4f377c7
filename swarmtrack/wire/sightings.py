"""`identities/<id>`, the sightings: teammates in view of a drone, and the ray to each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, ClassVar, Final

import numpy as np
from msgspec import Meta

from swarmtrack.messages import Sighting, SightingReport
from swarmtrack.wire.checks import DecodeError, check_unit
from swarmtrack.wire.fields import (
    MAX_KNOWN,
    MAX_SIGHTINGS,
    Direction,
    DroneId,
    Length,
    PeerMessage,
    Position,
    Probability,
    Record,
    Seconds,
    peer_fields,
)

NOWHERE_SIGMA_M: Final = 1e7
"""Of a position that says nothing: the most that `Length` holds."""


class SightingMessage(Record, frozen=True):
    """Unit vector to one teammate in view from the observer's camera, in the team's NED frame."""

    what: ClassVar[str] = "sighting"
    drone_id: DroneId
    probability: Probability
    direction: Direction
    sigma_rad: Annotated[float, Meta(ge=0.0, le=math.pi)]


class SightingsMessage(PeerMessage, frozen=True):
    """`identities/<id>`: teammates in view of one drone and its camera's position at the exposure, `age_s` before
    sending.

    sequence counts what this boot published; known: drones whose announcements the observer has; leans_on: those on
    whom the position rests, where teammates carry the observer; confirmed: those in view whose names motion alone gives
    as well. Of these two the last ones that are empty are not on the wire.
    """

    what: ClassVar[str] = "sightings"
    age_s: Seconds
    position_m: Position
    position_sigma_m: Length
    known: Annotated[tuple[DroneId, ...], Meta(max_length=MAX_KNOWN)]
    sightings: Annotated[tuple[SightingMessage, ...], Meta(max_length=MAX_SIGHTINGS)]
    leans_on: Annotated[tuple[DroneId, ...], Meta(max_length=MAX_KNOWN)] = ()
    confirmed: Annotated[tuple[DroneId, ...], Meta(max_length=MAX_SIGHTINGS)] = ()


def sightings_message(report: SightingReport, utc_offset: float, now: float) -> SightingsMessage:
    """The own sightings as sent at `now`."""
    r = report
    return SightingsMessage(
        *peer_fields(r.observer, r, utc_offset),
        age_s=max(0.0, float(now - r.t)),
        position_m=tuple(r.position.tolist()),
        position_sigma_m=float(r.position_sigma),
        known=r.known,
        sightings=tuple(
            SightingMessage(s.drone_id, float(s.probability), tuple(s.direction.tolist()), float(s.sigma))
            for s in r.sightings
        ),
        leans_on=r.leans_on,
        confirmed=tuple(s.drone_id for s in r.sightings if s.is_confirmed),
    )


def report_from_nowhere(drone_id: int, boot: str, sequence: int, now: float) -> SightingReport:
    """Report of a drone that does not know where it is: a sign of life. now: on our monotonic clock [s]."""
    return SightingReport(drone_id, boot, sequence, now, 0.0, np.zeros(3), NOWHERE_SIGMA_M, (), ())


def is_from_nowhere(message: SightingsMessage) -> bool:
    """Whether the sender does not know where it is: it only reports that it lives."""
    return message.position_sigma_m >= NOWHERE_SIGMA_M and not message.sightings


def check(message: SightingsMessage) -> None:
    """Raise DecodeError for an invalid message."""
    for sighting in message.sightings:
        check_unit("sightings: direction", sighting.direction, "a unit vector")
    seen = [sighting.drone_id for sighting in message.sightings]
    for name in ("known", "leans_on", "confirmed"):
        _check_once(name, getattr(message, name))
    _check_once("sightings", seen)
    unseen = set(message.confirmed).difference(seen)
    if unseen:
        raise DecodeError(f"sightings: confirmed: has drone {min(unseen)}, expected only drones in sightings")


def _check_once(name: str, ids: Sequence[int]) -> None:
    if len(set(ids)) < len(ids):
        raise DecodeError(f"sightings: {name}: names a drone twice, expected each once")


def report_from(message: SightingsMessage, t: float, t_sigma: float) -> SightingReport:
    """A teammate's sightings as the core takes them. t: the exposure, on our monotonic clock."""
    m = message
    return SightingReport(
        observer=m.drone_id,
        boot=m.boot,
        sequence=m.sequence,
        t=t,
        t_sigma=t_sigma,
        position=np.array(m.position_m),
        position_sigma=m.position_sigma_m,
        known=m.known,
        sightings=tuple(
            Sighting(s.drone_id, s.probability, np.array(s.direction), s.sigma_rad, s.drone_id in m.confirmed)
            for s in m.sightings
        ),
        leans_on=m.leans_on,
    )
