"""Two charts of the sphere of directions: which undistorted pixel stands for which direction.

The plane of an ordinary lens is the tangent plane (*gnomonic*), u = f tan θ: straight lines stay straight, and nothing
beyond 90° off the axis has a place in it. That of a wide lens is *stereographic*, u = 2 f tan(θ/2): angles stay angles,
and all but the direction straight behind has a place. At 95° a pixel is stretched by 2.2 either way, where the tangent
plane has stretched by 130 at 85°. Both are u = m f tan(θ/m), with m = 1 and m = 2.

Everything that trackers and identities must know of the plane that they work in is here: rays, their derivatives, what
a rotation of the camera does to places and motions, and how many pixels an angle is.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry.rotation import to_quaternion
from swarmtrack.messages import Array

# A direction that turns further off the axis than this cosine-like depth leaves every image; beyond it the plane would
# fold over or run to infinity, so it is held there: far outside, finite, soon dropped.
MIN_DEPTH = 0.05
FARTHEST_IMAGE_POINT = 100.0  # focal lengths off the axis, where the tangent of 89 degrees is 57


class Turned(NamedTuple):
    """n positions and velocities after a rotation. moving (2, 2, n): coordinate, then position and velocity; by_state
    (n, 4, 4): their derivative with respect to those before, both in that order.
    """

    moving: Array
    by_state: Array


def _turned(moving: Array, J: Array, bend: Array) -> Turned:
    """J (2, 2, n): d place' / d place, which is d motion' / d motion as well; bend (2, 2, n): d motion' / d place."""
    by_state = np.zeros((2, 2, 2, 2, moving.shape[2]))
    by_state[:, 0, :, 0] = by_state[:, 1, :, 1] = J
    by_state[:, 1, :, 0] = bend
    return Turned(moving, np.ascontiguousarray(by_state.reshape(4, 4, -1).transpose(2, 0, 1)))


def _by_homography() -> Array:
    """(96, 9): from a homography M (3, 3) to what `Gnomonic.turn` multiplies, (6, 4, 4)."""
    matrix = np.zeros((3, 2, 2, 2, 2, 2, 3, 3))
    for i, j in np.ndindex(2, 2):
        for value, before, after in ((0, 0, 0), (0, 1, 1), (1, 0, 1)):
            matrix[2, value, i, after, j, before, i, j] = 1.0
            matrix[i, value, i, after, j, before, 2, j] = -1.0
    return matrix.reshape(96, 9)


@dataclass(frozen=True)
class Chart(ABC):
    """Focal lengths and centre, px. Pixels (n, 2) are undistorted ones; directions are in the camera's axes."""

    fx: float
    fy: float
    cx: float
    cy: float

    halves: ClassVar[float]
    """m in u = m f tan(θ/m)."""
    reach: ClassVar[float]
    """rad off the axis: what is further has no place."""

    @cached_property
    def K(self) -> Array:
        """(3, 3): places in focal lengths to pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @cached_property
    def K_inverse(self) -> Array:
        """The inverse of K (3, 3), written out."""
        return np.array(
            [
                [1.0 / self.fx, 0.0, -self.cx / self.fx],
                [0.0, 1.0 / self.fy, -self.cy / self.fy],
                [0.0, 0.0, 1.0],
            ]
        )

    def normalised(self, pixels: Array) -> Array:
        return (pixels - [self.cx, self.cy]) / [self.fx, self.fy]

    def denormalised(self, places: Array) -> Array:
        return places * [self.fx, self.fy] + [self.cx, self.cy]

    @abstractmethod
    def places(self, points: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Points (n, 3) m -> positions (n, 2) in focal lengths, d position / d point (n, 2, 3), valid (n,). Rows that
        are not valid are undefined.
        """

    @abstractmethod
    def rays(self, places: Array) -> Array:
        """Unit vectors (n, 3) of positions (n, 2) in focal lengths."""

    @abstractmethod
    def rays_by_place(self, places: Array) -> Array:
        """d ray / d place (n, 3, 2), places in focal lengths."""

    @abstractmethod
    def flow(self, pixels: Array) -> Array:
        """d pixel / d angle (n, 2, 3) px/rad, of points at infinity for a rotation of the camera."""

    @abstractmethod
    def flow_gradient(self, pixels: Array, angle: Array) -> Array:
        """d (flow · angle) / d pixel (n, 2, 2), at an angle (3,) rad."""

    @abstractmethod
    def add_flow_of_error(self, cov: Array, pixels: Array, variance: float) -> None:
        """Add variance [rad²] × flow flowᵀ to the position block of covariances (n, 4+, 4+), in place."""

    @abstractmethod
    def turn(self, moving: Array, rotation: Array) -> Turned:
        """Rotate directions and their motions by a rotation (3, 3): camera axes now from then. moving (2, 2, n) px and
        px/s: coordinate, then position and velocity.
        """

    @abstractmethod
    def per_radian(self, pixels: Array) -> Array:
        """Pixels per radian along u and v, (n, 2), or (2,) where it is the same for all."""

    @abstractmethod
    def solid_angle(self, pixels: Array) -> Array:
        """Solid angle (n,) [rad²] of a square pixel."""

    @abstractmethod
    def radial(self, squared: Array) -> tuple[Array, Array, Array]:
        """Radial factor from the *other* chart to this one at squared radii `squared` (n,) [focal lengths²], and its
        first two derivatives with respect to `squared`.
        """


