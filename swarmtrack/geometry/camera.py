"""A camera with its lens: from points to pixels and back, with Jacobians.

Three planes, and names that keep them apart:

    point (x, y, z) [m], camera frame  --chart-->  place in focal lengths, "normalised"
    normalised --K-->                     *undistorted* (ideal) pixels: what the trackers work in
    normalised --distortion--> --K-->     *distorted* pixels: the image as the camera gives it

The chart (`charts.py`) of an ordinary lens is the tangent plane, (x/z, y/z): "pinhole". That of a wide one, an
equidistant lens whose image shows more than `WIDE_LENS_RAD` off its axis, is stereographic, and reaches behind the
camera.

The camera looks along z, x right, y down; pixel centres are integers, origin top left. What has no
counterpart on the other side (a point behind the camera, a pixel beyond the lens model's reach) comes back as
a row of NaN, and from the projections also with `valid` False; it is never clamped to the image's border.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry.charts import Chart, Gnomonic, Stereographic
from swarmtrack.messages import Array

Mask = NDArray[np.bool_]

MAX_ANGLE = Gnomonic.reach  # rad off the axis: ideal pixels run to infinity at 90 degrees
# rad off the axis: an image that shows more in its corners is a wide lens'. There the tangent plane has stretched by
# 33 along the radius.
WIDE_LENS_RAD = math.radians(80.0)
# rad off the axis: farther out no lens is believed. Of a fisheye whose circle ends before, the rest is dark.
WIDEST_LENS_RAD = math.radians(110.0)
MIN_SLOPE = 0.01  # of distorted over ideal radius: less, and the lens folds or errors grow a hundredfold
NEWTON_STEPS = 20  # from the table's start, 3 to 6 are taken
LAST_STEP = 1e-9  # the iteration squares its error, so what is left after such a step is rounding
RESIDUAL = 1e-12  # in normalised units, 1e-9 px at a focal length of 1000 px


def _reach(angle: Array, slope: Array) -> int:
    """How many of the table's entries come before the lens flattens or folds, at least 2."""
    flat = np.flatnonzero(~(slope > MIN_SLOPE))
    return max(2, int(flat[0])) if flat.size else len(angle)


