"""What a detector needs to plan a look: expected boxes of tracks, and the camera's rotation since a frame."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from swarmtrack.messages import Array
from swarmtrack.motion.gyro import rotation_between
from swarmtrack.perceived import DetectorView

# By which two pictures may miss each other and still be compared.
BLURRED_PX = 3.0

PixelMapping = Callable[[Array], Array]
"""Pixels (n, 2) of a frame → where the same directions lie in an earlier one; NaN where the lens does not reach."""


class Expectation(Protocol):
    """Expected boxes and pixels for frames by their own stamps [s]; queries change nothing."""

    def boxes(self, exposed: float) -> Array:
        """Expected boxes of the tracks in a frame, in the form of `AttentionWindows.next`: (n, 6) px of the image
        as the camera gives it.
        """
        ...

    def pixels_at(self, then: float, now: float) -> PixelMapping | None:
        """Map from pixels of a frame exposed now to those of one exposed then; None if unknown."""
        ...


class PerceivedExpectation:
    """Expectation from the tracks and the gyro of one drone, for one of its cameras."""

    def __init__(self, perceived: DetectorView, camera: int = 0) -> None:
        """camera: for the frames of which of the drone's, by its place in the config."""
        self._perceived = perceived
        self._camera = camera
        self._lens = perceived.cameras[camera].lens

    def boxes(self, exposed: float) -> Array:
        perceived = self._perceived
        found = perceived.expected(exposed + self._offset_s, self._camera)
        if not len(found.centre):
            return np.empty((0, 6))
        centre = self._lens.distort(found.centre)
        sigma = found.sigma * self._lens.framed(found.centre).scale
        boxes = np.concatenate([centre, 3.0 * sigma, found.size], axis=1)
        return np.asarray(boxes[np.isfinite(boxes[:, :4]).all(axis=1)])

    def pixels_at(self, then: float, now: float) -> PixelMapping | None:
        """The map by the gyro alone."""
        gyro, camera, offset = self._perceived.gyro, self._lens, self._offset_s
        turn = rotation_between(gyro.orientation(now + offset), gyro.orientation(then + offset))
        if camera.fx * math.sqrt(turn.variance) > BLURRED_PX:
            return None
        matrix = turn.matrix
        if self._camera:
            # The gyro's axes are the first camera's.
            cameras = self._perceived.cameras
            own = cameras[self._camera].body_from_camera.rotation.T @ cameras[0].body_from_camera.rotation
            matrix = own @ matrix @ own.T

        def earlier(pixels: Array) -> Array:
            rays = camera.bearing(pixels) @ matrix.T
            return camera.project(rays)[0]

        return earlier

    @property
    def _offset_s(self) -> float:
        return self._perceived.cameras[self._camera].clock.used_s
