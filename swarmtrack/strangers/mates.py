"""What teammates' rays to each other show of their headings and places, and where they state that they are.

A report states where its observer was and on which rays it saw teammates. Once the next report of such a teammate has
come, its place at the time of the ray is known, and the ray shows by how much the observer is turned.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from swarmtrack.messages import Array, Sighting, SightingReport
from swarmtrack.strangers.priors import (
    MATE_BEND_M_S2,
    MATE_BRACKET_S,
    MATE_CENTRE_SIGMA_M,
    MATE_LEAST_PROBABILITY,
    MATE_NEAREST_M,
    MATE_SIGHT_PERIOD_S,
    MATE_SPEED_M_S,
    MATE_TURNED_SIGHTS_KEPT,
    MOST_MATES,
    RAY_WHITE_RAD,
    VAGUE_OBSERVER_M,
)


class MateSight(NamedTuple):
    """At t [s] an observer, stated to be at camera (3,) m, saw a teammate in the direction (3,); sigma rad, of what
    does not last; that stated to be at place (3,) m. The sigmas [m] are of what both state."""

    t: float
    observer: int
    camera: Array
    camera_sigma: float
    direction: Array
    sigma: float
    mate: int
    place: Array
    place_sigma: float


class MatePlace(NamedTuple):
    """Where a drone states that it was at t [s]: position (3,) m, sigma m per axis."""

    t: float
    position: Array
    sigma: float


@dataclass(slots=True)
class _Mate:
    last: SightingReport
    awaited: deque[tuple[SightingReport, Sighting]] = field(
        default_factory=lambda: deque(maxlen=MATE_TURNED_SIGHTS_KEPT)
    )
    """Rays to it that are newer than its last report."""
    sighted: dict[int, float] = field(default_factory=dict)
    """By observer, when its last ray was taken, s: what lasts of its error is the same in the next ones."""


class MateSights:
    """Grows by every report, those of this drone as well."""

    def __init__(self) -> None:
        self._mates: dict[int, _Mate] = {}
        self._sights: deque[MateSight] = deque(maxlen=MATE_TURNED_SIGHTS_KEPT)
        self._news: deque[MateSight] = deque(maxlen=MATE_TURNED_SIGHTS_KEPT)

    def hear(self, report: SightingReport) -> None:
        """A report of any drone; one that is vague or not newer is ignored."""
        mate = self._mates.get(report.observer)
        vague = report.position_sigma > VAGUE_OBSERVER_M
        if vague or (mate is None and len(self._mates) >= MOST_MATES) or (mate and report.t <= mate.last.t):
            return
        if mate is not None:
            self._news += [sight for one in mate.awaited if (sight := _sight(*one, mate.last, report))]
            mate.awaited.clear()
            mate.last = report
        else:
            self._mates[report.observer] = _Mate(report)
        for seen in report.sightings:
            target = self._mates.get(seen.drone_id)
            if target is None or seen.probability < MATE_LEAST_PROBABILITY:
                continue
            if report.t - target.sighted.get(report.observer, -math.inf) >= MATE_SIGHT_PERIOD_S:
                target.sighted[report.observer] = report.t
                target.awaited.append((report, seen))

    def take(self) -> list[MateSight]:
        """What is known since the last call."""
        news = list(self._news)
        self._news.clear()
        self._sights += news
        return news

    @property
    def kept(self) -> Iterator[MateSight]:
        """What `take` has returned of late."""
        return iter(self._sights)

    def places(self, t: float) -> dict[int, MatePlace]:
        """By drone, where it states that it is; as vague as it may have flown since."""
        return {
            drone: MatePlace(
                mate.last.t,
                mate.last.position,
                math.hypot(mate.last.position_sigma, MATE_SPEED_M_S * (t - mate.last.t)),
            )
            for drone, mate in self._mates.items()
            if abs(t - mate.last.t) < MATE_BRACKET_S
        }

    def forget(self, drone_id: int) -> None:
        """What was stated in its name counts no more."""
        self._mates.pop(drone_id, None)
        for sights in (self._news, self._sights):
            kept = [sight for sight in sights if drone_id not in (sight.observer, sight.mate)]
            sights.clear()
            sights.extend(kept)


def _sight(
    said: SightingReport, seen: Sighting, before: SightingReport, after: SightingReport
) -> MateSight | None:
    """A ray with the place of its target between two reports of that; None where these are too far apart."""
    gap = after.t - before.t
    if not before.t <= said.t <= after.t or not 0.0 < gap < MATE_BRACKET_S:
        return None
    share = (said.t - before.t) / gap
    place = (1.0 - share) * before.position + share * after.position
    distance = float(np.linalg.norm(place - said.position))
    if distance < MATE_NEAREST_M:
        return None
    off = math.hypot(MATE_CENTRE_SIGMA_M, MATE_BEND_M_S2 * gap**2 / 8.0)
    return MateSight(
        said.t,
        said.observer,
        said.position,
        said.position_sigma,
        seen.direction,
        math.hypot(RAY_WHITE_RAD, off / distance),
        seen.drone_id,
        place,
        after.position_sigma,
    )
