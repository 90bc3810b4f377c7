"""Small Kalman filters that follow bearings in a frame that does not turn, under several assumptions at once.

Turned by the gyro as it was at their exposure into such a frame, the bearings of a target change smoothly. What is
assumed wrongly, when the picture was taken (`time_offset.py`) or how the camera sits (`picture_turn.py`), makes them
move and shake with the camera. So the assumption whose filters are surprised least is the likeliest. All filters of a
target share one covariance, which does not know of the assumption; only their means differ.

How agile targets are is not told but found: each filter comes in a few densities of acceleration, in units of the
measurement's variance.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array, Scan
from swarmtrack.motion.gyro import Orientation
from swarmtrack.motion.priors import (
    BEARING_AGILITIES,
    BEARING_ESTABLISHED_HITS,
    BEARING_GATE,
    BEARING_GATE_SCALE_STEP,
    BEARING_LEAST_SCALE,
    BEARING_LONGEST_LAPSE_S,
    BEARING_MAX_DETECTIONS,
    BEARING_MAX_TARGETS,
    BEARING_MAX_TURN_VARIANCE_RAD2,
    BEARING_RATE_SIGMA_RAD_S,
)


def bearings_of(scan: Scan, camera: PinholeCamera) -> tuple[Array, Array]:
    """Unit vectors (m, 3), camera axes, of what a scan detected, and their variance (m,) rad² per axis."""
    m = BEARING_MAX_DETECTIONS
    bearings = camera.bearing_undistorted(scan.z)
    variance = camera.chart.solid_angle(scan.z)
    if scan.R is not None:
        with np.errstate(invalid="ignore"):
            variance = variance * np.sqrt(np.linalg.det(scan.R))
    sound = np.isfinite(variance) & (variance > 0.0)
    return bearings[sound][:m], variance[sound][:m]


def is_lapse(then: tuple[float, Orientation], now: tuple[float, Orientation]) -> bool:
    """Whether from one scan to the next, s and orientation of each, nothing can be followed."""
    turned = abs(now[1].variance - then[1].variance)
    return now[0] - then[0] > BEARING_LONGEST_LAPSE_S or turned > BEARING_MAX_TURN_VARIANCE_RAD2


def likelihoods(cost: Array, log_det: Array, components: Array) -> tuple[Array, Array]:
    """Log-likelihood of b blocks of innovations: their squares over their variances cost (b, q, g) for each agility
    and assumption, the sum of these variances' logarithms log_det (b, q), and their number components (b,): the
    log-likelihood (b, q, g) with the scale of all variances that suits best, and that scale (b, q, g).
    """
    n = components[:, None, None]
    scale = np.maximum(cost / n, BEARING_LEAST_SCALE)
    return -0.5 * (n * np.log(scale) + log_det[:, :, None]), scale


class BearingFilters:
    """Each target's bearing in a frame that does not turn, and its speed, under each of g assumptions of how that frame
    is turned.

    mean (slot, q, 2, 3, g) rad, rad/s; cov (slot, q, 3): variance of the bearing, covariance, variance of the speed;
    hits (slot,): detections so far, 0 where a slot is free; slots (n,): those that are not.
    """

    def __init__(self, assumptions: int) -> None:
        self.mean = np.zeros((BEARING_MAX_TARGETS, len(BEARING_AGILITIES), 2, 3, assumptions))
        self.cov = np.zeros((BEARING_MAX_TARGETS, len(BEARING_AGILITIES), 3))
        self._psd = np.zeros((BEARING_MAX_TARGETS, len(BEARING_AGILITIES)))
        self._gate_scale = 1.0
        self.restart()

    def restart(self) -> None:
        """No target is followed any longer."""
        self.hits = np.zeros(BEARING_MAX_TARGETS, dtype=int)
        self.slots = np.flatnonzero(self.hits)
        self._seen = np.zeros(BEARING_MAX_TARGETS)
        self._t = 0.0

    def follow(
        self,
        t: float,
        turned: Array,
        variance: Array,
        *,
        agility: int,
        likely: NDArray[np.bool_],
        least_hits: int,
    ) -> tuple[Array, Array, Array]:
        """A scan at t saw bearings turned (n, 3, g) of variance (n,) rad². A target goes on with one that is alone in
        its gate, the gate being open for all assumptions that are likely (g,); where there is a choice, nothing is
        learned. Returns, of those with so many hits at least, the innovations y (k, q, 3, g), their variance S (k, q),
        and that of the bearings (k,)."""
        self.predict(t)
        near = self._near(turned, variance, agility, likely)
        sure = near & (near.sum(axis=1, keepdims=True) == 1) & (near.sum(axis=0) == 1)
        rows, columns = np.nonzero(sure)
        slots = self.slots[rows]
        y, S = self.innovations(slots, turned[columns], variance[columns])
        known = self.hits[slots] >= least_hits
        self.correct(slots, y, S)
        self.leave_out(near.sum(axis=1) == 0)
        new = ~near.any(axis=0)
        self.begin(turned[new], variance[new])
        return y[known], S[known], variance[columns][known]

    def learn_gate(self, distance: Array) -> None:
        """From squared innovations over their variance (k,), under the assumption that suits each best. Steps towards
        the median find it even from where most fall outside the gate."""
        above = float(np.sign(distance - 2.0 * math.log(2.0) * self._gate_scale).sum())
        self._gate_scale *= math.exp(BEARING_GATE_SCALE_STEP * above)

    def _near(
        self, turned: Array, variance: Array, agility: int, likely: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Which of the detections (m, 3, g) lie in which target's gate, (n, m)."""
        prior = self.mean[self.slots, agility, 0][..., likely]
        e = turned[None, :, :, likely] - prior[:, None]
        S = self.cov[self.slots, agility, 0][:, None] + variance
        inside: NDArray[np.bool_] = (e * e).sum(axis=2).min(axis=2) < BEARING_GATE * self._gate_scale * S
        return inside

    def predict(self, t: float) -> None:
        """Carry all on to t; who was not seen for too long is gone."""
        dt, self._t = t - self._t, t
        self.hits[t - self._seen > BEARING_LONGEST_LAPSE_S] = 0
        slots = self.slots = np.flatnonzero(self.hits)
        self.mean[slots, :, 0] += dt * self.mean[slots, :, 1]
        p, c, v = self.cov[slots].transpose(2, 0, 1)
        psd = self._psd[slots]
        p, c = p + dt * (2.0 * c + dt * v) + psd * dt**3 / 3.0, c + dt * v + psd * dt**2 / 2.0
        self.cov[slots] = np.array([p, c, v + psd * dt]).transpose(1, 2, 0)

    def innovations(self, slots: NDArray[np.intp], turned: Array, variance: Array) -> tuple[Array, Array]:
        """y (n, q, 3, g) of the bearings turned (n, 3, g), and their variance S (n, q)."""
        return turned[:, None] - self.mean[slots, :, 0], self.cov[slots, :, 0] + variance[:, None]

    def correct(self, slots: NDArray[np.intp], y: Array, S: Array) -> None:
        p, c, v = self.cov[slots].transpose(2, 0, 1)
        self.mean[slots, :, 0] += (p / S)[:, :, None, None] * y
        self.mean[slots, :, 1] += (c / S)[:, :, None, None] * y
        self.cov[slots] = np.array([p - p * p / S, c - p * c / S, v - c * c / S]).transpose(1, 2, 0)
        self.hits[slots] += 1
        self._seen[slots] = self._t

    def leave_out(self, missing: NDArray[np.bool_]) -> None:
        """missing (n,): which of the targets have no detection in their gate; one that is new must have."""
        missed = self.slots[missing]
        self.hits[missed[self.hits[missed] < BEARING_ESTABLISHED_HITS]] = 0

    def begin(self, turned: Array, variance: Array) -> None:
        """New targets at bearings turned (n, 3, g), as many as there is room for."""
        slots = np.flatnonzero(self.hits == 0)[: len(turned)]
        turned, variance = turned[: len(slots)], variance[: len(slots)]
        self.mean[slots, :, 0] = turned[:, None]
        self.mean[slots, :, 1] = 0.0
        self.cov[slots] = np.array([1.0, 0.0, 0.0]) * variance[:, None, None]
        self.cov[slots, :, 2] = BEARING_RATE_SIGMA_RAD_S**2
        self._psd[slots] = BEARING_AGILITIES * variance[:, None]
        self.hits[slots] = 1
        self._seen[slots] = self._t
