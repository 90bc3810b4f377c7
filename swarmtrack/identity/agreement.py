"""Do the others see the same drone where this one sees it?

Theory of operation. Every drone tells on which rays it sees whom, and where it stands. Two rays to one drone must
meet ahead of both observers; a ray to the reporter itself must pass through where it says it stands. Each report is
one vote of its sender on each drone that both see, as heavy as the log odds of the sender's own belief. Whoever is
outvoted gives its hypothesis up, whoever is not keeps it: since both compare the same two numbers, one of them
yields, without a master.

Whoever lies may speak first and often, the rest once a second. So the votes on a third drone are counted only once
all had time to speak, that drone among them, whose word on its own place outweighs any single other. Votes age by our
clock, not by what a report says of the time, and a report too vague to be wrong is none.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
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
VOTE_S = 3.0  # s that a vote counts, on our clock
HEARING_S = 1.5  # s from the first vote against to the verdict: everybody reports once a second
# Vaguer than this a report agrees with everything:
VAGUE_T, VAGUE_PLACE, VAGUE_RAY = 0.5, 10.0, 0.3  # s, m, rad


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


class _Vote(NamedTuple):
    t: float
    weight: float  # log odds, negative against


class _Case:
    """The votes on one hypothesis of ours."""

    def __init__(self) -> None:
        self._votes: dict[int, _Vote] = {}
        self._disputed_since = math.inf

    def vote(self, observer: int, t: float, weight: float) -> None:
        self._votes = {i: vote for i, vote in self._votes.items() if t - vote.t < VOTE_S}
        if weight < 0.0 and all(vote.weight >= 0.0 for vote in self._votes.values()):
            self._disputed_since = t
        self._votes[observer] = _Vote(t, weight)

    def is_heard(self, t: float) -> bool:
        """Whether all had time to speak since somebody spoke against it."""
        return t - self._disputed_since >= HEARING_S

    @property
    def balance(self) -> float:
        return sum(vote.weight for vote in self._votes.values())


class Agreement:
    """Compares reports with this drone's own rays, and counts the votes."""

    def __init__(self) -> None:
        self._views: deque[OwnView] = deque()
        self._cases: dict[int, _Case] = {}
        self.agreed = 0
        self.disagreed = 0

    def remember(self, view: OwnView) -> None:
        """The rays of a scan of our own."""
        self._views.append(view)
        while self._views[0].t < view.t - MEMORY_S:
            self._views.popleft()

    def forget(self, drone_id: int) -> None:
        """Our hypothesis on this drone is given up: votes on it count no more, and it is not compared again."""
        self._cases.pop(drone_id, None)
        self._views = deque(_without(view, drone_id) for view in self._views)

    def compare(self, report: SightingReport) -> list[Disagreement]:
        """What the report says against our own hypotheses."""
        view = min(self._views, key=lambda view: abs(view.t - report.t), default=None)
        if view is None or abs(view.t - report.t) > SIMULTANEOUS + report.t_sigma:
            return []
        if report.t_sigma > VAGUE_T or report.position_sigma > VAGUE_PLACE:
            return []
        now = self._views[-1].t
        moved = SPEED * (abs(view.t - report.t) + report.t_sigma)
        reported = {seen.drone_id: seen for seen in report.sightings if seen.sigma <= VAGUE_RAY}
        found = []
        for drone_id, ours in view.sightings.items():
            if drone_id == report.observer:
                miss, distance = miss_of_point(view, ours, report, moved)
                weight = OWN_WORD
            elif drone_id in reported:
                theirs = reported[drone_id]
                miss, distance = miss_of_rays(view, ours, report, theirs, moved)
                weight = _log_odds(theirs.probability)
            else:
                continue
            case = self._cases.setdefault(drone_id, _Case())
            if distance <= GATE:
                self.agreed += 1
                case.vote(report.observer, now, weight)
                continue
            self.disagreed += 1
            case.vote(report.observer, now, -weight)
            # Ties go against us as against them: then both ask again.
            outvoted = _log_odds(ours.probability) + case.balance <= 0.0
            overruled = outvoted and (drone_id == report.observer or case.is_heard(now))
            found.append(Disagreement(report.observer, drone_id, miss, overruled))
        return found


def _without(view: OwnView, drone_id: int) -> OwnView:
    return replace(view, sightings={i: seen for i, seen in view.sightings.items() if i != drone_id})


def _log_odds(probability: float) -> float:
    p = min(max(probability, 1e-9), 1.0 - 1e-9)
    return min(max(math.log(p / (1.0 - p)), 0.0), SURE)


def stands_there(own: SightingReport, ray: Sighting, report: SightingReport) -> bool:
    """Whether our ray to a teammate leads to where it says it stands, within `FARTHEST`; a vague report is no place."""
    vague = report.t_sigma > VAGUE_T or report.position_sigma > VAGUE_PLACE
    if vague or float(np.linalg.norm(report.position - own.position)) > FARTHEST:
        return False
    moved = SPEED * (abs(own.t - report.t) + report.t_sigma)
    return miss_of_point(own, ray, report, moved)[1] <= GATE


def miss_of_point(
    view: OwnView | SightingReport, ours: Sighting, report: SightingReport, moved: float
) -> tuple[float, float]:
    """How far our ray passes by where the reporter says it stands: metres, and squared Mahalanobis distance."""
    towards = report.position - view.position
    length = max(float(np.linalg.norm(towards)), NEAREST)
    place = math.hypot(view.position_sigma, report.position_sigma, moved)
    return _off_axis(ours, towards, length, place)


def miss_of_rays(
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
