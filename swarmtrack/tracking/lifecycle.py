"""Existence of a target: born from a detection, updated by hits and misses, deleted in the end.

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
from swarmtrack.tracking.priors import MAX_EXISTENCE, MAX_SIGMA_IMAGES, MAX_SLANT, SURELY_INSIDE_SIGMAS


def survive(existence: Array, dt: float, p_survival: float) -> Array:
    """Existence (n,) dt seconds later; p_survival is that of one second."""
    return np.asarray(existence * p_survival**dt)


def reweigh(existence: Array, likelihood_ratio: Array) -> Array:
    """Existence (n,) after a scan that was likelihood_ratio (n,) times as likely with the target as without."""
    there = existence * likelihood_ratio
    return np.minimum(there / (1.0 - existence + there), MAX_EXISTENCE)


def probability_in_view(mean: Array, cov: Array, camera: PinholeCamera) -> Array:
    """(n,) that a target's position lies inside the image, its two axes taken as independent."""
    at, scale = camera.framed(mean[:, POSITION])
    low, high = camera.frame_bounds
    above, below = at - low, high - at
    variance = cov.diagonal(axis1=1, axis2=2)[:, POSITION]
    if not camera.is_wide:
        # By the largest numbers alone, a third of the price of asking for each; NaN fails it.
        margin, widest = np.minimum(above, below).min(initial=math.inf), variance.max(initial=1e-12)
        if margin > SURELY_INSIDE_SIGMAS * math.sqrt(widest):
            return np.ones(len(mean))
    sigma = np.sqrt(np.maximum(variance, 1e-12)) * scale
    surely = np.minimum(above, below) > SURELY_INSIDE_SIGMAS * sigma
    inside = np.ones(len(mean))
    if not surely.all():
        near = ~surely.all(axis=1)
        above, below = above[near] / sigma[near], below[near] / sigma[near]
        inside[near] = (_normal_cdf(below) - _normal_cdf(-above)).prod(axis=1)
    if camera.is_wide:
        inside *= _within_the_circle(at, sigma, camera)
    return inside


def _within_the_circle(at: Array, sigma: Array, camera: PinholeCamera) -> Array:
    """(n,) that a place (n, 2) of the frame, ± sigma (n, 2), is within the reach of a wide lens."""
    spread = sigma / [camera.fx, camera.fy]
    return _normal_cdf(camera.within_reach(at) / np.sqrt((spread**2).mean(axis=1)))


def _normal_cdf(x: Array) -> Array:
    """Of each element. As `scipy.special.ndtr`, whose import takes every agent 0.15 s and 20 MB."""
    return np.reshape([0.5 * math.erfc(-value / math.sqrt(2.0)) for value in x.ravel().tolist()], x.shape)


def within_reach(mean: Array, camera: PinholeCamera) -> NDArray[np.bool_]:
    """(n,) that a target's direction is one that the image plane can still hold: in front, not grazing it."""
    x, y = (mean[:, 0] - camera.cx) / camera.fx, (mean[:, 2] - camera.cy) / camera.fy
    near = np.hypot(x, y) < MAX_SLANT
    if near.all():
        return np.asarray(near)
    low, high = camera.ideal_bounds
    shown = ((mean[:, POSITION] >= low) & (mean[:, POSITION] <= high)).all(axis=1)
    return np.asarray(near | shown)


def largest_variance(camera: PinholeCamera) -> float:
    """px² of a position that is known at all."""
    return float((MAX_SIGMA_IMAGES * max(camera.width, camera.height)) ** 2)


def is_placed(cov: Array, camera: PinholeCamera) -> NDArray[np.bool_]:
    """(n,) that something is known of where a target is. Beyond that, products of covariances lose their sign."""
    variance = largest_variance(camera)
    return np.asarray((cov[:, 0, 0] < variance) & (cov[:, 2, 2] < variance))


class Reach:
    """Targets with means (n, 4) and covariances (n, 4, 4) within a camera's reach, and placed."""

    def __init__(self, camera: PinholeCamera) -> None:
        self._camera = camera
        self._surely_before = MAX_SLANT * min(camera.fx, camera.fy) / 2.0 - max(camera.cx, camera.cy)
        self._surely_placed = largest_variance(camera)

    def surely_holds_all(self, mean: Array, cov: Array) -> bool:
        """By the largest numbers alone, a quarter of the price of asking for each; NaN fails it."""
        return bool(
            np.abs(mean).max(initial=0.0) < self._surely_before and cov.max(initial=0.0) < self._surely_placed
        )

    def holds(self, mean: Array, cov: Array) -> NDArray[np.bool_]:
        """(n,)."""
        return within_reach(mean, self._camera) & is_placed(cov, self._camera)
