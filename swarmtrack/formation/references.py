"""Whether a reference may be flown by: named surely for long enough, seen lately, and where it was expected."""

from __future__ import annotations

import math

from swarmtrack.formation.setpoint import OwnFlight, Velocity
from swarmtrack.messages import IdentifiedTrack, RelativeState, TrackStatus

# A name comes in at more than this for ENTRY_S seconds, and goes out below the second.
SURE, DOUBTED = 0.99, 0.9
ENTRY_S = 1.0
# s without a detection: then where it is is not known well enough any more.
UNSEEN_S = 1.5
# Of ln(range): a range that is known no better is none.
VAGUE_RANGE = 0.5
# m, and m/s: a reference that is this much elsewhere than it was expected is another drone.
JUMP_M, JUMP_SPEED = 2.0, 3.0
# s: so long the nose is kept to where it was last seen.
LOOKED_AFTER_S = 4.0


class ReferenceWatch:
    """One reference. Times [s]; places in the team frame."""

    def __init__(self, drone_id: int) -> None:
        self.drone_id = drone_id
        self.trusted = False
        """Whether it may be flown by."""
        self.entering = False
        """Whether it is named, and not for long enough."""
        self._track: int | None = None
        self._sure_since: float | None = None
        self._place: Velocity = (0.0, 0.0, 0.0)
        self._velocity: Velocity = (0.0, 0.0, 0.0)
        self._placed_at = -math.inf

    def restart(self) -> None:
        """Its name has to hold for `ENTRY_S` again."""
        self.trusted = self.entering = False
        self._track = self._sure_since = None

    def see(self, entry: IdentifiedTrack, state: RelativeState, own: OwnFlight, t: float) -> None:
        """It bears the name now."""
        coasting = entry.track.coasting_since
        unseen = coasting is not None and t - coasting > UNSEEN_S
        vague = not state.range_sigma_log < VAGUE_RANGE
        if unseen or vague or entry.track.status is not TrackStatus.CONFIRMED:
            return self.miss()
        north, east, down = state.position.tolist()
        vn, ve, vd = state.velocity.tolist()
        place = (own.position[0] + north, own.position[1] + east, own.position[2] + down)
        if entry.track.id != self._track or self._is_elsewhere(place, t):
            self.restart()
        self._track = entry.track.id
        self._place, self._placed_at = place, t
        self._velocity = (own.velocity[0] + vn, own.velocity[1] + ve, own.velocity[2] + vd)
        # While it is not detected its probability falls with the track's own, which says nothing against the name.
        p = entry.identity_probability if coasting is None or not self.trusted else 1.0
        if p > SURE:
            self._sure_since = t if self._sure_since is None else self._sure_since
        elif p < DOUBTED or not self.trusted:
            self._sure_since = None
        self.trusted = self._sure_since is not None and t - self._sure_since >= ENTRY_S
        self.entering = not self.trusted
        return None

    def miss(self) -> None:
        """Nobody bears its name, or it has not been seen for too long."""
        self.restart()

    def direction(self, own: OwnFlight, t: float) -> tuple[float, float] | None:
        """North and east, of length 1, to where it is or was last expected; None after `LOOKED_AFTER_S`."""
        age = t - self._placed_at
        if not 0.0 <= age < LOOKED_AFTER_S:
            return None
        north = self._place[0] + age * self._velocity[0] - own.position[0]
        east = self._place[1] + age * self._velocity[1] - own.position[1]
        away = math.hypot(north, east)
        return (north / away, east / away) if away > 1e-3 else None

    def _is_elsewhere(self, place: Velocity, t: float) -> bool:
        age = t - self._placed_at
        if not 0.0 <= age < LOOKED_AFTER_S:
            return False
        moved = [
            there - here - age * v for there, here, v in zip(place, self._place, self._velocity, strict=True)
        ]
        return math.hypot(*moved) > JUMP_M + JUMP_SPEED * age
