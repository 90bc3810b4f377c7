"""Lens models of other tools, each replaced by the nearest `RadTan` or `Equidistant` lens.

A model here is a function from directions to places in the normalised image, or back. Another model's numbers mean
nothing to us, but its pixels do: directions all over the image are projected by it, and a lens of ours is fitted to
these pairs by least squares. The worst residual says whether the two are the same lens. It is hundredths of a pixel for
real lenses, since all these models describe the same glass.

Models: unified (Mei & Rives 2007; Kalibr's `omni`), extended unified (Khomutenko, Garcia & Martinet 2016; `eucm`),
double sphere (Usenko, Demmel & Cremers 2018; `ds`), field of view (Devernay & Faugeras 2001; `fov`, RealSense's
`ftheta`), Brown-Conrady backwards (RealSense), and OpenCV's with thin prism and tilted sensor.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from swarmtrack.geometry.camera import WIDEST_LENS_RAD, Distortion, Equidistant, PinholeCamera, RadTan
from swarmtrack.messages import Array

Model = Callable[[Array], Array]
"""Directions (n, 3) in the camera frame to places (n, 2) in the normalised image; NaN where it has none."""

SAMPLED_ANGLES, SAMPLED_AZIMUTHS = 160, 32
FEWEST_SAMPLES = 100  # of an image: with fewer the model does not reach into it


class FittedLens(NamedTuple):
    """Our lens in place of another. worst_px: largest distance between the two anywhere in the image."""

    camera: PinholeCamera
    worst_px: float


class ImagePlane(NamedTuple):
    """Focal lengths and principal point [px], and the image's size [px]."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


# --- the models -------------------------------------------------------------------------------------------------------


def unified(xi: float) -> Model:
    """A sphere seen from `xi` above its centre."""

    def places(rays: Array) -> Array:
        return _divided(rays, rays[:, 2] + xi * np.linalg.norm(rays, axis=1))

    return places


def extended_unified(alpha: float, beta: float) -> Model:
    """An ellipsoid instead of a sphere."""

    def places(rays: Array) -> Array:
        d = np.sqrt(beta * (rays[:, 0] ** 2 + rays[:, 1] ** 2) + rays[:, 2] ** 2)
        return _divided(rays, alpha * d + (1.0 - alpha) * rays[:, 2])

    return places


def double_sphere(xi: float, alpha: float) -> Model:
    """Two spheres, one after the other."""

    def places(rays: Array) -> Array:
        z = rays[:, 2] + xi * np.linalg.norm(rays, axis=1)
        d = np.sqrt(rays[:, 0] ** 2 + rays[:, 1] ** 2 + z**2)
        return _divided(rays, alpha * d + (1.0 - alpha) * z)

    return places


def pinhole(rays: Array) -> Array:
    """The tangent plane."""
    return _divided(rays, rays[:, 2])


def field_of_view(w: float) -> Callable[[Array], Array]:
    """Places of a pinhole (n, 2) to those of a lens with the angle `w` [rad]."""

    def bent(places: Array) -> Array:
        r = np.linalg.norm(places, axis=1)
        with np.errstate(all="ignore"):
            scale = np.where(
                r > 1e-9, np.arctan(2.0 * r * math.tan(w / 2.0)) / (w * r), 2.0 * math.tan(w / 2.0) / w
            )
        return places * scale[:, None]

    return bent


