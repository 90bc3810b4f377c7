"""Motion model of a target in the image: constant velocity, and the camera's rotation.

State [u, vu, v, vv]: undistorted pixels and px/s; the velocity is the target's own, the flow of the rotation is not in
it. Means are (n, 4), covariances (n, 4, 4): all tracks at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.charts import Stereographic, Turned, cross
from swarmtrack.messages import Array

POSITION = slice(0, None, 2)  # u, v
VELOCITY = slice(1, None, 2)  # vu, vv

_AT_REST = np.eye(4)

Turn = Callable[[Array, Array, PinholeCamera], tuple[Array, Array]]
"""Turns means with the camera: (mean (n, 4), rotation (3, 3), camera) -> (mean, and its Jacobian F (n, 4, 4))."""


def turn_exactly(mean: Array, camera_from_before: Array, camera: PinholeCamera) -> tuple[Array, Array]:
    """A finite rotation of every bearing, see `Chart.turn`: its derivative turns the velocity."""
    return _of_states(camera.chart.turn(_moving(mean), camera_from_before))


def turn_by_flow(mean: Array, camera_from_before: Array, camera: PinholeCamera) -> tuple[Array, Array]:
    """The paper's turn: optical flow times the angle, x' = x + B(x) u and F = I + ∂B/∂x u; the velocity stays."""
    u = -rotation.log(camera_from_before)  # the camera turned by u, so what it sees turned by −u
    turned = mean.copy()
    turned[:, POSITION] += optical_flow(mean[:, POSITION], camera) @ u
    F = np.tile(np.eye(4), (len(mean), 1, 1))
    F[:, POSITION, POSITION] += camera.chart.flow_gradient(mean[:, POSITION], u)
    return turned, F


def turn_into(before: PinholeCamera) -> Turn:
    """Transform from one camera's pixels to those of another with another axis: its axes from those. Lenses may be
    of two kinds.
    """

    def turn(mean: Array, camera_from_before: Array, camera: PinholeCamera) -> tuple[Array, Array]:
        # Turned where all directions have a place: one that is ahead of either camera only has none with the other.
        whole = Stereographic(camera.fx, camera.fy, camera.cx, camera.cy)
        lifted, F = _of_states(cross(_moving(mean), before.chart, whole))
        turned, G = _of_states(whole.turn(_moving(lifted), camera_from_before))
        found, H = _of_states(cross(_moving(turned), whole, camera.chart))
        return found, H @ G @ F

    return turn


def _moving(mean: Array) -> Array:
    """(2, 2, n) of means (n, 4): coordinate, then place and motion."""
    return mean.T.reshape(2, 2, len(mean))


def _of_states(turned: Turned) -> tuple[Array, Array]:
    """Means (n, 4), and their Jacobian (n, 4, 4)."""
    moving, F = turned
    return np.ascontiguousarray(moving.reshape(4, -1).T), F


def optical_flow(points: Array, camera: PinholeCamera) -> Array:
    """∂(pixel)/∂(angle) of points (n, 2) px at infinity for a rotation of the camera: (n, 2, 3) px/rad."""
    return camera.chart.flow(points)


def propagate(
    mean: Array,
    cov: Array,
    dt: float,
    *,
    psd: float | Array,
    camera: PinholeCamera,
    rotation: Array | None = None,
    rotation_variance: float = 0.0,
    turn: Turn = turn_exactly,
) -> tuple[Array, Array]:
    """Carry all targets on by dt [s] while the camera turns: rotation (3, 3) is camera axes then to axes now.

    At constant velocity, x' = A x, with white acceleration of density psd [px²/s³], one number or (n,): per axis Q =
    psd [dt³/3 dt²/2; dt²/2 dt], so that P grows the same per second at any rate. Bar-Shalom, Li & Kirubarajan (2001),
    section 6.2.2. With the turn's Jacobian F, P' = F (A P Aᵀ + Q) Fᵀ = (F A) (P + A⁻¹ Q A⁻ᵀ) (F A)ᵀ: one product of
    matrices for each track, and not two. Back, where dt < 0, Q is zero: what a scan has told since does not wear off
    by looking back, and is not known better.

    rotation_variance [rad²] per axis is what the gyro does not know of it; it moves every target by its flow.
    """
    A = _AT_REST.copy()
    A[0, 1] = A[2, 3] = dt
    F: Array = A
    mean = mean @ A.T
    if rotation is not None:
        mean, turned = turn(mean, rotation, camera)
        F = (turned.reshape(-1, 4) @ A).reshape(-1, 4, 4)
    cov = _through(F, cov + _noise_before(dt, psd))
    if rotation_variance > 0.0:
        add_flow_of_error(cov, mean, rotation_variance, camera)
    return mean, cov


def _through(F: Array, cov: Array) -> Array:
    """F P Fᵀ."""
    # matmul takes twice as long for a transposed view
    return F @ cov @ np.ascontiguousarray(F.swapaxes(-1, -2))


@dataclass(frozen=True)
class FadingAcceleration:
    """acceleration (L, n, 2) px/s², of L kinds that fade in times of their own. reach: by how much one of 1 moves
    position and velocity within dt, 2 L numbers."""

    acceleration: Array
    reach: Callable[[float], Sequence[float]]


class Course:
    """Prediction of n targets from means (n, 4) and covariances (n, 4, 4) to many times.

    It says what `propagate` says. Before the camera's turn, all numbers are polynomials of the time that passes: their
    coefficients are worked out once, and one product tells the numbers of a time.
    """

    def __init__(
        self,
        mean: Array,
        cov: Array,
        *,
        psd: float | Array,
        camera: PinholeCamera,
        turn: Turn,
        drift: FadingAcceleration | None = None,
        gyro_error: Callable[[float], float] = float,
    ) -> None:
        """drift: beside the velocity. gyro_error: the variance to believe, from that which is said with a turn."""
        self._n = n = len(mean)
        self._camera, self._turn, self._gyro_error = camera, turn, gyro_error
        self._reach = None if drift is None else drift.reach
        # A row each for 1, dt, dt²; for Q of constant psd, which is 0 where dt < 0; for the reach of an acceleration.
        rows = 6 if drift is None else 6 + 2 * len(drift.acceleration)
        self._by_time = np.zeros((rows, 20 * n))
        states = self._by_time[:, : 4 * n].reshape(rows, 4, n)
        covs = self._by_time[:, 4 * n :].reshape(rows, n, 4, 4)
        states[0] = mean.T
        states[1, POSITION] = mean.T[VELOCITY]
        covs[0] = cov
        covs[1, :, POSITION] = cov[:, VELOCITY]
        covs[1, :, :, POSITION] += cov[:, :, VELOCITY]
        covs[2, :, POSITION, POSITION] = cov[:, VELOCITY, VELOCITY]
        noise = covs[3:6].reshape(3, n, 16)
        density = np.reshape(psd, (-1, 1))
        noise[0][:, [5, 15]] = density
        noise[1][:, [1, 4, 11, 14]] = density / 2.0
        noise[2][:, [0, 10]] = density / 3.0
        if drift is not None:
            states[6::2, POSITION] = states[7::2, VELOCITY] = drift.acceleration.swapaxes(1, 2)

    def at(self, dt: float, rotation: Array | None, rotation_variance: float) -> tuple[Array, Array]:
        """Means (n, 4) and covariances (n, 4, 4) after dt; rotation, rotation_variance: see `propagate`."""
        ahead, n = max(dt, 0.0), self._n
        powers = [1.0, dt, dt * dt, ahead, ahead**2, ahead**3]
        if self._reach is not None:
            powers += self._reach(dt)
        numbers = np.array(powers) @ self._by_time
        mean, cov = numbers[: 4 * n].reshape(4, n).T, numbers[4 * n :].reshape(n, 4, 4)
        if rotation is not None:
            mean, F = self._turn(mean, rotation, self._camera)
            cov = _through(F, cov)
        variance = self._gyro_error(rotation_variance)
        if variance > 0.0:
            add_flow_of_error(cov, mean, variance, self._camera)
        return mean, cov


def add_flow_of_error(cov: Array, mean: Array, variance: float, camera: PinholeCamera) -> None:
    """Add variance [rad²] × flow flowᵀ of `optical_flow`, in place."""
    camera.chart.add_flow_of_error(cov, mean[:, :4:2], variance)


def _noise_before(dt: float, psd: float | Array) -> Array:
    """A⁻¹ Q A⁻ᵀ, (4, 4) or (n, 4, 4): white acceleration of density psd, as if all of it came before the motion."""
    dt = max(dt, 0.0)
    a, b = dt**3 / 3.0, -(dt**2) / 2.0
    # One flat list: nested ones take twice as long.
    Q = np.array([a, b, 0.0, 0.0, b, dt, 0.0, 0.0, 0.0, 0.0, a, b, 0.0, 0.0, b, dt]).reshape(4, 4)
    return psd[:, None, None] * Q if isinstance(psd, np.ndarray) else psd * Q
