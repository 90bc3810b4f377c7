"""Rotations as 3x3 matrices, and conversions from and to other forms.

A matrix `a_from_b` takes coordinates in b to coordinates in a. All functions accept leading batch axes.
Sources: Solà, Deray & Atchuthan, "A micro Lie theory for state estimation in robotics" (2018), appendix B for
exp and log; Diebel, "Representing attitude" (2006), for quaternions and Euler angles.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from swarmtrack.messages import Array

ENU_FROM_NED: Array = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
BODY_FROM_FORWARD_CAMERA: Array = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Of a camera (x right, y down, z forward) that looks along the nose: body FRD = [z_cam, x_cam, y_cam]."""
BODY_FROM_FORWARD_CAMERA.setflags(write=False)
_NO_ROTATION = "quaternion: norm is zero or NaN, expected a rotation (w, x, y, z)"


def hat(v: ArrayLike) -> Array:
    """The matrix of the cross product: hat(v) @ w = v × w. v (…, 3) -> (…, 3, 3)."""
    v = np.asarray(v, dtype=float)
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 2, 1] = v[..., 0]
    matrix[..., 0, 2] = v[..., 1]
    matrix[..., 1, 0] = v[..., 2]
    return matrix - np.swapaxes(matrix, -1, -2)


def exp(phi: ArrayLike) -> Array:
    """The rotation by |phi| [rad] about phi, Rodrigues' formula. phi (…, 3) -> (…, 3, 3)."""
    phi = np.asarray(phi, dtype=float)
    if phi.shape == (3,):
        return _exp_of_one(phi.tolist())
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    # np.sinc is sin(pi x) / (pi x), exact at zero; (1 - cos a) / a² is half a sinc² and keeps its digits too.
    a = np.sinc(angle / np.pi)
    b = 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    cross = hat(phi)
    R: Array = np.eye(3) + a * cross + b * (cross @ cross)
    return R


def log(R: ArrayLike) -> Array:
    """The rotation vector [rad] of R, of length 0…pi. R (…, 3, 3) -> (…, 3).

    By way of the quaternion, which keeps its digits near zero and near half a turn alike.
    At exactly half a turn the axis' sign is free: one of the two is returned.
    """
    R = np.asarray(R, dtype=float)
    if R.shape == (3, 3):
        return _log_of_one(R.tolist())
    q = to_quaternion(R)
    w, v = q[..., :1], q[..., 1:]
    sine = np.linalg.norm(v, axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, w)
    scale = np.where(sine > 0.0, angle / np.where(sine > 0.0, sine, 1.0), 2.0)
    phi: Array = scale * v
    return phi


def angle(R: ArrayLike) -> Array:
    """The angle [rad] by which R turns, 0…pi. R (…, 3, 3) -> (…)."""
    return np.asarray(np.linalg.norm(log(R), axis=-1))


def from_quaternion(q: ArrayLike) -> Array:
    """The matrix of a quaternion (w, x, y, z), normalised first. q (…, 4) -> (…, 3, 3)."""
    q = np.asarray(q, dtype=float)
    if q.shape == (4,):
        return _matrix_of_one(q.tolist())
    norm = np.linalg.norm(q, axis=-1, keepdims=True)
    if not np.all(norm > 0.0):  # NaN fails this too
        raise ValueError(_NO_ROTATION)
    w, x, y, z = np.moveaxis(q / norm, -1, 0)
    R = np.empty((*q.shape[:-1], 3, 3))
    R[..., 0, 0], R[..., 1, 1], R[..., 2, 2] = (
        1 - 2 * (y * y + z * z),
        1 - 2 * (x * x + z * z),
        1 - 2 * (x * x + y * y),
    )
    R[..., 0, 1], R[..., 1, 0] = 2 * (x * y - w * z), 2 * (x * y + w * z)
    R[..., 0, 2], R[..., 2, 0] = 2 * (x * z + w * y), 2 * (x * z - w * y)
    R[..., 1, 2], R[..., 2, 1] = 2 * (y * z - w * x), 2 * (y * z + w * x)
    return R


def to_quaternion(R: ArrayLike) -> Array:
    """The unit quaternion (w, x, y, z) of R, with w >= 0. R (…, 3, 3) -> (…, 4).

    R gives the outer product 4 q qᵀ; of its rows the one with the largest diagonal is the best conditioned.
    """
    R = np.asarray(R, dtype=float)
    if R.shape == (3, 3):
        return np.array(_quaternion_of_one(R.tolist()))
    xx, yy, zz = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    wx, wy, wz = (
        R[..., 2, 1] - R[..., 1, 2],
        R[..., 0, 2] - R[..., 2, 0],
        R[..., 1, 0] - R[..., 0, 1],
    )
    xy, xz, yz = (
        R[..., 0, 1] + R[..., 1, 0],
        R[..., 0, 2] + R[..., 2, 0],
        R[..., 1, 2] + R[..., 2, 1],
    )
    rows = [
        [1 + xx + yy + zz, wx, wy, wz],
        [wx, 1 + xx - yy - zz, xy, xz],
        [wy, xy, 1 - xx + yy - zz, yz],
        [wz, xz, yz, 1 - xx - yy + zz],
    ]
    outer = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    positive: Array = np.where(q[..., :1] < 0.0, -q, q)
    return positive


