"""Senders under one ID, by the numbers of their frames.

Each port of an autopilot numbers its frames from 0 to 255, again and again. So two senders under one ID are two counts
that alternate, however equal their clocks are.

Two counts alone prove no second autopilot. One that is connected by two of its ports has a count on each, and a second,
slower way repeats the count of the first. What proves it is a contradiction between two counts: another flight state,
place, attitude or clock, in turns, and for longer than a way delays. Two autopilots whose data agree stay one.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np

from swarmtrack.autopilot.limits import (
    CANDIDATE_GONE_S,
    CONTRADICTION_TURNS,
    COPY_REMEMBERED_S,
    FRAME_COUNTS_KEPT,
    LATEST_WAY_S,
    MOST_LATE,
    NUMBERED_GAP_S,
    SENDERS_APART_M,
    SENDERS_APART_RAD,
    SENDERS_ATTITUDE_GAP_S,
    SENDERS_PLACE_GAP_S,
    SEQUENCE_LOSS,
)
from swarmtrack.geometry import rotation
from swarmtrack.messages import Array

Value = TypeVar("Value")
NUMBERS = 256  # of frames, before they begin again


@dataclass(slots=True, eq=False)
class FrameCount:
    """One count of frames. number: its newest; late: how many more of its stamped frames were late than were not, up to
    MOST_LATE either way; delay [s]: of the last late one."""

    number: int
    late: int = 0
    delay: float = 0.0


class _Turn(NamedTuple):
    """What the frames of one count said of a subject at t [s]; turns: alternations in a row that contradicted."""

    frames: FrameCount
    t: float
    value: Any
    turns: int


class SenderWatch:
    """Counts of the frames under our autopilot's ID, and whether they contradict each other. All times are ours [s].

    came, lost: frames, since the start; a longer gap than SEQUENCE_LOSS is taken for another count and not in it.
    breaks: frames whose number was not the next one of any count.
    """

    def __init__(self) -> None:
        self.came = self.lost = self.breaks = 0
        self._counts: list[FrameCount] = []
        """Latest first."""
        self._turns: dict[Hashable, _Turn] = {}
        self._contradiction = ""
        self._contradicted_at = -math.inf

    def on_frame(self, number: int) -> None:
        """A frame of that number has come; what follows is about it."""
        self.came += 1
        counts = self._counts
        if counts and (number - counts[0].number) % NUMBERS == 1:
            counts[0].number = number
            return
        ahead = [(number - count.number) % NUMBERS for count in counts]
        best = min(range(len(counts)), key=lambda k: (ahead[k] or NUMBERS, k), default=None)
        self.breaks += best is None or ahead[best] != 1
        if best is not None and 0 < ahead[best] <= SEQUENCE_LOSS:
            count = counts.pop(best)
            self.lost += ahead[best] - 1
            count.number = number
        else:
            count = FrameCount(number)
        counts.insert(0, count)
        del counts[FRAME_COUNTS_KEPT:]

    def on_stamped(self, delay: float | None) -> None:
        """The frame has a stamp. delay [s]: behind the newest by the first way; None: it came by that."""
        if not self._counts:
            return
        count = self._counts[0]
        count.late = min(max(count.late + (-1 if delay is None else 1), -MOST_LATE), MOST_LATE)
        # What is of an earlier boot tells of no delay.
        if delay is not None and 0.0 < delay < COPY_REMEMBERED_S:
            count.delay = delay

    @property
    def comes_late(self) -> bool:
        """Whether the frame came by a second, slower way, as most of its count did."""
        return bool(self._counts) and self._counts[0].late > 0

    @property
    def delay(self) -> float:
        """s by which it came late; 0 by the first way."""
        return self._counts[0].delay if self.comes_late else 0.0

    def compare(
        self, t: float, subject: Hashable, value: Value, contradiction: Callable[[Value, Value], str]
    ) -> None:
        """Compare what the frame says of the subject with the other count's latest. contradiction: how an earlier value
        and a later one cannot be one autopilot's, in words, empty where they can."""
        if not self._counts:
            return
        count, last = self._counts[0], self._turns.get(subject)
        turns = 0
        if last is not None and t - last.t < CANDIDATE_GONE_S:
            turns = last.turns
            if last.frames is not count:
                both_on_time = count.late <= 0 and last.frames.late <= 0
                words = contradiction(last.value, value) if both_on_time else ""
                turns = turns + 1 if words else 0
                if turns >= CONTRADICTION_TURNS:
                    self._contradiction, self._contradicted_at = words, t
        self._turns[subject] = _Turn(count, t, value, turns)

    def contradiction(self, now: float) -> str:
        """How two autopilots under the ID differ, in words; empty where there is one."""
        return self._contradiction if now - self._contradicted_at < CANDIDATE_GONE_S else ""


