"""How a stranger's direction goes on, so that its next bearing can be predicted as sharply as a teammate's.

Whatever is not in the team stands, hovers (a random walk), manoeuvres (random acceleration) or flies straight. Each is
a filter of a direction and its rate; across the bearing both axes are alike, so a covariance is (2, 2), of angle and
rate. The filter pays the same white errors as the teammate that the track is compared with, and predicts no bearing
better than the teammate does: otherwise every lasting error, which takes both aside, would speak for strangers.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.team.priors import (
    STRANGER_HOVER_M_SQRT_S,
    STRANGER_MANOEUVRES_M_S,
    STRANGER_MANOEUVRES_M_S2,
    STRANGER_MANOEUVRES_M_SQRT_S,
    STRANGER_PARALLAX_SIGMA,
    STRANGER_STRAIGHT_M_S,
    STRANGER_STRAIGHT_M_S2,
)
from swarmtrack.team.rows import TeammateRows

KINDS = 4
"""Stands, hovers, manoeuvres, flies straight."""


class StrangerFilters(TeammateRows):
    """Filters of tracks, for n distances and each kind. All arrays are (n, KINDS, …)."""

    def __init__(self, n: int) -> None:
        self._direction = np.zeros((n, KINDS, 3))
        self._rate = np.zeros((n, KINDS, 3))
        self._cov = np.zeros((n, KINDS, 3))
        """Variance of the angle, of angle and rate, of the rate."""
        self._walk = np.zeros((n, KINDS))
        self._acceleration = np.zeros((n, KINDS))
        self._begun = np.zeros(n, bool)

    def turn(self, rotation: Array) -> None:
        """The axes of the bearings have turned: rotation (3, 3) takes directions along."""
        self._direction = self._direction @ rotation.T
        self._rate = self._rate @ rotation.T

    def restart(self, column: int) -> None:
        """The filters of that distance begin again."""
        self._begun[column] = False

    def predict_and_update(
        self,
        bearing: Array,
        *,
        dt: Array,
        parallax: Array,
        variance: Array,
        least: Array,
        distance: Array,
    ) -> Array:
        """Log predictive densities (n, KINDS) per rad² of bearings (n, 3); they are folded in.

        dt (n,) s since the last; parallax (n, 3) rad: of the own motion since then, at distance (n,) m; variance (n,)
        rad² of the bearing, all white errors included; least (n,) rad²: of any prediction. Filters that begin return
        zeros.
        """
        new = ~self._begun
        if new.any():
            self._begin(new, bearing[new], variance[new], distance[new])
        F12 = dt[:, None]
        rate, (c00, c01, c11) = self._rate, np.moveaxis(self._cov, -1, 0)
        direction = self._direction + parallax[:, None] + rate * F12[..., None]
        q = self._acceleration**2
        p00 = c00 + 2.0 * F12 * c01 + F12**2 * c11 + q * F12**3 / 3.0 + self._walk**2 * F12
        p00 = p00 + (STRANGER_PARALLAX_SIGMA**2 * np.sum(parallax**2, axis=1))[:, None]
        p01 = c01 + F12 * c11 + q * F12**2 / 2.0
        p11 = c11 + q * F12
        innovation = bearing[:, None] - direction
        innovation -= bearing[:, None] * (innovation @ bearing[:, :, None])
        S = p00 + variance[:, None]
        vague = np.maximum(S, least[:, None])
        log_density = -np.log(2.0 * math.pi * vague) - 0.5 * np.sum(innovation**2, axis=-1) / vague
        k0, k1 = p00 / S, p01 / S
        updated = np.stack([p00 - k0 * p00, p01 - k0 * p01, p11 - k1 * p01], axis=-1)
        old = ~new
        self._direction[old] = (direction + k0[..., None] * innovation)[old]
        self._rate[old] = (rate + k1[..., None] * innovation)[old]
        self._cov[old] = updated[old]
        log_density[new] = 0.0
        return np.asarray(log_density)

    def _begin(self, new: NDArray[np.bool_], bearing: Array, variance: Array, rho: Array) -> None:
        self._begun[new] = True
        self._direction[new] = bearing[:, None]
        self._rate[new] = 0.0
        self._cov[new] = 0.0
        self._cov[new, :, 0] = variance[:, None]
        self._cov[new, :, 2] = np.stack(
            [
                np.full_like(rho, 1e-12),
                np.full_like(rho, 1e-12),
                (STRANGER_MANOEUVRES_M_S / rho) ** 2,
                (STRANGER_STRAIGHT_M_S / rho) ** 2,
            ],
            axis=1,
        )
        none = np.zeros_like(rho)
        self._walk[new] = np.stack(
            [none, STRANGER_HOVER_M_SQRT_S / rho, STRANGER_MANOEUVRES_M_SQRT_S / rho, none], axis=1
        )
        self._acceleration[new] = np.stack(
            [none, none, STRANGER_MANOEUVRES_M_S2 / rho, STRANGER_STRAIGHT_M_S2 / rho], axis=1
        )
