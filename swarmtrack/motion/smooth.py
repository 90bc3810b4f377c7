"""Smooth functions of time with three derivatives: how a motion begins, ends and swings without a jump of its jerk."""

from __future__ import annotations

import math

import numpy as np

from swarmtrack.messages import Array

DERIVATIVES = 4  # position, velocity, acceleration, jerk


def sinusoid(amplitude: Array, omega: Array, angle: Array) -> Array:
    """amplitude sin(angle) and its derivatives where the angle grows by omega: (…) -> (DERIVATIVES, …)."""
    sine, cosine = amplitude * np.sin(angle), amplitude * np.cos(angle)
    square = omega * omega
    return np.array([sine, omega * cosine, -square * sine, -square * omega * cosine])


def scaled(factor: Array, flat: Array) -> Array:
    """The derivatives (4, 3) of a path's `flat` (4, 3) times a number with the derivatives `factor` (4,): Leibniz."""
    product = np.zeros((DERIVATIVES, 3))
    for order in range(DERIVATIVES):
        for k in range(order + 1):
            product[order] += math.comb(order, k) * factor[k] * flat[order - k]
    return product


def smooth_step(x: float) -> Array:
    """From 0 to 1 on 0…1 by the polynomial of degree 7 that is flat to third order at both ends.

    Value and three derivatives, (4,).
    """
    if x <= 0.0:
        return np.zeros(DERIVATIVES)
    if x >= 1.0:
        return np.array([1.0, 0.0, 0.0, 0.0])
    return np.array(
        [
            x**4 * (35 - 84 * x + 70 * x**2 - 20 * x**3),
            140 * x**3 * (1 - x) ** 3,
            420 * x**2 * (1 - x) ** 2 * (1 - 2 * x),
            840 * x * (1 - x) * (1 - 5 * x + 5 * x**2),
        ]
    )
