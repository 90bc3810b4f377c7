"""Do the drones agree on who is who? Judged from what they tell, as a bystander who knows no truth.

Theory of operation. Each drone says where it stands, and on which rays it sees whom. A ray that carries the name of a
drone must pass by where that drone says it stands; if it passes by another one instead, its observer confuses the two.
A drone that does not report its position is seen in one place by all, or an observer errs. Drones speak once a second,
each at its own instants. So of each observer the newest report is judged that all others have spoken after, and their
places at that instant lie between two that they told.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from swarmtrack.identity.consensus import GATE, SPEED, OwnView, miss_of_point, miss_of_rays
from swarmtrack.messages import Array, Sighting, SightingReport

VERDICT_MEMORY_S = 4.0  # s of reports of each drone
WAIT_S = 2.0  # s that a report waits for the others to speak, before it is judged by what there is
BETWEEN_M = 0.3  # m: by how much a drone leaves the straight line between two places it told, a second apart


class JudgedSighting(NamedTuple):
    """One sighting with its verdict. called: the name it was given; whom: the drone at that position, None if
    unknown.

    right: None where there was nothing to compare it with.
    """

    observer: int
    called: int
    probability: float
    whom: int | None
    right: bool | None


@dataclass(frozen=True, slots=True)
class TeamVerdict:
    """All looks, and a sentence for each disagreement."""

    looks: tuple[JudgedSighting, ...]
    disagreements: tuple[str, ...]


class Reports:
    """Recent reports of each drone."""

    def __init__(self) -> None:
        self._reports: dict[int, deque[SightingReport]] = {}

    def add(self, report: SightingReport) -> None:
        said = self._reports.setdefault(report.observer, deque())
        if said and report.t <= said[-1].t:
            if report.boot == said[-1].boot:
                return
            said.clear()
        said.append(report)
        while said[0].t < report.t - VERDICT_MEMORY_S:
            said.popleft()

    def remove(self, drone_id: int) -> None:
        self._reports.pop(drone_id, None)

    def newest(self, drone_id: int) -> SightingReport | None:
        said = self._reports.get(drone_id)
        return said[-1] if said else None

    def evaluate(self, alive: Iterable[int], now: float) -> TeamVerdict:
        """Verdict on the live drones."""
        lives = frozenset(alive)
        there = [drone_id for drone_id in lives if drone_id in self._reports]
        all_spoke = min((self._reports[i][-1].t for i in there), default=now)
        judged = {i: _last_before(self._reports[i], max(all_spoke, now - WAIT_S)) for i in there}
        looks: list[JudgedSighting] = []
        sentences: list[str] = []
        for report in judged.values():
            for sighting in report.sightings:
                look = self._judge(report, sighting, judged, lives)
                looks.append(look)
                if look.right is False:
                    sentences.append(_sentence(look))
        return TeamVerdict(tuple(looks), tuple(sentences))

    def _judge(
        self,
        report: SightingReport,
        sighting: Sighting,
        judged: Mapping[int, SightingReport],
        lives: frozenset[int],
    ) -> JudgedSighting:
        observer, called = report.observer, sighting.drone_id
        if called in judged and self._miss(report, sighting, called) <= GATE:
            return JudgedSighting(observer, called, sighting.probability, called, True)
        if called in lives and called not in judged:  # it has not told yet where it stands
            return JudgedSighting(observer, called, sighting.probability, None, None)
        whom = self._who_stands_there(report, sighting, judged)
        right = False if called in judged or whom is not None else _seen_there(report, sighting, judged)
        return JudgedSighting(observer, called, sighting.probability, whom, right)

    def _who_stands_there(
        self, report: SightingReport, sighting: Sighting, judged: Mapping[int, SightingReport]
    ) -> int | None:
        """The nearest to a ray with another's name, of those whom the observer does not rightly see elsewhere."""
        named = {other.drone_id: other for other in report.sightings}
        misses = {
            drone_id: self._miss(report, sighting, drone_id)
            for drone_id in judged
            if drone_id not in (report.observer, sighting.drone_id)
            and not (drone_id in named and self._miss(report, named[drone_id], drone_id) <= GATE)
        }
        nearest = min(misses, key=lambda drone_id: misses[drone_id], default=None)
        return nearest if nearest is not None and misses[nearest] <= GATE else None

    def _miss(self, report: SightingReport, sighting: Sighting, drone_id: int) -> float:
        """Squared Mahalanobis distance of a ray from where a drone says it stood at that instant."""
        place, sigma = self._place(drone_id, report.t)
        told = self._reports[drone_id][-1]
        there = SightingReport(
            told.observer,
            told.boot,
            told.sequence,
            report.t,
            told.t_sigma,
            place,
            told.position_sigma,
            (),
            (),
        )
        return miss_of_point(_view(report), sighting, there, sigma + SPEED * (report.t_sigma + told.t_sigma))[
            1
        ]

    def _place(self, drone_id: int, t: float) -> tuple[Array, float]:
        """Where a drone stood at t by what it said, and how far it may have been off that [m]."""
        said = self._reports[drone_id]
        for before, after in pairwise(said):
            if before.t <= t <= after.t:
                share = (t - before.t) / max(after.t - before.t, 1e-9)
                return before.position + share * (after.position - before.position), BETWEEN_M
        closest = min(said, key=lambda report: abs(report.t - t))
        return closest.position, SPEED * abs(closest.t - t)


def _seen_there(
    report: SightingReport, sighting: Sighting, judged: Mapping[int, SightingReport]
) -> bool | None:
    """Whether the others see this drone, which does not speak, in the same place; None where nobody else does."""
    votes = [
        miss_of_rays(_view(report), sighting, other, theirs, SPEED * abs(other.t - report.t))[1] <= GATE
        for observer, other in judged.items()
        if observer != report.observer
        for theirs in other.sightings
        if theirs.drone_id == sighting.drone_id
    ]
    return all(votes) if votes else None


def _view(report: SightingReport) -> OwnView:
    return OwnView(
        report.t, report.position, report.position_sigma, {s.drone_id: s for s in report.sightings}
    )


def _last_before(said: deque[SightingReport], t: float) -> SightingReport:
    """The newest at or before t; the oldest where all came later."""
    return next((report for report in reversed(said) if report.t <= t + 1e-9), said[0])


def _sentence(look: JudgedSighting) -> str:
    if look.whom is None:
        return f"drone {look.observer} sees drone {look.called} where it is not"
    return f"drone {look.observer} calls drone {look.whom} drone {look.called}"
