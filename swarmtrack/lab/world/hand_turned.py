"""A drone that somebody turns by hand in a room, its gyro, and what its camera sees: the truth for calibrations.

The room is a sphere with a texture; the camera turns, and sways a little, near its middle.
"""

from __future__ import annotations

import cv2
import numpy as np

from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array, Image

TEXTURE = (3072, 1536)  # texels: a pixel of a camera with f = 430 px is about one
RATE_STEP = 1e-4  # s over which the truth is differentiated


class HandTurned:
    """Angles and sway as sums of sinusoids, drawn from `rng`.

    amplitude (3,) rad: about of roll, pitch and yaw; sway_m: of the position, per axis.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        *,
        amplitude: tuple[float, float, float] = (0.45, 0.45, 0.6),
        sway_m: float = 0.03,
    ) -> None:
        self._w = 2.0 * np.pi * rng.uniform(0.1, 0.7, (3, 5))
        self._phase = rng.uniform(0.0, 2.0 * np.pi, (3, 5))
        self._a = np.array(amplitude)[:, None] * rng.uniform(0.15, 0.5, (3, 5))
        self._sway = sway_m * rng.uniform(0.3, 1.0, (3, 3))
        self._sway_w = 2.0 * np.pi * rng.uniform(0.1, 0.5, (3, 3))
        self._sway_phase = rng.uniform(0.0, 2.0 * np.pi, (3, 3))

    def world_from_body(self, t: Array) -> Array:
        """(n, 3, 3) at times (n,) s."""
        angles = (self._a * np.sin(self._w * t[:, None, None] + self._phase)).sum(axis=2)
        return rotation.from_euler(*angles.T)

    def position(self, t: Array) -> Array:
        """(n, 3) m from the room's middle."""
        sway: Array = (self._sway * np.sin(self._sway_w * t[:, None, None] + self._sway_phase)).sum(axis=2)
        return sway

    def rates(self, t: Array) -> Array:
        """(n, 3) rad/s in body axes."""
        before, after = self.world_from_body(t - RATE_STEP), self.world_from_body(t + RATE_STEP)
        rates: Array = rotation.log(np.swapaxes(before, 1, 2) @ after) / (2.0 * RATE_STEP)
        return rates


class Room:
    """A sphere of radius `radius_m` with a texture, seen by a camera near its middle."""

    def __init__(self, rng: np.random.Generator, camera: PinholeCamera, *, radius_m: float = 8.0) -> None:
        self._camera = camera
        self._radius = radius_m
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        self._rays = camera.bearing(np.stack([u.ravel(), v.ravel()], axis=1).astype(float))
        self._rays = np.nan_to_num(self._rays).astype(np.float32)
        self._texture = _texture(rng)

    def image(self, world_from_camera: Array, position: Array, noise: Image | None = None) -> Image:
        """(h, w) grey. world_from_camera (3, 3); position (3,) m; noise: (h, w), added about its 128."""
        rays = self._rays @ world_from_camera.T.astype(np.float32)
        along = rays @ position.astype(np.float32)
        far = -along + np.sqrt(along**2 + np.float32(self._radius**2 - float(position @ position)))
        x, y, z = (position.astype(np.float32) + far[:, None] * rays).T
        azimuth = cv2.phase(x, y)  # 0 … 2π
        elevation = np.arcsin(np.clip(z / np.float32(self._radius), -1.0, 1.0))
        width, height = TEXTURE
        shape = (self._camera.height, self._camera.width)
        columns = (azimuth.ravel() * np.float32(width / (2.0 * np.pi))).reshape(shape)
        rows = ((elevation / np.float32(np.pi) + np.float32(0.5)) * np.float32(height - 1)).reshape(shape)
        seen = cv2.remap(self._texture, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        if noise is not None:
            seen = cv2.addWeighted(seen, 1.0, noise, 1.0, -128.0)
        return np.asarray(seen, np.uint8)


def _texture(rng: np.random.Generator) -> Image:
    """Spots of all sizes, as walls and shelves have."""
    width, height = TEXTURE
    total = np.zeros((height, width), np.float32)
    for cells in (48, 128, 384, 1024):
        coarse = rng.normal(0.0, 1.0, (cells // 2, cells)).astype(np.float32)
        total += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.clip(128.0 + 28.0 * total, 0, 255), np.uint8)
