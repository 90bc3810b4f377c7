"""What a drone's camera sees of a simulated world, drawn with OpenCV.

A frame is made back to front:

1. Sky, clouds, two far ridges and the textured ground, from each pixel's ray. They are soft, so half the
   resolution is enough, and any lens model is right by construction.
2. Trees, poles and houses: flat figures at fixed places of the world, upright and turned towards the observer.
3. The other drones, farthest first: a solid model of the airframe under flat shading, drawn four times finer
   than the pixels and averaged, with translucent rotor discs.

Steps 1 and 2 are blurred as the observer turns during the exposure, each drone as its own image moves. Then come
the lens' blur and the sensor's noise. Everything is a function of the world's seed, the time and the frame's
number. Colours are BGR, 0…255.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.lab.world.airframe import SolidModel, solid_model
from swarmtrack.lab.world.scenery import SHIFT, Backdrop, Scenery
from swarmtrack.lab.world.world import World, frame_numbers
from swarmtrack.messages import Array, Image

FARTHEST_DRAWN_M = 1000.0  # m: where only turning moves the image
NEAREST_DRAWN_M = 0.2  # m: whatever reaches nearer to the camera is not drawn


@dataclass(frozen=True, slots=True)
class Optics:
    """The camera beyond its geometry."""

    exposure_s: float = 0.004
    blur_px: float = 0.6  # standard deviation of the lens' point spread
    noise: float = 2.0  # standard deviation of the sensor's noise, grey levels
    haze_m: float = 250.0  # distance at which 63 % of the contrast is lost


class Renderer:
    """Draws the frames of one kind of camera in one world. Holds textures and scenery, no state."""

    def __init__(
        self,
        world: World,
        camera: PinholeCamera,
        body_from_camera: Pose,
        optics: Optics | None = None,
        *,
        number: int = 0,
    ) -> None:
        """number: which of the drones' cameras it is; no two have the same noise."""
        self.world = world
        self._number = number
        self.camera = camera
        self.body_from_camera = body_from_camera
        self.optics = optics or Optics()
        self._backdrop = Backdrop(world, camera, self.optics.haze_m)
        self._scenery = Scenery(world, self.optics.haze_m)
        self._models = {drone_id: _paint_job(world, drone_id) for drone_id in world.drones}
        grain = world.chance("grain").normal(
            0.0, self.optics.noise, (camera.height + 64, camera.width + 64, 3)
        )
        self._grain = np.clip(np.rint(grain), -127, 127).astype(np.int8)

    def image(self, drone_id: int, t: float, sequence: int, targets: Collection[int] | None = None) -> Image:
        """The frame number `sequence` of `drone_id`, exposed around world time t: (h, w, 3) BGR uint8.

        targets: the drones to draw, all others by default.
        """
        half = self.optics.exposure_s / 2.0
        eye, *ends = (
            self.world.pose(drone_id, when) @ self.body_from_camera for when in (t, t - half, t + half)
        )
        image = self._backdrop.draw(eye)
        self._scenery.draw(image, eye, self.camera, self._backdrop.palette.horizon)
        straight_ahead = eye.transform(np.array([[0.0, 0.0, FARTHEST_DRAWN_M]]))
        image = _motion_blurred(image, self._image_motion(ends, np.repeat(straight_ahead, 2, axis=0)))
        if self.optics.blur_px > 0.0:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), self.optics.blur_px), dtype=np.uint8)

        if targets is None:
            targets = self.world.drones.keys()
        others = [(other, self.world.pose(other, t)) for other in sorted(targets) if other != drone_id]
        others.sort(key=lambda other: -float(np.linalg.norm(other[1].position - eye.position)))
        for other, pose in others:
            path = self.world.drones[other]
            motion = self._image_motion(ends, np.stack([path.position(t - half), path.position(t + half)]))
            turns = self.world.chance("rotors", drone_id, *frame_numbers(other, self._number, sequence))
            phases = turns.uniform(0.0, math.pi, 4)
            self._draw_drone(image, self._models[other], eye, pose, phases=phases, motion=motion)
        return self._with_noise(image, drone_id, sequence)

    def _image_motion(self, ends: list[Pose], points: Array) -> Array:
        """How far a point's image moves during the exposure, (2,) px, from its place (2, 3) m at both ends."""
        in_camera = [end.inverse().transform(point[None])[0] for end, point in zip(ends, points, strict=True)]
        pixels, _, valid = self.camera.project(np.stack(in_camera))
        return pixels[1] - pixels[0] if valid.all() else np.zeros(2)

    def _draw_drone(
        self,
        image: Image,
        model: SolidModel,
        world_from_camera: Pose,
        world_from_body: Pose,
        *,
        phases: Array,
        motion: Array,
    ) -> None:
        """Writes one drone into `image`. phases (4,) rad of its rotors; motion (2,) px of its own image."""
        body_from_camera = world_from_body.inverse() @ world_from_camera
        vertices = model.vertices(phases)
        in_camera = (vertices - body_from_camera.position) @ body_from_camera.rotation
        pixels, _, valid = self.camera.project(in_camera)
        if not valid.all() or self.camera.depth(in_camera).min() < NEAREST_DRAWN_M:
            return

        margin = math.ceil(3.0 * self.optics.blur_px + np.abs(motion).max()) + 2
        low = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - margin, 0)
        high = np.minimum(
            np.ceil(pixels.max(axis=0)).astype(int) + margin + 1, (self.camera.width, self.camera.height)
        )
        width, height = high - low
        if width <= 0 or height <= 0:
            return

        finer = 4 if max(width, height) <= 96 else 2 if max(width, height) <= 256 else 1
        canvas = np.zeros((height * finer, width * finer, 4), np.uint8)  # BGRA, colour times opacity
        corners = np.rint(((pixels - low + 0.5) * finer - 0.5) * (1 << SHIFT)).astype(np.int32)
        sun = world_from_body.rotation.T @ self._backdrop.palette.sun
        clear = math.exp(-float(np.linalg.norm(body_from_camera.position)) / self.optics.haze_m)
        colours = clear * model.shaded(sun) + (1.0 - clear) * self._backdrop.palette.horizon
        for face in model.back_to_front(vertices, body_from_camera.position):
            _paint(canvas, corners[model.faces[face]], colours[face], float(model.opacity[face]))

        patch = np.asarray(
            cv2.resize(canvas, (int(width), int(height)), interpolation=cv2.INTER_AREA), dtype=np.uint8
        )
        patch = _motion_blurred(patch, motion)
        if self.optics.blur_px > 0.0:
            patch = np.asarray(
                cv2.GaussianBlur(patch, (0, 0), self.optics.blur_px, borderType=cv2.BORDER_REPLICATE),
                dtype=np.uint8,
            )
        behind = image[low[1] : high[1], low[0] : high[0]]
        shown = patch[:, :, :3] + behind * (1.0 - patch[:, :, 3:].astype(np.float32) / 255.0)
        behind[:] = np.clip(np.rint(shown), 0, 255).astype(np.uint8)

    def _with_noise(self, image: Image, drone_id: int, sequence: int) -> Image:
        # Fresh normal numbers for every pixel would cost more than all the drawing: a random window of one big
        # sheet has the same statistics and no visible repetition.
        rng = self.world.chance("noise", *frame_numbers(drone_id, self._number, sequence))
        row, column = rng.integers(0, 65, 2)
        window = self._grain[row : row + self.camera.height, column : column + self.camera.width]
        return np.asarray(cv2.add(image, np.ascontiguousarray(window), dtype=cv2.CV_8U), dtype=np.uint8)


