"""Feeds an autopilot that has lost its position with the place that teammates give its drone.

Nothing else is sent: no mode, no parameter, no set point. A place that is too old or too vague is not sent: then the
autopilot does what it does without a position. `docs/feeding.md` has the set-up.
"""

from __future__ import annotations

import asyncio
import logging
import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.fed_position import FedPosition
from swarmtrack.autopilot.limits import FED_FIX_BACK_S
from swarmtrack.autopilot.mavlink_autopilot import MavlinkAutopilot
from swarmtrack.autopilot.notices import Severity
from swarmtrack.autopilot.odometry import no_odometry, odometry, quality_of
from swarmtrack.clock import Clock
from swarmtrack.geometry.covariance import worst_sigma
from swarmtrack.messages import LinkStatus
from swarmtrack.motion.ego import AutopilotPlace
from swarmtrack.outputs.wording import held_in_words
from swarmtrack.perceived import FeedView

log = logging.getLogger(__name__)

# s: ArduPilot calls a source of odometry unhealthy that is silent for 0.3 s, and does not arm.
STANDBY_PERIOD_S = 0.2
# Of the sum of the covariances of two places: a change by more is a step, which an estimator should follow.
STEP_SIGMAS = 5.0
# Of both limits: it begins below, and ends beyond them.
BEGINS_BELOW_SHARE = 0.8
NO_FEED_NEEDED = "the autopilot has a position of its own, or no teammate has held us yet"


class Notices(Protocol):
    """What tells the pilot: `PilotNotices`."""

    def add(self, severity: Severity, text: str) -> None: ...


@dataclass(frozen=True, slots=True)
class FeedParameters:
    """Rate [Hz]; and of what is fed the worst sigma [m] and the age of its newest ray [s], at most."""

    hz: float = 20.0
    vaguest_m: float = 2.0
    oldest_s: float = 1.0


class PlaceFeed:
    """perceived: what is known of the place; fed: told what is sent, and says what the autopilot has of its own;
    notices: told to the pilot.

    `run` is a task. `feed` is all there is to it: told the time, it needs no event loop.
    """

    def __init__(
        self,
        perceived: FeedView,
        autopilot: MavlinkAutopilot,
        fed: FedPosition,
        notices: Notices,
        *,
        clock: Clock,
        parameters: FeedParameters,
    ) -> None:
        self._perceived, self._autopilot, self._fed, self._notices = perceived, autopilot, fed, notices
        self._clock, self._p = clock, parameters
        self._sent = self._standby = self._old = self._vague = self._resets = 0
        self._last: AutopilotPlace | None = None
        """What was sent last."""
        self._feeds, self._why = False, NO_FEED_NEEDED
        self._said_back = False
        self._standby_at = -math.inf

    async def run(self) -> None:
        """Until cancelled."""
        due = self._clock.now()
        while True:
            now = self._clock.now()
            self.feed(now)
            due = max(due + 1.0 / self._p.hz, now)
            await asyncio.sleep(due - now)

    def feed(self, now: float) -> None:
        """Send the place, or say why not."""
        place = self._perceived.place_for_autopilot
        if place is None:
            self._fed.end()
            self._said_back = False
        why = self._lack(place, now)
        if not why and place is not None and self._is_new(place):
            why = self._send(place, now)
        if why:
            self._stand_by(now)
        self._say(place, why, now)

    def _lack(self, place: AutopilotPlace | None, now: float) -> str:
        """Why nothing is fed now; empty where it is."""
        if place is None:
            return NO_FEED_NEEDED
        if self._autopilot.local_origin is None:
            return "where the autopilot's local frame begins is unknown"
        if self._fed.is_own_again(now):
            return f"its receiver has had a fix for {FED_FIX_BACK_S:.0f} s"
        age, sigma = now - place.held_t, worst_sigma(place.position_cov)
        share = 1.0 if self._feeds else BEGINS_BELOW_SHARE
        if not age <= share * self._p.oldest_s:
            self._old += 1
            return f"no teammate has held us for {age:.1f} s"
        if not sigma <= share * self._p.vaguest_m:
            self._vague += 1
            return f"±{sigma:.1f} m, expected ±{share * self._p.vaguest_m:.1f} m or better"
        return ""

    def _is_new(self, place: AutopilotPlace) -> bool:
        return self._last is None or place.t > self._last.t

    def _send(self, place: AutopilotPlace, now: float) -> str:
        origin, kind = self._autopilot.local_origin, self._autopilot.kind
        assert origin is not None
        stepped = self._last is not None and has_stepped(self._last, place)
        resets = self._resets + stepped
        quality = quality_of(worst_sigma(place.position_cov), self._p.vaguest_m)
        message = odometry(place, kind=kind or 0, origin=origin, quality=quality, resets=resets)
        if not self._autopilot.send_message(message):
            return "the autopilot is silent"
        self._fed.feed(now)
        self._last, self._resets = place, resets
        self._sent += 1
        return ""

    def _stand_by(self, now: float) -> None:
        """ArduPilot hears that there is no place."""
        is_ardupilot = self._autopilot.kind == common.MAV_AUTOPILOT_ARDUPILOTMEGA
        if is_ardupilot and now - self._standby_at >= STANDBY_PERIOD_S - 1e-6:
            self._standby_at = now
            self._standby += self._autopilot.send_message(no_odometry(now, resets=self._resets))

    def _say(self, place: AutopilotPlace | None, why: str, now: float) -> None:
        feeds = not why
        if feeds != self._feeds:
            held = "" if place is None else held_in_words(place.by, worst_sigma(place.position_cov))
            self._tell(f"place feed begins: {held}" if feeds else f"place feed ends: {why}")
        self._feeds, self._why = feeds, why
        if feeds and not self._said_back and self._fed.is_coming_back(now):
            self._said_back = True
            self._tell(f"GPS is back: the place feed ends in {FED_FIX_BACK_S:.0f} s; select EKF source set 1")

    def _tell(self, line: str) -> None:
        log.warning("%s", line)
        self._notices.add(Severity.WARNING, line)

    def status(self) -> LinkStatus:
        """One line, and the counters."""
        counters = {
            "feeds": self._feeds,
            "odometry": self._sent,
            "standby": self._standby,
            "withheld_old": self._old,
            "withheld_vague": self._vague,
            "resets": self._resets,
        }
        text = "feeds the autopilot our place" if self._feeds else f"waits: {self._why}"
        return LinkStatus("feed", True, text, tuple((name, float(n)) for name, n in counters.items()))


def has_stepped(before: AutopilotPlace, after: AutopilotPlace) -> bool:
    """Whether the place has changed by more than its motion, and what both state of themselves."""
    dt = after.t - before.t
    moved = after.position - before.position - 0.5 * dt * (before.velocity + after.velocity)
    cov = before.position_cov + after.position_cov + dt * dt * (before.velocity_cov + after.velocity_cov)
    return float(moved @ np.linalg.solve(cov, moved)) > STEP_SIGMAS**2
