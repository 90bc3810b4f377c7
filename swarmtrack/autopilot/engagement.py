"""Whether the pilot wants to be flown: armed, in the air, and in the mode in which the autopilot listens to setpoints.

A pilot engages by changing into GUIDED (ArduCopter) or OFFBOARD (PX4), and disengages by any other mode. Nothing else
engages: who finds the mode on, or loses sight of it, or has failed, waits until the pilot has left it and comes again.
A take-off in the mode, as ArduCopter makes it by command, does not either: however fast a program arms and takes off,
the drone has to have been heard in the air in another mode before.

What counts is what the pilot *intends*. A failsafe of PX4 changes the mode and leaves the intention (CURRENT_MODE,
`intended_custom_mode`): as soon as it hears set points again it goes back into OFFBOARD by itself. So leaving the mode
means leaving the intention, and until then nothing is streamed to it after a failure: neither disarming nor the switch
that may be asked for besides makes up for that. A PX4 that does not tell its intention can be engaged once, and again
after it was disarmed. ArduCopter does not tell it, and never goes back by itself: its mode is the intention.
"""

from __future__ import annotations

import math
from enum import Enum, auto
from typing import Any

from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.limits import (
    AGENT_BACKLOG_S,
    AGENT_STOOD_STILL_S,
    ENGAGEMENT_SILENT_S,
    FAILSAFE_TOLD_WITHIN_S,
    LONGEST_FAILSAFE_TEXT,
    MODE_SETTLES_S,
)
from swarmtrack.autopilot.pilot_switch import PilotSwitch
from swarmtrack.plain_text import plain

# custom_mode of an ArduCopter; and PX4's main mode, in the third byte.
ARDUCOPTER_GUIDED, PX4_OFFBOARD = 4, 6
ROTORCRAFT = frozenset(
    {
        common.MAV_TYPE_QUADROTOR, common.MAV_TYPE_COAXIAL, common.MAV_TYPE_HELICOPTER, common.MAV_TYPE_HEXAROTOR,
        common.MAV_TYPE_OCTOROTOR, common.MAV_TYPE_TRICOPTER, common.MAV_TYPE_DODECAROTOR,
    }
)  # fmt: skip
ARDUCOPTER_MODES = {
    0: "STABILIZE", 1: "ACRO", 2: "ALT_HOLD", 3: "AUTO", 4: "GUIDED", 5: "LOITER", 6: "RTL", 7: "CIRCLE", 9: "LAND",
    11: "DRIFT", 13: "SPORT", 15: "AUTOTUNE", 16: "POSHOLD", 17: "BRAKE", 18: "THROW", 19: "AVOID_ADSB",
    20: "GUIDED_NOGPS", 21: "SMART_RTL", 22: "FLOWHOLD", 23: "FOLLOW", 24: "ZIGZAG", 27: "AUTO_RTL",
}  # fmt: skip
PX4_MODES = {1: "MANUAL", 2: "ALTCTL", 3: "POSCTL", 4: "AUTO", 5: "ACRO", 6: "OFFBOARD", 7: "STABILIZED"}
PX4_AUTO_MODES = {2: "TAKEOFF", 3: "HOLD", 4: "MISSION", 5: "RTL", 6: "LAND", 8: "FOLLOW", 9: "PRECLAND"}


LEFT, STOOD_STILL = "the pilot left the mode", "the agent stalled"


class EngagementStage(Enum):
    WAITING = auto()  # for the pilot to leave the mode: it was on already, or something has failed
    AWAY = auto()
    ENGAGED = auto()


class EngagementEvent(Enum):
    ENTERED = auto()
    LEFT = auto()
    SWITCHED_OFF = auto()
    FAILED = auto()


ENGAGEMENT_TRANSITIONS: dict[tuple[EngagementStage, EngagementEvent], EngagementStage] = {
    (EngagementStage.WAITING, EngagementEvent.LEFT): EngagementStage.AWAY,
    (EngagementStage.AWAY, EngagementEvent.ENTERED): EngagementStage.ENGAGED,
    (EngagementStage.AWAY, EngagementEvent.FAILED): EngagementStage.WAITING,
    (EngagementStage.ENGAGED, EngagementEvent.LEFT): EngagementStage.AWAY,
    (EngagementStage.ENGAGED, EngagementEvent.SWITCHED_OFF): EngagementStage.AWAY,
    (EngagementStage.ENGAGED, EngagementEvent.FAILED): EngagementStage.WAITING,
}


