"""Claims by Remote ID: which stranger each is of, and which are false.

A claim fits a stranger that is where it claims to be, for a while. It is false where that stranger flies elsewhere, or
where a camera looks at the claimed place and shows nothing there. A claim of a place that no camera sees is neither.
Whether a claim is of a teammate, whose places are known, is not judged here.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from swarmtrack.messages import Array, LocatedStranger, RemoteIdClaim
from swarmtrack.strangers.mates import MatePlace
from swarmtrack.strangers.priors import (
    CLAIM_ACCELERATION_M_S2,
    CLAIM_FALSE_AFTER_S,
    CLAIM_FITS_AFTER_S,
    CLAIM_GATE,
    CLAIM_LASTS_S,
    CLAIM_LEAST_SIGMA_M,
    MOST_CLAIMS,
)


class ClaimedPlace(NamedTuple):
    """Where a claim puts its drone by now: position (3,) m, sigma m per level axis, vertical m."""

    position: Array
    sigma: float
    vertical: float

    @property
    def cov(self) -> Array:
        return np.diag([self.sigma**2, self.sigma**2, self.vertical**2])


class RemoteIdNews(NamedTuple):
    """The claim of uas_id fits the stranger of that number, or is false (None); off_m: by how much it is off, level, or
    NaN where nothing is there at all."""

    t: float
    uas_id: str
    number: int | None
    off_m: float


@dataclass(slots=True)
class _Claim:
    newest: RemoteIdClaim
    number: int | None = None
    fits: int | None = None
    """The stranger that it fits, perhaps not for long enough, since a time [s]."""
    since: float = math.inf
    wrong_since: float = math.inf
    reported: int | None = 0
    """Which stranger it was last reported to be; None: false; 0: nothing was reported."""

    def at(self, t: float) -> ClaimedPlace:
        age = max(t - self.newest.t, 0.0)
        flown = 0.5 * CLAIM_ACCELERATION_M_S2 * age**2
        return ClaimedPlace(
            self.newest.position + age * self.newest.velocity,
            math.hypot(max(self.newest.position_sigma, CLAIM_LEAST_SIGMA_M), flown),
            math.hypot(max(self.newest.vertical_sigma, CLAIM_LEAST_SIGMA_M), flown),
        )


class RemoteIds:
    """Takes claims, and judges them after each scan."""

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        self._claims: dict[str, _Claim] = {}

    def __bool__(self) -> bool:
        """Whether there are claims."""
        return bool(self._claims)

    def hear(self, claim: RemoteIdClaim) -> None:
        """A claim as the autopilot has received it."""
        known = self._claims.get(claim.uas_id)
        if known is None and len(self._claims) >= MOST_CLAIMS:
            self.counters["remote_ids_crowded"] += 1
        elif known is None:
            self._claims[claim.uas_id] = _Claim(claim)
        elif claim.t > known.newest.t:
            known.newest = claim

    @property
    def of_number(self) -> Mapping[int, str]:
        """By stranger, which claim fits it."""
        return {one.number: uas_id for uas_id, one in self._claims.items() if one.number is not None}

    def judge(
        self,
        t: float,
        located: Iterable[LocatedStranger],
        mates: Iterable[MatePlace],
        is_empty: Callable[[ClaimedPlace], bool],
    ) -> list[RemoteIdNews]:
        """What is news by the strangers and teammates at t; is_empty: whether the camera shows nothing there."""
        self._claims = {id: one for id, one in self._claims.items() if t - one.newest.t < CLAIM_LASTS_S}
        strangers, teammates = tuple(located), tuple(mates)
        news = []
        for uas_id, one in self._claims.items():
            place = one.at(t)
            if any(
                _distance2(place, mate.position, mate.sigma**2 * np.eye(3)) < CLAIM_GATE for mate in teammates
            ):
                one.number, one.since, one.wrong_since = None, math.inf, math.inf
                continue
            off = self._compare(one, place, strangers, is_empty, t)
            verdict: int | None = one.number or 0
            if t - one.wrong_since >= CLAIM_FALSE_AFTER_S:
                one.number = verdict = None
            if verdict not in (0, one.reported):
                one.reported = verdict
                news.append(RemoteIdNews(t, uas_id, verdict, off))
        return news

    def _compare(
        self,
        one: _Claim,
        place: ClaimedPlace,
        strangers: tuple[LocatedStranger, ...],
        is_empty: Callable[[ClaimedPlace], bool],
        t: float,
    ) -> float:
        """Since when a claim fits or is wrong; returns by how much it is off, m, level."""
        distances = {s.number: _distance2(place, s.position, s.cov[:3, :3]) for s in strangers}
        off = {s.number: float(np.linalg.norm((s.position - place.position)[:2])) for s in strangers}
        best = min(distances, key=lambda n: distances[n], default=0)
        if best and distances[best] < CLAIM_GATE:
            if one.fits != best:
                one.fits, one.since = best, t
            if t - one.since >= CLAIM_FITS_AFTER_S:
                one.number = best
            one.wrong_since = math.inf
            return off[best]
        one.fits, one.since = None, math.inf
        left = one.number is not None and one.number in distances
        if left or is_empty(place):
            one.wrong_since = min(one.wrong_since, t)
        else:
            one.wrong_since = math.inf
        return off[one.number] if left and one.number is not None else math.nan


def _distance2(place: ClaimedPlace, position: Array, cov: Array) -> float:
    """Squared Mahalanobis distance of a claimed place from another of covariance (3, 3) m²."""
    r = position - place.position
    return float(r @ np.linalg.solve(cov + place.cov, r))