@dataclass(frozen=True)
class RadTan:
    """Brown-Conrady: `coefficients` (k1, k2, p1, p2), optionally k3, then optionally k4, k5, k6 (rational).

    Order and equations are those of OpenCV (calib3d, "Detailed description"), and of plumb_bob and
    rational_polynomial in ROS.
    """

    coefficients: tuple[float, ...]
    name: ClassVar[str] = "radtan"

    def __post_init__(self) -> None:
        object.__setattr__(self, "coefficients", tuple(float(c) for c in self.coefficients))
        if len(self.coefficients) not in (4, 5, 8) or not np.isfinite(self.coefficients).all():
            raise ValueError(
                f"radtan: coefficients {list(self.coefficients)}, expected finite numbers,"
                " 4 (k1 k2 p1 p2), 5 (… k3) or 8 (… k4 k5 k6)"
            )

    def _radial(self, s: Array) -> tuple[Array, Array]:
        """The radial factor at squared radius s, and its derivative by s."""
        k1, k2, _, _, k3, k4, k5, k6 = self.coefficients + (0.0,) * (8 - len(self.coefficients))
        above = 1.0 + s * (k1 + s * (k2 + s * k3))
        below = 1.0 + s * (k4 + s * (k5 + s * k6))
        below = np.where(below > 0.0, below, np.nan)  # beyond its pole a rational model means nothing
        factor = above / below
        slope = (k1 + s * (2 * k2 + s * 3 * k3) - factor * (k4 + s * (2 * k5 + s * 3 * k6))) / below
        return factor, slope

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        """Ideal and distorted radii along the rising part of the radial curve: where Newton starts."""
        angle = np.linspace(0.0, MAX_ANGLE, 1024)
        radius = np.tan(angle)
        with np.errstate(all="ignore"):
            factor, slope = self._radial(radius**2)
            # The Jacobian is symmetric: the model is the gradient of a potential, and one-to-one on any disc where
            # the Jacobian is positive definite. Its radial part has the eigenvalues `factor` (across the radius) and
            # factor + 2 r² slope (along it); the tangential part takes away 6 |p| r at most.
            smallest = np.minimum(factor, factor + 2 * radius**2 * slope)
            n = _reach(angle, smallest - 6 * np.linalg.norm(self.coefficients[2:4]) * radius)
        return radius[:n], (radius * factor)[:n]

    @property
    def max_radius(self) -> float:
        """Largest ideal radius up to which the model is one-to-one."""
        return float(self._table[0][-1])

    def apply(self, ideal: Array) -> tuple[Array, Array]:
        """Normalised ideal (n, 2) -> normalised distorted (n, 2), and the Jacobian (n, 2, 2)."""
        _, _, p1, p2 = self.coefficients[:4]
        x, y = ideal[:, 0], ideal[:, 1]
        s = x * x + y * y
        factor, slope = self._radial(s)
        distorted = np.stack(
            [
                x * factor + 2 * p1 * x * y + p2 * (s + 2 * x * x),
                y * factor + p1 * (s + 2 * y * y) + 2 * p2 * x * y,
            ],
            axis=1,
        )
        jacobian = np.empty((len(ideal), 2, 2))
        jacobian[:, 0, 0] = factor + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
        jacobian[:, 1, 1] = factor + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
        jacobian[:, 0, 1] = jacobian[:, 1, 0] = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
        return distorted, jacobian

    def remove(self, distorted: Array) -> Array:
        """Normalised distorted (n, 2) -> normalised ideal (n, 2); NaN where no ideal point lies within the lens'
        reach.

        The radial part is inverted by table, then Newton's iteration on the whole model. The fixed-point
        iteration that is common here diverges for strong barrel distortion.
        """
        ideal_radii, distorted_radii = self._table
        radius = np.linalg.norm(distorted, axis=1)
        start = np.interp(radius, distorted_radii, ideal_radii)
        ideal = distorted * np.where(radius > 0.0, start / np.where(radius > 0.0, radius, 1.0), 1.0)[:, None]
        with np.errstate(all="ignore"):
            for _ in range(NEWTON_STEPS):
                value, jacobian = self.apply(ideal)
                step = np.einsum("nij,nj->ni", _inverse_2x2(jacobian), distorted - value)
                ideal = ideal + step
                if not (np.abs(step) > LAST_STEP).any():
                    break
            value, _ = self.apply(ideal)
            solved = np.abs(value - distorted).max(axis=1, initial=0.0) <= RESIDUAL * (1.0 + radius)
            within = np.linalg.norm(ideal, axis=1) <= self.max_radius
        return np.where((solved & within)[:, None], ideal, np.nan)


