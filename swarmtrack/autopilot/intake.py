"""What came of one thing and what was used: where more is thrown away than used, the link is not in order."""

from __future__ import annotations

from collections import Counter

from swarmtrack.autopilot.limits import IMU_RATE_WINDOW_S, INTAKE_LEAST


class Intake:
    """Counts of one thing, named in the plural by `noun`. used; thrown: by the reason; both since the start."""

    def __init__(self, noun: str) -> None:
        self.noun = noun
        self.used = 0
        self.thrown: Counter[str] = Counter()
        self.fault = ""
        """Of the last window, empty where most was used."""
        self.shares: dict[str, float] = {}
        """By the reason, thrown away in the last window per thing that came."""
        self._used_before = 0
        self._thrown_before: Counter[str] = Counter()

    def throw(self, why: str, count: int = 1) -> None:
        self.thrown[why] += count

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
        """What was not used, for people; empty where all was."""
        return ", ".join(f"{n} {self.noun} ({why})" for why, n in self.thrown.most_common())
