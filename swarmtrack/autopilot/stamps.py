"""Stamps of one autopilot's messages: which of them are copies, and when its clock begins again."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.boot_clock import BootClock, CopyMemory, StampStep
from swarmtrack.autopilot.framer import HEADER_V1, HEADER_V2, V2
from swarmtrack.autopilot.limits import (
    COPIES_EXPECTED_S,
    LATEST_WAY_S,
    REBOOT_SLACK_S,
    SHORTEST_REBOOT_S,
    STATE_ORDER_S,
)
from swarmtrack.autopilot.pilot_switch import RC_CHANNELS
from swarmtrack.autopilot.senders import NumberedStamps, SenderWatch, clocks_apart
from swarmtrack.mavlink_dialect import CURRENT_MODE

# Messages whose newest one alone is true.
STATE_MESSAGES = frozenset({common.MAVLINK_MSG_ID_HEARTBEAT, CURRENT_MODE, RC_CHANNELS})


class AutopilotStamps:
    """copies: messages that came again, or late by a second way, since the start.

    senders: told which frames are late, and of all clocks; wrapped: called where a counter of 32 bits begins again;
    begun_again: where the clock does, with what is known of it, its stamp [s], and how far it is apart from the one
    before [s].
    """

    def __init__(
        self,
        senders: SenderWatch,
        *,
        wrapped: Callable[[], None],
        begun_again: Callable[[StampStep, float, float], None],
    ) -> None:
        self.copies = 0
        self._senders = senders
        self._wrapped = wrapped
        self._begun_again = begun_again
        self._clocks: dict[int, BootClock] = {}
        self._numbers: dict[int, NumberedStamps] = {}
        self._numbers_before: dict[int, NumberedStamps] = {}
        """By the kind of message; the latter of the last boot."""
        self._memory = CopyMemory()
        self._copied_at = self._began_at = -math.inf
        """When the last copy came, and the last clock was believed that began again."""
        self._read: tuple[float, float] | None = None
        """When a stamp was read last, and the stamp."""
        self._states_at: dict[int, float] = {}
        """When the newest of STATE_MESSAGES were sent."""

    def step(self, t: float, message: Any, raw: float, wrap_s: float) -> tuple[StampStep | None, float]:
        """What the stamp `raw` [s] is to its kind of message, None: a copy's; and the stamp without wraps."""
        message_id = message.get_msgId()
        clock = self._clocks.get(message_id)
        reboots = clock is None and self._is_early(t, raw, wrap_s)
        if clock is None:
            clock = self._clocks[message_id] = BootClock(wrap_s)
        number = message.get_seq()
        came = self._memory.has(t, message_id, _content(message))
        numbers = self._numbers.setdefault(message_id, NumberedStamps())
        unwrapped = raw + clock.wraps * wrap_s
        delay = numbers.newest - unwrapped
        is_late = (
            (came and delay != 0.0)
            or self._fits(t, message_id, unwrapped, number)
            or (delay == -math.inf and t - self._began_at < LATEST_WAY_S and self._senders.comes_late)
        )
        is_copy = came or is_late
        self._senders.on_stamped(delay if is_late else None)
        # A simulator may repeat its last boot to the byte, but ours is not heard meanwhile.
        goes_on = is_late and self._read is not None and t - self._read[0] < SHORTEST_REBOOT_S
        if is_copy and (goes_on or not clock.may_be_reboot(t, raw)):
            self._copied(t)
            return None, unwrapped
        self._senders.compare(t, (clocks_apart, message_id), raw - t, clocks_apart)
        near = None if self._read is None else self._read[1] + t - self._read[0]
        turns = clock.turns
        step, stamp = clock.read(t, raw, near)
        step = StampStep.REBOOT if reboots else step
        if step is StampStep.OTHER and (is_copy or self._senders.comes_late):
            self._copied(t)
            return None, stamp
        if step is StampStep.NEXT:
            self._read = t, stamp
            numbers.add(stamp, number)
            if clock.turns > turns:
                self._wrapped()
        elif step in (StampStep.REBOOT, StampStep.REPLACED):
            self._begun_again(step, stamp, clock.apart)
            self._clocks, self._began_at = {message_id: clock}, t
            self._numbers, self._numbers_before = {}, self._numbers
            self._read = t, stamp
        return step, stamp

    def _fits(self, t: float, message_id: int, stamp: float, number: int) -> bool:
        """Whether a frame fits among those that came before: the first way had lost it. Later a new boot's stamps are
        those of the last one again, so there some fit by chance."""
        numbers = self._numbers.get(message_id)
        if numbers is not None and numbers.holds(stamp, number):
            return True
        before = self._numbers_before.get(message_id) if t - self._began_at < LATEST_WAY_S else None
        return before is not None and before.holds(stamp, number)

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

    def is_late(self, t: float, message: Any) -> bool:
        """Whether a message without a stamp is a copy, or tells of a state before the one that is known."""
        if self._is_copy(t, message):
            return True
        message_id = message.get_msgId()
        if message_id in STATE_MESSAGES:
            sent = t - self._senders.delay
            if sent < self._states_at.get(message_id, -math.inf) - STATE_ORDER_S:
                return True
            self._states_at[message_id] = sent
        return False

    def _is_copy(self, t: float, message: Any) -> bool:
        """Whether a message without a stamp is a copy: only while others come twice, for its content may recur."""
        content = bytes((message.get_seq(),)) + _content(message)
        came = self._memory.has(t, message.get_msgId(), content)
        if came and t - self._copied_at < COPIES_EXPECTED_S:
            self._copied(t)
            return True
        return False

    def clock(self, message_id: int) -> BootClock | None:
        """Clock of one kind of message; None before its first."""
        return self._clocks.get(message_id)

    def _copied(self, t: float) -> None:
        self.copies += 1
        self._copied_at = t


def _content(message: Any) -> bytes:
    """Its payload without the zeros at the end, which MAVLink 2 cuts off and MAVLink 1 does not."""
    frame = message.get_msgbuf()
    header = HEADER_V2 if frame[0] == V2 else HEADER_V1
    return bytes(frame[header : header + frame[1]]).rstrip(b"\0")
