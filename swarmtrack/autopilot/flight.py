"""Whether the drone flies: by its heartbeats, and by EXTENDED_SYS_STATE where that comes.

ArduPilot's heartbeat says STANDBY while its landing detector says "landed", and ACTIVE in the air. PX4's says ACTIVE as
soon as it is armed, but PX4 sends EXTENDED_SYS_STATE by itself on an onboard link, and disarms within 10 s when it is
not taken off. So nothing need be asked for.
"""

from __future__ import annotations

import math
from typing import Any

from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.limits import LANDED_STATE_AGE_S
from swarmtrack.messages import FlightState

FLYING_STATES = (common.MAV_STATE_ACTIVE, common.MAV_STATE_CRITICAL, common.MAV_STATE_EMERGENCY)
AIRBORNE_LANDED_STATES = (
    common.MAV_LANDED_STATE_IN_AIR,
    common.MAV_LANDED_STATE_TAKEOFF,
    common.MAV_LANDED_STATE_LANDING,
)


class FlightWatch:
    """Time since which the drone is in the air, from both messages."""

    def __init__(self) -> None:
        self._landed_state_at = -math.inf
        self._since: float | None = None
        self._is_known = False

    def on_heartbeat(self, t: float, m: Any) -> FlightState:
        """HEARTBEAT has come at t [s]."""
        if t - self._landed_state_at > LANDED_STATE_AGE_S:
            # Armed on the ground ArduPilot is in STANDBY.
            armed = bool(m.base_mode & common.MAV_MODE_FLAG_SAFETY_ARMED)
            self._fly(t, is_airborne=armed and m.system_status in FLYING_STATES)
        return FlightState(t, self._since)

    def on_landed_state(self, t: float, m: Any) -> None:
        """EXTENDED_SYS_STATE has come at t [s]. Its landed state may be undefined."""
        if m.landed_state != common.MAV_LANDED_STATE_UNDEFINED:
            self._landed_state_at = t
            self._fly(t, is_airborne=m.landed_state in AIRBORNE_LANDED_STATES)

    def _fly(self, t: float, *, is_airborne: bool) -> None:
        if not is_airborne:
            self._since = None
        elif self._since is None:
            self._since = t if self._is_known else -math.inf
        self._is_known = True
