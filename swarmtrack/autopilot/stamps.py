"""Stamps of one autopilot's messages: which of them are copies, and when its clock begins again."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from swarmtrack.autopilot.boot_clock import BootClock, CopyMemory, StampStep
from swarmtrack.autopilot.limits import COPIES_EXPECTED_S, REBOOT_SLACK_S, SHORTEST_REBOOT_S


class AutopilotStamps:
    """copies: messages that came again, since the start.

    wrapped: called where a counter of 32 bits begins again; begun_again: where the clock does, with what is known of
    it, its stamp [s], and how far it is apart from the one before [s].
    """

    def __init__(
        self, *, wrapped: Callable[[], None], begun_again: Callable[[StampStep, float, float], None]
    ) -> None:
        self.copies = 0
        self._wrapped = wrapped
        self._begun_again = begun_again
        self._clocks: dict[int, BootClock] = {}
        self._memory = CopyMemory()
        self._copied_at = -math.inf
        self._read: tuple[float, float] | None = None
        """When a stamp was read last, and the stamp."""

    def step(self, t: float, message: Any, raw: float, wrap_s: float) -> tuple[StampStep | None, float]:
        """What the stamp `raw` [s] is to its kind of message, None: a copy's; and the stamp without wraps."""
        message_id = message.get_msgId()
        clock = self._clocks.get(message_id)
        reboots = clock is None and self._is_early(t, raw, wrap_s)
        if clock is None:
            clock = self._clocks[message_id] = BootClock(wrap_s)
        if self._memory.has(t, message_id, bytes(message.get_payload())) and not clock.may_be_reboot(t, raw):
            self._copied(t)
            return None, raw + clock.wraps * wrap_s
        near = None if self._read is None else self._read[1] + t - self._read[0]
        turns = clock.turns
        step, stamp = clock.read(t, raw, near)
        step = StampStep.REBOOT if reboots else step
        if step is StampStep.NEXT:
            self._read = t, stamp
            if clock.turns > turns:
                self._wrapped()
        elif step in (StampStep.REBOOT, StampStep.REPLACED):
            self._begun_again(step, stamp, clock.apart)
            self._clocks = {message_id: clock}
            self._read = t, stamp
        return step, stamp

    def _is_early(self, t: float, raw: float, wrap_s: float) -> bool:
        """Whether a kind of message that was not there before is of another boot: an autopilot sends what it always
        does before it is asked for more."""
        if self._read is None:
            return False
        silence = t - self._read[0]
        behind = self._read[1] + silence - raw
        is_wrap = abs(math.remainder(behind, wrap_s)) <= SHORTEST_REBOOT_S
        is_young = 0.0 < raw <= silence + REBOOT_SLACK_S
        return silence >= SHORTEST_REBOOT_S < behind and is_young and not is_wrap

    def is_copy(self, t: float, message_id: int, frame: bytes) -> bool:
        """Whether a message without a stamp is a copy: only while others come twice, for its content may recur."""
        if self._memory.has(t, message_id, frame) and t - self._copied_at < COPIES_EXPECTED_S:
            self._copied(t)
            return True
        return False

    def clock(self, message_id: int) -> BootClock | None:
        """Clock of one kind of message; None before its first."""
        return self._clocks.get(message_id)

    def _copied(self, t: float) -> None:
        self.copies += 1
        self._copied_at = t
