"""State of the connection and of its other end, and log lines about changes."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field

from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.limits import LINK_NEWS_PERIOD_S

log = logging.getLogger(__package__)

OPENING = "opening"


@dataclass(slots=True)
class Contact:
    """State kept by `MavlinkAutopilot`; all times are ours [s].

    expected_system: the configured vehicle, None for the first one heard; down: why there is no connection, None while
    there is one; frames_before: good frames of earlier connections; heard_at: time of our autopilot's last message;
    others: (system, component) of further senders, and their kind; signature_trouble: why signed frames are rejected;
    kind: MAV_AUTOPILOT of the dialect: the autopilot's firmware, None until its first heartbeat.
    """

    expected_system: int | None
    down: str | None = OPENING
    opened_at: float = 0.0
    received_at: float = -math.inf
    bytes: int = 0  # of this connection
    frames_before: int = 0
    system: int | None = None
    kind: int | None = None
    known_at: float = 0.0
    heard_at: float = -math.inf
    others: dict[tuple[int, int], str] = field(default_factory=dict)
    signature_trouble: str = ""
    foreign: int = 0
    reconnects: int = 0


class RepeatLimiter:
    """Logger that repeats the same line at most every LINK_NEWS_PERIOD_S seconds, so that a flapping link does not
    flood the log.
    """

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._said: dict[str, float] = {}  # by name, when it was logged last

    def log(self, level: int, name: str, text: str, *values: object) -> None:
        now = self._now()
        if now - self._said.get(name, -math.inf) >= LINK_NEWS_PERIOD_S:
            self._said[name] = now
            log.log(level, text, *values)

    def warn(self, name: str, text: str, *values: object) -> None:
        self.log(logging.WARNING, name, text, *values)


def heartbeat(kind: int) -> object:
    """HEARTBEAT of this agent. kind: its MAV_TYPE of the dialect."""
    return common.MAVLink_heartbeat_message(
        type=kind,
        autopilot=common.MAV_AUTOPILOT_INVALID,
        base_mode=0,
        custom_mode=0,
        system_status=common.MAV_STATE_ACTIVE,
        mavlink_version=3,
    )
