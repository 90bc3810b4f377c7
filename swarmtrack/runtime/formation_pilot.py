"""Flies a follower: ten decisions per second to its guard, while its pilot wants that.

It never arms, takes off, lands, changes a mode or a parameter. It decides, and only while the pilot has it engaged
(`autopilot/engagement.py`). What becomes of a decision is the guard's business (`swarmtrack/guard.py`): it alone sends
set points, and ends the engagement where decisions stay away or go beyond the limits. Without the guard the drone is
not flown; it is started again on the ground.
"""

from __future__ import annotations

import asyncio
import logging
import math

from swarmtrack.autopilot.engagement import EngagementStage, PilotEngagement
from swarmtrack.autopilot.mavlink_autopilot import MavlinkAutopilot
from swarmtrack.autopilot.notices import Severity
from swarmtrack.clock import Clock
from swarmtrack.follower import Engagement, LocalSetpoint
from swarmtrack.formation.parameters import FormationParameters
from swarmtrack.formation.setpoint import Velocity, Why
from swarmtrack.guard import Decision
from swarmtrack.messages import LinkStatus
from swarmtrack.outputs.pilot_notices import PilotNotices
from swarmtrack.runtime.door import Door
from swarmtrack.runtime.guard_process import GuardLine

log = logging.getLogger(__name__)

FORMATION_PERIOD_S = 0.1
# s: a guard that has sent nothing for so long, though it was told to, stands still, or its link leads nowhere.
FORMATION_QUIET_S = 1.0
# s that a reason to hold must last to be said.
SAID_AFTER_S = 0.5
# Times the clearance: whoever comes nearer is said to the pilot; and again, once nobody was so near for so long [s].
NEAR_MISS_FACTOR, NEAR_MISS_FORGOTTEN_S = 1.5, 5.0
# What holds a drone that may be moving all the same.
TAKE_OVER = (Why.HEIGHT_DOUBT, Why.DIVERGES)
UNKNOWN_VELOCITY: Velocity = (math.nan, math.nan, math.nan)


