"""Does the filter know how wrong it is? The normalised innovations squared of the last detections, beside their band.

What the filter expects of a detection of its target is N(H x, S); then νᵀ S⁻¹ ν has the χ² distribution with two
degrees of freedom, and a mean of n of them that of χ²(2n) / n. Above the band the filter is too sure of itself (R or
the motion model too small, a camera's clock that is off), below it too careful.
Bar-Shalom, Li & Kirubarajan (2001), section 5.4.2.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

WINDOW = 200  # detections: at 7 Hz and four targets, seven seconds
FEWEST = 30
NORMAL_99 = 2.5758293035489004  # the standard normal's 99.5 % quantile


class Consistency(NamedTuple):
    """nis: mean over the window, expected 2; low, high: where it lies with 99 % if the filter is right."""

    nis: float
    low: float
    high: float


class InnovationWindow:
    """The last `WINDOW` normalised innovations squared."""

    def __init__(self) -> None:
        self._nis: deque[float] = deque(maxlen=WINDOW)

    def add(self, nis: list[float]) -> None:
        self._nis.extend(nis)

    def consistency(self) -> Consistency | None:
        """None until there are enough to tell."""
        n = len(self._nis)
        if n < FEWEST:
            return None
        low, high = (_chi2_quantile(sign * NORMAL_99, 2 * n) / n for sign in (-1.0, 1.0))
        return Consistency(math.fsum(self._nis) / n, low, high)


def _chi2_quantile(standard_score: float, degrees: int) -> float:
    """Wilson & Hilferty (1931): to a few parts in ten thousand from thirty degrees of freedom on."""
    spread = 2.0 / (9.0 * degrees)
    return degrees * (1.0 - spread + standard_score * math.sqrt(spread)) ** 3
