"""Who has just left the picture is still there: it flies on as it was last seen, and is known worse every moment."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from swarmtrack.formation.setpoint import OwnFlight, Velocity
from swarmtrack.messages import Array, RelativeState

# s: so long somebody is remembered.
REMEMBERED_S = 3.0
# m/s², one sigma: how somebody may change its velocity meanwhile.
CHANGES = 0.3
# m: who is seen so near to where somebody was expected is that one, on another track.
SAME_M = 2.0


class LastSeen(NamedTuple):
    """t [s]; here [m] and flies [m/s]: the own drone then, team frame; state: of the other against it."""

    t: float
    here: Velocity
    flies: Velocity
    state: RelativeState

    def after(self, age: float, own: OwnFlight) -> RelativeState:
        """As it is expected that much later, against where this drone is and how it flies by then."""
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
    """Told whom a drone sees, by track, each time; `states` are those whom it does not see any more."""

    def __init__(self) -> None:
        self._seen: dict[int, LastSeen] = {}

    def forget(self) -> None:
        self._seen.clear()

    def states(self, seen: Mapping[int, RelativeState], own: OwnFlight, t: float) -> dict[int, RelativeState]:
        """By the track that each had; what places were measured in before the own one leapt, or the own heading
        stepped, is forgotten."""
        frame_age = min(own.leap_age, own.heading_step_age)
        expected = {}
        for track, last in list(self._seen.items()):
            if track in seen:
                continue
            age = t - last.t
            state = last.after(age, own) if 0.0 <= age < min(REMEMBERED_S, frame_age) else None
            if state is None or not _is_elsewhere(state, seen.values()):
                del self._seen[track]
            else:
                expected[track] = state
        self._seen |= {track: LastSeen(t, own.position, own.velocity, state) for track, state in seen.items()}
        return expected


def _is_elsewhere(state: RelativeState, seen: Iterable[RelativeState]) -> bool:
    """Than this drone itself, and than all those who are seen."""
    return bool(state.position.any()) and all(
        math.dist(state.position, other.position) >= SAME_M for other in seen
    )


def _grown(cov: Array, age: float) -> Array:
    """(6, 6), after so many seconds of unknown acceleration."""
    F = np.eye(6)
    F[:3, 3:] = age * np.eye(3)
    noise = np.diag([(0.5 * CHANGES * age * age) ** 2] * 3 + [(CHANGES * age) ** 2] * 3)
    return F @ cov @ F.T + noise
