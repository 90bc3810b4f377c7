"""The displacement law: a velocity from the positions and velocities of the references.

    e = (Σ P_r⁻¹)⁻¹ Σ P_r⁻¹ (r − D)    w = (Σ P_v⁻¹)⁻¹ Σ P_v⁻¹ v_j    v = sat(k e) + w

The covariances weigh: a camera is accurate across a ray, and not along it. Without w no formation holds at 1.5 m/s.
Level only: the own autopilot holds the height.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from swarmtrack.formation.margins import STATE_LEAST_SIGMA
from swarmtrack.formation.setpoint import Velocity
from swarmtrack.messages import Array


class SeenReference(NamedTuple):
    """A reference: error (3,) m: its position less the wanted one; velocity (3,) m/s, its own; cov (6, 6)."""

    error: Array
    velocity: Array
    cov: Array


def displacement(seen: Sequence[SeenReference]) -> tuple[Velocity, Velocity]:
    """Error of the own position [m], and the velocity of the formation [m/s]."""
    errors = [(entry.error, entry.cov[:3, :3]) for entry in seen]
    velocities = [(entry.velocity, entry.cov[3:, 3:]) for entry in seen]
    return _weighted(errors), _weighted(velocities)


def _weighted(values: Sequence[tuple[Array, Array]]) -> Velocity:
    told = np.array([value for value, _ in values])
    mean = told[0]
    if len(values) > 1:
        floor = STATE_LEAST_SIGMA**2 * np.eye(3)
        try:
            weights = np.linalg.inv(np.array([cov for _, cov in values]) + floor)
            mean = np.linalg.solve(weights.sum(axis=0), np.einsum("nij,nj->i", weights, told))
        except np.linalg.LinAlgError:
            # No covariance at all: they count alike.
            mean = told.mean(axis=0)
    north, east, down = mean.tolist()
    return north, east, down


def saturated(v: Velocity, most: float) -> Velocity:
    """The same direction, at most `most` long."""
    north, east, down = v
    length = math.sqrt(north * north + east * east + down * down)
    if length <= most:
        return v
    share = most / length
    return north * share, east * share, down * share


def added(a: Velocity, b: Velocity) -> Velocity:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def dot(a: Velocity, b: Velocity) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def towards(now: Velocity, wanted: Velocity, most: float) -> Velocity:
    """Step from one velocity towards another, by no more than `most`."""
    north, east, down = (goal - here for here, goal in zip(now, wanted, strict=True))
    step = saturated((north, east, down), most)
    return now[0] + step[0], now[1] + step[1], now[2] + step[2]


def turn_rate(error: float, gain: float, most: float) -> float:
    """Yaw rate [rad/s] that removes an error of heading [rad, any]."""
    return min(max(gain * math.remainder(error, 2.0 * math.pi), -most), most)
