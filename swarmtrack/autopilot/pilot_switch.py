"""A switch of the pilot's transmitter: a channel of the radio control, as the autopilot reports it by RC_CHANNELS.

It is thrown when the channel rises above a threshold. Where the switch stands when it is first heard of, or heard of
again, says nothing of when it was moved there.
"""

from __future__ import annotations

import math
from typing import Any

from pymavlink.dialects.v20 import common

RC_CHANNELS: int = common.MAVLINK_MSG_ID_RC_CHANNELS
REPORTS_HZ = 5.0
# µs: no receiver says less or more. A channel that there is not is 0 on ArduPilot and 65535 on PX4.
SHORTEST_US, LONGEST_US = 800, 2200
# s: who was silent for longer is heard of for the first time.
FORGOTTEN_AFTER = 2.0
# µs below the threshold: a channel that trembles there is thrown once.
TREMBLES_US = 50


class PilotSwitch:
    """channel: from 1 on; above_us: it is on above this [µs]. Told of RC_CHANNELS."""

    def __init__(self, channel: int, above_us: float) -> None:
        self.channel = channel
        self._above_us = above_us
        self._field = f"chan{channel}_raw"
        self._on: bool | None = None
        self._heard_at = -math.inf

    def on_channels(self, t: float, m: Any) -> bool:
        """RC_CHANNELS has come at t [s]; whether the switch has been thrown since the last one."""
        level = getattr(m, self._field)
        if not SHORTEST_US <= level <= LONGEST_US:
            return False
        before = self._on if t - self._heard_at < FORGOTTEN_AFTER else None
        self._heard_at = t
        self._on = level > self._above_us - (TREMBLES_US if before else 0)
        return self._on and before is False

    def is_heard(self, now: float) -> bool:
        """Whether anybody knows where it stands."""
        return now - self._heard_at < FORGOTTEN_AFTER

    def is_on(self, now: float) -> bool:
        return self.is_heard(now) and bool(self._on)

    def in_words(self, now: float) -> str:
        """Where it stands."""
        if not self.is_heard(now):
            return f"no switch: channel {self.channel} is not reported"
        return f"switch {'on' if self._on else 'off'}"
