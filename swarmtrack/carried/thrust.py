"""How a drone's tilt pushes it: the level part of its thrust.

A multirotor whose thrust T along its own axis z carries its weight, T R₃₃ = g, is pushed level by −g (R₁₃, R₂₃) / R₃₃
m/s². A steady part of that only balances drag and wind, or is the error of the attitude: it is taken off.
"""

from __future__ import annotations

import math

import numpy as np

from swarmtrack.carried.priors import PUSH_KNOWN_S, STEADY_PUSH_S, TILT_PUSHES_LEAST
from swarmtrack.geometry.geodesy import STANDARD_GRAVITY_M_S2
from swarmtrack.messages import Array


class TiltedThrust:
    """Takes attitudes, one after the other."""

    def __init__(self) -> None:
        self._t = math.nan
        self._before, self._steady = np.zeros(3), np.zeros(3)

    def push(self, t: float, world_from_body: Array) -> Array:
        """(3,) m/s² NED, on average since the last attitude; world_from_body (3, 3): at t [s]."""
        north, east, upright = world_from_body[:, 2].tolist()
        share = -STANDARD_GRAVITY_M_S2 / max(upright, TILT_PUSHES_LEAST)
        now = np.array([share * north, share * east, 0.0])
        if math.isnan(self._t):
            self._steady = now
        average = 0.5 * (now + self._before)
        dt = t - self._t
        self._t, self._before = t, now
        if not 0.0 < dt < PUSH_KNOWN_S:
            return np.zeros(3)
        pushed = average - self._steady
        self._steady = self._steady - math.expm1(-dt / STEADY_PUSH_S) * (average - self._steady)
        return pushed
