"""The detections' real scatter and the calm process noise, learned in flight, below and above the configured
values.

Theory of operation. A filter is told R, the noise of a detection, and Q, that of its motion model. If both are right,
its innovations ν are white with covariance S = H P Hᵀ + R. Whitened by the S that it assumed, e = S^(−1/2) ν, they tell
of the truth:

    u = |e|² / 2               1 on average: the normalised innovation squared per axis
    r = e · e_before / 2       0 on average: the correlation of neighbours (Mehra, IEEE Trans. AC 15(2), 1970)

An R that was told too large makes the filter sluggish: u < 1 and r > 0. A Q that was told too large makes it follow the
noise: u < 1 and r < 0. So u − r is what R must be multiplied by, whatever Q is: to 5 % for a steady filter at constant
velocity with q dt³ ≤ R / 10, to a quarter up to q dt³ = R (`tests/tracking/test_noise.py`). And u + r rises and falls
with Q. A manoeuvre raises both u and r: it teaches Q and leaves R alone.

Each detection counts by its Fisher information, (R / S)² of R and (P / S)² of Q. Where the prediction is much less sure
than a detection, R could be anything, and what was told stays. Where both are learned they are taken to be told wrong
by the same factor until proven otherwise, for that leaves every estimate as it was; then the shares count once.

A wrong clock and a gyro that lags show while the camera starts or stops to turn. That is no noise of detections, so
scans in which its rate has just changed teach Q alone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.tracking.gaussian import variances
from swarmtrack.tracking.motion_model import POSITION
from swarmtrack.tracking.priors import (
    LOG_Q_PRIOR_SIGMA,
    LOG_R_PRIOR_SIGMA,
    MEASURED_SCALE_INFORMATION,
    NOISE_CLASS_KEPT,
    NOISE_CLASS_SIDES_PX,
    NOISE_NEWTON_STEPS,
    NOISE_NEWTON_TOLERANCE,
    PIXEL_SIGMA_PX,
    Q_SCALE_BOUNDS,
    R_SCALE_BOUNDS,
    WINSOR_LIMIT,
)

POINTS = len(NOISE_CLASS_SIDES_PX)


Rows = tuple[NDArray[np.intp], NDArray[np.intp]]


class SurePairs(NamedTuple):
    """k detections of a scan, each surely made by one track. track (k,) ids; detection (k,) rows in the scan; whitened
    (k, 2) innovations; share (k,): of R in S; weight (k,): that the track flew as the model says that is judged; nis
    (k,): squared Mahalanobis distances by all models, of which 2 is expected.
    """

    track: NDArray[np.int64]
    detection: NDArray[np.intp]
    whitened: Array
    share: Array
    weight: Array
    nis: Array


class Scale:
    """A factor λ on a variance. The likelihood of n weighted samples of mean a, N ln λ + a / λ, whose memory fades, and
    a lognormal prior around what was told; the value is the mode of the posterior."""

    def __init__(self, prior_log_sigma: float, least: float, most: float) -> None:
        self.value = 1.0
        self._precision = prior_log_sigma**-2
        self._least, self._most = math.log(least), math.log(most)
        self._weight = self._sum = 0.0

    @property
    def weight(self) -> float:
        """Effective number of detections behind it, by their information."""
        return self._weight

    @property
    def is_known(self) -> bool:
        """Whether it is measured rather than configured."""
        return self._weight > MEASURED_SCALE_INFORMATION * self._precision

    def add(self, ratio: float, information: float) -> None:
        """One detection says that the variance is `ratio` times what it was assumed to be, which is `value`."""
        self._weight = NOISE_CLASS_KEPT * self._weight + information
        self._sum = NOISE_CLASS_KEPT * self._sum + information * ratio * self.value

    def settle(self) -> None:
        """Newton's method on N ℓ + A exp(−ℓ) + ℓ² / (2 τ²), which is convex in ℓ = ln λ."""
        total, log = max(self._sum, 0.0), math.log(self.value)
        for _ in range(NOISE_NEWTON_STEPS):
            fit = total * math.exp(-log)
            step = (self._weight - fit + self._precision * log) / (fit + self._precision)
            log = min(max(log - step, self._least), self._most)
            if abs(step) < NOISE_NEWTON_TOLERANCE:
                break
        self.value = math.exp(log)


