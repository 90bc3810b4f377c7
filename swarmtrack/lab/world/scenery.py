"""Everything in a frame that is not a drone: sky, far ridges, ground, and figures that stand on it.

Colours are BGR, 0…255. The world frame is NED, the ground is z = 0; `haze_m` is the distance [m] at which 63 % of
the contrast is lost.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.lab.world.world import World
from swarmtrack.messages import Array, Image

Array32 = NDArray[np.float32]
Real = NDArray[np.floating[Any]]

SHIFT = 4  # OpenCV's fixed-point coordinates: 1/16 px
TILE = 512  # texels: side of the periodic textures
RIDGE_BINS = 8192  # azimuths of the far ridges: 0.3 px at a focal length of 430 px
GROUND_SCALES = (
    0.03,
    0.25,
    2.0,
)  # m a texel: three sizes of the one texture, each fades where it would alias
CLOUD = np.array([240.0, 238.0, 236.0])
# Cosine: what stands farther off an ordinary lens' axis is not drawn.
LEAST_AHEAD = 0.3
FIGURE_CORNERS = 18  # of every figure; simpler ones repeat their last


@dataclass(frozen=True, slots=True, eq=False)
class Palette:
    """Colours (3,) BGR of one world, and the direction (3,) to the sun in the world frame."""

    horizon: Array
    zenith: Array
    grass: Array
    earth: Array
    ridges: tuple[Array, Array]
    cloudiness: float
    sun: Array


def draw_palette(rng: np.random.Generator) -> Palette:
    horizon = np.array([222.0, 216.0, 206.0]) + rng.normal(0.0, 6.0, 3)
    zenith = np.array([206.0, 160.0, 112.0]) + rng.normal(0.0, 10.0, 3)
    grass = np.array([62.0, 112.0, 96.0]) + rng.normal(0.0, 8.0, 3)
    earth = np.array([98.0, 128.0, 144.0]) + rng.normal(0.0, 10.0, 3)
    forest = np.array([70.0, 92.0, 76.0])
    azimuth, elevation = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(0.5, 1.1)
    return Palette(
        horizon=horizon,
        zenith=zenith,
        grass=grass,
        earth=earth,
        ridges=(0.35 * forest + 0.65 * horizon, 0.65 * forest + 0.35 * horizon),
        cloudiness=rng.uniform(0.2, 0.7),
        sun=np.array(
            [
                math.cos(azimuth) * math.cos(elevation),
                math.sin(azimuth) * math.cos(elevation),
                -math.sin(elevation),
            ]
        ),
    )


class Backdrop:
    """Sky, clouds, ridges and ground, evaluated along the rays of every second pixel."""

    def __init__(self, world: World, camera: PinholeCamera, haze_m: float) -> None:
        rng = world.chance("backdrop")
        self.palette = draw_palette(rng)
        self._size = (camera.width, camera.height)
        self._haze_m = haze_m
        self._f = 0.25 * (camera.fx + camera.fy)  # of the image at half the resolution
        self._shape = ((camera.height + 1) // 2, (camera.width + 1) // 2)
        v, u = np.meshgrid(
            2.0 * np.arange(self._shape[0]) + 0.5, 2.0 * np.arange(self._shape[1]) + 0.5, indexing="ij"
        )
        rays = camera.bearing(np.column_stack([u.ravel(), v.ravel()]))
        # Beyond the lens model's reach: dark, as outside a fisheye's circle.
        blind = ~np.isfinite(rays).all(axis=1)
        rays[blind] = (0.0, 0.0, 1.0)
        self._blind = blind.reshape(self._shape)
        self._rays = np.ascontiguousarray(rays.T, dtype=np.float32)
        self._texture = _texture(rng, 1.6)
        self._clouds = _texture(rng, 3.2)
        self._ridges = (_ridge(rng, 0.055, 9), _ridge(rng, 0.03, 40))
        self._highest = float(max(ridge.max() for ridge in self._ridges)) + 2.0 / self._f

    def draw(self, world_from_camera: Pose) -> Image:
        """(h, w, 3) BGR."""
        # Not `@`: for so thin a product BLAS wakes its threads, which costs more than the rest of the frame.
        world_rays = np.einsum("ij,jn->in", world_from_camera.rotation.astype(np.float32), self._rays)
        x, y, z = world_rays.reshape(3, *self._shape)
        level, azimuth = cv2.cartToPolar(x, y)
        slope = -z / np.maximum(level, 1e-3)  # tangent of the elevation
        planes = self._sky(x, y, z)

        skyline = _rows((slope > -0.02) & (slope < self._highest))
        bins = (np.asarray(azimuth)[skyline] * (RIDGE_BINS / (2.0 * math.pi))).astype(np.int32)
        for ridge, colour in zip(self._ridges, self.palette.ridges, strict=True):
            share = np.clip((ridge[bins] - slope[skyline]) * self._f + 0.5, 0.0, 1.0)
            _blend(planes[:, skyline], share, colour)

        below = _rows(z > -0.01)
        ground = self._ground(x[below], y[below], z[below], world_from_camera.position)
        _blend(planes[:, below], np.clip(0.5 - slope[below] * self._f, 0.0, 1.0), ground)

        if self._blind.any():
            planes[:, self._blind] = 0.0
        half = np.asarray(cv2.merge([np.clip(plane, 0.0, 255.0).astype(np.uint8) for plane in planes]))
        full = cv2.resize(half, (2 * self._shape[1], 2 * self._shape[0]), interpolation=cv2.INTER_LINEAR)
        return np.ascontiguousarray(full[: self._size[1], : self._size[0]], dtype=np.uint8)

    def _sky(self, x: Array32, y: Array32, z: Array32) -> Array32:
        """Colour planes (3, h, w)."""
        up = np.maximum(-z, 0.0)
        blue = 1.0 - np.exp(-3.0 * up)
        planes = np.stack(
            [
                np.float32(low) + np.float32(high - low) * blue
                for low, high in zip(self.palette.horizon, self.palette.zenith, strict=True)
            ],
            dtype=np.float32,
        )
        # A cloud layer that bends down with the Earth: a flat one crowds the horizon.
        scale = np.float32(0.12 * TILE) / (up + np.float32(0.12))
        density = _sample(self._clouds, x * scale, y * scale)
        cover = np.clip((density + np.float32(2.0 * self.palette.cloudiness - 1.0)) * 0.5, 0.0, 0.8)
        cover *= np.minimum(8.0 * up, 1.0)
        _blend(planes, cover, CLOUD)
        return planes

    def _ground(self, x: Array32, y: Array32, z: Array32, eye: Array) -> Array32:
        """Colour planes (3, h, w) where the rays meet the plane z = 0."""
        height = np.float32(max(-eye[2], 0.1))
        reach = height / np.maximum(z, np.float32(1e-3))
        north, east = reach * x + np.float32(eye[0]), reach * y + np.float32(eye[1])
        footprint = reach * reach / (height * np.float32(self._f))  # m along the line of sight in one pixel
        octaves = []
        for scale in GROUND_SCALES:
            share = np.exp(-((footprint / np.float32(6.0 * scale)) ** 2))
            octaves.append(
                share * _sample(self._texture, north / np.float32(scale), east / np.float32(scale))
            )
        mixture = np.clip(0.4 + 0.22 * octaves[2] + 0.15 * octaves[1], 0.0, 1.0)
        light = 1.0 + 0.10 * octaves[0] + 0.09 * octaves[1] + 0.05 * octaves[2]
        clear = np.exp(reach * np.float32(-1.0 / self._haze_m))
        colours = np.stack([self.palette.grass, self.palette.earth, self.palette.ridges[1]], axis=1)
        return np.stack(
            [
                clear * ((grass + mixture * (earth - grass)) * light - far) + far
                for grass, earth, far in colours.astype(np.float32)
            ],
            dtype=np.float32,
        )


def _rows(mask: NDArray[np.bool_]) -> slice:
    """The rows from the first to the last in which `mask` (h, w) holds anywhere."""
    rows = np.flatnonzero(mask.any(axis=1))
    return slice(int(rows[0]), int(rows[-1]) + 1) if rows.size else slice(0, 0)


def _blend(planes: Array32, share: Real, colours: Real) -> None:
    """Writes `colours` (3,) or (3, h, w) over `planes` (3, h, w), as far as `share` (h, w) says."""
    for plane, colour in zip(planes, colours.astype(np.float32, copy=False), strict=True):
        np.add(plane, share * (colour - plane), out=plane)


def _sample(texture: Array32, x: Real, y: Real) -> Array32:
    """The periodic texture at texel coordinates x, y of any size."""
    if x.size == 0:
        return np.zeros(x.shape, np.float32)
    # x - floor(x): np.mod says the same at ten times the cost.
    u, v = (((c / TILE - np.floor(c / TILE)) * TILE).astype(np.float32, copy=False) for c in (x, y))
    return np.asarray(cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP), np.float32)


def _texture(rng: np.random.Generator, slope: float) -> Array32:
    """Periodic noise (TILE, TILE) with mean 0 and variance 1, whose power falls as frequency to the -slope."""
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(TILE), np.fft.fftfreq(TILE)))
    frequency[0, 0] = np.inf
    spectrum = np.fft.fft2(rng.standard_normal((TILE, TILE))) * frequency ** (-slope / 2.0)
    noise = np.fft.ifft2(spectrum).real
    return np.asarray(noise / noise.std(), dtype=np.float32)


def _ridge(rng: np.random.Generator, height: float, detail: int) -> Array32:
    """Skyline: the tangent of its elevation by azimuth, (RIDGE_BINS + 1,) with the first repeated at the end.

    It is `height` on average, with `detail` waves around the horizon.
    """
    azimuth = np.linspace(0.0, 2.0 * math.pi, RIDGE_BINS + 1)
    order = np.arange(1, detail + 1)
    waves = np.sin(np.outer(azimuth, order) + rng.uniform(0.0, 2.0 * math.pi, detail)) / order**0.8
    shape = waves.sum(axis=1)
    return np.asarray(height * np.maximum(0.2, 1.0 + 0.5 * shape / shape.std()), dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Figure:
    """A flat polygon: outline (CORNERS, 2) m, to the right and up from the foot; colour (3,)."""

    outline: Array
    colour: Array


class Scenery:
    """Trees, poles and houses: upright figures at fixed places, facing the observer, drawn farthest first.

    Each kind stands all around, one in each equal part of the horizon: no view is without a house.
    """

    def __init__(self, world: World, haze_m: float) -> None:
        rng = world.chance("scenery")
        places: list[Array] = []
        figures: list[Figure] = []
        self.places: dict[str, Array] = {}
        """(n, 2) m from the origin, by kind."""
        for kind, build, count, nearest, farthest in (
            ("tree", _tree, 110, 38.0, 120.0),
            ("pole", _pole, 16, 30.0, 80.0),
            ("house", _house, 12, 45.0, 110.0),
        ):
            standing = []
            for k in range(count):
                azimuth = 2.0 * math.pi * (k + rng.uniform(0.0, 1.0)) / count
                distance = rng.uniform(nearest, farthest)
                parts = build(rng)
                figures += parts
                standing.append(distance * np.array([math.cos(azimuth), math.sin(azimuth)]))
                places += [standing[-1]] * len(parts)
            self.places[kind] = np.array(standing)
        self._places = np.array(places)  # (n, 2) m
        self._outlines = np.array([figure.outline for figure in figures])
        self._colours = np.array([figure.colour for figure in figures])
        self._haze_m = haze_m

    def draw(self, image: Image, world_from_camera: Pose, camera: PinholeCamera, horizon: Array) -> None:
        """Writes into `image`. horizon (3,): the colour of the haze."""
        eye = world_from_camera.position
        away = self._places - eye[:2]
        distance = np.linalg.norm(away, axis=1)
        ahead = away @ world_from_camera.rotation[:2, 2]
        least = math.cos(camera.reach) if camera.is_wide else LEAST_AHEAD
        seen = np.flatnonzero((ahead > least * distance) & (distance > 5.0))
        # Equal distance: the parts of one figure, in order.
        seen = seen[np.argsort(-distance[seen], kind="stable")]
        if not seen.size:
            return
        right = np.column_stack([-away[seen, 1], away[seen, 0]]) / distance[seen, None]
        outline = self._outlines[seen]
        corners = np.empty((len(seen), FIGURE_CORNERS, 3))
        corners[:, :, :2] = self._places[seen, None] + outline[:, :, :1] * right[:, None]
        corners[:, :, 2] = -outline[:, :, 1]
        in_camera = (corners - eye) @ world_from_camera.rotation
        pixels, _, valid = camera.project(in_camera.reshape(-1, 3))
        pixels = pixels.reshape(-1, FIGURE_CORNERS, 2)
        low, high = pixels.min(axis=1), pixels.max(axis=1)
        shown = valid.reshape(-1, FIGURE_CORNERS).all(axis=1)
        with np.errstate(invalid="ignore"):
            shown &= (high > 0.0).all(axis=1) & (low < (camera.width, camera.height)).all(axis=1)
        clear = np.exp(-distance[seen] / self._haze_m)[:, None]
        colours = clear * self._colours[seen] + (1.0 - clear) * horizon
        fixed = np.rint(np.where(shown[:, None, None], pixels, 0.0) * (1 << SHIFT)).astype(np.int32)
        for figure in np.flatnonzero(shown):
            cv2.fillPoly(image, [fixed[figure]], colours[figure].tolist(), cv2.LINE_AA, SHIFT)


def _figure(points: list[tuple[float, float]], colour: Array) -> Figure:
    outline = np.array(points, dtype=float)
    return Figure(
        np.concatenate([outline, np.repeat(outline[-1:], FIGURE_CORNERS - len(outline), axis=0)]), colour
    )


def _rectangle(left: float, right: float, bottom: float, top: float, colour: Array) -> Figure:
    return _figure([(left, bottom), (right, bottom), (right, top), (left, top)], colour)


def _tree(rng: np.random.Generator) -> list[Figure]:
    height = rng.uniform(3.0, 9.0)
    width = height * rng.uniform(0.25, 0.5)
    green = np.array([44.0, 84.0, 62.0]) * rng.uniform(0.7, 1.3) + rng.normal(0.0, 6.0, 3)
    trunk = _rectangle(-0.03 * height, 0.03 * height, -0.1, 0.45 * height, np.array([48.0, 62.0, 74.0]))
    angle = np.linspace(0.0, 2.0 * math.pi, FIGURE_CORNERS, endpoint=False)
    crown = []
    for size, shift, light in ((1.0, 0.0, 0.8), (0.72, 0.06, 1.0), (0.4, 0.14, 1.2)):
        ragged = size * rng.uniform(0.82, 1.12, FIGURE_CORNERS)
        right = width * (ragged * np.cos(angle) - shift)
        up = height * (0.62 + 0.37 * ragged * np.sin(angle) + 0.5 * shift)
        crown.append(_figure(list(zip(right, up, strict=True)), np.clip(light * green, 0.0, 255.0)))
    return [trunk, *crown]


def _pole(rng: np.random.Generator) -> list[Figure]:
    height = rng.uniform(4.0, 8.0)
    grey = np.full(3, rng.uniform(70.0, 150.0))
    post = _rectangle(-0.07, 0.07, -0.1, height, grey)
    arm = rng.uniform(0.4, 1.2)
    return [post, _rectangle(-arm * rng.uniform(0.0, 1.0), arm, height - 0.25, height - 0.12, grey)]


def _house(rng: np.random.Generator) -> list[Figure]:
    half, height = rng.uniform(3.0, 7.0), rng.uniform(3.0, 6.0)
    wall = np.array([190.0, 200.0, 208.0]) * rng.uniform(0.6, 1.05) + rng.normal(0.0, 8.0, 3)
    roof = np.array([70.0, 78.0, 120.0]) * rng.uniform(0.7, 1.2) + rng.normal(0.0, 8.0, 3)
    eaves = half + 0.4
    parts = [
        _rectangle(-half, half, -0.1, height, wall),
        _figure(
            [(-eaves, height), (eaves, height), (0.6 * half, 1.5 * height), (-0.6 * half, 1.5 * height)], roof
        ),
    ]
    glass = np.array([92.0, 84.0, 76.0])
    windows = np.arange(-half + 0.8, half - 1.6, 2.2)
    return parts + [_rectangle(left, left + 1.1, 0.35 * height, 0.7 * height, glass) for left in windows]
