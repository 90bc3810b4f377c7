"""Where GPS says this drone is, in the team frame.

GLOBAL_POSITION_INT is the position of the autopilot's estimator in degrees, so each message stands for itself.
LOCAL_POSITION_NED is finer (it has no grid of 11 mm), but counts from an origin that another message tells, that PX4
moves when its estimator restarts and ArduPilot sets at some moment after the first fix: the grid is negligible against
GPS's own errors, a mistaken origin shifts the whole frame.

Whether to believe it is told by GPS_RAW_INT: both autopilots go on sending positions without a fix, ArduPilot at
0° N 0° E. Its `h_acc` and `v_acc` are the receiver's own standard deviations, of which the second is often twice the
first. Much of that error is the same for all
drones of one field and cancels between them, so the user may state a smaller one.

Attitude and velocity stay with the drone's own north, which 10 km from the origin, at 45° N, is 0.1° from the team's.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.limits import (
    GPS_FARTHEST_FROM_ORIGIN_M,
    GPS_FIX_AGE_S,
    GPS_USUAL_SIGMA_M,
    GPS_WORST_SIGMA_M,
)
from swarmtrack.geometry.geodesy import Geodetic, to_ned
from swarmtrack.messages import Array

FIX_3D: int = common.GPS_FIX_TYPE_3D_FIX
UNKNOWN_SATELLITES = 255  # satellites


class GlobalPosition:
    """Position in the team frame from GPS_RAW_INT and GLOBAL_POSITION_INT.

    origin: of the team frame, height above mean sea level; stated_sigma: m per axis, overrides the receiver's. `sigma`
    [m] is that of north and of east, `vertical_sigma` [m] of down.
    """

    def __init__(self, origin: Geodetic, stated_sigma: float | None = None) -> None:
        self.sigma = self.vertical_sigma = stated_sigma or GPS_USUAL_SIGMA_M
        self._origin = origin
        self._stated_sigma = stated_sigma
        self._fix_at = self._told_at = -math.inf
        self._fix_lack = self._place_lack = ""

    def lack(self, now: float) -> str:
        """Why there is no position, in a few words; empty while there is one."""
        if now - self._fix_at > GPS_FIX_AGE_S:
            return "no GPS_RAW_INT comes"
        if self._fix_lack:
            return self._fix_lack
        return "no GLOBAL_POSITION_INT comes" if now - self._told_at > GPS_FIX_AGE_S else self._place_lack

    def on_fix(self, t: float, m: Any) -> None:
        """GPS_RAW_INT has come at t [s]."""
        # 0: not told, by an old firmware.
        told = 1e-3 * m.h_acc, 1e-3 * m.v_acc
        self._fix_at = t
        self._fix_lack = ""
        if m.fix_type < FIX_3D:
            seen = (
                ""
                if m.satellites_visible == UNKNOWN_SATELLITES
                else f" with {m.satellites_visible} satellites"
            )
            self._fix_lack = f"GPS fix {m.fix_type}{seen}, expected a 3D fix (3 or more)"
        elif max(told) > GPS_WORST_SIGMA_M:
            self._fix_lack = f"GPS ±{max(told):.1f} m, expected ±{GPS_WORST_SIGMA_M:g} m or better"
        else:
            horizontal, vertical = told
            self.sigma = self._stated_sigma or horizontal or vertical or GPS_USUAL_SIGMA_M
            self.vertical_sigma = self._stated_sigma or vertical or horizontal or GPS_USUAL_SIGMA_M

    def place(self, t: float, m: Any) -> tuple[Array, Array] | None:
        """Position (3,) m and velocity (3,) m/s, north, east, down, from the GLOBAL_POSITION_INT that came at t; or
        None.
        """
        place = Geodetic.from_degrees(1e-7 * m.lat, 1e-7 * m.lon, 1e-3 * m.alt)
        position = to_ned(place, self._origin)
        away = float(np.linalg.norm(position))
        self._told_at = t
        self._place_lack = ""
        if m.lat == m.lon == 0:
            self._place_lack = "the estimator has no position yet (0° N 0° E)"
        elif away > GPS_FARTHEST_FROM_ORIGIN_M:
            expected = f"expected at most {GPS_FARTHEST_FROM_ORIGIN_M * 1e-3:.0f} km"
            self._place_lack = f"{away * 1e-3:.0f} km from the team's origin, {expected}"
        return None if self.lack(t) else (position, 1e-2 * np.array((m.vx, m.vy, m.vz)))