def brown(coefficients: Sequence[float]) -> Callable[[Array], Array]:
    """Places (n, 2) to distorted ones: OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tau_x tau_y]]]]."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tau_x, tau_y = [
        *coefficients, *[0.0] * (14 - len(coefficients))
    ]  # fmt: skip
    tilt = _tilt(tau_x, tau_y)

    def bent(places: Array) -> Array:
        x, y = places.T
        s = x * x + y * y
        with np.errstate(all="ignore"):
            below = 1.0 + s * (k4 + s * (k5 + s * k6))
            factor = (1.0 + s * (k1 + s * (k2 + s * k3))) / np.where(below > 0.0, below, np.nan)
            u = x * factor + 2 * p1 * x * y + p2 * (s + 2 * x * x) + s * (s1 + s * s2)
            v = y * factor + p1 * (s + 2 * y * y) + 2 * p2 * x * y + s * (s3 + s * s4)
            w = np.stack([u, v, np.ones_like(u)], axis=1) @ tilt.T
            return np.asarray(w[:, :2] / w[:, 2:])

    return bent


def modified_brown(coefficients: Sequence[float]) -> Callable[[Array], Array]:
    """As `brown`, for k1 k2 p1 p2 [k3]: RealSense applies p1 and p2 to what the others gave."""
    radial = brown([*coefficients[:2], 0.0, 0.0, *coefficients[4:5]])
    p1, p2 = coefficients[2:4]

    def bent(places: Array) -> Array:
        x, y = radial(places).T
        s = (places**2).sum(axis=1)
        return np.stack(
            [x + 2 * p1 * x * y + p2 * (s + 2 * x * x), y + 2 * p2 * x * y + p1 * (s + 2 * y * y)], axis=1
        )

    return bent


def _tilt(tau_x: float, tau_y: float) -> Array:
    """Homography (3, 3) of a sensor tilted about x and y [rad]: OpenCV, calib3d, "Detailed description"."""
    cx, sx, cy, sy = math.cos(tau_x), math.sin(tau_x), math.cos(tau_y), math.sin(tau_y)
    R = np.array([[cy, 0.0, -sy], [0.0, 1.0, 0.0], [sy, 0.0, cy]]) @ np.array(
        [[1.0, 0.0, 0.0], [0.0, cx, sx], [0.0, -sx, cx]]
    )
    P = np.array([[R[2, 2], 0.0, -R[0, 2]], [0.0, R[2, 2], -R[1, 2]], [0.0, 0.0, 1.0]])
    return np.asarray(P @ R)


def _divided(rays: Array, by: Array) -> Array:
    with np.errstate(all="ignore"):
        return np.asarray(rays[:, :2] / np.where(by > 1e-9, by, np.nan)[:, None])


# --- pairs of directions and pixels -----------------------------------------------------------------------------------


def projected(model: Model, lens: ImagePlane) -> tuple[Array, Array]:
    """Directions (n, 3) all over the image and their pixels (n, 2), as far as the model is one-to-one."""
    theta = np.linspace(0.0, WIDEST_LENS_RAD, SAMPLED_ANGLES)[1:]
    phi = np.linspace(0.0, 2.0 * np.pi, SAMPLED_AZIMUTHS, endpoint=False)
    rays = np.stack(
        [
            np.outer(np.sin(theta), np.cos(phi)),
            np.outer(np.sin(theta), np.sin(phi)),
            np.outer(np.cos(theta), np.ones_like(phi)),
        ],
        axis=-1,
    )
    places = model(rays.reshape(-1, 3)).reshape(*rays.shape[:2], 2)
    with np.errstate(invalid="ignore"):
        radius = np.linalg.norm(places, axis=2)
        rising = np.diff(radius, axis=0, prepend=0.0) > 0.0
    sound = np.logical_and.accumulate(rising & np.isfinite(radius), axis=0)
    pixels = np.where(sound[..., None], places, 0.0) * [lens.fx, lens.fy] + [lens.cx, lens.cy]
    inside = ((pixels > -0.5) & (pixels < [lens.width - 0.5, lens.height - 0.5])).all(axis=2) & sound
    return rays[inside], pixels[inside]


def looked_back(undistorted: Callable[[Array], Array], lens: ImagePlane) -> tuple[Array, Array]:
    """The same of a lens whose model takes distorted places to undistorted ones."""
    u, v = np.meshgrid(np.linspace(0.0, lens.width - 1.0, 60), np.linspace(0.0, lens.height - 1.0, 45))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    places = undistorted((pixels - [lens.cx, lens.cy]) / [lens.fx, lens.fy])
    sound = np.isfinite(places).all(axis=1)
    return np.column_stack([places, np.ones(len(places))])[sound], pixels[sound]


# --- the fit ----------------------------------------------------------------------------------------------------------


def equidistant_through(rays: Array, pixels: Array, start: ImagePlane) -> FittedLens:
    """The equidistant lens nearest to pairs of directions (n, 3) and pixels (n, 2). Raises ValueError where they do not
    define one.
    """
    theta = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    way = rays[:, :2] / np.maximum(np.hypot(rays[:, 0], rays[:, 1]), 1e-12)[:, None]
    powers = theta[:, None] ** np.array([3.0, 5.0, 7.0, 9.0])

    def residuals(p: Array) -> Array:
        radius = theta + powers @ p[4:]
        return np.asarray((way * radius[:, None] * p[:2] + p[2:4] - pixels).ravel())

    p = _solved(residuals, [*start[:4], 0.0, 0.0, 0.0, 0.0], rays)
    return _fitted(residuals, p, Equidistant(tuple(p[4:])), start)


def radtan_through(
    rays: Array, pixels: Array, start: ImagePlane, coefficients: Sequence[float] = ()
) -> FittedLens:
    """The same for a `RadTan` lens. coefficients: (k1 … k6) where the search starts; k4, k5, k6 are kept."""
    first = [*coefficients[:8], *[0.0] * (8 - len(coefficients[:8]))]
    places = pinhole(rays)

    def residuals(p: Array) -> Array:
        bent = brown([*p[4:], *first[5:]])(places)
        return np.asarray((bent * p[:2] + p[2:4] - pixels).ravel())

    p = _solved(residuals, [*start[:4], *first[:5]], rays)
    return _fitted(residuals, p, RadTan((*p[4:], *first[5:])), start)


def _solved(residuals: Callable[[Array], Array], first: Sequence[float], rays: Array) -> Array:
    from scipy.optimize import least_squares  # noqa: PLC0415

    if len(rays) < FEWEST_SAMPLES:
        raise ValueError("reaches no part of the image")
    if not np.isfinite(residuals(np.array(first))).all():
        raise ValueError("is undefined within the image")
    with np.errstate(all="ignore"):
        try:
            return np.asarray(least_squares(residuals, first, x_scale="jac", max_nfev=100).x)
        except (ValueError, np.linalg.LinAlgError):
            raise ValueError("is unlike any lens") from None


def _fitted(residuals: Callable[[Array], Array], p: Array, lens: Distortion, start: ImagePlane) -> FittedLens:
    worst = float(np.linalg.norm(residuals(p).reshape(-1, 2), axis=1).max())
    fx, fy, cx, cy = (float(each) for each in p[:4])
    camera = PinholeCamera(fx, fy, cx, cy, start.width, start.height, lens)
    return FittedLens(camera, worst)
