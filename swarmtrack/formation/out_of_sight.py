"""Prediction of tracks that approached when they left the image: constant velocity, with growing uncertainty."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from swarmtrack.formation.margins import (
    COMING_SPEED_M_S,
    OUT_OF_SIGHT_ACCELERATION_M_S2,
    OUT_OF_SIGHT_REMEMBERED_S,
    OUT_OF_SIGHT_SAME_M,
)
from swarmtrack.formation.setpoint import OwnFlight, Velocity
from swarmtrack.messages import Array, RelativeState


class LastSight(NamedTuple):
    """since, t [s]: first and last time seen; here [m], flies [m/s]: the own drone then; state: of the other
    relative to it.
    """

    since: float
    t: float
    here: Velocity
    flies: Velocity
    state: RelativeState

    def after(self, age: float, own: OwnFlight) -> RelativeState:
        """Prediction after some time, relative to this drone's position and velocity by then."""
        flies = self.state.velocity + self.flies
        place = self.state.position + self.here + age * flies - own.position
        return replace(
            self.state,
            t=self.t + age,
            position=place,
            velocity=flies - own.velocity,
            cov=_grown(self.state.cov, age),
        )


class OutOfSight:
    """Takes the tracks in view each time; `states` are those that left it."""

    def __init__(self) -> None:
        self._seen: dict[int, LastSight] = {}

    def states(self, seen: Mapping[int, RelativeState], own: OwnFlight, t: float) -> dict[int, RelativeState]:
        """States by former track; those from before a jump of the own position or heading are dropped."""
        frame_age = min(own.leap_age, own.heading_step_age)
        expected = {}
        for track, last in list(self._seen.items()):
            if track in seen:
                continue
            age = t - last.t
            # Clutter is over as soon as it came: nobody is remembered for longer than it was seen.
            lasts = min(OUT_OF_SIGHT_REMEMBERED_S, last.t - last.since, frame_age)
            state = last.after(age, own) if 0.0 <= age < lasts else None
            if state is None or not _comes(last.state) or not _is_elsewhere(state, seen.values()):
                del self._seen[track]
            else:
                expected[track] = state
        for track, state in seen.items():
            since = self._seen[track].since if track in self._seen else t
            self._seen[track] = LastSight(since, t, own.position, own.velocity, state)
        return expected


def _comes(state: RelativeState) -> bool:
    """Who did not come when it was last seen is in nobody's way."""
    return float(state.position @ state.velocity) < -COMING_SPEED_M_S * math.hypot(*state.position)


def _is_elsewhere(state: RelativeState, seen: Iterable[RelativeState]) -> bool:
    """Than this drone itself, and than all those who are seen."""
    return bool(state.position.any()) and all(
        math.dist(state.position, other.position) >= OUT_OF_SIGHT_SAME_M for other in seen
    )


def _grown(cov: Array, age: float) -> Array:
    """(6, 6), after so many seconds of unknown acceleration."""
    F = np.eye(6)
    F[:3, 3:] = age * np.eye(3)
    noise = np.diag(
        [(0.5 * OUT_OF_SIGHT_ACCELERATION_M_S2 * age * age) ** 2] * 3
        + [(OUT_OF_SIGHT_ACCELERATION_M_S2 * age) ** 2] * 3
    )
    return F @ cov @ F.T + noise
