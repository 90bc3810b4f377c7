"""Flies a follower: the newest decision to the autopilot, ten times per second, while its pilot wants that.

It never arms, takes off, lands, changes a mode or a parameter. It sends SET_POSITION_TARGET_LOCAL_NED, and that only
while the pilot has it engaged (`sensors/mavlink/engagement.py`). One task decides, another sends: a decision that is
`STALE_S` old becomes zero velocity, and one that is `DEAD_S` old ends the engagement with a zero. The same ends it when
the agent stops. Should the agent die at once, the autopilot's own time-out counts: 3 s on ArduCopter (GUID_TIMEOUT),
COM_OF_LOSS_T on PX4.
"""

from __future__ import annotations

import asyncio
import logging
import math
from typing import Any

from pymavlink.dialects.v20 import common

from swarmtrack.clock import Clock
from swarmtrack.follower import Engagement, LocalSetpoint
from swarmtrack.formation.parameters import FormationParameters
from swarmtrack.formation.setpoint import STILL, Velocity, Why
from swarmtrack.messages import LinkStatus
from swarmtrack.runtime.door import Door
from swarmtrack.runtime.pilot_notices import PilotNotices
from swarmtrack.sensors.mavlink.autopilot import MavlinkAutopilot
from swarmtrack.sensors.mavlink.engagement import EngagementStage, PilotEngagement
from swarmtrack.sensors.mavlink.notices import Severity

log = logging.getLogger(__name__)

PERIOD_S = 0.1
# s since the decision.
STALE_S, DEAD_S = 0.3, 1.0
# s that a reason to hold must last to be said.
SAID_AFTER_S = 0.5
# Ignored: position, acceleration and heading; used: velocity and yaw rate.
MASK = (
    common.POSITION_TARGET_TYPEMASK_X_IGNORE
    | common.POSITION_TARGET_TYPEMASK_Y_IGNORE
    | common.POSITION_TARGET_TYPEMASK_Z_IGNORE
    | common.POSITION_TARGET_TYPEMASK_AX_IGNORE
    | common.POSITION_TARGET_TYPEMASK_AY_IGNORE
    | common.POSITION_TARGET_TYPEMASK_AZ_IGNORE
    | common.POSITION_TARGET_TYPEMASK_YAW_IGNORE
)


