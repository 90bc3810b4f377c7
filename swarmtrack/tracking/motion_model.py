"""How a target moves in the image: at constant velocity, and with the camera's rotation.

State [u, vu, v, vv]: undistorted pixels and px/s; the velocity is the target's own, the flow of the rotation is not in
it. Means are (n, 4), covariances (n, 4, 4): all tracks at once.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array

POSITION = slice(0, None, 2)  # u, v
VELOCITY = slice(1, None, 2)  # vu, vv

# A target that rotates further off the axis than this cosine-like depth leaves every image; beyond it the projection
# would fold over and show what is behind the camera in front of it, so it is held there: far outside, finite, soon
# dropped.
MIN_DEPTH = 0.05
_AT_REST = np.eye(4)
FAR = 100.0  # focal lengths off the axis, where the tangent of 89 degrees is 57

Turn = Callable[[Array, Array, PinholeCamera], tuple[Array, Array]]
"""Turns means with the camera: (mean (n, 4), rotation (3, 3), camera) -> (mean, and its Jacobian F (n, 4, 4))."""


def turn_exactly(mean: Array, camera_from_before: Array, camera: PinholeCamera) -> tuple[Array, Array]:
    """A finite rotation of every bearing: the homography K R K⁻¹ for the position, its derivative for the velocity.

    With M = K R K⁻¹, h = M·[u v 1], w = M·[vu vv 0] and k = 1 / h₃: p' = k h₁₂, v' = k (w₁₂ − w₃ p') = J v,
    J = ∂p'/∂p = k (M₁₂ − p' M₃), and ∂v'/∂p = −k (w₃ J + v' M₃).
    Hartley & Zisserman (2004), section 8.4, differentiated. The targets are the last axis on the way: NumPy loops
    over them then, and not over pairs of coordinates.
    """
    n = len(mean)
    M = camera.K @ camera_from_before @ camera.K_inverse
    m3 = M[2, :2, None]
    lifted = (M[:, :2] @ mean.T.reshape(2, 2 * n)).reshape(3, 2, n)
    h, w = lifted[:, 0], lifted[:, 1]
    h += M[:, 2:]
    (behind,) = (h[2] < MIN_DEPTH).nonzero()
    if behind.size:
        h[:, behind] = _far_outside(h[:, behind], camera)
    k = 1.0 / h[2]
    turned = lifted[:2] * k
    p, v = turned[:, 0], turned[:, 1]
    approach = k * w[2]
    v -= approach * p
    J = (M[:2, :2, None] - p[:, None] * m3) * k
    F = np.zeros((4, 4, n))
    F[POSITION, POSITION] = F[VELOCITY, VELOCITY] = J
    F[VELOCITY, POSITION] = -(approach * J + (k * v)[:, None] * m3)
    return np.ascontiguousarray(turned.reshape(4, n).T), np.ascontiguousarray(F.transpose(2, 0, 1))


def turn_by_flow(mean: Array, camera_from_before: Array, camera: PinholeCamera) -> tuple[Array, Array]:
    """The paper's turn: optical flow times the angle, x' = x + B(x) u and F = I + ∂B/∂x u; the velocity stays."""
    u = -rotation.log(camera_from_before)  # the camera turned by u, so what it sees turned by −u
    p = (mean[:, POSITION] - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    turned = mean.copy()
    turned[:, POSITION] += optical_flow(mean[:, POSITION], camera) @ u
    x, y = p[:, 0], p[:, 1]
    aspect = camera.fx / camera.fy
    F = np.tile(np.eye(4), (len(mean), 1, 1))
    F[:, 0, 0] += y * u[0] - 2.0 * x * u[1]
    F[:, 0, 2] += aspect * (x * u[0] + u[2])
    F[:, 2, 0] += (-y * u[1] - u[2]) / aspect
    F[:, 2, 2] += 2.0 * y * u[0] - x * u[1]
    return turned, F


def optical_flow(points: Array, camera: PinholeCamera) -> Array:
    """∂(pixel)/∂(angle) of points (n, 2) px at infinity for a rotation of the camera: (n, 2, 3) px/rad.

    The position rows of the paper's B (its equation 4) without dt, for two focal lengths.
    """
    x = (points[:, 0] - camera.cx) / camera.fx
    y = (points[:, 1] - camera.cy) / camera.fy
    flow = np.empty((len(points), 2, 3))
    flow[:, 0, 0], flow[:, 0, 1], flow[:, 0, 2] = x * y, -1.0 - x * x, y
    flow[:, 1, 0], flow[:, 1, 1], flow[:, 1, 2] = 1.0 + y * y, -x * y, -x
    return flow * [[camera.fx], [camera.fy]]


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

    At constant velocity, x' = A x, with white acceleration of density psd [px²/s³], one number or (n,): per axis
    Q = psd [dt³/3 dt²/2; dt²/2 dt], so that P grows the same per second at any rate. Bar-Shalom, Li & Kirubarajan
    (2001), section 6.2.2. With the turn's Jacobian F, P' = F (A P Aᵀ + Q) Fᵀ = (F A) (P + A⁻¹ Q A⁻ᵀ) (F A)ᵀ: one
    product of matrices for each track, and not two.

    rotation_variance [rad²] per axis is what the gyro does not know of it; it moves every target by its flow.
    """
    A = _AT_REST.copy()
    A[0, 1] = A[2, 3] = dt
    F: Array = A
    mean = mean @ A.T
    if rotation is not None:
        mean, turned = turn(mean, rotation, camera)
        F = (turned.reshape(-1, 4) @ A).reshape(-1, 4, 4)
    # matmul takes twice as long for a transposed view
    cov = F @ (cov + _noise_before(dt, psd)) @ np.ascontiguousarray(F.swapaxes(-1, -2))
    if rotation_variance > 0.0:
        add_flow_of_error(cov, mean, rotation_variance, camera)
    return mean, cov


