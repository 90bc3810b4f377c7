"""Where GPS says this drone is, in the team frame.

GLOBAL_POSITION_INT is the position of the autopilot's estimator in degrees, so each message stands for itself.
LOCAL_POSITION_NED is finer (it has no grid of 11 mm), but counts from an origin that another message tells, that PX4
moves when its estimator restarts and ArduPilot sets at some moment after the first fix: the grid is negligible against
GPS's own errors, a mistaken origin shifts the whole frame.

Whether to believe it is told by GPS_RAW_INT, and by GPS2_RAW of a second receiver: the better one counts. Both
autopilots go on sending positions without a fix, ArduPilot at 0° N 0° E. `h_acc` and `v_acc` are the receiver's own
standard deviations, of which the second is often twice the first. Much of that error is the same for all drones of one
field and cancels between them, so the user may state a smaller one.

Attitude and velocity stay with the drone's own north, which 10 km from the origin, at 45° N, is 0.1° from the team's.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

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
FIX_NEEDED = "GPS_RAW_INT or GPS2_RAW is needed (ArduPilot SRn_EXT_STAT)"


class _Fix(NamedTuple):
    """Of one receiver at t [s]. lack: why it is not to be believed; sigma [m]: north and east; vertical_sigma [m]."""

    t: float
    lack: str
    sigma: float
    vertical_sigma: float


class GlobalPosition:
    """Position in the team frame from GPS_RAW_INT, GPS2_RAW and GLOBAL_POSITION_INT.

    origin: of the team frame, height above mean sea level; stated_sigma: m per axis, overrides the receiver's. `sigma`
    [m] is that of north and of east, `vertical_sigma` [m] of down.
    """

    def __init__(self, origin: Geodetic, stated_sigma: float | None = None) -> None:
        self.sigma = self.vertical_sigma = stated_sigma or GPS_USUAL_SIGMA_M
        self._origin = origin
        self._stated_sigma = stated_sigma
        self._fixes: dict[int, _Fix] = {}
        """By the number of the receiver."""
        self._told_at = -math.inf
        self._place_lack = ""

    def lack(self, now: float) -> str:
        """Why there is no position, in a few words; empty while there is one."""
        heard = [fix for _, fix in sorted(self._fixes.items()) if now - fix.t <= GPS_FIX_AGE_S]
        if not heard:
            return f"no GPS_RAW_INT comes, so the fix is unknown: {FIX_NEEDED}"
        # Of the first receiver, where none is good.
        if all(fix.lack for fix in heard):
            return heard[0].lack
        return "no GLOBAL_POSITION_INT comes" if now - self._told_at > GPS_FIX_AGE_S else self._place_lack

    def on_fix(self, t: float, m: Any) -> None:
        """GPS_RAW_INT has come at t [s]."""
        self._take(1, t, m)

    def on_second_fix(self, t: float, m: Any) -> None:
        """GPS2_RAW has come at t [s]."""
        self._take(2, t, m)

    def _take(self, receiver: int, t: float, m: Any) -> None:
        # 0: not told, by an old firmware.
        horizontal, vertical = 1e-3 * m.h_acc, 1e-3 * m.v_acc
        lack = ""
        if m.fix_type < FIX_3D:
            seen = (
                ""
                if m.satellites_visible == UNKNOWN_SATELLITES
                else f" with {m.satellites_visible} satellites"
            )
            lack = f"GPS fix {m.fix_type}{seen}, expected a 3D fix (3 or more)"
        elif max(horizontal, vertical) > GPS_WORST_SIGMA_M:
            lack = f"GPS ±{max(horizontal, vertical):.1f} m, expected ±{GPS_WORST_SIGMA_M:g} m or better"
        told = horizontal or vertical or GPS_USUAL_SIGMA_M, vertical or horizontal or GPS_USUAL_SIGMA_M
        self._fixes[receiver] = _Fix(t, lack, *told)
        good = [fix for _, fix in sorted(self._fixes.items()) if not fix.lack and t - fix.t <= GPS_FIX_AGE_S]
        if good and self._stated_sigma is None:
            best = min(good, key=lambda fix: fix.sigma)
            self.sigma, self.vertical_sigma = best.sigma, best.vertical_sigma

    def place(self, t: float, m: Any) -> tuple[Array, Array] | None:
        """Position (3,) m and velocity (3,) m/s, north, east, down, from the GLOBAL_POSITION_INT that came at t; or
        None, also without a fix.
        """
        stated = self.stated(t, m)
        return None if self.lack(t) else stated

    def stated(self, t: float, m: Any) -> tuple[Array, Array] | None:
        """The same, whatever the receivers say: what the estimator flies by."""
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
        return None if self._place_lack else (position, 1e-2 * np.array((m.vx, m.vy, m.vz)))
