"""Observers with lasting errors, and a stranger that they see; nothing of it is known to the code under test."""

import math

import numpy as np

from swarmtrack.strangers.priors import VISITOR_ACCELERATION_PSD_M2_S3
from swarmtrack.strangers.ray_filter import Errors, Ray

ERRORS = Errors(0.1, math.radians(0.5), math.radians(1.5))
SIGMA, SCAN_S = 5e-3, 1.0 / 7.0


class World:
    """Observers with lasting errors as large as they state, and a stranger of the filter's own motion; a seed each."""

    def __init__(self, seed, observers=3):
        self.rng = rng = np.random.default_rng(seed)
        self.camera = np.array([[0.0, 0.0, 0.0], [6.0, 0.0, 0.0], [0.0, 6.0, 0.5]])[:observers]
        self.camera = self.camera + rng.normal(size=(observers, 3))
        self.turn = rng.normal(size=(observers, 3)) * [ERRORS.tilt, ERRORS.tilt, ERRORS.heading]
        self.off = rng.normal(size=(observers, 3)) * ERRORS.place
        self.place = np.array([10.0, 12.0, -2.0]) + rng.normal(size=3) * [3.0, 3.0, 1.0]
        self.velocity = rng.normal(size=3) * [2.0, 2.0, 0.5]
        self.size = 0.63 * rng.normal()

    def ray(self, i, t, there=None, sigma=SIGMA):
        r = (self.place if there is None else there) - self.camera[i] - self.off[i]
        u = r / np.linalg.norm(r)
        m = u - np.cross(self.turn[i], u) + sigma * self.rng.normal(size=3)
        range_ln = math.log(float(np.linalg.norm(r))) + self.size
        return Ray(i, t, self.camera[i], m / np.linalg.norm(m), sigma, ERRORS, range_ln)

    def fly(self, dt=SCAN_S):
        q = VISITOR_ACCELERATION_PSD_M2_S3
        a = self.rng.normal(size=3) * math.sqrt(q / dt)
        self.place = self.place + dt * self.velocity + 0.5 * dt**2 * a
        self.velocity = self.velocity + dt * a
