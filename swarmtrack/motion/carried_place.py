"""Where a drone is that its teammates carry, as the filter of `carried` last found it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from swarmtrack.geometry.covariance import worst_sigma
from swarmtrack.messages import Array


@dataclass(frozen=True, slots=True, eq=False)
class CarriedPlace:
    """Own position (3,) m and velocity (3,) m/s in the team frame at t [s], cov (6, 6) of both; density [m²/s³] of the
    unmeasured acceleration.

    turn [rad]: the true heading less the autopilot's, clockwise from above, and its sigma. by: the teammates that hold
    it now; empty: it is only extrapolated; held_t [s]: their newest ray. leans_on: all teammates that it rests on,
    directly or not. off_m: error of the autopilot's position; None: there is none.

    offset (3,) m: by how much the autopilot's position was off while it was sound, and offset_cov (6, 6): `cov`, of the
    place with that offset. A place in the autopilot's own frame is known better than one in the team's. is_lost: the
    autopilot has no position.
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
    held_t: float
    offset: Array
    offset_cov: Array
    is_lost: bool

    def at(self, t: float) -> tuple[Array, Array]:
        """Position (3,) m and its covariance (3, 3) at t [s]."""
        return self.position + (t - self.t) * self.velocity, self._spread(self.cov, t - self.t)

    def by_autopilot(self, t: float) -> tuple[Array, Array]:
        """Position (3,) m that a sound autopilot would state at t [s], and the covariance (3, 3)."""
        return self.at(t)[0] + self.offset, self._spread(self.offset_cov, t - self.t)

    def _spread(self, cov: Array, dt: float) -> Array:
        place = cov[:3, :3] + dt * (cov[:3, 3:] + cov[3:, :3]) + dt * dt * cov[3:, 3:]
        return np.asarray(place + self.density * abs(dt) ** 3 / 3.0 * np.eye(3))

    @property
    def walk(self) -> float:
        """m²/s per axis: how fast the variance of the own way grows. Between two looks that of the place grows by twice
        its covariance with the velocity, and the second look takes the place aside by as much."""
        return max(2.0 * float(np.trace(self.cov[:3, 3:])) / 3.0, 0.0)

    @property
    def sigma_m(self) -> float:
        """m, of the worst axis, at t."""
        return worst_sigma(self.cov[:3, :3])
