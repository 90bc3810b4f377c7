"""Trust in a reference: named confidently for long enough, seen recently, and at its expected position."""

from __future__ import annotations

import math

from swarmtrack.formation.margins import (
    REFERENCE_DOUBTED_PROBABILITY,
    REFERENCE_ENTRY_S,
    REFERENCE_JUMP_M,
    REFERENCE_JUMP_M_S,
    REFERENCE_KNOWN_PROBABILITY,
    REFERENCE_NOSE_KEPT_S,
    REFERENCE_UNSEEN_S,
    REFERENCE_VAGUE_LOG_RANGE,
)
from swarmtrack.formation.setpoint import OwnFlight, Velocity
from swarmtrack.messages import IdentifiedTrack, RelativeState, TrackStatus


class ReferenceWatch:
    """One reference. Times [s]; positions in the team frame."""

    def __init__(self, drone_id: int, sure: float) -> None:
        self.drone_id = drone_id
        self._sure = sure
        self._known_track: int | None = None
        self.trusted = False
        """Whether it may be flown by."""
        self.entering = False
        """Whether it is named, and not for long enough."""
        self.camera: int | None = None
        """That which saw it last."""
        self._track: int | None = None
        self._sure_since: float | None = None
        self._place: Velocity = (0.0, 0.0, 0.0)
        self._velocity: Velocity = (0.0, 0.0, 0.0)
        self._placed_at = -math.inf

    def engage(self) -> None:
        """Begin a new flight, without the state of the last one."""
        self.restart()
        self._known_track = self.camera = None

    def restart(self) -> None:
        """No track has its name, or it has not been seen for too long: the conditions have to hold for
        `REFERENCE_ENTRY_S` again.
        """
        self.trusted = self.entering = False
        self._track = self._sure_since = None

    def observe(self, entry: IdentifiedTrack, state: RelativeState, own: OwnFlight, t: float) -> None:
        """A track has its name now."""
        self.camera = entry.track.camera
        coasting = entry.track.coasting_since
        unseen = coasting is not None and t - coasting > REFERENCE_UNSEEN_S
        vague = not state.range_sigma_log < REFERENCE_VAGUE_LOG_RANGE
        if unseen or vague or entry.track.status is TrackStatus.TENTATIVE:
            self.restart()
            return
        north, east, down = state.position.tolist()
        vn, ve, vd = state.velocity.tolist()
        place = (own.position[0] + north, own.position[1] + east, own.position[2] + down)
        leaps = self._is_elsewhere(place, t)
        if leaps:
            self._known_track = None
        if leaps or entry.track.id != self._track:
            self.restart()
        self._track = entry.track.id
        self._place, self._placed_at = place, t
        self._velocity = (own.velocity[0] + vn, own.velocity[1] + ve, own.velocity[2] + vd)
        # While it is not detected its probability falls with the track's own, which says nothing against the name.
        p = entry.identity_probability if coasting is None or self._sure_since is None else 1.0
        if p > (
            min(self._sure, REFERENCE_KNOWN_PROBABILITY)
            if entry.track.id == self._known_track
            else self._sure
        ):
            self._sure_since = t if self._sure_since is None else self._sure_since
        elif p < REFERENCE_DOUBTED_PROBABILITY or not self.trusted:
            self._sure_since = None
        lasts = self._sure_since is not None and t - self._sure_since >= REFERENCE_ENTRY_S
        # A missed detection ends no trust, and begins none.
        self.trusted = lasts and (self.trusted or coasting is None)
        self.entering = not self.trusted
        if self.trusted:
            self._known_track = entry.track.id

    def direction(self, own: OwnFlight, t: float) -> tuple[float, float] | None:
        """Level unit vector, north and east, to its last expected position; None after `REFERENCE_NOSE_KEPT_S`."""
        age = t - self._placed_at
        if not 0.0 <= age < REFERENCE_NOSE_KEPT_S:
            return None
        north = self._place[0] + age * self._velocity[0] - own.position[0]
        east = self._place[1] + age * self._velocity[1] - own.position[1]
        away = math.hypot(north, east)
        return (north / away, east / away) if away > 1e-3 else None

    def _is_elsewhere(self, place: Velocity, t: float) -> bool:
        age = t - self._placed_at
        if not 0.0 <= age < REFERENCE_NOSE_KEPT_S:
            return False
        moved = [
            there - here - age * v for there, here, v in zip(place, self._place, self._velocity, strict=True)
        ]
        return math.hypot(*moved) > REFERENCE_JUMP_M + REFERENCE_JUMP_M_S * age
