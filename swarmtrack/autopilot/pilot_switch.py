"""A switch of the pilot's transmitter: a channel of the radio control, as the autopilot reports it by RC_CHANNELS.

It is thrown when the channel rises above a threshold. Its position in the first report, or in the first one after a
gap, does not show when it was moved there.
"""

from __future__ import annotations

import math
from typing import Any

from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.limits import (
    CHANNEL_FORGOTTEN_AFTER_S,
    CHANNEL_TREMBLES_US,
    LONGEST_CHANNEL_US,
    SHORTEST_CHANNEL_US,
)

RC_CHANNELS: int = common.MAVLINK_MSG_ID_RC_CHANNELS


class PilotSwitch:
    """State of the switch from RC_CHANNELS. channel: from 1 on; above_us: it is on above this [µs]."""

    def __init__(self, channel: int, above_us: float) -> None:
        self.channel = channel
        self._above_us = above_us
        self._field = f"chan{channel}_raw"
        self._on: bool | None = None
        self._heard_at = -math.inf

    def on_channels(self, t: float, m: Any) -> bool:
        """RC_CHANNELS has come at t [s]; whether the switch has been thrown since the last one."""
        level = getattr(m, self._field)
        if not SHORTEST_CHANNEL_US <= level <= LONGEST_CHANNEL_US:
            return False
        before = self._on if t - self._heard_at < CHANNEL_FORGOTTEN_AFTER_S else None
        self._heard_at = t
        self._on = level > self._above_us - (CHANNEL_TREMBLES_US if before else 0)
        return self._on and before is False

    def is_heard(self, now: float) -> bool:
        """Whether its position is known."""
        return now - self._heard_at < CHANNEL_FORGOTTEN_AFTER_S

    def is_on(self, now: float) -> bool:
        return self.is_heard(now) and bool(self._on)

    def in_words(self, now: float) -> str:
        """Its position, in words."""
        if not self.is_heard(now):
            return f"no switch: channel {self.channel} is not reported"
        return f"switch {'on' if self._on else 'off'}"
