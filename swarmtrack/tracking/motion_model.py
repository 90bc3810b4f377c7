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
FAR = 100.0  # focal lengths off the axis, where the tangent of 89 degrees is 57

Turn = Callable[[Array, Array, PinholeCamera], tuple[Array, Array]]
"""Turns means with the camera: (mean (n, 4), rotation (3, 3), camera) -> (mean, and its Jacobian F (n, 4, 4))."""


def drift(mean: Array, cov: Array, dt: float, psd: float) -> tuple[Array, Array]:
    """Constant velocity with white acceleration of density psd [px²/s³].

    Per axis Q = psd [dt³/3 dt²/2; dt²/2 dt], so that P grows the same per second at any rate.
    Bar-Shalom, Li & Kirubarajan (2001), section 6.2.2. Written out: A P Aᵀ + Q by rows and columns.
    """
    mean = mean.copy()
    mean[:, POSITION] += dt * mean[:, VELOCITY]
    cov = cov.copy()
    cov[:, POSITION] += dt * cov[:, VELOCITY]
    cov[:, :, POSITION] += dt * cov[:, :, VELOCITY]
    return mean, cov + _white_acceleration(dt, psd)


def turn_exactly(mean: Array, camera_from_before: Array, camera: PinholeCamera) -> tuple[Array, Array]:
    """A finite rotation of every bearing: the homography K R K⁻¹ for the position, its derivative for the velocity.

    With M = K R K⁻¹, h = M·[u v 1], w = M·[vu vv 0] and k = 1 / h₃: p' = k h₁₂, v' = k (w₁₂ − w₃ p') = J v,
    J = ∂p'/∂p = k (M₁₂ − p' M₃), and ∂v'/∂p = −k (w₃ J + v' M₃).
    Hartley & Zisserman (2004), section 8.4, differentiated.
    """
    M = _homography(camera_from_before, camera)
    m3 = M[2, :2]
    h = mean[:, POSITION] @ M[:, :2].T + M[:, 2]
    w = mean[:, VELOCITY] @ M[:, :2].T
    k = 1.0 / np.maximum(h[:, 2:], MIN_DEPTH)
    p = h[:, :2] * k
    behind = h[:, 2] < MIN_DEPTH
    if behind.any():
        p[behind] = _far_outside(h[behind], camera)
    v = (w[:, :2] - p * w[:, 2:]) * k
    J = (M[:2, :2] - p[:, :, None] * m3) * k[:, :, None]
    turned = np.empty_like(mean)
    turned[:, POSITION], turned[:, VELOCITY] = p, v
    F = np.zeros((len(mean), 4, 4))
    F[:, POSITION, POSITION] = F[:, VELOCITY, VELOCITY] = J
    F[:, VELOCITY, POSITION] = (w[:, 2:, None] * J + v[:, :, None] * m3) * -k[:, :, None]
    return turned, F


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
    psd: float,
    camera: PinholeCamera,
    rotation: Array | None = None,
    rotation_variance: float = 0.0,
    turn: Turn = turn_exactly,
) -> tuple[Array, Array]:
    """Carry all targets on by dt [s] while the camera turns: rotation (3, 3) is camera axes then to axes now.

    rotation_variance [rad²] per axis is what the gyro does not know of it; it moves every target by its flow.
    """
    mean, cov = drift(mean, cov, dt, psd)
    if rotation is not None and len(mean):
        mean, F = turn(mean, rotation, camera)
        cov = F @ cov @ F.swapaxes(1, 2)
    if rotation_variance > 0.0 and len(mean):
        cov[:, POSITION, POSITION] += rotation_variance * _flow_squared(mean[:, POSITION], camera)
    return mean, cov


def _homography(camera_from_before: Array, camera: PinholeCamera) -> Array:
    """K R K⁻¹."""
    return np.asarray(camera.K @ camera_from_before @ camera.K_inverse)


def _far_outside(h: Array, camera: PinholeCamera) -> Array:
    """(n, 2) px for targets at h (n, 3) = K ray that no image shows: the way they went, beyond any lens' reach."""
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    ray = (h[:, :2] - centre * h[:, 2:]) / focal
    length = np.hypot(ray[:, :1], ray[:, 1:])
    way = np.where(length > 0.0, ray / np.where(length > 0.0, length, 1.0), [1.0, 0.0])
    return np.asarray(centre + FAR * focal * way)


def _flow_squared(points: Array, camera: PinholeCamera) -> Array:
    """flow flowᵀ of `optical_flow` (n, 2, 2) px²/rad², multiplied out: (1 + x² + y²) (I + p pᵀ) for p = (x, y)."""
    p = (points - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    outer = p[:, :, None] * p[:, None, :]
    spread = 1.0 + (p * p).sum(axis=1)
    scale = np.array(
        [[camera.fx * camera.fx, camera.fx * camera.fy], [camera.fx * camera.fy, camera.fy * camera.fy]]
    )
    return np.asarray(spread[:, None, None] * (np.eye(2) + outer) * scale)


def _white_acceleration(dt: float, psd: float) -> Array:
    a, b, c = psd * dt**3 / 3.0, psd * dt**2 / 2.0, psd * dt
    return np.array([[a, b, 0.0, 0.0], [b, c, 0.0, 0.0], [0.0, 0.0, a, b], [0.0, 0.0, b, c]])