@dataclass(frozen=True)
class Equidistant:
    """Kannala-Brandt fisheye: `coefficients` (k1 … k4) of theta_d = theta (1 + k1 theta² + … + k4 theta⁸).

    Kannala & Brandt (2006), equation 6; OpenCV's `fisheye`, Kalibr's and ROS' `equidistant`.
    """

    coefficients: tuple[float, ...]
    name: ClassVar[str] = "equidistant"

    def __post_init__(self) -> None:
        object.__setattr__(self, "coefficients", tuple(float(c) for c in self.coefficients))
        if len(self.coefficients) != 4 or not np.isfinite(self.coefficients).all():
            raise ValueError(
                f"equidistant: coefficients {list(self.coefficients)}, expected 4 finite numbers (k1 … k4)"
            )

    def _radial(self, theta: Array) -> tuple[Array, Array]:
        """theta_d at the angle theta [rad] off the axis, and its derivative."""
        k1, k2, k3, k4 = self.coefficients
        s = theta * theta
        return (
            theta * (1 + s * (k1 + s * (k2 + s * (k3 + s * k4)))),
            1 + s * (3 * k1 + s * (5 * k2 + s * (7 * k3 + s * 9 * k4))),
        )

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        """Angles and distorted radii along the rising part of the curve, as far as the tangent plane goes."""
        return self.rising(MAX_ANGLE)

    def rising(self, farthest: float) -> tuple[Array, Array]:
        """Angles up to `farthest` [rad] and their distorted radii, along the rising part of the curve."""
        angle = np.linspace(0.0, farthest, 1024)
        radius, slope = self._radial(angle)
        n = _reach(angle, slope)
        return angle[:n], radius[:n]

    @property
    def max_radius(self) -> float:
        """Largest ideal radius up to which the model is one-to-one."""
        return float(np.tan(self._table[0][-1]))

    def apply(self, ideal: Array, halves: float = 1.0, reach: float = math.inf) -> tuple[Array, Array]:
        """Normalised ideal (n, 2) -> normalised distorted (n, 2), and the Jacobian (n, 2, 2).

        halves: of the chart of `ideal`, see `charts.py`. Beyond `reach` [rad] off the axis the mapping continues
        linearly, as if the lens had no end.
        """
        r = np.linalg.norm(ideal, axis=1)
        theta = halves * np.arctan(r / halves)
        within = np.minimum(theta, reach)
        theta_d, slope = self._radial(within)
        theta_d = theta_d + slope * (theta - within)
        tiny = r < 1e-8  # the series' first terms are exact there: theta_d / r = 1 + (k1 - 1/(3 m²)) r²
        divisor = np.where(tiny, 1.0, r)
        scale = np.where(tiny, 1.0, theta_d / divisor)
        # (d scale / d r) / r
        bend = np.where(
            tiny,
            2 * (self.coefficients[0] - 1 / (3 * halves**2)),
            (slope / (1 + r * r / halves**2) - scale) / divisor**2,
        )
        jacobian = bend[:, None, None] * ideal[:, :, None] * ideal[:, None, :]
        jacobian[:, [0, 1], [0, 1]] += scale[:, None]
        return scale[:, None] * ideal, jacobian

    def remove(
        self, distorted: Array, halves: float = 1.0, table: tuple[Array, Array] | None = None
    ) -> Array:
        """Normalised distorted (n, 2) -> normalised ideal (n, 2); NaN beyond the lens' reach, or beyond a `table` of
        angles and radii.
        """
        angles, radii = self._table if table is None else table
        radius = np.linalg.norm(distorted, axis=1)
        theta = np.interp(radius, radii, angles)
        for _ in range(NEWTON_STEPS):
            value, slope = self._radial(theta)
            step = (radius - value) / slope
            theta = np.clip(theta + step, 0.0, angles[-1])
            if not (np.abs(step) > LAST_STEP).any():
                break
        solved = np.abs(self._radial(theta)[0] - radius) <= RESIDUAL
        ideal_radius = halves * np.tan(theta / halves)
        scale = np.where(radius > 0.0, ideal_radius / np.where(radius > 0.0, radius, 1.0), 1.0)
        return np.where(solved[:, None], distorted * scale[:, None], np.nan)


Distortion = RadTan | Equidistant


@dataclass(frozen=True)
class WideLens:
    """Equidistant lens in the stereographic plane. Its model ends at `reach` [rad] off the axis."""

    lens: Equidistant

    @cached_property
    def table(self) -> tuple[Array, Array]:
        """Angles and distorted radii over the trusted part of the model."""
        return self.lens.rising(WIDEST_LENS_RAD)

    @property
    def reach(self) -> float:
        return float(self.table[0][-1])

    @property
    def max_radius(self) -> float:
        """Largest ideal radius up to which the model is one-to-one."""
        return Stereographic.halves * math.tan(self.reach / Stereographic.halves)

    def apply(self, ideal: Array) -> tuple[Array, Array]:
        """As `Equidistant.apply`; beyond the reach the mapping continues as if the lens had no end."""
        return self.lens.apply(ideal, Stereographic.halves, self.reach)

    def remove(self, distorted: Array) -> Array:
        """As `Equidistant.remove`."""
        return self.lens.remove(distorted, Stereographic.halves, self.table)


class Framed(NamedTuple):
    """n undistorted pixels in the plane where the image is an upright box: at (n, 2). scale: px of that plane per
    undistorted px, (n, 2) along u and v, or one number for all.
    """

    at: Array
    scale: Array | float


