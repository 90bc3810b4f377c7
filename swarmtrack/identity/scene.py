"""What the camera's scene is like, learned from what it shows: how many tracks are of no teammate, and how surely a
teammate in view has a track.

Both are the prior of the matching (`posterior.Prior`). Before anything is seen they are `PRIOR`'s, as sure as after
`PRIOR_S` of looking. A team over an empty field and one among houses that look like drones are soon told apart; a
drone on its pad that the detector overlooks makes what stands near it no more likely to be that drone.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np

from swarmtrack.identity.posterior import PRIOR

# s of looking that the first guess is worth.
PRIOR_S = 5.0
# Look-alikes of nobody that are too weak to be confirmed, and of the teammates with a track those that are.
WEAK_STRANGERS, WEAK_SHARE = 3.0, 0.2
# s after which what was seen counts half: the camera turns to other scenes.
HALF_LIFE_S = 15.0
# s: a longer pause between two scans counts as this.
MAX_STEP_S = 1.0
# rad: strangers are counted by bands of this height, three at a time.
ELEVATION_STEP = math.radians(5.0)
# Never certain.
LEAST, MOST = 0.05, 0.95


class _Mean:
    """Of a quantity over time, beginning at a guess that counts as `PRIOR_S` of it."""

    def __init__(self, guess: float) -> None:
        self._guess = guess
        self._sum = 0.0
        self._time = 0.0

    def add(self, value: float, dt: float) -> None:
        kept = 0.5 ** (dt / HALF_LIFE_S)
        self._sum = kept * self._sum + value * dt
        self._time = kept * self._time + dt

    @property
    def value(self) -> float:
        return (self._guess * PRIOR_S + self._sum) / (PRIOR_S + self._time)


class _Strangers:
    """How many there would be in an image that is everywhere as it is around an elevation: houses stand on the horizon,
    and so do, in a camera's eye, most teammates."""

    def __init__(self, guess: float, height_rad: float) -> None:
        self._guess = guess
        self._share = 3.0 * ELEVATION_STEP / height_rad
        self._sums = np.zeros(round(math.pi / ELEVATION_STEP) + 3)
        self._time = 0.0

    def add(self, found: Iterable[tuple[float, float]], dt: float) -> None:
        kept = 0.5 ** (dt / HALF_LIFE_S)
        self._sums *= kept
        self._time = kept * self._time + dt
        for elevation, probability in found:
            self._sums[self._bin(elevation)] += probability * dt

    def near(self, elevation: float) -> float:
        middle = self._bin(elevation)
        around = float(self._sums[middle - 1 : middle + 2].sum()) / self._share
        return (self._guess * PRIOR_S + around) / (PRIOR_S + self._time)

    def _bin(self, elevation: float) -> int:
        return round((elevation + math.pi / 2.0) / ELEVATION_STEP) + 1


class Scene:
    """Told after every scan what its posterior made of it."""

    def __init__(self, height_rad: float) -> None:
        """height_rad: of the image."""
        self._t: float | None = None
        self._strangers = _Strangers(PRIOR.strangers, height_rad)
        self._weak = _Strangers(WEAK_STRANGERS, height_rad)
        self._seen: dict[int, _Mean] = {}

    def learn(
        self,
        t: float,
        strangers: Iterable[tuple[float, float]],
        weak: Iterable[tuple[float, float]],
        seen: Mapping[int, float],
    ) -> None:
        """strangers, weak: by nameless track, confirmed or not, its elevation [rad] and the probability that it is a
        target and no teammate; seen: by drone that should be in view, the probability that one of the tracks is it."""
        dt = 0.0 if self._t is None else min(t - self._t, MAX_STEP_S)
        self._t = t
        self._strangers.add(strangers, dt)
        self._weak.add(weak, dt)
        for drone, probability in seen.items():
            self._seen.setdefault(drone, _Mean(PRIOR.p_seen)).add(probability, dt)

    def log_ratio(self, drone_id: int, elevation: float, *, weak: bool, in_view: float = 1.0) -> float:
        """Of "this track at that elevation is that drone" and "a stranger, and the drone is not seen", before looking
        where the drone is.
        in_view: the probability that the drone is in the image at all; one that is not is surely not seen."""
        p = self.seen(drone_id)
        share = WEAK_SHARE if weak else 1.0 - WEAK_SHARE
        strangers = self._weak if weak else self._strangers
        return math.log(share * p / (1.0 - p * in_view) / max(strangers.near(elevation), LEAST))

    def seen(self, drone_id: int) -> float:
        """The probability that the drone has a track while it is in view."""
        seen = self._seen.get(drone_id)
        return min(max(PRIOR.p_seen if seen is None else seen.value, LEAST), MOST)

    def strangers(self, elevation: float) -> float:
        """How many confirmed tracks of nobody there would be in an image that is everywhere as at that elevation."""
        return max(self._strangers.near(elevation), LEAST)

    def log_missed(self, drone_id: int) -> float:
        """Log odds for a track that was named when a newcomer had no track yet: the drone would have been missed."""
        seen = self._seen.get(drone_id)
        return -math.log(1.0 - min(PRIOR.p_seen if seen is None else seen.value, PRIOR.p_seen))
