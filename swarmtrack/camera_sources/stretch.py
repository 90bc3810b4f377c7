"""Images of more than 8 bits, brought to 8 by what they hold.

A thermal camera writes 14 bits into 16, and its whole scene lies within a few hundred values: the upper 8 bits show one
or two shades. So the range of values that occur becomes 0 … 255. It is taken without the few darkest and brightest
pixels, which may be defects, and follows a change of the scene smoothly: a jump in brightness would look like motion.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Image

IGNORED_PIXELS = 1e-4  # share, at each end
NARROWEST_RANGE = 256.0  # values of 65536: within less there is noise
NARROWING = 0.05  # share of the way to a narrower range, per image; a wider one is taken at once


class Stretch:
    """Stretches the images of one source. Images of 8 bits pass through."""

    def __init__(self) -> None:
        self._range: tuple[float, float] | None = None

    def __call__(self, image: NDArray[Any]) -> Image:
        """(h, w) or (h, w, 3) of 8 or 16 bits, or floats, to the same of 8 bits."""
        if image.dtype == np.uint8:
            return image
        if image.dtype != np.uint16:
            image = _as_16_bits(image)
        low, high = _occurring(image)
        if self._range is not None:
            low = min(low, self._range[0] + NARROWING * (low - self._range[0]))
            high = max(high, self._range[1] + NARROWING * (high - self._range[1]))
        self._range = low, high
        middle, span = (low + high) / 2.0, max(high - low, NARROWEST_RANGE)
        stretched = (image.astype(np.float32) - np.float32(middle - span / 2.0)) * np.float32(255.0 / span)
        return np.asarray(np.clip(stretched + 0.5, 0.0, 255.0), np.uint8)


def _occurring(image: NDArray[np.uint16]) -> tuple[float, float]:
    """Darkest and brightest value, without the ignored pixels."""
    summed = np.cumsum(np.bincount(image.ravel(), minlength=1 << 16))
    ignored = IGNORED_PIXELS * image.size
    low, high = np.searchsorted(summed, [ignored, image.size - ignored], side="right")
    return float(low), float(min(high, (1 << 16) - 1))


def _as_16_bits(image: NDArray[Any]) -> NDArray[np.uint16]:
    """Floats, or other integers, by their own range; what is not finite is dark."""
    values = np.asarray(image, np.float64)
    finite = np.isfinite(values)
    if not finite.any():
        return np.zeros(image.shape, np.uint16)
    low, high = float(values[finite].min()), float(values[finite].max())
    with np.errstate(all="ignore"):
        share = np.where(finite, (values - low) / max(high - low, 1e-300), 0.0)
    return np.asarray(np.nan_to_num(share) * 65535.0, np.uint16)
