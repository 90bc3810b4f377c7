"""How likely a target exists: born from a detection, carried by hits and misses, dropped in the end.

The recursion is that of the integrated PDA, Musicki, Evans & Stankovic (1994): existence r becomes r Λ / (1 − r + r Λ)
with Λ = 1 − p_D for a scan that missed it and Λ = 1 − p_D + p_D N(y; 0, S) / κ for one that found it at y.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array
from swarmtrack.tracking.motion_model import POSITION

MAX_EXISTENCE = 1.0 - 1e-6
# A detector misses in bursts (a drone before a tree, behind another), which the recursion takes for proof of absence.
# Existence of a confirmed track stops here, so that one clear detection brings it back; time ends it, not misses.
MIN_CONFIRMED_EXISTENCE = 0.05
LOST_BELOW = 0.1  # existence of a missed track: rather hidden or gone than there
# Tangent of 80 degrees off the axis. A pixel further out covers next to nothing, and every turn of the camera would
# multiply the covariance of what is there, without bound, until it comes back.
MAX_SLANT = 5.7


def survive(existence: Array, dt: float, p_survival: float) -> Array:
    """Existence (n,) dt seconds later; p_survival is that of one second."""
    return np.asarray(existence * p_survival**dt)


def reweigh(existence: Array, likelihood_ratio: Array) -> Array:
    """Existence (n,) after a scan that was likelihood_ratio (n,) times as likely with the target as without."""
    there = existence * likelihood_ratio
    return np.minimum(there / (1.0 - existence + there), MAX_EXISTENCE)


def probability_in_view(mean: Array, cov: Array, camera: PinholeCamera) -> Array:
    """(n,) that a target's position lies inside the image, its two axes taken as independent."""
    sigma = np.sqrt(np.maximum(cov[:, [0, 2], [0, 2]], 1e-12))
    low, high = camera.ideal_bounds
    upper = _normal_cdf((high - mean[:, POSITION]) / sigma)
    lower = _normal_cdf((low - mean[:, POSITION]) / sigma)
    return np.asarray((upper - lower).prod(axis=1))


def _normal_cdf(x: Array) -> Array:
    """Of each element. As `scipy.special.ndtr`, whose import takes every agent 0.15 s and 20 MB."""
    return np.reshape([0.5 * math.erfc(-value / math.sqrt(2.0)) for value in x.ravel().tolist()], x.shape)


def within_reach(mean: Array, camera: PinholeCamera) -> NDArray[np.bool_]:
    """(n,) that a target's direction is one that the image plane can still hold: in front, not grazing it."""
    position = mean[:, POSITION]
    ray = (position - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    low, high = camera.ideal_bounds
    shown = ((position >= low) & (position <= high)).all(axis=1)
    return np.asarray(shown | (np.hypot(ray[:, 0], ray[:, 1]) < MAX_SLANT))