class FormationPilot:
    """parameters: of the place in the formation; guard: what sends set points; clock: the flight's; door: asked for
    decisions; notices: said to the pilot.

    `run` is a task. `decide` is all there is to it: told the time, it needs no event loop.
    """

    def __init__(
        self,
        door: Door,
        autopilot: MavlinkAutopilot,
        engagement: PilotEngagement,
        guard: GuardLine,
        notices: PilotNotices,
        *,
        clock: Clock,
        parameters: FormationParameters,
    ) -> None:
        self.ends = 0
        self.holds = 0
        """How often it was said that the drone holds."""
        self._door, self._autopilot, self._engagement, self._guard = door, autopilot, engagement, guard
        self._notices, self._clock = notices, clock
        north, east, _ = parameters.slots[parameters.drone_id]
        self._place = (
            ("leader", float(parameters.leader)),
            ("slot_north_m", north),
            ("slot_east_m", east),
        )
        self._near = NEAR_MISS_FACTOR * parameters.clearance
        self._near_at = -math.inf
        self._newest: LocalSetpoint | None = None
        self._number = 0
        self._flown = 0
        """The engagement that the guard has decisions of; 0: none."""
        self._why: Why | None = None
        self._why_since = math.inf
        self._said: Why | None = None
        self._guard_died = False
        self._sent = 0
        self._sent_at = -math.inf
        """How many set points the guard has sent, and since when."""

    async def run(self) -> None:
        """Until cancelled; then the drone is told to stand."""
        self._guard.start()
        try:
            due = self._clock.now()
            while True:
                now = self._clock.now()
                self.decide(now)
                # After a stall no decisions are made up for.
                due = max(due + FORMATION_PERIOD_S, now)
                await asyncio.sleep(due - now)
        finally:
            self.stop()

    def decide(self, now: float) -> None:
        """What to fly from now on, to the guard."""
        engagement, guard = self._engagement, self._guard
        engagement.tick(now)
        self._listen(now)
        self._look_for_end(now)
        guard.reach(self._autopilot.way())
        if engagement.engaged:
            self._begin(now)
            told = self._door.command(now, Engagement(engagement.number, self._autopilot.clock_known))
            self._newest = told
            guard.decide(self._decision(told))
            self._look_for_news(told.setpoint.why, told.setpoint.text, now)
            self._look_for_near(told.setpoint.nearest, now)
        elif engagement.wants_stream:
            guard.stand()

    def _decision(self, told: LocalSetpoint) -> Decision:
        place_t, place = self._autopilot.place or (-math.inf, UNKNOWN_VELOCITY)
        return Decision(
            self._engagement.number, told.setpoint.t, told.velocity, told.yaw_rate, place, place_t, told.room
        )

    def _listen(self, now: float) -> None:
        """To the guard; where there is none nobody is flown."""
        engagement, guard = self._engagement, self._guard
        news = guard.news()
        for release in news.releases:
            if release.number == engagement.number:
                engagement.fail(release.why)
        if news.died:
            self._guard_died = True
            engagement.fail("the guard has died")
            self._notices.add(Severity.WARNING, "formation guard died: no set points")
            log.error(
                "formation: the guard has died: the drone is not flown until it is started again, on the ground"
            )
        if guard.sent != self._sent or not self._flown:
            self._sent, self._sent_at = guard.sent, now
        elif now - self._sent_at > FORMATION_QUIET_S:
            engagement.fail("the guard sends nothing")
        if not guard.alive:
            if engagement.armed:
                engagement.fail("there is no guard")
            else:
                guard.start()
                self._guard_died = False

    def stop(self) -> None:
        """The agent stops: the drone is told to stand, and the guard ends."""
        if self._engagement.engaged:
            # The guard is not told that this is over: it has the last word.
            self._flown = 0
        self._engagement.fail("the agent stops")
        self._look_for_end(math.inf)
        self._guard.stop()

    def on_reboot(self) -> None:
        """The autopilot has rebooted."""
        self._engagement.fail("the autopilot has rebooted")

    def status(self) -> LinkStatus:
        """One line, and the counters."""
        newest, engaged = self._newest, self._engagement.engaged
        error = newest.setpoint.error if engaged and newest is not None else None
        counters = (
            ("setpoints", float(self._guard.sent)),
            ("stale", float(self._guard.stale)),
            ("refused", float(self._guard.refused)),
            ("engagements", float(self._engagement.number)),
            ("engaged", float(engaged)),
            ("holds", float(self.holds)),
            *self._place,
            ("error_m", math.nan if error is None else error),
        )
        if self._guard_died:
            return LinkStatus(
                "formation", False, "the guard has died: land and disarm, it is started again there", counters
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
        """Of an engagement that is new."""
        if self._engagement.number == self._number:
            return
        self._number = self._flown = self._engagement.number
        self._sent_at = now
        self._why = self._said = None
        self._notices.add(Severity.WARNING, "formation engaged")
        log.warning("formation: engaged by the pilot, no. %d", self._number)

    def _look_for_end(self, now: float) -> None:
        """The guard hears of it at once, people as soon as it is known who ended it."""
        if self._flown and not self._engagement.engaged:
            self._guard.end(self._flown)
            self._flown, self._newest = 0, None
        why = self._engagement.take_end(now)
        if why:
            self.ends += 1
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
            text += ": take over" if why in TAKE_OVER else ""
            self._notices.add(Severity.WARNING, f"formation holds: {text}")
            log.warning("formation: holds: %s", text)
        else:
            self._notices.add(Severity.INFO, "in formation" if why is Why.FOLLOW else f"formation: {text}")

    def _look_for_near(self, nearest: float | None, now: float) -> None:
        if nearest is None or nearest >= self._near:
            return
        if now - self._near_at > NEAR_MISS_FORGOTTEN_S:
            self._notices.add(Severity.WARNING, f"formation: another drone {nearest:.1f} m away")
            log.warning("formation: another drone is %.1f m away, at least", nearest)
        self._near_at = now
