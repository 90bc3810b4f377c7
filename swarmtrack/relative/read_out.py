"""What people read of relative states: how far, how sure that is, and how fast the two close in."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from swarmtrack.messages import Array


class ReadOut(NamedTuple):
    """distance m, its standard deviation sigma m, and closing m/s: positive while they come nearer."""

    distance: float
    sigma: float
    closing: float


def read_out(position: Array, velocity: Array, cov: Array) -> ReadOut:
    """position (3,) m and velocity (3,) m/s of one against the other, cov (6, 6) of both, in any axes."""
    return ReadOut(*read_outs(position[None], velocity[None], cov[None])[0].tolist())


def read_outs(position: Array, velocity: Array, cov: Array) -> Array:
    """The same (n, 3) of n: position (n, 3), velocity (n, 3), cov (n, 6, 6)."""
    distance = np.sqrt((position * position).sum(axis=1))
    towards = position / distance[:, None]
    along = (cov[:, :3, :3] @ towards[:, :, None])[:, :, 0]
    variance = (towards * along).sum(axis=1)
    sigma = np.sqrt(np.maximum(variance, 0.0))
    return np.stack([distance, sigma, -(towards * velocity).sum(axis=1)], axis=1)


def flat_ellipses(cov: Array, sigmas: float) -> Array:
    """(n, 3): of covariances (n, …, …) [m²] whose first two axes are north and east, as seen from above: the long and
    the short radius in m, and the bearing of the long one, rad clockwise from north, within ±π/2."""
    n, ne, e = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    middle, half = 0.5 * (n + e), np.hypot(0.5 * (n - e), ne)
    long, short = np.sqrt(np.maximum(middle + half, 0.0)), np.sqrt(np.maximum(middle - half, 0.0))
    return np.stack([sigmas * long, sigmas * short, 0.5 * np.arctan2(2.0 * ne, n - e)], axis=1)