def _paint_job(world: World, drone_id: int) -> SolidModel:
    """The drone in its own colours: mostly dark, some grey, few white, as they are sold."""
    rng = world.chance("colours", drone_id)
    tone = rng.choice(
        [rng.uniform(28.0, 75.0), rng.uniform(90.0, 150.0), rng.uniform(190.0, 235.0)], p=(0.6, 0.2, 0.2)
    )
    return solid_model(
        world.airframe(drone_id),
        np.clip(tone + rng.normal(0.0, 5.0, 3), 15.0, 245.0),
        rng.uniform(20.0, 235.0, 3),
    )


def _paint(canvas: Image, corners: NDArray[np.int32], colour: Array, opacity: float) -> None:
    """Writes a convex polygon over `canvas` (BGRA, premultiplied). corners (n, 2) in 1/16 px."""
    bgra = (float(colour[0]), float(colour[1]), float(colour[2]), 255.0)
    if opacity >= 1.0:
        cv2.fillConvexPoly(canvas, corners, bgra, cv2.LINE_AA, SHIFT)
        return
    low = np.maximum((corners.min(axis=0) >> SHIFT) - 2, 0)
    high = np.minimum((corners.max(axis=0) >> SHIFT) + 3, canvas.shape[1::-1])
    if (high <= low).any():
        return
    part = canvas[low[1] : high[1], low[0] : high[0]]
    over = part.copy()
    cv2.fillConvexPoly(over, corners - (low << SHIFT).astype(np.int32), bgra, cv2.LINE_AA, SHIFT)
    part[:] = cv2.addWeighted(over, opacity, part, 1.0 - opacity, 0.0)


def _motion_blurred(image: Image, motion: Array) -> Image:
    """`image` averaged along a straight line of `motion` (2,) px."""
    length = float(np.linalg.norm(motion))
    if length < 0.5:
        return image
    reach = math.ceil(length / 2.0) + 1
    steps = np.linspace(-0.5, 0.5, 4 * math.ceil(length) + 1)
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    for u, v in steps[:, None] * motion + reach:
        column, row = math.floor(u), math.floor(v)
        right, down = u - column, v - row
        kernel[row : row + 2, column : column + 2] += np.outer((1 - down, down), (1 - right, right))
    return np.asarray(
        cv2.filter2D(image, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE), dtype=np.uint8
    )
