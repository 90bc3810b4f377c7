"""Who is who by one look: log ratios for the posterior over all one-to-one matchings.

Strangers are a Poisson process, uniform over the image. Nobody's density is thinner than that of a drone which is in
view with probability `IN_VIEW`, and anywhere in it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array
from swarmtrack.tracking.association import gate_threshold
from swarmtrack.tracking.gaussian import LOG_TWO_PI

# Prior: that a drone which may be anywhere is in front of this camera.
IN_VIEW = 0.2
GATE_PROBABILITY = 0.9999


class Prior(NamedTuple):
    """What to expect of an image. p_seen: that a drone which should be in view has a confirmed track; strangers:
    how many confirmed tracks are none of the announced drones. Neither is ever certain: p_seen < 1, strangers > 0."""

    p_seen: float = 0.9
    strangers: float = 1.0

    @property
    def log_ratio(self) -> float:
        """Of "this track is that drone" and "a stranger, and the drone is not seen", before looking where they
        are."""
        return math.log(self.p_seen / (1.0 - self.p_seen) / self.strangers)


PRIOR = Prior()


def log_ratios(
    tracks: Array, projected: Array, variance: float, camera: PinholeCamera, prior: Prior = PRIOR
) -> Array:
    """log (n, k) of how much more likely "track i is drone j" is than "i is a stranger, and j is not seen"; −inf
    outside the gate. tracks (n, 2), projected (k, 2) px; variance px² per axis: of both together."""
    log_area = math.log(camera.width * camera.height)
    distance = ((tracks[:, None] - projected) ** 2).sum(axis=2) / variance
    log_extent = min(LOG_TWO_PI + math.log(variance), log_area - math.log(IN_VIEW))
    log_density = np.where(distance > gate_threshold(GATE_PROBABILITY), -np.inf, -0.5 * distance - log_extent)
    return np.asarray(log_density + log_area + prior.log_ratio)
