"""Whether the pilot wants to be flown: armed, in the air, and in the mode in which the autopilot listens to setpoints.

A pilot engages by changing into GUIDED (ArduCopter) or OFFBOARD (PX4), and disengages by any other mode. Nothing else
engages: who finds the mode on, or loses sight of it, or has failed, waits until the pilot has left it and comes again.
A take-off in the mode, as ArduCopter makes it by command, does not either: however fast a program arms and takes off,
the drone has to have been heard in the air in another mode before.
"""

from __future__ import annotations

import math
from enum import Enum, auto
from typing import Any

from pymavlink.dialects.v20 import common

# custom_mode of an ArduCopter; and PX4's main mode, in the third byte.
ARDUCOPTER_GUIDED, PX4_OFFBOARD = 4, 6
ROTORCRAFT = frozenset(
    {
        common.MAV_TYPE_QUADROTOR, common.MAV_TYPE_COAXIAL, common.MAV_TYPE_HELICOPTER, common.MAV_TYPE_HEXAROTOR,
        common.MAV_TYPE_OCTOROTOR, common.MAV_TYPE_TRICOPTER, common.MAV_TYPE_DODECAROTOR,
    }
)  # fmt: skip
# s without a heartbeat: nobody knows the mode any more. Heartbeats come once per second, and with each change of mode.
SILENT_S = 2.5


class EngagementStage(Enum):
    WAITING = auto()  # for the pilot to leave the mode: it was on already, or something has failed
    AWAY = auto()
    ENGAGED = auto()


class EngagementEvent(Enum):
    ENTERED = auto()
    LEFT = auto()
    FAILED = auto()


TRANSITIONS: dict[tuple[EngagementStage, EngagementEvent], EngagementStage] = {
    (EngagementStage.WAITING, EngagementEvent.LEFT): EngagementStage.AWAY,
    (EngagementStage.AWAY, EngagementEvent.ENTERED): EngagementStage.ENGAGED,
    (EngagementStage.AWAY, EngagementEvent.FAILED): EngagementStage.WAITING,
    (EngagementStage.ENGAGED, EngagementEvent.LEFT): EngagementStage.AWAY,
    (EngagementStage.ENGAGED, EngagementEvent.FAILED): EngagementStage.WAITING,
}


class PilotEngagement:
    """Told of heartbeats and of time; times are ours [s]. `number` counts engagements."""

    def __init__(self) -> None:
        self.number = 0
        self.stage = EngagementStage.WAITING
        self.wants_stream = False
        """Whether this autopilot lets nobody into the mode who does not send setpoints yet, and could be let in now."""
        self.armed = False
        """As the last heartbeat had it."""
        self._heard_at = -math.inf
        self._flown_by_hand = False
        """Whether it has been heard in another mode since it left the ground."""
        self._ended = ""

    @property
    def engaged(self) -> bool:
        return self.stage is EngagementStage.ENGAGED

    def take_end(self) -> str:
        """Why an engagement has ended since the last call, in words; empty if none has."""
        ended, self._ended = self._ended, ""
        return ended

    def on_heartbeat(self, t: float, m: Any, kind: int | None, *, airborne: bool) -> None:
        """HEARTBEAT of our autopilot at t; kind: its MAV_AUTOPILOT; airborne: whether it flies."""
        self._heard_at = t
        armed = self.armed = bool(m.base_mode & common.MAV_MODE_FLAG_SAFETY_ARMED)
        guided = _is_guided(m, kind)
        self._flown_by_hand = armed and airborne and (self._flown_by_hand or not guided)
        if not (armed and guided):
            self._fire(EngagementEvent.LEFT, "the pilot left the mode" if armed else "disarmed")
        elif self._flown_by_hand:
            self._fire(EngagementEvent.ENTERED, "")
        else:
            # On the ground in the mode, or taking off in it: that must not be steered away from.
            self._fire(EngagementEvent.FAILED, "on the ground")
        self.wants_stream = kind == common.MAV_AUTOPILOT_PX4 and armed and self.stage is EngagementStage.AWAY

    def tick(self, now: float) -> None:
        """Time passes."""
        if now - self._heard_at > SILENT_S:
            self.fail("the autopilot is silent")

    def fail(self, why: str) -> None:
        """What is needed to fly is missing for too long: over, until the pilot engages anew."""
        self._fire(EngagementEvent.FAILED, why)
        self.wants_stream = False

    def _fire(self, event: EngagementEvent, why: str) -> None:
        then = TRANSITIONS.get((self.stage, event), self.stage)
        if then is self.stage:
            return
        if self.engaged:
            self._ended = why
        self.stage = then
        self.number += then is EngagementStage.ENGAGED


def _is_guided(m: Any, kind: int | None) -> bool:
    """In the mode in which it listens to setpoints; other vehicles number their modes otherwise."""
    if m.type not in ROTORCRAFT or not m.base_mode & common.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
        return False
    if kind == common.MAV_AUTOPILOT_ARDUPILOTMEGA:
        return bool(m.custom_mode == ARDUCOPTER_GUIDED)
    return bool(kind == common.MAV_AUTOPILOT_PX4 and m.custom_mode >> 16 & 0xFF == PX4_OFFBOARD)
