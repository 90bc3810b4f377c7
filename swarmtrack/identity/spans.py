"""How large teammates look: a track that is as large as its drone should be at its distance is more likely that drone.

Nobody announces a size. Before a drone was ever recognised its span is log-normal, as multirotors come: half of them
are between 0.3 and 0.7 m, one in twenty beyond 0.15 or 1.5 m. Each time the posterior is sure of a drone whose place is
fresh, its box and its distance give the span. The memory of that is a mixture: with the probability of the name the
span is that of the box, else nothing was learned. Boxes of strangers have any size, evenly in the logarithm.
"""

from __future__ import annotations

import math

import numpy as np

from swarmtrack.messages import Array

# m, and its log sigma.
SPAN, SPAN_SIGMA = 0.45, 0.6
# Of a box's longer side: attitude, blur and a detector's habits, as log sigma.
BOX_SIGMA = 0.25
# Of a distance, relative: a drone that may be anywhere is no vaguer than this.
MOST_VAGUE = 1.0
# Nats over which the boxes of strangers spread: from 4 px to half of an image of 640.
STRANGER_LOG = math.log(320.0 / 4.0)
# However often a drone was recognised: some of its boxes are around a half of it, or around two.
MOST_SURE = 0.98


class Spans:
    """By drone, what its boxes told."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[float, float, float]] = {}
        """log m, how many times it was measured, and the probability that it was this drone's."""

    def learn(
        self, drone_id: int, size: Array, distance: float, probability: float, *, focal_px: float
    ) -> None:
        """size (2,) px of a box that is this drone's with that probability, by a camera of that focal length; distance
        m."""
        seen = _log_span(size, distance, focal_px)
        if not math.isfinite(seen):
            return
        p = min(probability, MOST_SURE)
        known = self._known.get(drone_id)
        if known is not None and abs(seen - known[0]) < 3.0 * BOX_SIGMA:
            mean, count, before = known
            # What keeps its box is the same thing again, and no more likely the drone.
            self._known[drone_id] = (
                mean + (seen - mean) / (count + 1.0),
                min(count + 1.0, 10.0),
                max(p, before),
            )
        elif known is None or p > known[2]:
            self._known[drone_id] = (seen, 1.0, p)

    def forget(self, drone_id: int) -> None:
        """Whoever was taken for it may have been another."""
        self._known.pop(drone_id, None)

    def log_ratio(
        self, drone_id: int, size: Array, distance: float, distance_sigma: float, *, focal_px: float
    ) -> float:
        """Of a box (2,) px if it is the drone at that distance, ± distance_sigma m, and if it is a stranger's. Zero
        where either is not known."""
        seen = _log_span(size, distance, focal_px)
        if not math.isfinite(seen):
            return 0.0
        noise = BOX_SIGMA**2 + min(distance_sigma / distance, MOST_VAGUE) ** 2
        density = _normal(seen - math.log(SPAN), SPAN_SIGMA**2 + noise)
        if drone_id in self._known:
            mean, count, p = self._known[drone_id]
            density = p * _normal(seen - mean, BOX_SIGMA**2 / count + noise) + (1.0 - p) * density
        return math.log(max(density * STRANGER_LOG, 1e-6))


def _log_span(size: Array, distance: float, focal_px: float) -> float:
    side = float(np.max(size))
    return math.log(side * distance / focal_px) if side > 0.0 and distance > 0.0 else math.nan


def _normal(x: float, variance: float) -> float:
    return math.exp(-0.5 * x * x / variance) / math.sqrt(2.0 * math.pi * variance)