class FormationPilot:
    """parameters: of the place in the formation, told for whoever watches; clock: the flight's; door: asked for
    decisions; notices: said to the pilot.

    `run` is a task. `decide` and `send` are all there is to it: told the time, they need no event loop.
    """

    def __init__(
        self,
        door: Door,
        autopilot: MavlinkAutopilot,
        engagement: PilotEngagement,
        notices: PilotNotices,
        clock: Clock,
        *,
        parameters: FormationParameters,
    ) -> None:
        self.sent = 0
        self.zeros = 0
        self.ends = 0
        self.holds = 0
        """How often it was said that the drone holds."""
        self._door, self._autopilot, self._engagement = door, autopilot, engagement
        self._notices, self._clock = notices, clock
        north, east, _ = parameters.slots[parameters.drone_id]
        self._place = (
            ("leader", float(parameters.leader)),
            ("slot_north_m", north),
            ("slot_east_m", east),
        )
        self._decided = asyncio.Event()
        self._newest: LocalSetpoint | None = None
        self._begun_at = -math.inf
        self._number = 0
        self._why: Why | None = None
        self._why_since = math.inf
        self._said: Why | None = None

    async def run(self) -> None:
        """Until cancelled; then the drone is told to stand."""
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(self._keep_deciding(), name="formation decides")
                tasks.create_task(self._keep_sending(), name="formation sends")
        finally:
            self.stop()

    async def _keep_deciding(self) -> None:
        due = self._clock.now()
        while True:
            now = self._clock.now()
            self.decide(now)
            self._decided.set()
            # After a stall no decisions are made up for.
            due = max(due + PERIOD_S, now)
            await asyncio.sleep(due - now)

    async def _keep_sending(self) -> None:
        """With each decision, or as soon as one stays away."""
        while True:
            try:
                async with asyncio.timeout(1.5 * PERIOD_S):
                    await self._decided.wait()
            except TimeoutError:
                pass
            self._decided.clear()
            self.send(self._clock.now())

    def decide(self, now: float) -> None:
        """What to fly from now on."""
        engagement = self._engagement
        engagement.tick(now)
        if not engagement.engaged:
            return
        told = self._door.command(now, Engagement(engagement.number, self._autopilot.clock_known))
        self._newest = told
        self._look_for_news(told.setpoint.why, told.setpoint.text, now)

    def send(self, now: float) -> None:
        """The newest decision, or what it means by now."""
        engagement = self._engagement
        engagement.tick(now)
        if engagement.engaged and engagement.number != self._number:
            self._begin(now)
        if engagement.engaged:
            newest = self._newest
            age = now - (self._begun_at if newest is None else newest.setpoint.t)
            if age > DEAD_S:
                self._say(now, STILL, 0.0)
                engagement.fail(f"no decision for {age:.1f} s")
            elif newest is None or age > STALE_S:
                self.zeros += 1
                self._say(now, STILL, 0.0)
            else:
                self._say(now, newest.velocity, newest.yaw_rate)
        elif engagement.wants_stream:
            self._say(now, STILL, 0.0)
        self._look_for_end()

    def stop(self) -> None:
        """The agent stops: the drone is told to stand, once."""
        if self._engagement.engaged:
            self._say(self._clock.now(), STILL, 0.0)
            self._engagement.fail("the agent stops")
            self._look_for_end()

    def on_reboot(self) -> None:
        """The autopilot has rebooted."""
        self._engagement.fail("the autopilot has rebooted")

    def status(self) -> LinkStatus:
        """One line, and the counters."""
        newest, engaged = self._newest, self._engagement.engaged
        error = newest.setpoint.error if engaged and newest is not None else None
        counters = (
            ("setpoints", float(self.sent)),
            ("stale", float(self.zeros)),
            ("engagements", float(self._engagement.number)),
            ("engaged", float(engaged)),
            ("holds", float(self.holds)),
            *self._place,
            ("error_m", math.nan if error is None else error),
        )
        match self._engagement.stage:
            case EngagementStage.ENGAGED if newest is not None:
                return LinkStatus("formation", not newest.setpoint.holds, newest.setpoint.text, counters)
            case EngagementStage.ENGAGED:
                return LinkStatus("formation", True, "engaged", counters)
            case EngagementStage.AWAY:
                return LinkStatus("formation", True, "waits for its pilot to engage it", counters)
        return LinkStatus(
            "formation", True, "waits for its pilot to leave the mode and engage it again", counters
        )

    def _begin(self, now: float) -> None:
        """Engaged: what was decided for an earlier engagement counts no more."""
        self._number = self._engagement.number
        self._begun_at = now
        if self._newest is not None and self._newest.setpoint.t < now - PERIOD_S:
            self._newest = None
        self._why = self._said = None
        self._notices.add(Severity.WARNING, "formation engaged")
        log.warning("formation: engaged by the pilot, no. %d", self._number)

    def _look_for_end(self) -> None:
        why = self._engagement.take_end()
        if why:
            self.ends += 1
            self._newest = None
            self._notices.add(Severity.WARNING, f"formation released: {why}")
            log.warning("formation: released: %s", why)

    def _look_for_news(self, why: Why, text: str, now: float) -> None:
        if why is not self._why:
            self._why, self._why_since = why, now
        if now - self._why_since < SAID_AFTER_S or why is self._said:
            return
        self._said = why
        if why.holds:
            self.holds += 1
            self._notices.add(Severity.WARNING, f"formation holds: {text}")
            log.warning("formation: holds: %s", text)
        else:
            self._notices.add(Severity.INFO, "in formation" if why is Why.FOLLOW else f"formation: {text}")

    def _say(self, now: float, velocity: Velocity, yaw_rate: float) -> None:
        self.sent += self._autopilot.tell(local_setpoint(now, self._autopilot.system, velocity, yaw_rate))


def local_setpoint(now: float, system: int, velocity: Velocity, yaw_rate: float) -> Any:
    """SET_POSITION_TARGET_LOCAL_NED for the autopilot of a system: velocity [m/s] NED and yaw_rate [rad/s], no more."""
    return common.MAVLink_set_position_target_local_ned_message(
        int(now * 1e3) % 2**32,
        system,
        common.MAV_COMP_ID_AUTOPILOT1,
        common.MAV_FRAME_LOCAL_NED,
        MASK,
        *(0.0, 0.0, 0.0),
        *velocity,
        *(0.0, 0.0, 0.0),
        0.0,
        yaw_rate,
    )