@dataclass(frozen=True)
class PinholeCamera:
    """Intrinsics [px] for images of width x height pixels, and the lens distortion (None: ideal pinhole). An
    equidistant lens may be as wide as `WIDEST_LENS_RAD`.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: Distortion | None = None

    def __post_init__(self) -> None:
        for name in ("fx", "fy"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"PinholeCamera.{name}: {value}, expected a focal length in pixels above 0")
        for name in ("cx", "cy"):
            if not np.isfinite(getattr(self, name)):
                raise ValueError(
                    f"PinholeCamera.{name}: {getattr(self, name)}, expected a finite number of pixels"
                )
        for name in ("width", "height"):
            value = getattr(self, name)
            if not (value > 0 and int(value) == value):
                raise ValueError(f"PinholeCamera.{name}: {value}, expected a whole number of pixels above 0")
            object.__setattr__(self, name, int(value))
        if not self._reaches_image():
            raise ValueError(
                f"PinholeCamera.cx, cy: ({self.cx:g}, {self.cy:g}), expected them in the image of {self.width} x "
                f"{self.height}, or so near to it that the lens' model reaches a part of it"
            )

    def _reaches_image(self) -> bool:
        """Whether the lens' model has an answer for any pixel of the image."""
        if (self.middle == (self.cx, self.cy)).all():
            return True
        return bool(np.isfinite(self.bearing(self.middle[None])).all())

    @property
    def middle(self) -> Array:
        """Pixel (2,) of the image nearest to the lens axis: (cx, cy) unless that is outside the image."""
        low, high = np.array([-0.5, -0.5]), np.array([self.width, self.height]) - 0.5
        return np.clip([self.cx, self.cy], low, high)

    @cached_property
    def K(self) -> Array:
        """The intrinsic matrix (3, 3): normalised to undistorted pixels."""
        return self.chart.K

    @cached_property
    def K_inverse(self) -> Array:
        """The inverse of K (3, 3): undistorted pixels to normalised."""
        return self.chart.K_inverse

    @cached_property
    def is_wide(self) -> bool:
        """Whether the image's farthest corner is more than `WIDE_LENS_RAD` off the axis, so that undistorted pixels are
        stereographic.
        """
        if not isinstance(self.distortion, Equidistant):
            return False
        low, high = np.array([-0.5, -0.5]), np.array([self.width, self.height]) - 0.5
        centre, focal = np.array([self.cx, self.cy]), np.array([self.fx, self.fy])
        corner = float(np.linalg.norm(np.maximum(centre - low, high - centre) / focal))
        angles, radii = self.distortion.rising(WIDE_LENS_RAD)
        return bool(angles[-1] == WIDE_LENS_RAD and radii[-1] < corner)

    @cached_property
    def chart(self) -> Chart:
        """Chart between directions and undistorted pixels."""
        kind = Stereographic if self.is_wide else Gnomonic
        return kind(self.fx, self.fy, self.cx, self.cy)

    @cached_property
    def _lens(self) -> RadTan | Equidistant | WideLens | None:
        """The distortion, in the plane of the chart."""
        if self.is_wide:
            assert isinstance(self.distortion, Equidistant)
            return WideLens(self.distortion)
        return self.distortion

    @cached_property
    def reach(self) -> float:
        """Angle off the axis [rad] beyond which the lens model is undefined."""
        if self._lens is None:
            return self.chart.reach
        return self._lens.reach if isinstance(self._lens, WideLens) else math.atan(self._lens.max_radius)

    @cached_property
    def field(self) -> tuple[float, float]:
        """Horizontal and vertical field of view [rad] through the image's middle; of an ordinary lens without its
        distortion.
        """
        if not self.is_wide:
            return 2.0 * math.atan(0.5 * self.width / self.fx), 2.0 * math.atan(0.5 * self.height / self.fy)
        ends = np.tile([self.cx, self.cy], (4, 1))
        ends[[0, 1], 0], ends[[2, 3], 1] = (-0.5, self.width - 0.5), (-0.5, self.height - 0.5)
        rays = self.bearing(ends)
        off = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
        left, right, up, down = np.where(np.isnan(off), self.reach, off).tolist()
        return left + right, up + down

    @cached_property
    def ideal_bounds(self) -> Array:
        """[[u_min, v_min], [u_max, v_max]] (2, 2): bounding box of the whole image in ideal pixels.

        A lens that bends outer rays inwards shows more than width x height ideal pixels: at the border of a wide
        image, targets have negative ones.
        """
        low, high = np.array([-0.5, -0.5]), np.array([self.width, self.height]) - 0.5
        if self._lens is None:
            return np.stack([low, high])
        columns, rows = np.linspace(low, high, 33).T
        pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        ideal = self.undistort(pixels)
        # Where the image goes on beyond the lens model's reach, what is shown ends with that reach.
        focal, centre = np.array([self.fx, self.fy]), np.array([self.cx, self.cy])
        outermost = centre + np.sign(pixels - centre) * focal * self._lens.max_radius
        ideal = np.where(np.isnan(ideal), outermost, ideal)
        return np.stack([ideal.min(axis=0), ideal.max(axis=0)])

    @cached_property
    def frame_bounds(self) -> Array:
        """[[u_min, v_min], [u_max, v_max]] (2, 2): the image's borders in the plane of `framed`."""
        if not self.is_wide:
            return self.ideal_bounds
        reach = self.frame_radius * np.array([self.fx, self.fy])
        centre = np.array([self.cx, self.cy])
        low, high = np.array([-0.5, -0.5]), np.array([self.width, self.height]) - 0.5
        return np.stack([np.maximum(low, centre - reach), np.minimum(high, centre + reach)])

    @cached_property
    def frame_radius(self) -> float:
        """Radius [focal lengths] in the plane of `framed` at which a wide lens ends; infinite for others."""
        return float(self._lens.table[1][-1]) if isinstance(self._lens, WideLens) else math.inf

    def within_reach(self, at: Array) -> Array:
        """Distance (n,) [focal lengths] of points (n, 2) in the plane of `framed` from the end of a wide lens;
        negative beyond it.
        """
        away = (at - [self.cx, self.cy]) / [self.fx, self.fy]
        return np.asarray(self.frame_radius - np.linalg.norm(away, axis=1))

    def framed(self, pixels: Array) -> Framed:
        """Undistorted pixels (n, 2) in the plane where the image is an upright box and boxes have their measured size.

        For an ordinary lens that is nearly the undistorted plane. A wide lens' undistorted image is far from upright:
        there it is the plane of the image itself, continued beyond its border and the lens' reach.
        """
        if not isinstance(self._lens, WideLens):
            return Framed(pixels, 1.0)
        at, by_ideal = self._lens.apply(self._normalised(pixels))
        focal = np.array([self.fx, self.fy])
        by_pixel = focal[:, None] * by_ideal / focal[None, :]
        return Framed(self._denormalise(at), np.linalg.norm(by_pixel, axis=2))

    def rays_in_frame(self, at: Array) -> Array:
        """Unit vectors (n, 3) of places (n, 2) in the plane of `framed`; NaN beyond the reach of a wide lens."""
        return self.bearing(at) if self.is_wide else self.bearing_undistorted(at)

    def per_radian(self, pixels: Array) -> Array:
        """Undistorted px per radian along u and v at undistorted pixels (n, 2): (n, 2), or (2,) for all."""
        return self.chart.per_radian(pixels)

    def box_per_radian(self, pixels: Array) -> Array:
        """Image px per radian along the sides of a box centred at undistorted pixels (n, 2): (n, 2), or (2,) for all.
        Boxes are measured in the distorted image.
        """
        if not isinstance(self._lens, WideLens):
            return self.chart.per_radian(pixels)
        _, by_ideal = self._lens.apply(self._normalised(pixels))
        # rad for a px of the image: the chart stretches alike all ways.
        by_image = _inverse_2x2(by_ideal) / np.array([self.fx, self.fy])
        stretch = self.chart.per_radian(pixels)[:, :1] / self.fx
        return np.asarray(stretch / np.linalg.norm(by_image, axis=1))

    def depth(self, points: Array) -> Array:
        """Depth (n,) [m] of points (n, 3) along the axis; for a wide lens, their range."""
        points = np.asarray(points, dtype=float).reshape(-1, 3)
        return np.asarray(np.linalg.norm(points, axis=1) if self.is_wide else points[:, 2])

    def project(self, points: Array) -> tuple[Array, Array, Mask]:
        """points (n, 3) m, camera frame -> distorted pixels (n, 2), d pixel / d point (n, 2, 3), valid (n,).

        Valid means in front of the camera (any direction for a wide lens) and within the lens model's reach, not
        necessarily inside the image (see `contains`). Rows that are not valid are NaN.
        """
        ideal, by_point, valid = self.chart.places(points)
        if self._lens is not None:
            valid &= np.linalg.norm(np.where(valid[:, None], ideal, 0.0), axis=1) <= self._lens.max_radius
            ideal, by_ideal = self._lens.apply(np.where(valid[:, None], ideal, 0.0))
            by_point = by_ideal @ by_point
        return self._to_pixels(ideal, by_point, valid)

    def project_undistorted(self, points: Array) -> tuple[Array, Array, Mask]:
        """As `project`, to the ideal pixels that the trackers work in."""
        return self._to_pixels(*self.chart.places(points))

    def undistort(self, pixels: Array) -> Array:
        """Distorted pixels (n, 2) -> ideal pixels (n, 2); rows beyond the lens model's reach are NaN."""
        return self._denormalise(self._ideal(pixels))

    def distort(self, pixels: Array) -> Array:
        """Ideal pixels (n, 2) -> distorted pixels (n, 2); rows beyond the lens model's reach are NaN."""
        ideal = self._normalised(pixels)
        if self._lens is None:
            return self._denormalise(ideal)
        within = np.linalg.norm(ideal, axis=1) <= self._lens.max_radius
        distorted, _ = self._lens.apply(np.where(within[:, None], ideal, 0.0))
        return self._denormalise(np.where(within[:, None], distorted, np.nan))

    def undistort_jacobian(self, pixels: Array) -> Array:
        """d ideal pixel / d distorted pixel (n, 2, 2) at distorted pixels (n, 2): it carries covariances."""
        if self._lens is None:
            return np.broadcast_to(np.eye(2), (len(_pairs(pixels)), 2, 2)).copy()
        _, by_ideal = self._lens.apply(self._ideal(pixels))
        focal = np.array([self.fx, self.fy])
        jacobian: Array = focal[:, None] * _inverse_2x2(by_ideal) / focal[None, :]
        return jacobian

    def bearing(self, pixels: Array) -> Array:
        """Distorted pixels (n, 2) -> unit vectors (n, 3) in the camera frame; NaN as in `undistort`."""
        return self.chart.rays(self._ideal(pixels))

    def bearing_undistorted(self, pixels: Array) -> Array:
        """Ideal pixels (n, 2) -> unit vectors (n, 3) in the camera frame."""
        return self.chart.rays(self._normalised(pixels))

    def bearing_by_place(self, pixels: Array) -> Array:
        """d bearing / d place (n, 3, 2) at ideal pixels (n, 2), places in focal lengths."""
        return self.chart.rays_by_place(self._normalised(pixels))

    def bearing_jacobian(self, pixels: Array) -> Array:
        """d bearing / d distorted pixel (n, 3, 2) at distorted pixels (n, 2)."""
        by_ideal_pixel = self.chart.rays_by_place(self._ideal(pixels)) / np.array([self.fx, self.fy])
        jacobian: Array = by_ideal_pixel @ self.undistort_jacobian(pixels)
        return jacobian

    def contains(self, pixels: Array, margin: float = 0.0) -> Mask:
        """Whether pixels (n, 2) lie in the image with its border moved out by `margin` px (in, if negative)."""
        pixels = _pairs(pixels)
        limit = np.array([self.width, self.height]) - 0.5 + margin  # pixel centres are integers
        return np.asarray(((pixels >= -0.5 - margin) & (pixels <= limit)).all(axis=1))

    def scaled(self, width: int, height: int) -> PinholeCamera:
        """The same lens behind an image resized to width x height (not cropped)."""
        sx, sy = width / self.width, height / self.height
        # Pixel centres are integers, so it is the corner (-0.5, -0.5) that stays.
        cx, cy = (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5
        return PinholeCamera(self.fx * sx, self.fy * sy, cx, cy, width, height, self.distortion)

    def _to_pixels(self, normalised: Array, by_point: Array, valid: Mask) -> tuple[Array, Array, Mask]:
        focal = np.array([self.fx, self.fy])
        pixels = np.where(valid[:, None], self._denormalise(normalised), np.nan)
        jacobian = np.where(valid[:, None, None], focal[:, None] * by_point, np.nan)
        return pixels, jacobian, valid

    def _ideal(self, pixels: Array) -> Array:
        """Distorted pixels (n, 2) -> ideal rays (n, 2)."""
        normalised = self._normalised(pixels)
        return normalised if self._lens is None else self._lens.remove(normalised)

    def _normalised(self, pixels: Array) -> Array:
        return self.chart.normalised(_pairs(pixels))

    def _denormalise(self, normalised: Array) -> Array:
        return self.chart.denormalised(normalised)


def _pairs(pixels: Array) -> Array:
    """pixels as float (n, 2), n = 0 included."""
    return np.asarray(pixels, dtype=float).reshape(-1, 2)


def _inverse_2x2(matrices: Array) -> Array:
    """Inverses (n, 2, 2) in closed form: several times cheaper than the general solver at this size."""
    a, b, c, d = matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 0], matrices[:, 1, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        adjugate = np.stack([np.stack([d, -b], axis=-1), np.stack([-c, a], axis=-1)], axis=-2)
        inverse: Array = adjugate / (a * d - b * c)[:, None, None]
        return inverse