def from_euler(roll: ArrayLike, pitch: ArrayLike, yaw: ArrayLike) -> Array:
    """World (NED) from body (FRD), aerospace angles (…) [rad] -> Rz(yaw) Ry(pitch) Rx(roll) (…, 3, 3)."""
    roll, pitch, yaw = np.broadcast_arrays(*(np.asarray(a, dtype=float) for a in (roll, pitch, yaw)))
    cr, sr, cp, sp, cy, sy = (
        np.cos(roll),
        np.sin(roll),
        np.cos(pitch),
        np.sin(pitch),
        np.cos(yaw),
        np.sin(yaw),
    )
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def to_euler(R: ArrayLike) -> Array:
    """(roll, pitch, yaw) [rad] of world-from-body, pitch in -pi/2…pi/2. R (…, 3, 3) -> (…, 3).

    With the nose straight up or down only yaw ∓ roll is defined; the sum is put where the noise puts it.
    """
    R = np.asarray(R, dtype=float)
    roll = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    pitch = np.arctan2(-R[..., 2, 0], np.hypot(R[..., 0, 0], R[..., 1, 0]))
    # Yaw once roll is undone: right also near the poles, where R[1, 0] and R[0, 0] are both noise.
    cr, sr = np.cos(roll), np.sin(roll)
    yaw = np.arctan2(sr * R[..., 0, 2] - cr * R[..., 0, 1], cr * R[..., 1, 1] - sr * R[..., 1, 2])
    return np.stack([roll, pitch, yaw], axis=-1)


def is_rotation(R: ArrayLike, tolerance: float = 1e-6) -> bool:
    """Whether every R (…, 3, 3) is orthonormal with determinant +1, each entry of RRᵀ within `tolerance`."""
    R = np.asarray(R, dtype=float)
    return R.shape[-2:] == (3, 3) and all(_is_one(rows, tolerance) for rows in R.reshape(-1, 3, 3).tolist())


# Of a single rotation, in plain numbers: the same as above at a tenth of NumPy's price.


def _exp_of_one(phi: list[float]) -> Array:
    x, y, z = phi
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if not math.isfinite(angle):
        return np.full((3, 3), math.nan)
    small = angle < 1e-4
    a = 1.0 - square / 6.0 if small else math.sin(angle) / angle
    b = 0.5 - square / 24.0 if small else 2.0 * (math.sin(0.5 * angle) / angle) ** 2
    return np.array(
        [
            [1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)],
        ]
    )


def _log_of_one(rows: list[list[float]]) -> Array:
    w, x, y, z = _quaternion_of_one(rows)
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 * math.atan2(sine, w) / sine if sine > 0.0 else 2.0
    return np.array([scale * x, scale * y, scale * z])


def _matrix_of_one(q: list[float]) -> Array:
    norm = math.sqrt(_dot(q, q) + q[3] * q[3])
    if not norm > 0.0:
        raise ValueError(_NO_ROTATION)
    w, x, y, z = (part / norm for part in q)
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def _quaternion_of_one(rows: list[list[float]]) -> tuple[float, float, float, float]:
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rows
    wx, wy, wz = zy - yz, xz - zx, yx - xy
    outer = (
        (1.0 + xx + yy + zz, wx, wy, wz),
        (wx, 1.0 + xx - yy - zz, xy + yx, xz + zx),
        (wy, xy + yx, 1.0 - xx + yy - zz, yz + zy),
        (wz, xz + zx, yz + zy, 1.0 - xx - yy + zz),
    )
    w, x, y, z = outer[max(range(4), key=lambda k: outer[k][k])]
    norm = math.copysign(math.sqrt(w * w + x * x + y * y + z * z), w)
    return w / norm, x / norm, y / norm, z / norm


def _is_one(rows: list[list[float]], tolerance: float) -> bool:
    """`is_rotation` of one matrix, in plain numbers: for nine of them a fifth of NumPy's price. NaN fails it."""
    a, b, c = rows
    products = (_dot(a, a) - 1.0, _dot(b, b) - 1.0, _dot(c, c) - 1.0, _dot(a, b), _dot(b, c), _dot(c, a))
    normal = (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    return all(abs(product) <= tolerance for product in products) and _dot(normal, c) > 0.0


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
