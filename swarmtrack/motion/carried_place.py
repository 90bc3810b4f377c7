"""Where a drone is that its teammates carry, as the filter of `carried` last found it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from swarmtrack.messages import Array


@dataclass(frozen=True, slots=True, eq=False)
class CarriedPlace:
    """Own position (3,) m and velocity (3,) m/s in the team frame at t [s], cov (6, 6) of both; density [m²/s³] of the
    unmeasured acceleration.

    turn [rad]: the true heading less the autopilot's, clockwise from above, and its sigma. by: the teammates that hold
    it now; empty: it is only extrapolated. leans_on: all teammates that it rests on, directly or not. off_m: error of
    the autopilot's position; None: there is none.
    """

    t: float
    position: Array
    velocity: Array
    cov: Array
    density: float
    turn: float
    turn_sigma: float
    by: tuple[int, ...]
    leans_on: tuple[int, ...]
    off_m: float | None

    def at(self, t: float) -> tuple[Array, Array]:
        """Position (3,) m and its covariance (3, 3) at t [s]."""
        dt = t - self.t
        cov = self.cov
        place = cov[:3, :3] + dt * (cov[:3, 3:] + cov[3:, :3]) + dt * dt * cov[3:, 3:]
        return self.position + dt * self.velocity, place + self.density * abs(dt) ** 3 / 3.0 * np.eye(3)

    @property
    def sigma_m(self) -> float:
        """m, of the worst axis, at t."""
        return math.sqrt(float(self.cov.diagonal()[:3].max()))
