"""Whether the position that an autopilot states is its own, or rests on the one that it was fed.

A fed autopilot states what its filter makes of our place. Taken for a measurement, that would make the place surer with
each turn. So from the first fed place on, and until some time after the last, it has no position of its own. Nor has
an ArduPilot whose pilot has selected a further set of sources: it says so in a text.
"""

from __future__ import annotations

import math
import re
from typing import Any

from swarmtrack.autopilot.global_position import FIX_3D
from swarmtrack.autopilot.limits import FED_FIX_BACK_S, FED_POSITION_RESTS_S

SOURCE_SET = re.compile(r"EKF Source Set (\d)")
FIRST_SET = 1


class FedPosition:
    """Whether the position is its own, by what is fed and said of receiver and sources. Times are ours [s]."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """The autopilot has rebooted."""
        self._fed_at, self._begun_at = -math.inf, math.inf
        self._set, self._set_at = FIRST_SET, -math.inf
        self._fix_since = math.inf

    def on_fix(self, t: float, m: Any) -> None:
        """GPS_RAW_INT has come."""
        self._fix_since = min(self._fix_since, t) if m.fix_type >= FIX_3D else math.inf

    def on_text(self, t: float, m: Any) -> None:
        """STATUSTEXT has come."""
        if (said := SOURCE_SET.search(m.text)) is not None:
            self._set, self._set_at = int(said[1]), t

    def feed(self, t: float) -> None:
        """A place is sent."""
        self._fed_at, self._begun_at = t, min(self._begun_at, t)

    def end(self) -> None:
        """No place is needed any more."""
        self._begun_at = math.inf

    def rests(self, t: float) -> bool:
        """Whether the autopilot's position at t rests on ours, or may."""
        return self._set != FIRST_SET or t - self._fed_at <= FED_POSITION_RESTS_S

    def is_own_again(self, t: float) -> bool:
        """Whether the receiver has had a fix again for long enough since the feed began, and counts."""
        back_at = max(self._fix_since, self._set_at)
        is_back = self._begun_at <= back_at <= t - FED_FIX_BACK_S and self._fix_since < math.inf
        return is_back and self._set == FIRST_SET

    def is_coming_back(self, t: float) -> bool:
        """Whether the receiver has a fix again since the feed began."""
        return self._begun_at <= self._fix_since <= t
