"""Occlusion: two targets in nearly the same direction, of which the detector finds one, or one box around both."""

from __future__ import annotations

import math

import numpy as np

from swarmtrack.messages import Array
from swarmtrack.tracking.motion_model import POSITION
from swarmtrack.tracking.priors import RESOLVED_SIGMAS, UNRESOLVED_SIDES


def resolutions(size: Array, least: float) -> Array:
    """(n, 2) px: how close another of its kind may come to each target before the two are one detection.

    size (n, 2) px of their boxes, NaN while unknown; least px: that of points.
    """
    return np.fmax(UNRESOLVED_SIDES * size, least)


def unresolved(mean: Array, cov: Array, resolution: Array) -> Array:
    """(n, n) that a scan does not resolve i and j, 0 on the diagonal; resolution (n, 2) px per axis.

    Two points an offset Δ apart are taken to be one detection with probability exp(−½ Δᵀ A⁻¹ Δ), and Δ is only known
    as N(Δ, C): the mean is sqrt(|A| / |A + C|) exp(−½ Δᵀ (A + C)⁻¹ Δ). A is diagonal, and as large as an ellipse of the
    resolution's half axes. Koch & van Keuk, IEEE Trans. AES 33(3), 1997.
    """
    n = len(mean)
    result = np.zeros((n, n))
    if n < 2 or not resolution.any():
        return result
    position, sigma = mean[:, POSITION], np.sqrt(cov.diagonal(axis1=1, axis2=2)[:, POSITION])
    reach = RESOLVED_SIGMAS * (resolution / math.sqrt(8.0) + sigma)
    pairs = _overlapping(position - reach, position + reach)
    if not pairs:
        return result
    i, j = np.array(pairs).T
    offset = position[i] - position[j]
    A = 0.125 * (resolution[i] + resolution[j]) ** 2
    S = cov[i][:, POSITION, POSITION] + cov[j][:, POSITION, POSITION]
    a, b, c = S[:, 0, 0] + A[:, 0], S[:, 0, 1], S[:, 1, 1] + A[:, 1]
    u, v = offset[:, 0], offset[:, 1]
    determinant = a * c - b * b
    distance = (c * u * u - 2.0 * b * u * v + a * v * v) / determinant
    result[i, j] = result[j, i] = np.sqrt(A.prod(axis=1) / determinant) * np.exp(-0.5 * distance)
    return result


def _overlapping(low: Array, high: Array) -> list[tuple[int, int]]:
    """Pairs of n upright boxes that overlap, each once; low, high (n, 2): their corners.

    Sweep and prune along u: who is far from everybody is compared with the next one only. Ericson, Real-Time Collision
    Detection (2005), section 7.5.
    """
    left, top, right, bottom = (edge.tolist() for edge in (*low.T, *high.T))
    order = sorted(range(len(left)), key=left.__getitem__)
    pairs = []
    for place, i in enumerate(order):
        for j in order[place + 1 :]:
            if left[j] >= right[i]:
                break
            if top[j] < bottom[i] and top[i] < bottom[j]:
                pairs.append((i, j))
    return pairs


def hidden_behind(size: Array, sigma: float) -> Array:
    """(n, n) that j hides i if the two are not resolved: the larger is nearer; the equally large, either.

    size (n, 2) px, NaN while unknown; sigma: relative, of a side.
    """
    side = 0.5 * np.log(size).sum(axis=1)
    larger = np.nan_to_num(side[None] - side[:, None], nan=0.0)
    return np.asarray(0.5 * (1.0 + np.tanh(larger / sigma)))
