"""What came of one thing and what was used: where more is thrown away than used, the link is not in order."""

from __future__ import annotations

from collections import Counter

from swarmtrack.autopilot.framer import Framer
from swarmtrack.autopilot.limits import IMU_RATE_WINDOW_S, INTAKE_LEAST
from swarmtrack.autopilot.senders import SenderWatch

# Why a frame is thrown away.
DAMAGED_FRAMES = "damaged on the way"


class Intake:
    """Counts of one thing, named in the plural by `noun`, all since the start. used; thrown, and spare where nothing is
    wrong with it: by the reason.
    """

    def __init__(self, noun: str) -> None:
        self.noun = noun
        self.used = 0
        self.thrown: Counter[str] = Counter()
        self.spare: Counter[str] = Counter()
        self.fault = ""
        """Of the last window, empty where most was used."""
        self.shares: dict[str, float] = {}
        """By the reason, thrown away in the last window per thing that came."""
        self._used_before = 0
        self._thrown_before: Counter[str] = Counter()

    def throw(self, why: str, count: int = 1) -> None:
        self.thrown[why] += count

    def pass_over(self, why: str) -> None:
        """Count what is in order and still of no use."""
        self.spare[why] += 1

    def judge(self) -> None:
        """A window has ended."""
        used, self._used_before = self.used - self._used_before, self.used
        thrown, self._thrown_before = self.thrown - self._thrown_before, self.thrown.copy()
        wasted = thrown.total()
        self.shares = {why: n / (used + wasted) for why, n in thrown.items()}
        self.fault = ""
        if wasted > used and wasted >= INTAKE_LEAST:
            (why, _), *_ = thrown.most_common(1)
            self.fault = (
                f"{wasted} of {used + wasted} {self.noun} in {IMU_RATE_WINDOW_S:g} s thrown away: {why}"
            )

    def __str__(self) -> str:
        """What was thrown away, for people; empty where nothing was."""
        return self._in_words(self.thrown)

    @property
    def unused(self) -> str:
        """What was not used, for people; empty where all was."""
        return self._in_words(self.thrown + self.spare)

    def _in_words(self, counts: Counter[str]) -> str:
        return ", ".join(f"{n} {self.noun} ({why})" for why, n in counts.most_common())


class FrameLoss:
    """Judges how many frames are damaged: bytes outside of frames where numbers are missing as well. Noise between
    frames costs none of them, and what a router leaves out costs no bytes.
    """

    def __init__(self, framer: Framer, senders: SenderWatch) -> None:
        self.intake = Intake("frames")
        self._framer = framer
        self._senders = senders
        self._bytes_before = 0, 0
        self._lost_before = 0

    def judge(self) -> None:
        """A window has ended."""
        good, bad = self._framer.good_bytes, self._framer.bad_bytes
        (good_before, bad_before), self._bytes_before = self._bytes_before, (good, bad)
        came, lost = self._senders.came - self.intake.used, self._senders.lost - self._lost_before
        self._lost_before = self._senders.lost
        self.intake.used = self._senders.came
        damaged = round(came * (bad - bad_before) / max(1, good - good_before))
        self.intake.throw(DAMAGED_FRAMES, min(lost, damaged))
        self.intake.judge()
