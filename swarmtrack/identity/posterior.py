"""Which track is which drone: the paper's Algorithm 1, and the posterior over all one-to-one matchings."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.identity.reprojection import Predictions
from swarmtrack.messages import Array
from swarmtrack.tracking.association import gate_threshold
from swarmtrack.tracking.gaussian import LOG_TWO_PI
from swarmtrack.tracking.marginals import matching_marginals

# Prior: that a drone which may be anywhere is in front of this camera.
IN_VIEW = 0.2
GATE_PROBABILITY = 0.9999
# Of a covariance: its determinant over that without correlation; beyond it rounding is all there is.
FLATTEST = 1e-12


class Prior(NamedTuple):
    """What to expect of an image. p_seen: that a drone which should be in view has a confirmed track; strangers:
    how many confirmed tracks are none of the announced drones. Neither is ever certain: p_seen < 1, strangers > 0."""

    p_seen: float = 0.9
    strangers: float = 1.0

    @property
    def log_ratio(self) -> float:
        """Of "this track is that drone" and "a stranger, and the drone is not seen", before looking where they
        are."""
        return math.log(self.p_seen / (1.0 - self.p_seen) / self.strangers)


PRIOR = Prior()
LOG_ANYWHERE = PRIOR.log_ratio + math.log(IN_VIEW)
"""The log ratio of a drone that may be anywhere, and any track."""


class ReprojectionResiduals(NamedTuple):
    """Between n tracks and k predicted drones: mean (n, k, 2) px, and what it should be by each of c hypotheses on
    the drone's motion: cov (c, n, k, 2, 2) px², share (c, k)."""

    mean: Array
    cov: Array
    share: Array


def residuals(mean: Array, cov: Array, predicted: Predictions) -> ReprojectionResiduals:
    """Of one scan. mean (n, 4), cov (n, 4, 4) of the tracks."""
    return ReprojectionResiduals(
        mean[:, None, ::2] - predicted.pixel,
        cov[:, None, ::2, ::2] + predicted.cov[:, None],
        predicted.share,
    )


def log_ratios(found: ReprojectionResiduals, camera: PinholeCamera, prior: Prior = PRIOR) -> Array:
    """log (n, k) of how much more likely "track i is drone j" is than "i is a stranger, and j is not seen"; −inf
    outside every gate.

    Strangers are a Poisson process, uniform over the image. Nobody's density is thinner than that of a drone which is
    in view with probability `IN_VIEW`, and anywhere in it.
    """
    log_area = math.log(camera.width * camera.height)
    distance, determinant = squared_sigmas(found.mean, found.cov)
    # Of the Gaussian, px².
    log_extent = LOG_TWO_PI + 0.5 * np.log(determinant)
    # From a pose that is no time old, nothing has flown off: the logarithm of a share of zero.
    with np.errstate(divide="ignore"):
        log_share = np.log(found.share)[:, None]
    log_density = log_share - 0.5 * distance - np.minimum(log_extent, log_area - math.log(IN_VIEW))
    log_density[distance > gate_threshold(GATE_PROBABILITY)] = -np.inf
    total = np.logaddexp.reduce(log_density, axis=0)
    return np.asarray(total + log_area + prior.log_ratio)


def squared_sigmas(mean: Array, cov: Array) -> tuple[Array, Array]:
    """How many sigmas (...) of cov (..., 2, 2) each mean (..., 2) is long, squared; and the determinants (...)."""
    u, v = mean[..., 0], mean[..., 1]
    a, b, c = cov[..., 0, 0], cov[..., 0, 1], cov[..., 1, 1]
    # Anyone may announce a covariance like a needle: its determinant must not round to zero, and all of this to NaN.
    determinant = np.maximum(a * c - b * b, FLATTEST * a * c)
    return np.maximum(c * u * u - 2.0 * b * u * v + a * v * v, 0.0) / determinant, determinant


def log_ratios_of_each(found: ReprojectionResiduals, camera: PinholeCamera) -> Array:
    """(s, n, k): the same of residuals of s hypotheses, mean (s, n, k, 2) and cov (c, s, n, k, 2, 2)."""
    s, n, k = found.mean.shape[:3]
    rows = ReprojectionResiduals(
        found.mean.reshape(s * n, k, 2), found.cov.reshape(len(found.cov), s * n, k, 2, 2), found.share
    )
    return log_ratios(rows, camera).reshape(s, n, k)


def posterior(
    mean: Array, cov: Array, predicted: Predictions, camera: PinholeCamera, prior: Prior = PRIOR
) -> Array:
    """The probability (n, k) that track i is drone j by one scan alone; what a row lacks to one is "none of them"."""
    if len(mean) == 0 or not predicted.drone_id:
        return np.zeros((len(mean), len(predicted.drone_id)))
    return matching_marginals(log_ratios(residuals(mean, cov, predicted), camera, prior))


def nearest(mean: Array, predicted: Predictions) -> dict[int, int]:
    """Algorithm 1 as printed: row -> ID of the nearest projection, twice the same if so it falls.

    mean (n, 4) of the tracks. No gate, no "unknown".
    """
    if not predicted.drone_id:
        return {}
    distance = np.linalg.norm(mean[:, None, ::2] - predicted.pixel[None], axis=2)
    return {row: predicted.drone_id[column] for row, column in enumerate(distance.argmin(axis=1))}
