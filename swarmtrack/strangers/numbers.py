"""Which stranger each of this drone's tracks of strangers is: the numbers on which a team agrees.

Theory of operation. A number is 100 · the ID of the observer that claimed it + that observer's own count, so that two
observers never claim the same. Only the observer of a track decides which stranger it is, and each by one rule, so that
nothing has to be negotiated: a track whose rays fit a stranger for a while takes its number, of several the one that
fits clearly best; where none fits, it claims a number. A track that has a number gives it up for a lower one that fits
as well. So the lowest claim wins. Two tracks of one observer are never the same stranger.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field

from swarmtrack.strangers.priors import (
    CLAIMS_AFTER_S,
    CLAIMS_AT_LAST_S,
    FITS_FOR_S,
    FITS_LEAST_RAYS,
    FITS_MARGIN,
    FITS_MOST_COST,
    GIVES_WAY_AFTER_S,
    MISFITS_FOR_S,
    NUMBERS_OF_OBSERVER,
    RAY_GATE,
)
from swarmtrack.strangers.ray_filter import RayFit


@dataclass(slots=True)
class _Fits:
    """Of a track with a stranger, without a break since a time [s]."""

    since: float
    rays: int = 0
    cost: float = 0.0
    log_density: float = 0.0

    @property
    def score(self) -> float:
        """Mean of −2 log density; less is better."""
        return -2.0 * self.log_density / max(self.rays, 1)

    def add(self, fit: RayFit) -> None:
        self.rays += 1
        self.cost += fit.cost
        self.log_density += fit.log_density

    def lasts(self, t: float, seconds: float) -> bool:
        return (
            self.rays >= FITS_LEAST_RAYS
            and t - self.since >= seconds
            and self.cost <= FITS_MOST_COST * self.rays
        )


@dataclass(slots=True)
class _Track:
    since: float
    number: int | None = None
    misfits_since: float = math.inf
    fits: dict[int, _Fits] = field(default_factory=dict)


class OwnNumbers:
    """The numbers of one drone's tracks of strangers."""

    def __init__(self, drone_id: int) -> None:
        self._drone_id = drone_id
        self._tracks: dict[int, _Track] = {}
        self._count = 0

    @property
    def by_track(self) -> dict[int, int]:
        return {track: one.number for track, one in self._tracks.items() if one.number is not None}

    def keep(self, tracks: Collection[int]) -> dict[int, int]:
        """All other tracks are no strangers, or are gone. Returns the numbers of these, by track."""
        gone = {track: number for track, number in self.by_track.items() if track not in tracks}
        self._tracks = {track: one for track, one in self._tracks.items() if track in tracks}
        return gone

    def candidates(self, track: int, numbers: Iterable[int], seen: Collection[int], t: float) -> list[int]:
        """The numbers that a track may take, of those that no other track has: any, or lower ones than its own that
        teammates have just seen."""
        one = self._tracks.setdefault(track, _Track(t))
        held = {other.number for other in self._tracks.values()}
        own = one.number
        return [n for n in numbers if n not in held and (own is None or (n < own and n in seen))]

    def add_fits(self, track: int, fits: Mapping[int, RayFit], t: float) -> None:
        """How a ray of a track at t fits each of its candidates."""
        one = self._tracks[track]
        one.fits = {n: known for n, known in one.fits.items() if n in fits}
        for n, fit in fits.items():
            if fit.cost > RAY_GATE:
                one.fits.pop(n, None)
            else:
                one.fits.setdefault(n, _Fits(t)).add(fit)

    def mark_fit(self, track: int, *, fits: bool, t: float) -> None:
        """Whether a ray of a track fitted the stranger whose number it has. One that does not for long loses it."""
        one = self._tracks[track]
        one.misfits_since = math.inf if fits else min(one.misfits_since, t)
        if t - one.misfits_since >= MISFITS_FOR_S:
            self._tracks[track] = _Track(t)

    def chosen(self, track: int, t: float) -> int | None:
        """The number that a track takes now; None: it keeps what it has."""
        one = self._tracks[track]
        wait = FITS_FOR_S if one.number is None else GIVES_WAY_AFTER_S
        lasting = [n for n, fits in one.fits.items() if fits.lasts(t, wait)]
        if not lasting:
            return None
        best = min(lasting, key=lambda n: (one.fits[n].score, n))
        score = one.fits[best].score + FITS_MARGIN
        rivals = [fits.score for n, fits in one.fits.items() if n != best]
        rivals += [
            other.fits[best].score
            for k, other in self._tracks.items()
            if k != track and best in other.fits and (other.number is None or best < other.number)
        ]
        return None if any(rival < score for rival in rivals) else best

    def claims(self, track: int, t: float, taken: Collection[int]) -> int | None:
        """The number that a track claims now, because it fits none; None: not yet. taken: numbers in use."""
        one = self._tracks[track]
        wait = CLAIMS_AT_LAST_S if one.fits else CLAIMS_AFTER_S
        if one.number is not None or t - one.since < wait:
            return None
        for _ in range(NUMBERS_OF_OBSERVER - 1):
            self._count = self._count % (NUMBERS_OF_OBSERVER - 1) + 1
            number = NUMBERS_OF_OBSERVER * self._drone_id + self._count
            if number not in taken:
                return number
        return None

    def take(self, track: int, number: int) -> int | None:
        """A track has that number now. Returns the one that it had."""
        one = self._tracks[track]
        had, one.number, one.misfits_since = one.number, number, math.inf
        one.fits = {n: fits for n, fits in one.fits.items() if n < number}
        return had
