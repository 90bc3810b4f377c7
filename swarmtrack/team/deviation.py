"""How far a teammate is from where it says it is.

Its own estimate, its controller and the wind take it aside smoothly: that is a state and no noise, a critically damped
process across the bearing. Where the teammate should be is linear in unknowns z (`evidence.py`), so the estimate of
that state is as well: here it is a matrix that takes z to metres. What is left of each bearing, the innovations, is
white, and adds up to a likelihood of z.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarmtrack.messages import Array
from swarmtrack.team.rows import TeammateRows


class Deviation(NamedTuple):
    """Standard deviation per axis [m], bandwidth [rad/s], and white variance [m²] on top, (m,) each."""

    sigma: Array
    bandwidth: Array
    white: Array


class DeviationFilters(TeammateRows):
    """Filters of n teammates. `aside` (n, 2, 3, 8): of z, how far it is aside [m] and how fast [m/s]."""

    def __init__(self, n: int) -> None:
        self._aside = np.zeros((n, 2, 3, 8))
        self._cov = np.zeros((n, 3))
        self._t = np.full(n, -math.inf)

    def restart(self, column: int) -> None:
        """Begin one filter again."""
        self._t[column] = -math.inf

    def turn(self, to_old: Array, rotation: Array) -> None:
        """The axes of the own rays have turned: rotation (3, 3) takes directions along, to_old (8, 8) z back."""
        self._aside = rotation @ self._aside @ to_old

    def innovations(self, across: Array, direction: Array, t: float, of: Deviation) -> tuple[Array, Array]:
        """Fold in bearings along direction (n, 3) at t [s]. across (n, 3, 8): where each teammate should be across its
        bearing, of z. Returns what is left of that (n, 3, 8), and its variance (n,) m² per axis."""
        begun = np.isfinite(self._t)
        dt = np.where(begun, t - self._t, 0.0)
        w, v = of.bandwidth, of.sigma**2
        decay = np.exp(-w * dt)
        F = decay * np.array([1.0 + w * dt, dt, -w * w * dt, 1.0 - w * dt])
        x, P = self._aside, self._cov
        f = F[:, :, None, None]
        ahead = np.stack([f[0] * x[:, 0] + f[1] * x[:, 1], f[2] * x[:, 0] + f[3] * x[:, 1]], axis=1)
        # The stationary covariance, and what is known better than by it.
        d00, d01, d11 = P[:, 0] - v, P[:, 1], P[:, 2] - v * w * w
        p00 = v + F[0] ** 2 * d00 + 2.0 * F[0] * F[1] * d01 + F[1] ** 2 * d11
        p01 = F[0] * F[2] * d00 + (F[0] * F[3] + F[1] * F[2]) * d01 + F[1] * F[3] * d11
        p11 = v * w * w + F[2] ** 2 * d00 + 2.0 * F[2] * F[3] * d01 + F[3] ** 2 * d11
        ahead[~begun] = 0.0
        p00, p01, p11 = np.where(begun, p00, v), np.where(begun, p01, 0.0), np.where(begun, p11, v * w * w)
        left = across - ahead[:, 0]
        left -= direction[:, :, None] * (direction[:, None] @ left)
        S = p00 + of.white
        k0, k1 = p00 / S, p01 / S
        ahead[:, 0] += k0[:, None, None] * left
        ahead[:, 1] += k1[:, None, None] * left
        self._aside = ahead
        self._cov = np.stack([p00 - k0 * p00, p01 - k0 * p01, p11 - k1 * p01], axis=1)
        self._t = np.full(len(S), t)
        return left, S
