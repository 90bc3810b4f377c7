"""Remote ID of other aircraft, as a receiver on the autopilot's link passes it on (OPEN_DRONE_ID_*), in the team frame.

A receiver sends what it hears with the sender's address in `id_or_mac`; what this aircraft broadcasts of itself has
none, and is ignored. Heights above the ground where the other took off are the only ones that fit a team's: Remote ID's
geodetic altitude is above the ellipsoid, tens of metres from the sea level of autopilots.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.limits import (
    REMOTE_ID_CLIMB_UNKNOWN_CM_S,
    REMOTE_ID_COURSE_UNKNOWN_CDEG,
    REMOTE_ID_ELLIPSOID_SIGMA_M,
    REMOTE_ID_GROUND_SIGMA_M,
    REMOTE_ID_NO_ALTITUDE_M,
    REMOTE_ID_SPEED_UNKNOWN_CM_S,
    REMOTE_IDS_KEPT,
)
from swarmtrack.geometry.geodesy import Geodetic, to_ned
from swarmtrack.messages import RemoteIdClaim
from swarmtrack.plain_text import plain

BASIC_ID = common.MAVLINK_MSG_ID_OPEN_DRONE_ID_BASIC_ID
LOCATION = common.MAVLINK_MSG_ID_OPEN_DRONE_ID_LOCATION
ACCURACIES_M = (
    math.inf,
    18_520.0,
    7_408.0,
    3_704.0,
    1_852.0,
    926.0,
    555.6,
    185.2,
    92.6,
    30.0,
    10.0,
    3.0,
    1.0,
)
"""By MAV_ODID_HOR_ACC: 95 % of positions are within it (ASTM F3411)."""


class RemoteIdReader:
    """Takes messages, and hands claims to `told`. origin: of the team frame."""

    def __init__(self, origin: Geodetic, told: Callable[[RemoteIdClaim], None]) -> None:
        self.unusable = 0
        """How many positions were none, or none on the Earth."""
        self._origin = origin
        self._told = told
        self._names: dict[bytes, str] = {}

    @property
    def readers(self) -> dict[int, Callable[[float, Any], None]]:
        """By message."""
        return {BASIC_ID: self._on_basic_id, LOCATION: self._on_location}

    def _on_basic_id(self, t: float, m: Any) -> None:
        address = bytes(m.id_or_mac)
        if any(address) and (address in self._names or len(self._names) < REMOTE_IDS_KEPT):
            self._names[address] = plain(bytes(m.uas_id).rstrip(b"\0").decode("ascii", "replace"))

    def _on_location(self, t: float, m: Any) -> None:
        address = bytes(m.id_or_mac)
        if not any(address):
            return
        latitude, longitude = 1e-7 * m.latitude, 1e-7 * m.longitude
        accuracy = (
            ACCURACIES_M[m.horizontal_accuracy] if m.horizontal_accuracy < len(ACCURACIES_M) else math.inf
        )
        above = _above_origin(m, self._origin)
        known = (m.latitude or m.longitude) and abs(latitude) <= 90.0 and abs(longitude) <= 180.0
        if not known or not math.isfinite(accuracy) or above is None:
            self.unusable += 1
            return
        height, vertical_sigma = above
        place = Geodetic.from_degrees(latitude, longitude, self._origin.height + height)
        self._told(
            RemoteIdClaim(
                t,
                self._names.get(address) or address.rstrip(b"\0").hex(),
                to_ned(place, self._origin),
                _velocity(m),
                0.5 * accuracy,
                vertical_sigma,
            )
        )


def _above_origin(m: Any, origin: Geodetic) -> tuple[float, float] | None:
    """m above the team's origin, and one sigma of that; None where no height is stated."""
    if math.isfinite(m.height) and m.height > REMOTE_ID_NO_ALTITUDE_M:
        return float(m.height), REMOTE_ID_GROUND_SIGMA_M
    if math.isfinite(m.altitude_geodetic) and m.altitude_geodetic > REMOTE_ID_NO_ALTITUDE_M:
        return float(m.altitude_geodetic) - origin.height, REMOTE_ID_ELLIPSOID_SIGMA_M
    return None


def _velocity(m: Any) -> Any:
    """(3,) m/s north, east, down; what is not stated is zero."""
    level = 0.01 * m.speed_horizontal if m.speed_horizontal != REMOTE_ID_SPEED_UNKNOWN_CM_S else 0.0
    if m.direction >= REMOTE_ID_COURSE_UNKNOWN_CDEG:
        level = 0.0
    course = math.radians(0.01 * m.direction)
    climb = 0.01 * m.speed_vertical if m.speed_vertical != REMOTE_ID_CLIMB_UNKNOWN_CM_S else 0.0
    return np.array([level * math.cos(course), level * math.sin(course), -climb])