class StampedPlace(NamedTuple):
    """position (3,) m and velocity (3,) m/s NED at a stamp [s]."""

    stamp: float
    position: Array
    velocity: Array


class StampedAttitude(NamedTuple):
    """attitude (3, 3) world_from_body at a stamp [s]; rate [rad/s]: at which it turns."""

    stamp: float
    attitude: Array
    rate: float


def flight_states_apart(earlier: object, later: object) -> str:
    """See `SenderWatch.compare`, of what two heartbeats say."""
    return "their flight states differ" if earlier != later else ""


def clocks_apart(earlier: float, later: float) -> str:
    """See `SenderWatch.compare`, of two stamps less their arrivals [s]: farther than a way delays."""
    apart = abs(later - earlier)
    return f"their clocks are {apart:.3g} s apart" if apart > LATEST_WAY_S else ""


def places_apart(earlier: StampedPlace, later: StampedPlace) -> str:
    """See `SenderWatch.compare`."""
    elapsed = later.stamp - earlier.stamp
    moved = later.position - earlier.position - elapsed * earlier.velocity
    apart = float(np.linalg.norm(moved))
    is_apart = abs(elapsed) < SENDERS_PLACE_GAP_S and apart > SENDERS_APART_M
    return f"their places are {apart:.3g} m apart" if is_apart else ""


def attitudes_apart(earlier: StampedAttitude, later: StampedAttitude) -> str:
    """See `SenderWatch.compare`."""
    apart = float(rotation.angle(earlier.attitude.T @ later.attitude))
    elapsed = abs(later.stamp - earlier.stamp)
    turned = elapsed * (earlier.rate + later.rate)
    is_apart = elapsed < SENDERS_ATTITUDE_GAP_S and apart > SENDERS_APART_RAD + turned
    return f"their attitudes are {math.degrees(apart):.0f}° apart" if is_apart else ""


class NumberedStamps:
    """Stamps of one kind of message and the numbers of their frames, of the last COPY_REMEMBERED_S."""

    def __init__(self) -> None:
        self._stamps: list[float] = []
        self._numbers = bytearray()

    def add(self, stamp: float, number: int) -> None:
        """stamp [s]: later than all before."""
        self._stamps.append(stamp)
        self._numbers.append(number)
        if self._stamps[len(self._stamps) // 2] < stamp - COPY_REMEMBERED_S:
            half = len(self._stamps) // 2
            del self._stamps[:half], self._numbers[:half]

    @property
    def newest(self) -> float:
        """s; -inf before the first."""
        return self._stamps[-1] if self._stamps else -math.inf

    def holds(self, stamp: float, number: int) -> bool:
        """Whether a frame of that number and stamp [s] was lost between two of these."""
        if stamp >= self.newest:
            return False
        at = bisect_left(self._stamps, stamp)
        if not 0 < at < len(self._stamps):
            return False
        (before, after), (first, last) = self._stamps[at - 1 : at + 1], self._numbers[at - 1 : at + 1]
        if stamp == after:
            return False
        # Across a longer gap they may have begun again.
        return after - before < NUMBERED_GAP_S and 0 < (number - first) % NUMBERS < (last - first) % NUMBERS
