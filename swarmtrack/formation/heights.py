"""Does the own height drift against that of a teammate? A Kalman filter of what the camera measures of it.

    off = d + b + level τ + lever r + white

d [m] is the drift since the watch began, 0 then, and its rate a random walk; b [m] is the constant between two heights
that were measured by different people, of which nothing is known; τ [rad] is the error of the own tilt, which lasts
for seconds; r the error of the distance, in its own sigmas. That lasts, too, but for what is learned of the distance:
where its sigma has halved since, most of the former error is gone. b cannot be separated from a drift that ended before
the watch began, nor can the drifting drone be identified: a finding is reported for both.

Their sum is what a drone needs whose own height is vague, as by an ordinary receiver: it is how much too high its own
height has it above a teammate.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from typing import NamedTuple

import numpy as np

from swarmtrack.formation.margins import (
    HEIGHT_AGREES_M,
    HEIGHT_CONSTANT_SIGMA_M,
    HEIGHT_DRIFT_GONE_M,
    HEIGHT_DRIFT_REPORTED_M,
    HEIGHT_DRIFT_SIGMAS,
    HEIGHT_DRIFT_STALE_S,
    HEIGHT_FARTHEST_M,
    HEIGHT_GATE_SIGMAS,
    HEIGHT_LEAP_AFTER_S,
    HEIGHT_LEAST_SIGMA_M,
    HEIGHT_MEASURED_SIGMA_M,
    HEIGHT_RATE_SIGMA_M_S,
    HEIGHT_RATE_WALK_M_S_SQRT_S,
    RANGE_ERROR_LASTS_S,
    TILT_ERROR_LASTS_S,
    TILT_ERROR_RAD,
)
from swarmtrack.relative.heights import HeightSight

# Of the state's entries, the first three.
DRIFT, CLIMB, CONSTANT = 0, 1, 2


class HeightDrift(NamedTuple):
    """off [m]: excess of the own height relative to a teammate's; sigma [m]; is_reported: it is large enough."""

    drone_id: int
    off: float
    sigma: float
    is_reported: bool


