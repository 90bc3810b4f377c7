"""Reading relative states at any time, many times between two scans.

What is believed changes with scans and messages, some tens of times a second; it is read a hundred times a second and
more. Carried on by dt, mean and covariance of place and velocity are

    r + φ v, e v        A C Aᵀ + Q    with A = [[I, φ I], [0, e I]]

which is linear in 1, φ, φ², e, e φ, e² and the two integrals of Q. So all that does not depend on dt is computed once,
when the first reader comes, and a reading is one product of eight numbers with a table, for all teammates at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from swarmtrack.messages import Array, RelativeSource, RelativeState
from swarmtrack.relative.log_range import Beliefs, VelocityPrior, cartesian, density, unit_decay

_PLACE, _SPEED = slice(0, 3), slice(3, 6)
_CROSS = np.zeros((3, 9))
"""v @ it, reshaped to (3, 3): the matrix of the cross product with v."""
_CROSS[0, 7] = _CROSS[1, 2] = _CROSS[2, 3] = 1.0
_CROSS[0, 5] = _CROSS[1, 6] = _CROSS[2, 1] = -1.0
_NUMBERS = 42  # of one teammate: 36 of the covariance, then 6 of the mean


class OwnMotion(NamedTuple):
    """The own camera at some time: camera (3,) m and velocity (3,) m/s along the team's axes, velocity_cov (3, 3),
    attitude_cov (3, 3) rad² about these axes."""

    camera: Array
    velocity: Array
    velocity_cov: Array
    attitude_cov: Array


class Reading:
    """What is believed of some teammates at a scan, ready to be read at any later time, and back to the last look."""

    def __init__(
        self,
        t: float,
        camera: Array,
        keys: Sequence[tuple[int, int]],
        beliefs: Beliefs,
        prior: VelocityPrior,
        *,
        sources: Sequence[tuple[RelativeSource, ...]],
        jitter_m: float,
        looked_t: float,
    ) -> None:
        """The scan's time and where the camera was then, (3,) m; keys: drone and track of n rows of beliefs; prior: of
        these rows; jitter_m: how far the own place scatters from one pose to the next; looked_t: of the last look, the
        scan's or of one that was exposed before it."""
        self._t, self._camera, self._keys = t, camera, tuple(keys)
        self._back = looked_t - t
        self._sources = tuple(sources)
        self._forget_s = prior.forget_s
        found = cartesian(beliefs)
        self._sigmas = tuple(found.range_sigma_log.tolist())
        self._table = _table(found.r, found.v, found.cov, density(prior), jitter_m**2)

    def at(self, t: float, own: OwnMotion) -> dict[int, RelativeState]:
        """By track: the states carried on to t, seen from where the own camera is then. The attitude's error, which
        bears on all of them alike, comes in here and nowhere else."""
        n = len(self._keys)
        numbers = self._step(max(t - self._t, self._back)) @ self._table
        cov, mean = numbers[: 36 * n].reshape(n, 6, 6), numbers[36 * n :].reshape(n, 6)
        mean[:, _PLACE] -= own.camera - self._camera
        mean[:, _SPEED] -= own.velocity
        by_turn = (mean.reshape(2 * n, 3) @ _CROSS).reshape(n, 6, 3)
        turned = (by_turn.reshape(6 * n, 3) @ own.attitude_cov).reshape(n, 6, 3)
        cov += turned @ by_turn.swapaxes(1, 2)
        cov[:, _SPEED, _SPEED] += own.velocity_cov
        states = RelativeState.of_rows(
            t, self._keys, mean, cov, range_sigma_log=self._sigmas, sources=self._sources
        )
        return {key[1]: state for key, state in zip(self._keys, states, strict=True)}

    def _step(self, dt: float) -> Array:
        """(8,): what the table is multiplied by."""
        if dt == 0.0:
            return np.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0])
        phi, left, pp, _, vv = unit_decay(dt, self._forget_s)
        if dt < 0.0:
            _, _, pp, _, vv = unit_decay(-dt, self._forget_s)
        return np.array([1.0, phi, phi * phi, left, left * phi, left * left, pp, vv])


def _table(r: Array, v: Array, cov: Array, q: Array, place_var: float) -> Array:
    """(8, 42 n): for each of 1, φ, φ², e, e φ, e² and the integrals of place and velocity what it adds to covariances
    (n, 6, 6) and means (n, 6). q (n,) m²/s³: density of the noise; place_var m², of each axis."""
    n = len(r)
    table = np.zeros((8, n * _NUMBERS))
    covs, means = table[:, : 36 * n].reshape(8, n, 6, 6), table[:, 36 * n :].reshape(8, n, 6)
    rr, rv, vv = cov[:, _PLACE, _PLACE], cov[:, _PLACE, _SPEED], cov[:, _SPEED, _SPEED]
    noise = q[:, None, None] * np.eye(3)
    covs[0, :, _PLACE, _PLACE] = rr + place_var * np.eye(3)
    covs[1, :, _PLACE, _PLACE] = rv + rv.swapaxes(1, 2)
    covs[2, :, _PLACE, _PLACE] = vv
    covs[2, :, _PLACE, _SPEED] = covs[2, :, _SPEED, _PLACE] = 0.5 * noise
    covs[3, :, _PLACE, _SPEED], covs[3, :, _SPEED, _PLACE] = rv, rv.swapaxes(1, 2)
    covs[4, :, _PLACE, _SPEED] = covs[4, :, _SPEED, _PLACE] = vv
    covs[5, :, _SPEED, _SPEED] = vv
    covs[6, :, _PLACE, _PLACE] = covs[7, :, _SPEED, _SPEED] = noise
    means[0, :, _PLACE], means[1, :, _PLACE], means[3, :, _SPEED] = r, v, v
    return table
