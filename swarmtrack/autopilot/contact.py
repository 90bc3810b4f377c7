"""What is known of the connection and of who is at its other end, and news of it for the log."""

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
    """Facts kept by `MavlinkAutopilot`; all times are ours [s].

    expected_system: the vehicle that the user named, None for the first one heard; down: why there is no connection,
    None while there is one; frames_before: good frames of earlier connections; heard_at: when our autopilot last spoke;
    others: (system, component) of who else speaks, and what it is; signature_trouble: why signed frames are refused;
    kind: MAV_AUTOPILOT of the dialect: which firmware ours is, None until it is heard.
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


class News:
    """Logs, but the same news at most every LINK_NEWS_PERIOD_S seconds: a flapping link writes no stream of lines."""

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
    """What tells an autopilot that we are here. kind: MAV_TYPE of the dialect: as what."""
    return common.MAVLink_heartbeat_message(
        type=kind,
        autopilot=common.MAV_AUTOPILOT_INVALID,
        base_mode=0,
        custom_mode=0,
        system_status=common.MAV_STATE_ACTIVE,
        mavlink_version=3,
    )
