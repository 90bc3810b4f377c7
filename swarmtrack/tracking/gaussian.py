"""The linear-Gaussian half of every tracker: innovations and updates of many tracks at once, positions measured.

z [u, v]; mean (n, 4) [u, vu, v, vv]; cov (n, 4, 4); R (…, 2, 2) px².
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarmtrack.messages import Array
from swarmtrack.tracking.motion_model import POSITION

LOG_TWO_PI = math.log(2.0 * math.pi)
IDENTITY = np.eye(4)
IDENTITY.setflags(write=False)


class Innovations(NamedTuple):
    """Innovations of n tracks × m measurements: distance (…, n, m), squared Mahalanobis; log_density (…, n, m) of
    N(y; 0, S).
    """

    distance: Array
    log_density: Array


def variances(cov: Array) -> Array:
    """The diagonals (…, d) of matrices (…, d, d) in C order: a view to write through, which `diagonal` does not
    give."""
    assert cov.flags.c_contiguous, "a copy would be written to"
    d = cov.shape[-1]
    return cov.reshape(*cov.shape[:-2], d * d)[..., :: d + 1]


def innovations(mean: Array, cov: Array, z: Array, R: Array) -> Innovations:
    """y = z − H x and S = H P Hᵀ + R for n tracks × m measurements; z (m, 2), R (m, 2, 2).

    R (k, m, 2, 2): the same with each of k noises at once, k in front of the result.
    """
    R = R[..., None, :, :, :]
    u, v = z[:, 0] - mean[:, 0, None], z[:, 1] - mean[:, 2, None]
    a, b, c = (
        cov[:, 0, 0, None] + R[..., 0, 0],
        cov[:, 0, 2, None] + R[..., 0, 1],
        cov[:, 2, 2, None] + R[..., 1, 1],
    )
    determinant = a * c - b * b
    distance = (c * u * u - 2.0 * b * u * v + a * v * v) / determinant
    return Innovations(distance, -0.5 * (distance + np.log(determinant)) - LOG_TWO_PI)


def update(mean: Array, cov: Array, z: Array, R: Array) -> tuple[Array, Array]:
    """Fold measurement z (k, 2) with R (k, 2, 2) into track k of mean (k, 4), cov (k, 4, 4).

    Joseph form, (I − K H) P (I − K H)ᵀ + K R Kᵀ: stays symmetric and positive when R is tiny, which (I − K H) P does
    not. H, two rows of the identity, makes it two products of rank two: B = P − K H P, then B + (K R − B Hᵀ) Kᵀ.
    Bar-Shalom, Li & Kirubarajan (2001), section 5.2.
    """
    PHt = cov[:, :, POSITION]
    K = PHt @ inverse(PHt[:, POSITION] + R)
    corrected = mean + (K @ (z - mean[:, POSITION])[:, :, None])[:, :, 0]
    B = cov - K @ cov[:, POSITION]
    P = B + (K @ R - B[:, :, POSITION]) @ K.swapaxes(1, 2)
    return corrected, 0.5 * (P + P.swapaxes(1, 2))


def inverse(S: Array) -> Array:
    """Inverse of symmetric positive (k, 2, 2) in closed form, ten times faster than a general solver on such small
    ones.
    """
    a, b, c = S[:, 0, 0], S[:, 0, 1], S[:, 1, 1]
    determinant = a * c - b * b
    inverse = np.empty_like(S)
    inverse[:, 0, 0], inverse[:, 1, 1] = c / determinant, a / determinant
    inverse[:, 0, 1] = inverse[:, 1, 0] = -b / determinant
    return inverse
