"""What teammates see of each other and of this drone: whether each of them is where it says.

A report has rays to those that its observer has named. A ray between a teammate and a drone at a known place is a
bearing of one from the other, and says where the teammate's start may be as own bearings do (`evidence.py`). But an
observer may have named the wrong drone, and is likeliest to name one that is where another should be.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarmtrack.messages import Array, Sighting
from swarmtrack.team.evidence import LEVEL, design, fading
from swarmtrack.team.log_sums import log_sum
from swarmtrack.team.own_errors import OwnErrors, PathTurn
from swarmtrack.team.priors import (
    NEAREST_BOX_M,
    P_RAYS_ANYWHERE,
    P_RAYS_MISNAMED,
    TEAMMATE_HEADING_SIGMA_RAD,
)

# Of what one observer reports to see.
_LOG_RIGHT = math.log1p(-P_RAYS_MISNAMED - P_RAYS_ANYWHERE)
_LOG_MISNAMED, _LOG_OTHER = math.log(P_RAYS_MISNAMED), math.log(P_RAYS_ANYWHERE)


class TeammateRay(NamedTuple):
    """A ray between a teammate and another drone at t [s], either way, direction (3,). place (3,) m: where the teammate
    says that it is, from where it says that it started; other (3,) m: where the other is, from where this drone says
    that it started; away [m]: from each other; variance [m²]: of how far the ray may miss."""

    t: float
    direction: Array
    place: Array
    other: Array
    away: float
    variance: float

    @classmethod
    def between(
        cls,
        starts: tuple[Array, Array],
        places: tuple[Array, Array],
        sighting: Sighting,
        t: float,
        sigma_m: float,
    ) -> TeammateRay:
        """starts: of the teammate and of this drone; places: of the teammate, and of the other drone; (3,) m, team
        frame, within sigma_m per axis."""
        away = max(math.dist(*places), NEAREST_BOX_M)
        variance = (sighting.sigma**2 + TEAMMATE_HEADING_SIGMA_RAD**2) * away**2 + sigma_m**2
        return cls(t, sighting.direction, places[0] - starts[0], places[1] - starts[1], away, variance)

    def by_own_errors(self, teammate: int, errors: OwnErrors) -> Array:
        """(k,): log likelihood ratio, of each component and of the first, that it is a ray to this drone."""
        turn = np.where(errors.path == PathTurn.OWN, errors.heading, 0.0)
        (north, east, down), c, s = self.other, np.cos(turn), np.sin(turn)
        way = np.stack([c * north - s * east, s * north + c * east, np.full(len(turn), down)], axis=1)
        towards = errors.stands_at(errors.own) + errors.shift + way - errors.stands_at(teammate) - self.place
        across = towards - (towards @ self.direction)[:, None] * self.direction
        variance = self.variance + errors.spread**2
        log = -np.log(variance) - 0.5 * (across**2).sum(axis=1) / variance
        # Who takes another for this drone, or lies, may name one that is anywhere.
        found = np.logaddexp(_LOG_RIGHT + log, _LOG_MISNAMED + log.max())
        return np.asarray(found - found[0])


class TeammateRays:
    """The last ray between one teammate and each other drone, either way."""

    def __init__(self) -> None:
        self._rays: dict[tuple[int, int], TeammateRay] = {}
        """By observer, and whom it sees."""

    def __bool__(self) -> bool:
        return bool(self._rays)

    def add(self, observer: int, seen: int, ray: TeammateRay) -> None:
        """observer sees seen along this ray."""
        self._rays[observer, seen] = ray

    def forget(self, drone_id: int | None = None) -> None:
        """Those to and from that drone, which has another frame; or all."""
        self._rays = {
            pair: ray for pair, ray in self._rays.items() if drone_id is not None and drone_id not in pair
        }

    def seen_by_it(self, t: float, teammate: int, errors: OwnErrors) -> Array | None:
        """(k,): what it says at t of the own errors how that teammate sees this drone, log; None: it does not."""
        ray = self._rays.get((teammate, errors.own))
        return None if ray is None else fading(max(t - ray.t, 0.0)) * ray.by_own_errors(teammate, errors)

    def cases(self, t: float) -> RayCases:
        """What they say at t."""
        rays = list(self._rays.values())
        _, directions, places, others, away, variance = (np.array(each) for each in zip(*rays, strict=True))
        G = design(places, np.zeros(3))
        G[:, :, LEVEL - 1] -= others
        across = G - directions[:, :, None] * (directions[:, None] @ G)
        left = np.array([fading(max(t - ray.t, 0.0)) for ray in rays])
        M = across.swapaxes(1, 2) @ across * (left / variance)[:, None, None]
        # Of one that leads to its target, over one to anywhere.
        log_density = left * np.log(2.0 * away**2 / variance)
        observers = np.array([observer for observer, _ in self._rays])
        by_observer = np.unique(observers)[:, None] == observers
        return RayCases(np.tensordot(by_observer.astype(float), M, axes=1), by_observer @ log_density)


class RayCases:
    """The cases that all observers name the right drones, all but one, and none.

    matrices (n, 8, 8): the rays of each observer alone, and of those that are right by case.
    """

    def __init__(self, M: Array, log_density: Array) -> None:
        """M (o, 8, 8): of each observer's rays, by `evidence.py`; log_density (o,): of rays that lead to their targets,
        over rays to anywhere."""
        n = len(M)
        but_one = ~np.eye(n, dtype=bool) if n > 1 else np.ones((0, 1), bool)
        self._right = np.concatenate([np.ones((1, n), bool), but_one, np.zeros((1, n), bool)])
        self._log_density = log_density
        self.matrices = np.concatenate([M, np.tensordot(self._right.astype(float), M, axes=1)])

    def p_near(self, log_evidence: Array, log_shares: Array) -> Array:
        """(2,): the probability that rays show the teammate where it says that it is, and that they do with its start
        off by the least. log_evidence (c, n): of `matrices`, by how far the start is off, first not at all; log_shares
        (c,): prior of that."""
        alone, by_case = np.split(log_evidence, [len(self._log_density)], axis=1)
        right = _LOG_RIGHT + self._log_density
        wrong = np.logaddexp(_LOG_MISNAMED + self._log_density + alone[0], _LOG_OTHER)
        log_p = np.where(self._right, right, wrong).sum(axis=1)
        by_start = log_sum(log_p[:-1] + by_case[:, :-1], 1) + log_shares
        every = np.append(by_start, log_p[-1])
        return np.asarray(np.exp(by_start[:2] - np.logaddexp.reduce(every)))