class MeasuredNoise(NamedTuple):
    """What flights say of what was told, as factors on standard deviations. detections: on R's, over all classes of
    sizes; motion: on that of the calm motion model, None where it is not learned."""

    detections: float
    motion: float | None


class NoiseScales:
    """Factors on R, per class of sizes, and on the calm motion's noise. motion: whether the latter is estimated."""

    def __init__(self, *, motion: bool) -> None:
        self._R = [Scale(LOG_R_PRIOR_SIGMA, *R_SCALE_BOUNDS) for _ in range(POINTS + 1)]
        self._Q = Scale(LOG_Q_PRIOR_SIGMA, *Q_SCALE_BOUNDS)
        self._learns_motion = motion
        self._before: dict[int, tuple[float, float, float]] = {}
        """Of each track, the whitened innovation of the scan before, and its weight."""

    @property
    def motion(self) -> float:
        return self._Q.value

    @property
    def measured(self) -> MeasuredNoise | None:
        """None until some class is known."""
        known = [scale for scale in self._R if scale.is_known]
        if not known:
            return None
        total = math.fsum(scale.weight for scale in known)
        log = math.fsum(scale.weight * math.log(scale.value) for scale in known) / total
        return MeasuredNoise(math.exp(0.5 * log), math.sqrt(self._Q.value) if self._learns_motion else None)

    def applied(self, R: Array, size: Array) -> Array:
        """R (m, 2, 2) px² of boxes of sizes (m, 2) px, NaN for points, as it was measured."""
        scale = np.array([scale.value for scale in self._R])[size_class(size)]
        R = R * scale[:, None, None]
        variance = variances(R)
        np.maximum(variance, PIXEL_SIGMA_PX**2, out=variance)
        return R

    def update(self, pairs: SurePairs, size: Array, *, steady: bool) -> None:
        """Update from one scan: size (m, 2) px of its detections; steady: the camera turns as it did in the scan
        before.
        """
        before, self._before = self._before, {}
        kinds = size_class(size[pairs.detection]).tolist()
        columns = (pairs.track, pairs.whitened, pairs.share, pairs.weight)
        for kind, track, (x, y), share, weight in zip(kinds, *(c.tolist() for c in columns), strict=True):
            last = before.get(track)
            self._before[track] = (x, y, weight)
            if last is None:
                continue
            u = min(0.5 * (x * x + y * y), WINSOR_LIMIT)
            r = min(max(0.5 * (x * last[0] + y * last[1]), -WINSOR_LIMIT), WINSOR_LIMIT)
            both = weight * last[2]
            if steady:
                self._R[kind].add(u - r, both * share * (1.0 if self._learns_motion else share))
            if self._learns_motion:
                self._Q.add(u + r, both * (1.0 - share))
        for scale in {*kinds}:
            self._R[scale].settle()
        self._Q.settle()


def pairs_of(
    track: NDArray[np.int64], prior: tuple[Array, Array], measured: tuple[Array, Array], rows: Rows
) -> SurePairs:
    """Pairs of Gaussian tracks: ids (n,), means (n, 4) and covariances (n, 4, 4); measured: z (m, 2), R (m, 2, 2);
    rows: of tracks (k,) and of detections (k,).
    """
    (mean, cov), (z, R), (i, j) = prior, measured, rows
    made = R.take(j, axis=0)
    S = cov.take(i, axis=0)[:, POSITION, POSITION] + made
    e = whitened(z.take(j, axis=0) - mean.take(i, axis=0)[:, POSITION], S)
    share = 0.5 * (made.diagonal(axis1=1, axis2=2) / S.diagonal(axis1=1, axis2=2)).sum(axis=1)
    return SurePairs(track[i], j, e, share, np.ones(len(i)), (e * e).sum(axis=1))


def size_class(size: Array) -> NDArray[np.intp]:
    """(n,) of boxes (n, 2) px; NaN for points."""
    side = np.sqrt(size[:, 0] * size[:, 1])
    return NOISE_CLASS_SIDES_PX.searchsorted(side)


def whitened(y: Array, S: Array) -> Array:
    """L⁻¹ y (k, 2) with S = L Lᵀ, of innovations y (k, 2) and their covariances S (k, 2, 2)."""
    a = np.sqrt(S[:, 0, 0])
    across = S[:, 0, 1] / a
    e = np.empty_like(y)
    e[:, 0] = first = y[:, 0] / a
    e[:, 1] = (y[:, 1] - across * first) / np.sqrt(S[:, 1, 1] - across**2)
    return e
