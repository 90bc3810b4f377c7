"""What the judge needs of a flight in formation: who had whom in view, who held how often, where all truly were."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping

import numpy as np

from swarmtrack.lab.scenarios.scenario import Scenario
from swarmtrack.lab.score.formation_score import (
    FormationScore,
    after_it_vanished,
    formation_score,
    nearest_pair,
    slot_errors,
)
from swarmtrack.lab.score.swarm_score import SCORE_HZ
from swarmtrack.lab.world.followed import NotTold
from swarmtrack.lab.world.star import TeamSlots
from swarmtrack.messages import Array
from swarmtrack.wire.health import HealthMessage

# s that a stranger is in view of a follower before that has to keep clear of it.
WATCHED_SEEN_S = 1.0


class FormationWatch:
    """Told of each judged view; asked for the score after landing."""

    def __init__(self, scenario: Scenario, formation: TeamSlots) -> None:
        self._world, self._formation = scenario.world, formation
        self._strangers = scenario.strangers
        self._leader_seen: dict[int, float] = {}
        self._glimpses: dict[tuple[int, int], int] = {}
        self._known_from: dict[tuple[int, int], float] = {}

    def saw(self, observer: int, t: float, in_view: Collection[int]) -> None:
        """Whom an observer truly had in view at world time t [s], ten times per second."""
        if observer == self._formation.leader:
            return
        if self._formation.leader in in_view:
            self._leader_seen[observer] = t
        for stranger in self._strangers & set(in_view):
            pair = observer, stranger
            self._glimpses[pair] = self._glimpses.get(pair, 0) + 1
            if self._glimpses[pair] > WATCHED_SEEN_S * SCORE_HZ:
                self._known_from.setdefault(pair, t)

    def score(
        self,
        health: Mapping[int, Iterable[tuple[float, HealthMessage]]],
        seconds: float,
        *,
        counts_from: float = 0.0,
    ) -> FormationScore:
        """health: by drone, with the world time at which it was heard. seconds: world time of the end; counts_from:
        that from which the beginning of the judgement counts."""
        formation = self._formation
        begins = counts_from + formation.judged_from_s
        times, places = self._flown(seconds)
        team = [formation.leader, *formation.followers]
        positions = np.stack([places[drone_id] for drone_id in team], axis=1)
        ends = min(formation.leader_leaves_s, seconds)
        slots = np.array([formation.slots[drone_id] for drone_id in team])
        errors = slot_errors(times, positions, slots, begins, ends)
        met = [
            nearest_pair(np.stack([places[observer], places[stranger]], axis=1)[times >= since])
            for (observer, stranger), since in self._known_from.items()
        ]
        holds = (_holds(health.get(d, ()), begins, ends) for d in formation.followers)
        gone = None
        if math.isfinite(formation.leader_leaves_s):
            left = max([formation.leader_leaves_s, *self._leader_seen.values()])
            gone = after_it_vanished(times, positions[:, 1:], left)
        errors = errors._replace(nearest=min([errors.nearest, *met]))
        return formation_score([errors], holds=sum(holds), gone=gone)

    def _flown(self, seconds: float) -> tuple[Array, dict[int, Array]]:
        """Times (m,) [s] at which all were told, and by drone positions (m, 3)."""
        drones, times = list(self._world.drones), []
        rows = []
        for k in range(int(seconds * SCORE_HZ) + 1):
            try:
                rows.append([self._world.drones[drone_id].position(k / SCORE_HZ) for drone_id in drones])
            except NotTold:
                continue
            times.append(k / SCORE_HZ)
        positions = np.array(rows).reshape(len(rows), len(drones), 3)
        return np.array(times), {drone_id: positions[:, k] for k, drone_id in enumerate(drones)}


def _holds(health: Iterable[tuple[float, HealthMessage]], begins: float, ends: float) -> int:
    """How often it said that it holds: a counter that begins at 0 with each life of the process."""
    first: dict[str, float] = {}
    last: dict[str, float] = {}
    for t, message in health:
        for link in message.links:
            if link.name == "formation" and t < ends:
                count = link.counters.get("holds", 0.0)
                last[message.boot] = count
                if t < begins:
                    first[message.boot] = count
    return int(sum(count - first.get(boot, 0.0) for boot, count in last.items()))
