"""Obstacles: lower bounds of range and motion of every track, from its state and uncertainty."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from swarmtrack.formation.barrier import HalfSpace, keep_clear, not_closing
from swarmtrack.formation.margins import (
    OBSTACLE_CARRIED_NEARER_M,
    OBSTACLE_NEARER_SIGMAS,
    OBSTACLE_VAGUEST_LOG_RANGE,
    OBSTACLE_VAGUEST_SPEED_M_S,
    OBSTACLE_WATCHED_M,
)
from swarmtrack.formation.parameters import FormationParameters
from swarmtrack.formation.setpoint import OwnFlight, Velocity
from swarmtrack.messages import RelativeState


class Obstacle(NamedTuple):
    """A track. place [m, from here], velocity [m/s, its own]; direction: of length 1, to it; nearest [m]: lower
    bound of its range; away and leaves [m/s]: its speed along the direction, lower bound and expected.
    """

    track: int
    place: Velocity
    velocity: Velocity
    direction: Velocity
    nearest: float
    away: float
    leaves: float

    def to_keep_clear(self, p: FormationParameters) -> HalfSpace:
        """Half-space of `keep_clear` for it."""
        return keep_clear(
            self.track, self.direction, self.nearest, self.away, clearance=p.clearance, fastest=p.limits.speed
        )

    def not_to_close_in(self, p: FormationParameters) -> HalfSpace:
        """Half-space of `not_closing` for it."""
        return not_closing(self.track, self.direction, self.nearest, self.leaves, clearance=p.clearance)


def obstacles(states: Mapping[int, RelativeState], own: OwnFlight, clearance: float) -> list[Obstacle]:
    """Obstacles that are near enough to count, by track. To a drone that is carried all are nearer by one sigma of its
    place, and slower by one of its velocity."""
    if not states:
        return []
    r = np.array([state.position for state in states.values()])
    v = np.array([state.velocity for state in states.values()]) + own.velocity
    distance = np.sqrt((r * r).sum(axis=1))
    d = r / distance[:, None]
    cov = np.array([state.cov for state in states.values()])
    place, speed = (
        np.sqrt(np.maximum((d[:, :, None] * cov[:, k, k] * d[:, None, :]).sum(axis=(1, 2)), 0.0))
        for k in (slice(0, 3), slice(3, 6))
    )
    nearest = distance * np.exp(
        -OBSTACLE_NEARER_SIGMAS * np.minimum(place / distance, OBSTACLE_VAGUEST_LOG_RANGE)
    )
    if own.is_carried:
        nearest = np.maximum(nearest - min(own.position_sigma, OBSTACLE_CARRIED_NEARER_M), 0.0)
    leaves = (d * v).sum(axis=1)
    away = leaves - np.minimum(np.hypot(speed, own.velocity_sigma), OBSTACLE_VAGUEST_SPEED_M_S)
    columns = (r.tolist(), v.tolist(), d.tolist(), nearest.tolist(), away.tolist(), leaves.tolist())
    return [
        Obstacle(track, tuple(there), tuple(motion), tuple(ray), least, slow, expected)
        for track, there, motion, ray, least, slow, expected in zip(states, *columns, strict=True)
        if least < clearance + OBSTACLE_WATCHED_M
    ]
