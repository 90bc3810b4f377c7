"""The teammates whose reports a drone of a large team receives.

Names need reports of the teammates that may be in view: those within sight, and whoever else is near the direction of a
track. Besides, the nearest are received however far they are: one of them comes into view next. Where all others are,
their announcements say, and a drone of a large team announces itself again when it has flown `ANNOUNCED_AGAIN_M`. A
drone that would receive most of its team receives all of it: a subscription to each of many costs more than the reports
of a few others.
"""

from __future__ import annotations

import math
from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry.covariance import worst_sigma
from swarmtrack.identity.teammates import Teammates
from swarmtrack.messages import Array

# Teammates.
NEAREST_RECEIVED = 20
# A drone that would receive so large a share of its team receives all.
MOST_RECEIVED = 0.5
# A drone may be so far from where it announced itself, m.
ANNOUNCED_AGAIN_M = 15.0
# A teammate that is not received may be so far from where it was last known to be, m.
_STALE_M = 2.0 * ANNOUNCED_AGAIN_M
# Whoever is received stays so until it is that much farther away than others that are not.
_STAYS_M = 10.0
# Directions of tracks and teammates may be so far apart: the errors of headings and starts.
_ALONG_RAD = math.radians(10.0)
# px: a detection may be of so small a box.
_SMALLEST_SEEN_PX = 5.0
# An announcement that knows less, m on its worst axis, is no place.
_VAGUE_M = 10.0


class Neighbours:
    """Chooses them anew at each call of `of`."""

    def __init__(self, focal_px: Collection[float], width_m: float) -> None:
        """focal_px: of the cameras, pixels per radian; width_m: of a teammate's box."""
        self._sight_m = width_m * max(focal_px, default=0.0) / _SMALLEST_SEEN_PX + _STALE_M
        self._received: frozenset[int] = frozenset()

    def of(
        self, place: Array | None, seen: Array, teammates: Teammates, needed: Collection[int]
    ) -> frozenset[int] | None:
        """Those of a drone at place (3,) m, None while it does not know; seen (n, 3): directions of its tracks, in team
        axes; needed: in any case. None: all."""
        known, self._received, before = teammates.announced, frozenset(), self._received
        if place is None:
            return None
        somewhere = {drone for drone, said in known.items() if worst_sigma(said.position_cov) > _VAGUE_M}
        placed = sorted(known.keys() - somewhere)
        places = [teammates.whereabouts.latest(drone).position for drone in placed]
        away = np.array(places).reshape(-1, 3) - place
        distance = np.linalg.norm(away, axis=1)
        order = distance - _STAYS_M * np.isin(placed, list(before))
        may_be_seen = (order < self._sight_m) | _is_along(away, distance, seen)
        may_be_seen[np.argsort(order, kind="stable")[:NEAREST_RECEIVED]] = True
        chosen = {drone for drone, is_chosen in zip(placed, may_be_seen.tolist(), strict=True) if is_chosen}
        received = frozenset({*chosen, *somewhere, *teammates.unplaced, *needed})
        if len(received) >= MOST_RECEIVED * len(known):
            return None
        self._received = received
        return received


def _is_along(away: Array, distance: Array, seen: Array) -> NDArray[np.bool_]:
    """(m,): teammates away (m, 3) m, at a distance (m,), that may be one of the tracks seen (n, 3)."""
    if not len(seen):
        return np.zeros(len(away), bool)
    to_nearest = np.arccos(np.clip((away @ seen.T).max(axis=1) / np.maximum(distance, 1e-3), -1.0, 1.0))
    return np.asarray(to_nearest < _ALONG_RAD + np.arctan2(_STALE_M, distance))


def is_far(place: Array, announced: Array | None) -> bool:
    """Whether a drone of a large team at place (3,) m is too far from where it announced itself, None: it has not."""
    return announced is not None and float(np.linalg.norm(place - announced)) > ANNOUNCED_AGAIN_M