def add_flow_of_error(cov: Array, mean: Array, variance: float, camera: PinholeCamera) -> None:
    """Add variance [rad²] × flow flowᵀ of `optical_flow`, multiplied out: (1 + x² + y²) (diag(fx², fy²) + q qᵀ) for
    q = (fx x, fy y) = (u, v) off the centre.
    """
    u, v = mean[:, 0] - camera.cx, mean[:, 2] - camera.cy
    ff, gg, uu, vv = camera.fx**2, camera.fy**2, u * u, v * v
    spread = variance + (variance / ff) * uu + (variance / gg) * vv
    cov[:, 0, 0] += spread * (ff + uu)
    cov[:, 2, 2] += spread * (gg + vv)
    across = spread * u * v
    cov[:, 0, 2] += across
    cov[:, 2, 0] += across


def _far_outside(h: Array, camera: PinholeCamera) -> Array:
    """(3, n) for targets at h (3, n) = K ray that no image shows: the way they went, beyond any lens' reach."""
    focal, centre = np.array([[camera.fx], [camera.fy]]), camera.K[:2, 2:]
    ray = (h[:2] - centre * h[2]) / focal
    length = np.hypot(ray[0], ray[1])
    way = np.where(length > 0.0, ray / np.where(length > 0.0, length, 1.0), [[1.0], [0.0]])
    far = np.full_like(h, MIN_DEPTH)
    far[:2] *= centre + FAR * focal * way
    return far


def _noise_before(dt: float, psd: float | Array) -> Array:
    """A⁻¹ Q A⁻ᵀ, (4, 4) or (n, 4, 4): white acceleration of density psd, as if all of it came before the motion."""
    a, b = dt**3 / 3.0, -(dt**2) / 2.0
    # One flat list: nested ones take twice as long.
    Q = np.array([a, b, 0.0, 0.0, b, dt, 0.0, 0.0, 0.0, 0.0, a, b, 0.0, 0.0, b, dt]).reshape(4, 4)
    return psd[:, None, None] * Q if isinstance(psd, np.ndarray) else psd * Q
