"""What people read of a relative state: how far, how sure that is, and how fast the two close in."""

from __future__ import annotations

import math
from typing import NamedTuple

from swarmtrack.messages import Array


class ReadOut(NamedTuple):
    """distance m, its standard deviation sigma m, and closing m/s: positive while they come nearer."""

    distance: float
    sigma: float
    closing: float


def read_out(position: Array, velocity: Array, cov: Array) -> ReadOut:
    """position (3,) m and velocity (3,) m/s of one against the other, cov (6, 6) of both, or (3, 3) of the position, in
    any axes."""
    distance = math.sqrt(float(position @ position))
    towards = position / distance
    sigma = math.sqrt(max(0.0, float(towards @ cov[:3, :3] @ towards)))
    return ReadOut(distance, sigma, -float(towards @ velocity))


def flat_ellipse(cov: Array, sigmas: float) -> tuple[float, float, float]:
    """Of a covariance [m²] whose first two axes are north and east, as seen from above: the long and the short radius
    in m, and the bearing of the long one, rad clockwise from north, within ±π/2."""
    n, ne, e = float(cov[0, 0]), float(cov[0, 1]), float(cov[1, 1])
    middle, half = 0.5 * (n + e), math.hypot(0.5 * (n - e), ne)
    long, short = math.sqrt(max(0.0, middle + half)), math.sqrt(max(0.0, middle - half))
    return sigmas * long, sigmas * short, 0.5 * math.atan2(2.0 * ne, n - e)
