"""Heights of two drones that stand on the ground, by their receivers: those of one field differ by little.

A receiver that reports heights above the ellipsoid where the autopilot expects those above the sea is wrong by the
geoid's height, tens of metres and the same everywhere on the field. So it does not show in one drone, but in two
of which one is right. Level offsets have other causes, and a drone sees them (identity, relative).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from swarmtrack.messages import Announcement, Array
from swarmtrack.motion.priors import (
    GROUND_HEIGHT_LEAST_M,
    GROUND_HEIGHT_SIGMAS,
    GROUND_STEEPEST_SLOPE,
)


class GroundHeightNews(NamedTuple):
    """A teammate's announced place is above_m [m] above ours (negative: below) while we stand on the ground."""

    t: float
    drone_id: int
    above_m: float


class GroundHeights:
    """Compares the first announcement of each life of a teammate with the own place on the ground."""

    def __init__(self) -> None:
        self._waiting: dict[int, Announcement] = {}
        self._compared: dict[int, str] = {}

    @property
    def has_waiting(self) -> bool:
        """Whether an announcement waits to be compared."""
        return bool(self._waiting)

    def hear(self, announcement: Announcement) -> None:
        """A teammate has announced itself. Later announcements of the same boot may be of its flight."""
        drone, boot = announcement.drone_id, announcement.boot
        known = self._waiting.get(drone)
        if self._compared.get(drone) != boot and (known is None or known.boot != boot):
            self._waiting[drone] = announcement

    def stand(self, t: float, position: Array, cov: Array) -> list[GroundHeightNews]:
        """This drone stands on the ground at t, at (3,) m in the team frame, cov (3, 3). Returns the teammates whose
        heights no ground explains."""
        heard, self._waiting = self._waiting, {}
        self._compared |= {drone: announcement.boot for drone, announcement in heard.items()}
        return [
            GroundHeightNews(t, drone, above)
            for drone, announcement in heard.items()
            if (above := _unexplained(announcement, position, cov))
        ]


def _unexplained(announcement: Announcement, position: Array, cov: Array) -> float:
    """m by which it is announced above the own place; 0 where the receivers' errors or a slope explain that."""
    north, east, down = (announcement.position - position).tolist()
    sigma = math.sqrt(float(announcement.position_cov[2, 2]) + float(cov[2, 2]))
    explained = GROUND_HEIGHT_SIGMAS * sigma + GROUND_STEEPEST_SLOPE * math.hypot(north, east)
    return -down if abs(down) > max(GROUND_HEIGHT_LEAST_M, explained) else 0.0
