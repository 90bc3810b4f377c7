"""State of the connection and of its other end, and log lines about changes."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field

from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.candidates import AutopilotAddress, AutopilotCandidates
from swarmtrack.autopilot.datagrams import Address
from swarmtrack.autopilot.framer import MavlinkFrame
from swarmtrack.autopilot.limits import LINK_NEWS_PERIOD_S

log = logging.getLogger(__package__)

OPENING = "opening"


@dataclass(slots=True)
class Contact:
    """State kept by `MavlinkAutopilot`; all times are ours [s].

    expected_system: the configured vehicle, or None; candidates: autopilots heard; down: why there is no connection,
    None while there is one; frames_before: good frames of earlier connections; heard_at: time of our autopilot's last
    message; others: further senders, and their kind; signature_trouble: why signed frames are rejected; system,
    component, kind, vehicle: of our autopilot, None before it is chosen; the last two are MAV_AUTOPILOT and MAV_TYPE;
    changeling: type of vehicle that speaks under the ID of ours as well, and when it did last; shared_at: when ours
    spoke after it; twins: senders of datagrams that keep ours from being chosen, for they send under one ID;
    version_2_at: when ours last spoke MAVLink 2; foreign: messages of others; early_lost: messages that came long
    before ours was chosen.
    """

    expected_system: int | None
    down: str | None = OPENING
    opened_at: float = 0.0
    received_at: float = -math.inf
    bytes: int = 0  # of this connection
    frames_before: int = 0
    system: int | None = None
    component: int = common.MAV_COMP_ID_AUTOPILOT1
    kind: int | None = None
    vehicle: int | None = None
    changeling: str = ""
    changeling_at: float = -math.inf
    shared_at: float = -math.inf
    version_2_at: float = -math.inf
    twins: tuple[Address, ...] = ()
    known_at: float = 0.0
    heard_at: float = -math.inf
    others: dict[AutopilotAddress, str] = field(default_factory=dict)
    candidates: AutopilotCandidates = field(init=False)
    signature_trouble: str = ""
    foreign: int = 0
    early_lost: int = 0
    reconnects: int = 0

    def __post_init__(self) -> None:
        self.candidates = AutopilotCandidates(self.expected_system)

    @property
    def address(self) -> AutopilotAddress:
        """Our autopilot's, once it is chosen."""
        return AutopilotAddress(self.system or 0, self.component)

    def is_of_ours(self, frame: MavlinkFrame) -> bool:
        """Whether it came from our autopilot, once that is chosen."""
        return frame.system == self.system and frame.component == self.component


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
