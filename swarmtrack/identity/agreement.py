"""Do the others see the same drone where this one sees it?

Theory of operation. Every drone tells on which rays it sees whom, and where it stands. Two rays to one drone must
meet ahead of both observers; a ray to the reporter itself must pass through where it says it stands. Each report is
one vote of its sender on each drone that both see, as heavy as the log odds of the sender's own belief. Whoever is
outvoted gives its hypothesis up, whoever is not keeps it: since both compare the same two numbers, one of them
yields, without a master.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from swarmtrack.messages import Array, Sighting, SightingReport

MEMORY_S = 2.0  # s of own rays: a report arrives within it
SIMULTANEOUS = 0.3  # s between two rays that may be compared
SPEED = 1.5  # m/s: how far a drone goes in between
FRAME_SIGMA = 0.03  # rad: how well two autopilots agree on north, and cameras on their mounting
GATE = 16.0  # squared: 4 σ
NEAREST, FARTHEST = 0.3, 300.0  # m along a ray
SURE = math.log(1e3)  # the log odds that no single vote exceeds
OWN_WORD = math.log(1e4)  # of a drone on where it stands itself
VOTE_S = 3.0  # s that a vote counts


class Disagreement(NamedTuple):
    """observer and this drone see drone_id on rays that miss each other by miss_m metres."""

    observer: int
    drone_id: int
    miss_m: float
    overruled: bool


@dataclass(frozen=True, slots=True, eq=False)
class OwnView:
    """What this drone saw in one scan: position (3,) m of its camera, and its sightings by drone."""

    t: float
    position: Array
    position_sigma: float
    sightings: dict[int, Sighting]


@dataclass(frozen=True, slots=True)
class _Vote:
    t: float
    weight: float  # log odds, negative against


class Agreement:
    """Compares reports with this drone's own rays, and counts the votes."""

    def __init__(self) -> None:
        self._views: deque[OwnView] = deque()
        self._votes: dict[int, dict[int, _Vote]] = {}
        self.agreed = 0
        self.disagreed = 0

    def remember(self, view: OwnView) -> None:
        """The rays of a scan of our own."""
        self._views.append(view)
        while self._views[0].t < view.t - MEMORY_S:
            self._views.popleft()

    def forget(self, drone_id: int) -> None:
        """Our hypothesis on this drone is a new one: the votes were on the old."""
        self._votes.pop(drone_id, None)

    def compare(self, report: SightingReport) -> list[Disagreement]:
        """What the report says against our own hypotheses."""
        view = min(self._views, key=lambda view: abs(view.t - report.t), default=None)
        if view is None or abs(view.t - report.t) > SIMULTANEOUS + report.t_sigma:
            return []
        moved = SPEED * (abs(view.t - report.t) + report.t_sigma)
        reported = {sighting.drone_id: sighting for sighting in report.sightings}
        found = []
        for drone_id, ours in view.sightings.items():
            if drone_id == report.observer:
                miss, distance = _miss_of_point(view, ours, report, moved)
                weight = OWN_WORD
            elif drone_id in reported:
                theirs = reported[drone_id]
                miss, distance = _miss_of_rays(view, ours, report, theirs, moved)
                weight = _log_odds(theirs.probability)
            else:
                continue
            if distance <= GATE:
                self.agreed += 1
                self._vote(drone_id, report, weight)
                continue
            self.disagreed += 1
            self._vote(drone_id, report, -weight)
            overruled = self._is_overruled(drone_id, ours.probability, report.t)
            found.append(Disagreement(report.observer, drone_id, miss, overruled))
        return found

    def _vote(self, drone_id: int, report: SightingReport, weight: float) -> None:
        self._votes.setdefault(drone_id, {})[report.observer] = _Vote(report.t, weight)

    def _is_overruled(self, drone_id: int, probability: float, t: float) -> bool:
        """Ties go against us as against them: then both ask again."""
        votes = [vote.weight for vote in self._votes[drone_id].values() if t - vote.t < VOTE_S]
        return _log_odds(probability) + sum(votes) <= 0.0


def _log_odds(probability: float) -> float:
    p = min(max(probability, 1e-9), 1.0 - 1e-9)
    return min(max(math.log(p / (1.0 - p)), 0.0), SURE)


def _miss_of_point(
    view: OwnView, ours: Sighting, report: SightingReport, moved: float
) -> tuple[float, float]:
    """How far our ray passes by where the reporter says it stands: metres, and squared Mahalanobis distance."""
    towards = report.position - view.position
    length = max(float(np.linalg.norm(towards)), NEAREST)
    place = math.hypot(view.position_sigma, report.position_sigma, moved)
    return _off_axis(ours, towards, length, place)


def _miss_of_rays(
    view: OwnView, ours: Sighting, report: SightingReport, theirs: Sighting, moved: float
) -> tuple[float, float]:
    """How far apart two rays pass, both looked along from their observers: metres, squared Mahalanobis distance.

    They pass closest at `NEAREST` ahead of each observer or more, and at `FARTHEST` or less. Rays that errors turned
    apart pass closest right there and may yet be to one drone far off, so that is tried as well.
    """
    between = report.position - view.position
    cosine = float(ours.direction @ theirs.direction)
    a, b = float(between @ ours.direction), float(between @ theirs.direction)
    sine2 = max(1.0 - cosine**2, 1e-9)
    s = min(max((a - cosine * b) / sine2, NEAREST), FARTHEST)
    r = min(max((cosine * a - b) / sine2, NEAREST), FARTHEST)

    def miss_at(s: float, r: float) -> tuple[float, float]:
        """s [m] along our ray and r along theirs, if both see what is halfway between."""
        on_ours, on_theirs = view.position + s * ours.direction, report.position + r * theirs.direction
        middle = 0.5 * (on_ours + on_theirs)
        _, by_ours = _off_axis(ours, middle - view.position, s, math.hypot(view.position_sigma, moved))
        _, by_theirs = _off_axis(theirs, middle - report.position, r, report.position_sigma)
        return float(np.linalg.norm(on_ours - on_theirs)), by_ours + by_theirs

    miss, distance = miss_at(s, r)
    return miss, min(distance, miss_at(FARTHEST, FARTHEST)[1])


def _off_axis(ray: Sighting, towards: Array, length: float, place: float) -> tuple[float, float]:
    """By how much a ray misses the point `towards` (3,) m from its origin; place [m]: sigma of both ends."""
    along = float(ray.direction @ towards)
    across = float(np.linalg.norm(towards - along * ray.direction))
    angle = math.atan2(across, along)
    sigma = math.hypot(ray.sigma, FRAME_SIGMA, place / length)
    return across if along > 0.0 else length, (angle / sigma) ** 2
