"""Fits an image into a network's input, and points of that input back into the image, exactly.

Pixel centres are integers in both. Resizing by s therefore maps x to (x + 0.5) s − 0.5: the half pixel matters, at
s = 0.5 forgetting it moves every detection by a quarter of a pixel, and at s = 3 by one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array, Image


@dataclass(frozen=True, slots=True)
class Letterbox:
    """An image resized to (width, height) and padded right and below to (input_width, input_height), all px.

    scale_x, scale_y: input px per image px. They differ by no more than rounding to whole pixels does: never stretched.
    """

    width: int
    height: int
    input_width: int
    input_height: int
    scale_x: float
    scale_y: float

    def to_input(self, image: Image, pad_value: int) -> NDArray[np.uint8]:
        """(h, w) grey or (h, w, 3) BGR → (input_height, input_width, 3) BGR."""
        if image.ndim == 2 or image.shape[2] == 1:
            image = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
        if image.shape[:2] != (self.height, self.width):
            shrinking = self.width < image.shape[1]
            how = cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR
            image = np.asarray(cv2.resize(image, (self.width, self.height), interpolation=how), np.uint8)
        below, right = self.input_height - self.height, self.input_width - self.width
        if below or right:
            border: Any = [pad_value] * 3
            padded = cv2.copyMakeBorder(image, 0, below, 0, right, cv2.BORDER_CONSTANT, value=border)
            image = np.asarray(padded, np.uint8)
        return image

    def points_to_image(self, points: Array) -> Array:
        """points (n, 2) px of the input → px of the image."""
        return (points + 0.5) / [self.scale_x, self.scale_y] - 0.5

    def points_to_input(self, points: Array) -> Array:
        """points (n, 2) px of the image → px of the input."""
        return (points + 0.5) * [self.scale_x, self.scale_y] - 0.5

    def sizes_to_image(self, sizes: Array) -> Array:
        """sizes (n, 2) px of the input → px of the image."""
        return sizes / [self.scale_x, self.scale_y]


def fit(width: int, height: int, *, scale: float, multiple: int) -> Letterbox:
    """For a net of any input size: enlarge by `scale`, pad to whole multiples of `multiple`."""
    w, h = max(1, round(width * scale)), max(1, round(height * scale))
    w_in, h_in = (multiple * math.ceil(side / multiple) for side in (w, h))
    return Letterbox(w, h, w_in, h_in, w / width, h / height)


def fit_fixed(width: int, height: int, *, input_width: int, input_height: int) -> Letterbox:
    """For a net of one input size: as large as fits without stretching."""
    scale = min(input_width / width, input_height / height)
    w, h = max(1, round(width * scale)), max(1, round(height * scale))
    return Letterbox(w, h, input_width, input_height, w / width, h / height)
