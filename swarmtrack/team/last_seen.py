"""Where a teammate was seen last, for the track in which it comes back.

A teammate that says where it is need not be remembered. Of one that says nothing, the ray on which it was seen is all
there is: it goes on along its course for a moment, and then anywhere, sooner or later.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarmtrack.messages import Array
from swarmtrack.team.priors import (
    SEEN_COURSE_S,
    SEEN_LOST_RAD,
    SEEN_LOST_RAD_S,
    SEEN_NEAREST_M,
    SEEN_RATE_APART_S,
    SEEN_TURN_RAD_S,
    SHARE_SEEN_LOST,
)
from swarmtrack.team.track_evidence import Bearing


class LastSeenRay(NamedTuple):
    """track: the one that the teammate was with probability p; bearing: its last; rate (3,) rad/s: of its direction, by
    the bearing rate_of and one before that."""

    track: int
    bearing: Bearing
    p: float
    rate: Array
    rate_of: Bearing

    @classmethod
    def after(cls, before: LastSeenRay | None, track: int, bearing: Bearing, p: float) -> LastSeenRay:
        """The next bearing; before: the last, maybe of another track."""
        if before is None or before.track != track:
            return cls(track, bearing, p, np.zeros(3), bearing)
        apart = bearing.t - before.rate_of.t
        if apart < SEEN_RATE_APART_S:
            return before._replace(bearing=bearing, p=p)
        return cls(track, bearing, p, (bearing.direction - before.rate_of.direction) / apart, bearing)

    def turned(self, forward: Array) -> LastSeenRay:
        """With the axes of the own rays turned by forward (3, 3)."""
        return self._replace(
            bearing=self.bearing._replace(direction=forward @ self.bearing.direction),
            rate=forward @ self.rate,
            rate_of=self.rate_of._replace(direction=forward @ self.rate_of.direction),
        )

    def log_density(self, new: Bearing) -> float:
        """The log density, per sr, of the first bearing of a new track that is the teammate."""
        seen = self.bearing
        age = max(new.t - seen.t, 0.0)
        direction = seen.direction - SEEN_COURSE_S * math.expm1(-age / SEEN_COURSE_S) * self.rate
        miss = new.direction - direction / np.linalg.norm(direction)
        moved = float(np.linalg.norm(new.camera - seen.camera)) / SEEN_NEAREST_M
        course = seen.variance + new.variance + moved**2 + (SEEN_TURN_RAD_S * age) ** 2
        lost = course + (SEEN_LOST_RAD + SEEN_LOST_RAD_S * age) ** 2
        miss2 = float(miss @ miss)
        on_course, off_course = _density(miss2, course), _density(miss2, lost)
        was_it = (1.0 - SHARE_SEEN_LOST) * on_course + SHARE_SEEN_LOST * off_course
        return math.log(self.p * was_it + (1.0 - self.p) / (4.0 * math.pi))


def _density(miss2: float, variance: float) -> float:
    """Per sr, of a squared miss [rad²] with a variance per axis; at most as wide as all directions."""
    variance = min(variance, 2.0)
    return math.exp(-0.5 * miss2 / variance) / (2.0 * math.pi * variance)
