"""Does the own height drift against that of a teammate? A Kalman filter of what the camera measures of it.

    off = d + b + level τ + lever r + white

d [m] is the drift since the watch began, 0 then, and its rate a random walk; b [m] is the constant between two heights
that were measured by different people, of which nothing is known; τ [rad] is the error of the own tilt, which lasts for
seconds; r the error of the distance, in its own sigmas. Nobody can tell b from a drift that is over before the watch
begins, nor whose height it is that drifts: what is found is said of both.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from typing import NamedTuple

import numpy as np

from swarmtrack.relative.heights import HeightSight

# m, m/s: by how much the constant may differ from the first sight; an honest barometer wanders by so much, one sigma.
CONSTANT_M, RATE = 5.0, 0.05
# m/s per √s: by which the rate of a drift changes: 0.1 m/s within 10 s.
RATE_WALK = 0.03
# rad, s: an autopilot's tilt is off by so much, for so long.
TILT, TILT_S = math.radians(1.0), 20.0
# s: so long the error of a distance stays the same.
RANGE_S = 30.0
# m: a drift is said from here on, and until it is less again; and it is surer than so many sigmas.
SAID_M, GONE_M, SIGMAS = 0.5, 0.35, 3.0
# Sigmas: a single sight that is farther off is a wrong box; s: where all are for so long, a height has leapt.
GATE, LEAPS_S = 4.0, 1.0
# s without a sight: then a drift is neither known nor said any more.
STALE_S = 30.0
# m: against a teammate that drifts less than this the own height is right, and another's is wrong.
AGREES_M = 0.25
# m: no height is measured better; and no teammate that is seen is farther, and no height more wrong.
LEAST_SIGMA_M, FARTHEST_M = 0.01, 1e4
# Of the state's entries, the first two.
DRIFT, CLIMB = 0, 1


class HeightDrift(NamedTuple):
    """off [m]: by how much the own height seems too high against a teammate's; sigma [m]; said: it is worth a word."""

    drone_id: int
    off: float
    sigma: float
    said: bool


class HeightWatch:
    """From the moment on that it is made. Told of sights, it says whether the own height seems wrong, or that of one of
    the references, by which it is flown. Teammates beside those only bear witness: a name that is doubted for its
    drift may be lost before it is said."""

    def __init__(self, references: Collection[int]) -> None:
        self._references = references
        self._rows: dict[int, _Row] = {}

    def see(self, sights: Iterable[HeightSight], t: float) -> None:
        """Of teammates that are surely named; the same sight twice counts once. t [s]: now."""
        if any(abs(t - row.taken_t) > STALE_S for row in self._rows.values()):
            self._rows = {drone: row for drone, row in self._rows.items() if abs(t - row.taken_t) <= STALE_S}
        for sight in sights:
            if not _is_possible(sight) or not abs(t - sight.t) <= STALE_S:
                continue
            row = self._rows.get(sight.drone_id)
            if row is None or row.word != sight.word:
                self._rows[sight.drone_id] = _Row(sight)
            elif row.t < sight.t:
                row.see(sight)

    def knows(self, drone_id: int) -> bool:
        """Whether a drift against that teammate is being watched."""
        return drone_id in self._rows

    @property
    def drifts(self) -> list[HeightDrift]:
        """Against each teammate."""
        return [
            HeightDrift(drone, float(row.x[DRIFT]), row.sigma, row.said) for drone, row in self._rows.items()
        ]

    @property
    def doubt(self) -> str | None:
        """In words, whose height seems wrong; None where nobody's does."""
        drifts = self.drifts
        said = [drift for drift in drifts if drift.said]
        followed = [drift for drift in drifts if drift.drone_id in self._references]
        if not said or (not any(drift.said for drift in followed) and any(map(_agrees, followed))):
            return None
        worst = max(said, key=lambda drift: (drift.drone_id in self._references, abs(drift.off)))
        if any(abs(drift.off) < AGREES_M for drift in drifts):
            whose = f"drone {worst.drone_id}'s"
        elif len(said) > 1:
            whose = "own"
        else:
            whose = f"own or drone {worst.drone_id}'s"
        return f"{whose} height seems wrong by {abs(worst.off):.1f} m"


class _Row:
    """One teammate, by one word of it."""

    def __init__(self, sight: HeightSight) -> None:
        self.word = sight.word
        self.t = self.taken_t = sight.t
        self.said = False
        # Of the constant nothing is known but this: somebody may have begun to count far above, or below.
        self.x = np.array([0.0, 0.0, sight.off, 0.0, 0.0])
        self.P = np.diag([0.0, RATE**2, CONSTANT_M**2, TILT**2, 1.0])

    @property
    def sigma(self) -> float:
        return math.sqrt(max(float(self.P[DRIFT, DRIFT]), 0.0))

    def see(self, sight: HeightSight) -> None:
        self._predict(sight.t - self.t)
        self.t = sight.t
        H = np.array([1.0, 0.0, 1.0, sight.level, sight.lever])
        innovation = sight.off - float(H @ self.x)
        S = float(H @ self.P @ H) + sight.sigma**2
        if innovation**2 > GATE**2 * S:
            if sight.t - self.taken_t < LEAPS_S:
                return
            self.P[DRIFT, DRIFT] += innovation**2
            S += innovation**2
        self.taken_t = sight.t
        K = self.P @ H / S
        A = np.eye(5) - np.outer(K, H)
        self.x = self.x + K * innovation
        # Joseph form: stays symmetric and positive.
        self.P = A @ self.P @ A.T + sight.sigma**2 * np.outer(K, K)
        off, sigma = abs(float(self.x[DRIFT])), self.sigma
        self.said = off > GONE_M if self.said else off > max(SAID_M, SIGMAS * sigma)

    def _predict(self, dt: float) -> None:
        tilt, distance = math.exp(-dt / TILT_S), math.exp(-dt / RANGE_S)
        F = np.diag([1.0, 1.0, 1.0, tilt, distance])
        F[DRIFT, CLIMB] = dt
        q = RATE_WALK**2
        Q = np.diag([q * dt**3 / 3.0, q * dt, 0.0, TILT**2 * (1.0 - tilt**2), 1.0 - distance**2])
        Q[DRIFT, CLIMB] = Q[CLIMB, DRIFT] = q * dt**2 / 2.0
        self.x = F @ self.x
        self.P = F @ self.P @ F.T + Q


def _agrees(drift: HeightDrift) -> bool:
    return abs(drift.off) < GONE_M


def _is_possible(sight: HeightSight) -> bool:
    """Whether these are numbers that a scan could tell; NaN fails every comparison."""
    lengths = (sight.sigma, sight.level, sight.lever)
    return (
        abs(sight.off) < FARTHEST_M
        and all(0.0 <= length < FARTHEST_M for length in lengths)
        and sight.sigma >= LEAST_SIGMA_M
    )