@dataclass(frozen=True)
class Gnomonic(Chart):
    """The tangent plane: (x, y) = (X, Y) / Z."""

    halves: ClassVar[float] = 1.0
    reach: ClassVar[float] = float(np.radians(89.0))

    def places(self, points: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        points = np.asarray(points, dtype=float).reshape(-1, 3)
        x, y, z = points.T
        with np.errstate(invalid="ignore", over="ignore"):
            valid = (z > 0.0) & (np.hypot(x, y) < np.tan(self.reach) * z)  # False for NaN
        depth = np.where(valid, z, 1.0)
        places = points[:, :2] / depth[:, None]
        by_point = np.zeros((len(points), 2, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = 1.0 / depth
        by_point[:, :, 2] = -places / depth[:, None]
        return places, by_point, valid

    def rays(self, places: Array) -> Array:
        rays = np.column_stack([places, np.ones(len(places))])
        unit: Array = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        return unit

    def rays_by_place(self, places: Array) -> Array:
        # b = r / |r| with r = (x, y, 1): db/dr = (I - b bᵀ) / |r|, and b_z = 1 / |r|.
        ray = self.rays(places)
        return np.asarray((np.eye(3) - ray[:, :, None] * ray[:, None, :])[:, :, :2] * ray[:, 2, None, None])

    def flow(self, pixels: Array) -> Array:
        """The position rows of the paper's B (its equation 4) without dt, for two focal lengths."""
        x = (pixels[:, 0] - self.cx) / self.fx
        y = (pixels[:, 1] - self.cy) / self.fy
        flow = np.empty((len(pixels), 2, 3))
        flow[:, 0, 0], flow[:, 0, 1], flow[:, 0, 2] = x * y, -1.0 - x * x, y
        flow[:, 1, 0], flow[:, 1, 1], flow[:, 1, 2] = 1.0 + y * y, -x * y, -x
        return flow * [[self.fx], [self.fy]]

    def flow_gradient(self, pixels: Array, angle: Array) -> Array:
        x, y = self.normalised(pixels).T
        aspect = self.fx / self.fy
        gradient = np.empty((len(pixels), 2, 2))
        gradient[:, 0, 0] = y * angle[0] - 2.0 * x * angle[1]
        gradient[:, 0, 1] = aspect * (x * angle[0] + angle[2])
        gradient[:, 1, 0] = (-y * angle[1] - angle[2]) / aspect
        gradient[:, 1, 1] = 2.0 * y * angle[0] - x * angle[1]
        return gradient

    def add_flow_of_error(self, cov: Array, pixels: Array, variance: float) -> None:
        """Multiplied out: (1 + x² + y²) (diag(fx², fy²) + q qᵀ) for q = (fx x, fy y) = (u, v) off the centre."""
        u, v = pixels[:, 0] - self.cx, pixels[:, 1] - self.cy
        ff, gg, uu, vv = self.fx**2, self.fy**2, u * u, v * v
        spread = variance + (variance / ff) * uu + (variance / gg) * vv
        cov[:, 0, 0] += spread * (ff + uu)
        cov[:, 2, 2] += spread * (gg + vv)
        across = spread * u * v
        cov[:, 0, 2] += across
        cov[:, 2, 0] += across

    def turn(self, moving: Array, rotation: Array) -> Turned:
        """The homography K R K⁻¹ for the position, its derivative for the velocity.

        With M = K R K⁻¹, h = M·[u v 1], w = M·[vu vv 0] and k = 1 / h₃: p' = k h₁₂ and v' = k (w₁₂ − w₃ p'), which is
        the derivative of p' along the motion. J = ∂p'/∂p = k (M₁₂ − p' M₃) is linear in g = k [p' 1], and ∂v'/∂p, its
        derivative along the motion, in ġ = k ([v' 0] − k w₃ [p' 1]). What multiplies them is linear in R, and one
        product makes all derivatives of all targets, which are the last axis until then.
        Hartley & Zisserman (2004), section 8.4, differentiated.
        """
        n = moving.shape[2]
        by_rotation = self._by_rotation @ rotation.ravel()
        M, by_features = by_rotation[:9].reshape(3, 3), by_rotation[9:].reshape(6, 16)
        lifted = (M[:, :2] @ moving.reshape(2, 2 * n)).reshape(3, 2, n)
        h = lifted[:, 0]
        h += M[:, 2:]
        depth = h[2]
        if depth.min(initial=1.0) < MIN_DEPTH:
            (behind,) = (depth < MIN_DEPTH).nonzero()
            h[:, behind] = self._far_outside(h[:, behind])
        k = 1.0 / depth
        lifted *= k
        approach = lifted[2, 1].copy()
        lifted[:, 1] -= approach * h
        features = lifted * k
        features[:, 1] -= approach * features[:, 0]
        return Turned(lifted[:2], (features.reshape(6, n).T @ by_features).reshape(n, 4, 4))

    @cached_property
    def _by_rotation(self) -> Array:
        """(105, 9): from a rotation to its homography, and to the derivatives that `turn` takes of it."""
        homography = np.kron(self.K, self.K_inverse.T)
        return np.concatenate([homography, _by_homography() @ homography])

    def _far_outside(self, h: Array) -> Array:
        """(3, n) for targets at h (3, n) = K ray that no image shows: the way they went, beyond any lens' reach."""
        focal, centre = np.array([[self.fx], [self.fy]]), self.K[:2, 2:]
        ray = (h[:2] - centre * h[2]) / focal
        length = np.hypot(ray[0], ray[1])
        way = np.where(length > 0.0, ray / np.where(length > 0.0, length, 1.0), [[1.0], [0.0]])
        far = np.full_like(h, MIN_DEPTH)
        far[:2] *= centre + FARTHEST_IMAGE_POINT * focal * way
        return far

    def per_radian(self, pixels: Array) -> Array:
        """Constant, as at the image's centre. Off the axis a radian covers more pixels, more along the radius than
        across it: within an ordinary image that is neglected.
        """
        return np.array([self.fx, self.fy])

    def solid_angle(self, pixels: Array) -> Array:
        # A pixel at the border covers less of an angle, by cos² along the radius and by cos across it.
        return np.asarray(self.rays(self.normalised(pixels))[:, 2] ** 3 / (self.fx * self.fy))

    def radial(self, squared: Array) -> tuple[Array, Array, Array]:
        """tan θ = t / (1 − t²/4), of t = 2 tan(θ/2); points that are not in front are mapped far outside."""
        ahead = np.maximum(1.0 - squared / 4.0, 1.0 / FARTHEST_IMAGE_POINT)
        return 1.0 / ahead, 0.25 / ahead**2, 0.125 / ahead**3


@dataclass(frozen=True)
class Stereographic(Chart):
    """(x, y) = 2 (X, Y) / (|P| + Z). As a complex number x + iy it transforms under rotation by a Möbius
    transformation, so all derivatives are complex numbers as well: a rotation of the plane and an isotropic scale.
    """

    halves: ClassVar[float] = 2.0
    reach: ClassVar[float] = float(np.radians(150.0))

    def places(self, points: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        points = np.asarray(points, dtype=float).reshape(-1, 3)
        with np.errstate(invalid="ignore", over="ignore"):
            length = np.linalg.norm(points, axis=1)
            valid = (length > 0.0) & (points[:, 2] > np.cos(self.reach) * length) & np.isfinite(length)
        points, length = np.where(valid[:, None], points, [0.0, 0.0, 1.0]), np.where(valid, length, 1.0)
        ray, depth = points / length[:, None], length + points[:, 2]
        places = 2.0 * points[:, :2] / depth[:, None]
        # d depth / d point = ray + e_z
        ray[:, 2] += 1.0
        by_point = -places[:, :, None] * ray[:, None, :]
        by_point[:, [0, 1], [0, 1]] += 2.0
        return places, by_point / depth[:, None, None], valid

    def rays(self, places: Array) -> Array:
        """(x, y, 1 − q) / (1 + q) with q = (x² + y²) / 4."""
        q = 0.25 * (places**2).sum(axis=1)
        rays = np.column_stack([places, 1.0 - q]) / (1.0 + q)[:, None]
        return np.asarray(rays)

    def rays_by_place(self, places: Array) -> Array:
        # d/dx of (x, y, 1 − q) / (1 + q): dq/dx = x/2.
        stretch = self._stretch(places)
        lifted = self.rays(places)
        lifted[:, 2] += 1.0
        by = -0.5 * lifted[:, :, None] * places[:, None, :]
        by[:, [0, 1], [0, 1]] += 1.0
        return np.asarray(by / stretch[:, None, None])

    def flow(self, pixels: Array) -> Array:
        places = self.normalised(pixels)
        x, y = places.T
        flow = np.empty((len(pixels), 2, 3))
        across, wide = 0.5 * x * y, 0.25 * (x * x - y * y)
        flow[:, 0, 0], flow[:, 0, 1], flow[:, 0, 2] = across, -1.0 - wide, y
        flow[:, 1, 0], flow[:, 1, 1], flow[:, 1, 2] = 1.0 - wide, -across, -x
        return flow * [[self.fx], [self.fy]]

    def flow_gradient(self, pixels: Array, angle: Array) -> Array:
        x, y = self.normalised(pixels).T
        along = 0.5 * (y * angle[0] - x * angle[1])
        across = 0.5 * (x * angle[0] + y * angle[1]) + angle[2]
        aspect = self.fx / self.fy
        gradient = np.empty((len(pixels), 2, 2))
        gradient[:, 0, 0] = gradient[:, 1, 1] = along
        gradient[:, 0, 1], gradient[:, 1, 0] = aspect * across, -across / aspect
        return gradient

    def add_flow_of_error(self, cov: Array, pixels: Array, variance: float) -> None:
        """A rotation error moves a direction equally in all directions, and the chart is conformal: the variance
        scales with the stretch squared.
        """
        spread = variance * self._stretch(self.normalised(pixels)) ** 2
        cov[:, 0, 0] += spread * self.fx**2
        cov[:, 2, 2] += spread * self.fy**2

    def turn(self, moving: Array, rotation: Array) -> Turned:
        """With ζ = (x + iy) / 2 and the rotation's quaternion (w, x, y, z), a = w + iz, b = y − ix:

        ζ' = (a ζ + b) / D with D = ā − b̄ ζ, dζ'/dζ = D⁻² (as |a|² + |b|² = 1), d²ζ'/dζ² = 2 b̄ D⁻³.
        Needham, Visual Complex Analysis (1997), sections 3.4 and 6.4.
        """
        w, x, y, z = to_quaternion(rotation).tolist()
        a, b = complex(w, z), complex(y, -x)
        scale_x, scale_y = 0.5 / self.fx, 0.5 / self.fy
        place = scale_x * (moving[0, 0] - self.cx) + 1j * scale_y * (moving[1, 0] - self.cy)
        motion = scale_x * moving[0, 1] + 1j * scale_y * moving[1, 1]
        D = a.conjugate() - b.conjugate() * place
        size = np.abs(D)
        # What turns straight behind, and so to infinity, is held far outside.
        held = size < MIN_DEPTH
        if held.any():
            way = np.where(size > 0.0, D / np.where(size > 0.0, size, 1.0), 1.0)
            D = np.where(held, MIN_DEPTH * way, D)
        by_place = 1.0 / D**2
        turned = (a * place + b) / D
        moved = by_place * motion
        bend = 2.0 * b.conjugate() / D * moved
        found = np.empty_like(moving, dtype=float)
        found[0, 0], found[1, 0] = turned.real / scale_x + self.cx, turned.imag / scale_y + self.cy
        found[0, 1], found[1, 1] = moved.real / scale_x, moved.imag / scale_y
        return _turned(found, self._matrices(by_place), self._matrices(bend))

    def _matrices(self, factor: Array) -> Array:
        """(2, 2, n) px of what multiplies by complex numbers (n,)."""
        aspect = self.fx / self.fy
        return np.array(
            [[factor.real, -aspect * factor.imag], [factor.imag / aspect, factor.real]], dtype=float
        )

    def per_radian(self, pixels: Array) -> Array:
        stretch = self._stretch(self.normalised(pixels))
        return np.asarray(stretch[:, None] * [self.fx, self.fy])

    def solid_angle(self, pixels: Array) -> Array:
        return np.asarray(1.0 / (self._stretch(self.normalised(pixels)) ** 2 * self.fx * self.fy))

    def radial(self, squared: Array) -> tuple[Array, Array, Array]:
        """2 tan(θ/2) = 2 t / (1 + √(1 + t²)), of t = tan θ."""
        root = np.sqrt(1.0 + squared)
        factor = 2.0 / (1.0 + root)
        # d root / d squared = 1 / (2 root)
        first = -0.25 * factor**2 / root
        second = 0.125 * factor**2 * (factor / root + 1.0 / root**2) / root
        return factor, first, second

    @staticmethod
    def _stretch(places: Array) -> Array:
        """(n,): places in focal lengths by angle, 1 + tan²(θ/2)."""
        return np.asarray(1.0 + 0.25 * (places**2).sum(axis=1))


def cross(moving: Array, here: Chart, there: Chart) -> Turned:
    """Positions and velocities (2, 2, n) px of one chart in another, for cameras with the same axis.

    Charts of two kinds differ by a radial factor s of q = |p|²: p' = s p, J = s I + 2 s' p pᵀ, v' = J v, and
    ∂v'/∂p = 2 s' (v pᵀ + p vᵀ + p·v I) + 4 s'' (p·v) p pᵀ.
    """
    before, after = (np.array([chart.fx, chart.fy])[:, None] for chart in (here, there))
    p = (moving[:, 0] - np.array([[here.cx], [here.cy]])) / before
    v = moving[:, 1] / before
    n = p.shape[1]
    if here.halves == there.halves:
        s, first, second = np.ones(n), np.zeros(n), np.zeros(n)
    else:
        s, first, second = there.radial((p**2).sum(axis=0))
    eye = np.eye(2)[:, :, None]
    outer, along = p[:, None] * p[None], (p * v).sum(axis=0)
    J = s * eye + 2.0 * first * outer
    mixed = v[:, None] * p[None] + p[:, None] * v[None] + along * eye
    bend = 2.0 * first * mixed + 4.0 * second * along * outer
    scale = after[:, None] / before[None]
    found = np.empty_like(moving, dtype=float)
    found[:, 0] = s * p * after + np.array([[there.cx], [there.cy]])
    found[:, 1] = np.einsum("ijn,jn->in", J, v) * after
    return _turned(found, scale * J, scale * bend)
