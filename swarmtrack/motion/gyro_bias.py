"""What the gyro says at rest, found in flight: the drift of its integral from the autopilot's attitude.

Theory of operation. An error-state Kalman filter holds an orientation, turned on by the gyro, and the gyro's bias; the
autopilot's attitude corrects both (Solà, "Quaternion kinematics for the error-state Kalman filter" (2017), section 5).
The three axes are alike, so one covariance (2, 2) serves all. An attitude's errors last for about a second, so what
comes more often is believed less each time. One that lies far off is left out; when it keeps lying there, the estimator
behind it has jumped, and only the orientation starts again: the bias does not jump with it.

The image alone cannot tell a bias from targets that all drift together, so without an attitude nothing is found.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarmtrack.geometry import rotation
from swarmtrack.messages import Array
from swarmtrack.motion.gyro import GyroHistory, Orientation, rotation_between
from swarmtrack.motion.priors import (
    BIAS_ATTITUDE_ERROR_LASTS_S,
    BIAS_ATTITUDE_LEAST_SIGMA_RAD,
    BIAS_ATTITUDE_PERIOD_S,
    BIAS_JUMP_ATTITUDES,
    BIAS_PRIOR_SIGMA_RAD_S,
    BIAS_RANDOM_WALK_RAD_S_SQRT_S,
    BIAS_RESIDUAL_GATE,
    BIAS_USED_SIGMA_RAD_S,
)


class BiasEstimate(NamedTuple):
    """bias (3,) rad/s of the gyro in camera axes; sigma [rad/s] per axis."""

    bias: Array
    sigma: float


class KnownGyroBias(NamedTuple):
    """found: estimated in flight, None while nothing is; used (3,) rad/s: what is taken off every sample."""

    found: BiasEstimate | None
    used: Array


class GyroBias:
    """Compares a gyro with attitudes, and takes the bias off it once that is sure."""

    def __init__(self, gyro: GyroHistory, *, estimates: bool = True) -> None:
        self.refused = 0
        """Attitudes far from where the gyro says the camera looks."""
        self._gyro = gyro
        self._told = gyro.bias
        self._estimates = estimates
        self._pending: tuple[float, Array, float] | None = None
        self.restart()

    def restart(self) -> None:
        """Drop the estimate: the autopilot rebooted, and may have calibrated its gyro again."""
        self._gyro.bias = self._told
        self._bias = np.array(self._told)
        self._pending = None
        self._last: tuple[float, Orientation] | None = None
        self._world_from_camera = np.eye(3)
        # Variance of the orientation's error, their covariance, variance of the bias.
        self._p, self._c, self._v = 0.0, 0.0, BIAS_PRIOR_SIGMA_RAD_S**2
        self._outside = 0

    @property
    def found(self) -> BiasEstimate | None:
        """Estimate so far; None while it is no better than the prior."""
        sigma = math.sqrt(self._v)
        return BiasEstimate(self._bias, sigma) if sigma < 0.5 * BIAS_PRIOR_SIGMA_RAD_S else None

    def known_in(self, axes: Array) -> KnownGyroBias:
        """What is known, in other axes (3, 3), from camera axes."""
        found = self.found
        return KnownGyroBias(
            found and found._replace(bias=axes @ found.bias), np.asarray(axes @ self._gyro.bias)
        )

    @property
    def counters(self) -> dict[str, int]:
        """Rejected attitudes."""
        return {"attitudes_refused": self.refused}

    def add_attitude(self, t: float, world_from_camera: Array, sigma: float) -> None:
        """Add the autopilot's attitude at t: world_from_camera (3, 3), its sigma [rad] per axis."""
        if not self._estimates:
            return
        if self._last is not None and t < self._last[0] + BIAS_ATTITUDE_PERIOD_S:
            if t > self._last[0] - self._gyro.history_s:
                return
            self._last = None  # the stamps jumped back
        # Whatever the gyro does not reach, because its stamps jumped or it fell silent, must not wait for ever.
        if self._pending is None or abs(t - self._pending[0]) > BIAS_ATTITUDE_PERIOD_S:
            self._pending = (t, world_from_camera, max(sigma, BIAS_ATTITUDE_LEAST_SIGMA_RAD))
            self.settle()

    def settle(self) -> None:
        """Use the attitude that waits, once the gyro has reached it."""
        newest = self._gyro.newest
        if self._pending is None or newest is None or newest < self._pending[0]:
            return
        (t, attitude, sigma), self._pending = self._pending, None
        if t < newest - self._gyro.history_s:
            return
        orientation = self._gyro.orientation(t)
        before, self._last = self._last, (t, orientation)
        if before is None:
            self._look_along(attitude, sigma)
        else:
            self._predict(before, t, orientation)
            self._correct(
                attitude, sigma * math.sqrt(max(1.0, BIAS_ATTITUDE_ERROR_LASTS_S / (t - before[0])))
            )
        if self._v < BIAS_USED_SIGMA_RAD_S**2:
            x, y, z = self._bias.tolist()
            self._gyro.bias = (x, y, z)

    def _predict(self, before: tuple[float, Orientation], t: float, orientation: Orientation) -> None:
        then, was = before
        dt = t - then
        turn = rotation_between(orientation, was)  # camera axes then from camera axes now
        left = np.array(self._gyro.bias) - self._bias  # what was taken off in excess
        self._world_from_camera = self._world_from_camera @ turn.matrix @ rotation.exp(left * dt)
        self._p += turn.variance - 2.0 * dt * self._c + dt * dt * self._v
        self._c -= dt * self._v
        self._v += BIAS_RANDOM_WALK_RAD_S_SQRT_S**2 * dt

    def _correct(self, attitude: Array, sigma: float) -> None:
        residual = rotation.log(self._world_from_camera.T @ attitude)
        S = self._p + sigma**2
        if residual @ residual > BIAS_RESIDUAL_GATE * S:
            self.refused += 1
            self._outside += 1
            if self._outside >= BIAS_JUMP_ATTITUDES:
                self._look_along(attitude, sigma)
            return
        self._outside = 0
        self._world_from_camera = self._world_from_camera @ rotation.exp(self._p / S * residual)
        self._bias = self._bias + self._c / S * residual
        self._v -= self._c**2 / S
        self._c -= self._p * self._c / S
        self._p -= self._p**2 / S

    def _look_along(self, attitude: Array, sigma: float) -> None:
        self._world_from_camera = attitude
        self._p, self._c = sigma**2, 0.0
        self._outside = 0