class PilotEngagement:
    """State of the pilot's engagement from heartbeats, intentions and time; times are ours [s]. `number` counts
    engagements.

    switch: has to be on as well; None: the mode is enough.
    """

    def __init__(self, switch: PilotSwitch | None = None) -> None:
        self.number = 0
        self.stage = EngagementStage.WAITING
        self.wants_stream = False
        """Whether this autopilot lets nobody into the mode who does not send setpoints yet, and could be let in now."""
        self.armed = False
        """As the last heartbeat had it."""
        self._switch = switch
        self._kind: int | None = None
        self._mode = 0
        """custom_mode of the last heartbeat."""
        self._guided = self._airborne = False
        self._intended: int | None = None
        """custom_mode; None where this autopilot does not tell."""
        self._heard_at = -math.inf
        self._ticked_at: float | None = None
        self._woke_at = -math.inf
        self._flown_by_hand = False
        """Whether it has been heard in the air since it was armed while the pilot did not want it."""
        self._ended = ""
        self._settles_at = -math.inf
        self._failsafe, self._failsafe_at = "", -math.inf

    @property
    def engaged(self) -> bool:
        return self.stage is EngagementStage.ENGAGED

    def take_end(self, now: float = math.inf) -> str:
        """Reason why an engagement has ended since the last call, in words; empty if none has, or before the reason
        is certain.
        """
        if now < self._settles_at:
            return ""
        ended, self._ended = self._ended, ""
        return ended

    def on_heartbeat(self, t: float, m: Any, kind: int | None, *, airborne: bool) -> None:
        """HEARTBEAT of our autopilot at t; kind: its MAV_AUTOPILOT; airborne: whether it flies."""
        self._distrust(t)
        self._heard_at = t
        self._kind, self._mode, self._airborne = kind, m.custom_mode, airborne
        self.armed = bool(m.base_mode & common.MAV_MODE_FLAG_SAFETY_ARMED)
        known = m.type in ROTORCRAFT and m.base_mode & common.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        was_guided, self._guided = self._guided, bool(known) and is_guided(m.custom_mode, kind)
        self._judge(t, fell_out=was_guided and not self._guided)

    def on_current_mode(self, t: float, m: Any) -> None:
        """CURRENT_MODE at t."""
        if m.intended_custom_mode == 0:
            return
        self._distrust(t)
        self._intended = m.intended_custom_mode
        if t < self._settles_at and self._intends() is False:
            self._ended, self._settles_at = LEFT, t
        self._judge(t)

    @property
    def asks_for_switch(self) -> bool:
        """Whether RC_CHANNELS are of interest."""
        return self._switch is not None

    def on_channels(self, t: float, m: Any) -> None:
        """RC_CHANNELS at t."""
        self._distrust(t)
        if self._switch is not None:
            self._switch.on_channels(t, m)
        self._judge(t)

    def on_text(self, t: float, text: str) -> None:
        """STATUSTEXT at t."""
        if "failsafe" in text.lower():
            self._failsafe, self._failsafe_at = plain(text)[:LONGEST_FAILSAFE_TEXT], t

    def tick(self, now: float) -> None:
        """Let time pass."""
        self._look_for_gap(now)
        self._ticked_at = now
        if now - self._heard_at > ENGAGEMENT_SILENT_S:
            self.fail("the autopilot is silent")
        elif self.engaged:
            self._judge(now)

    def fail(self, why: str) -> None:
        """End the engagement for a lasting fault, until the pilot engages again."""
        self._fire(EngagementEvent.FAILED, why)
        self.wants_stream = False

    def _look_for_gap(self, t: float) -> None:
        """Between two looks at the clock, or from the last one to what was heard."""
        gap = 0.0 if self._ticked_at is None else t - self._ticked_at
        if gap <= AGENT_STOOD_STILL_S:
            return
        self._woke_at = t
        why = f"{STOOD_STILL} for {gap:.1f} s"
        self.fail(why)
        if self._ended.startswith(STOOD_STILL):
            # Heard late, one after the other, each says a little more.
            self._ended, self._settles_at = why, t

    def _distrust(self, t: float) -> None:
        """What was heard while this agent stood still is news of a flight that it was not part of: also where the clock
        was looked at first, and what had waited is read thereafter."""
        self._look_for_gap(t)
        if t < self._woke_at + AGENT_BACKLOG_S:
            self.fail(STOOD_STILL)

    def _intends(self) -> bool | None:
        """Whether the pilot wants the mode; None: nobody knows whether it was left by the pilot."""
        if self._intended is not None:
            return is_guided(self._intended, self._kind)
        return None if self._kind == common.MAV_AUTOPILOT_PX4 and not self._guided else self._guided

    def _consents(self, t: float) -> bool:
        """Whether the switch is on, where it has to be."""
        return self._switch is None or self._switch.is_on(t)

    def _judge(self, t: float, *, fell_out: bool = False) -> None:
        """fell_out: just now the autopilot is not in the mode any more."""
        if self._heard_at == -math.inf:
            return
        intends, consents = self._intends(), self._consents(t)
        by_hand = intends is not True or not consents
        self._flown_by_hand = self.armed and self._airborne and (self._flown_by_hand or by_hand)
        if not self.armed:
            self._fire(EngagementEvent.FAILED if intends else EngagementEvent.LEFT, "disarmed")
        elif intends is False:
            self._fire(EngagementEvent.LEFT, LEFT if self._intended is not None else self._mode_in_words(t))
        elif not self._guided and (fell_out or self.engaged):
            self._settles_at = t + MODE_SETTLES_S if self.engaged and self._intended is not None else t
            self._fire(EngagementEvent.FAILED, self._mode_in_words(t))
        elif not consents:
            self._fire(EngagementEvent.SWITCHED_OFF, self._who_withdrew(t))
        elif not self._guided:
            pass  # it is asked for, and not yet in force
        elif self._flown_by_hand:
            self._fire(EngagementEvent.ENTERED, "")
        else:
            # On the ground in the mode, or taking off in it: that must not be steered away from.
            self._fire(EngagementEvent.FAILED, "on the ground")
        px4 = self._kind == common.MAV_AUTOPILOT_PX4
        self.wants_stream = px4 and self.armed and self.stage is EngagementStage.AWAY

    def _who_withdrew(self, t: float) -> str:
        heard = self._switch is not None and self._switch.is_heard(t)
        return "the pilot's switch is off" if heard else "no signal from the transmitter"

    def _mode_in_words(self, t: float) -> str:
        why = f" ({self._failsafe})" if t - self._failsafe_at < FAILSAFE_TOLD_WITHIN_S else ""
        return f"mode is {mode_name(self._mode, self._kind)} now{why}"

    def _fire(self, event: EngagementEvent, why: str) -> None:
        then = ENGAGEMENT_TRANSITIONS.get((self.stage, event), self.stage)
        if then is self.stage:
            return
        if self.engaged:
            self._ended = why
        self.stage = then
        self.number += then is EngagementStage.ENGAGED


def is_guided(custom_mode: int, kind: int | None) -> bool:
    """Whether it is the mode in which a rotorcraft's firmware accepts set points."""
    if kind == common.MAV_AUTOPILOT_ARDUPILOTMEGA:
        return custom_mode == ARDUCOPTER_GUIDED
    return kind == common.MAV_AUTOPILOT_PX4 and custom_mode >> 16 & 0xFF == PX4_OFFBOARD


def mode_name(custom_mode: int, kind: int | None) -> str:
    """The mode's name for pilots."""
    if kind == common.MAV_AUTOPILOT_PX4:
        main, sub = custom_mode >> 16 & 0xFF, custom_mode >> 24
        named = PX4_AUTO_MODES.get(sub) if PX4_MODES.get(main) == "AUTO" else PX4_MODES.get(main)
    else:
        named = ARDUCOPTER_MODES.get(custom_mode)
    return named or f"number {custom_mode}"