class HeightWatch:
    """Watch from its construction on. From sights it decides whether the own height seems wrong, or that of a
    reference by which the drone flies. Other teammates only corroborate: a name that is in doubt because of its
    drift may be lost before the drift is reported.
    """

    def __init__(self, references: Collection[int]) -> None:
        self._references = references
        self._rows: dict[int, _Row] = {}

    def add_sights(self, sights: Iterable[HeightSight], t: float) -> None:
        """Add sights of confidently named teammates; the same sight twice counts once. t [s]: now."""
        if any(abs(t - row.taken_t) > HEIGHT_DRIFT_STALE_S for row in self._rows.values()):
            self._rows = {
                drone: row
                for drone, row in self._rows.items()
                if abs(t - row.taken_t) <= HEIGHT_DRIFT_STALE_S
            }
        for sight in sights:
            if not _is_possible(sight) or not abs(t - sight.t) <= HEIGHT_DRIFT_STALE_S:
                continue
            row = self._rows.get(sight.drone_id)
            if row is None or row.word != sight.word:
                self._rows[sight.drone_id] = _Row(sight)
            elif row.t < sight.t:
                row.add_sight(sight)

    def knows(self, drone_id: int) -> bool:
        """Whether the drift relative to that teammate is watched."""
        return drone_id in self._rows

    @property
    def drifts(self) -> list[HeightDrift]:
        """Drift relative to each teammate."""
        return [
            HeightDrift(drone, float(row.x[DRIFT]), row.sigma, row.is_reported)
            for drone, row in self._rows.items()
        ]

    def correction(self, heights: Mapping[int, float]) -> float | None:
        """m: by how much the own reported height is too large, if the references are at `heights` [m], by drone. What
        they report themselves does not count. None where none is measured well enough.
        """
        measured = [
            (row.off + row.said - heights[drone], row.off_variance)
            for drone, row in self._rows.items()
            if drone in heights and row.off_variance < HEIGHT_MEASURED_SIGMA_M**2
        ]
        if not measured:
            return None
        weights = [1.0 / variance for _, variance in measured]
        return sum(w * off for w, (off, _) in zip(weights, measured, strict=True)) / sum(weights)

    @property
    def doubt(self) -> str | None:
        """The drone whose height seems wrong, in words; None without one."""
        drifts = self.drifts
        said = [drift for drift in drifts if drift.is_reported]
        followed = [drift for drift in drifts if drift.drone_id in self._references]
        if not said or (not any(drift.is_reported for drift in followed) and any(map(_agrees, followed))):
            return None
        worst = max(said, key=lambda drift: (drift.drone_id in self._references, abs(drift.off)))
        if any(abs(drift.off) < HEIGHT_AGREES_M for drift in drifts):
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
        self.said = sight.said
        self.t = self.taken_t = sight.t
        self._least_range_sigma = sight.range_sigma_log
        self.is_reported = False
        # Of the constant nothing is known but this: somebody may have begun to count far above, or below.
        self.x = np.array([0.0, 0.0, sight.off, 0.0, 0.0])
        self.P = np.diag([0.0, HEIGHT_RATE_SIGMA_M_S**2, HEIGHT_CONSTANT_SIGMA_M**2, TILT_ERROR_RAD**2, 1.0])

    @property
    def sigma(self) -> float:
        return math.sqrt(max(float(self.P[DRIFT, DRIFT]), 0.0))

    @property
    def off(self) -> float:
        return float(self.x[DRIFT] + self.x[CONSTANT])

    @property
    def off_variance(self) -> float:
        both = self.P[[DRIFT, CONSTANT]][:, [DRIFT, CONSTANT]]
        return max(float(both.sum()), HEIGHT_LEAST_SIGMA_M**2)

    def add_sight(self, sight: HeightSight) -> None:
        self._predict(sight.t - self.t, sight.range_sigma_log)
        self.t, self.said = sight.t, sight.said
        H = np.array([1.0, 0.0, 1.0, sight.level, sight.lever])
        innovation = sight.off - float(H @ self.x)
        S = float(H @ self.P @ H) + sight.sigma**2
        if innovation**2 > HEIGHT_GATE_SIGMAS**2 * S:
            if sight.t - self.taken_t < HEIGHT_LEAP_AFTER_S:
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
        self.is_reported = (
            off > HEIGHT_DRIFT_GONE_M
            if self.is_reported
            else off > max(HEIGHT_DRIFT_REPORTED_M, HEIGHT_DRIFT_SIGMAS * sigma)
        )

    def _predict(self, dt: float, range_sigma: float) -> None:
        tilt, distance = math.exp(-dt / TILT_ERROR_LASTS_S), math.exp(-dt / RANGE_ERROR_LASTS_S)
        # Of two estimates of which the second has learned more, the errors correlate like this.
        distance *= min(range_sigma / self._least_range_sigma, 1.0)
        self._least_range_sigma = min(range_sigma, self._least_range_sigma)
        F = np.diag([1.0, 1.0, 1.0, tilt, distance])
        F[DRIFT, CLIMB] = dt
        q = HEIGHT_RATE_WALK_M_S_SQRT_S**2
        Q = np.diag([q * dt**3 / 3.0, q * dt, 0.0, TILT_ERROR_RAD**2 * (1.0 - tilt**2), 1.0 - distance**2])
        Q[DRIFT, CLIMB] = Q[CLIMB, DRIFT] = q * dt**2 / 2.0
        self.x = F @ self.x
        self.P = F @ self.P @ F.T + Q


def _agrees(drift: HeightDrift) -> bool:
    return abs(drift.off) < HEIGHT_DRIFT_GONE_M


def _is_possible(sight: HeightSight) -> bool:
    """Whether these are numbers that a scan could tell; NaN fails every comparison."""
    lengths = (sight.sigma, sight.level, sight.lever)
    return (
        abs(sight.off) < HEIGHT_FARTHEST_M
        and all(0.0 <= length < HEIGHT_FARTHEST_M for length in lengths)
        and sight.sigma >= HEIGHT_LEAST_SIGMA_M
        and 0.0 < sight.range_sigma_log < HEIGHT_FARTHEST_M
    )
