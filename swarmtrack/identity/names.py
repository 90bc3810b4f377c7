"""The names that tracks have: given, carried from scan to scan, withdrawn, and remembered when a track ends."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from swarmtrack.identity.assignment import Assignment, Unassigned
from swarmtrack.identity.reprojection import LastSeen, ObserverCamera, rays_to
from swarmtrack.identity.standing import Event, Standing, fire
from swarmtrack.messages import FOREIGN, Identity, Track

# s after which it does not matter where somebody was last seen.
FORGET_S = 30.0


class Names:
    """Of each track its assignment, or since when it has none; iterates over assignments.

    alive: all tracks after the last scan, by their numbers; shown: those in the pixels of its camera. unassigned: those
    without an ID. lost: by drone, its assignment when its track ended.
    """

    def __init__(self) -> None:
        self.alive: Mapping[int, Track] = {}
        self.shown: Mapping[int, Track] = {}
        self.unassigned: dict[int, Unassigned] = {}
        self.lost: dict[int, Assignment] = {}
        self._assignments: dict[int, Assignment] = {}
        """By track."""
        self._looked: dict[int, float] = {}
        """By camera, of when its last scan is, s."""

    def __iter__(self) -> Iterator[Assignment]:
        return iter(self._assignments.values())

    def of(self, track_id: int) -> Assignment | None:
        """The assignment of a track."""
        return self._assignments.get(track_id)

    def holder(self, drone_id: int) -> Assignment | None:
        """The assignment of a drone."""
        return next((held for held in self if held.drone_id == drone_id), None)

    @property
    def drones(self) -> set[int]:
        """Those that have a track."""
        return {held.drone_id for held in self}

    @property
    def stated(self) -> list[int]:
        """The drones whose ID is published."""
        return [held.drone_id for held in self if held.stated]

    @property
    def stated_here(self) -> list[int]:
        """Those of them whose tracks the camera of the last scan shows."""
        return [held.drone_id for held in self if held.stated and held.track_id in self.shown]

    @property
    def settled(self) -> list[Assignment]:
        """The assignments against which nothing speaks."""
        return [held for held in self if held.standing is Standing.SETTLED]

    def stated_of(self, track: Track) -> tuple[Identity, float]:
        """Who a track is, and how surely. An ID says where its drone is: that is so as surely as the track still has
        its target."""
        held = self.of(track.id)
        if held is not None and held.stated:
            probability = held.probability * track.probability
            return (held.drone_id, probability) if probability > 0.5 else (None, 0.0)
        unassigned = self.unassigned.get(track.id)
        if unassigned is not None and unassigned.foreign:
            return FOREIGN, unassigned.p_none
        return None, 0.0

    def sightings(self, t: float) -> list[tuple[LastSeen, float]]:
        """The rays to identified drones that were detected in the scan of t, and how surely it is they."""
        named = [held for held in self.settled if held.track_id in self.shown]
        return [(held.seen, self._surely(held)) for held in named if held.seen and held.seen.t == t]

    def sightings_elsewhere(self, t: float, within: float) -> list[tuple[LastSeen, float]]:
        """Likewise of those that other cameras show, and detected when they looked last, within so many s of t."""
        return [
            (held.seen, self._surely(held))
            for held in self.settled
            if held.track_id not in self.shown
            and held.seen
            and abs(held.seen.t - t) <= within
            and held.seen.t >= self._looked.get(self.alive[held.track_id].camera, -math.inf)
        ]

    def _surely(self, held: Assignment) -> float:
        return held.probability * self.alive[held.track_id].probability

    def assign(self, held: Assignment) -> None:
        """Its track is that drone, and no longer whichever it was."""
        before = self.of(held.track_id)
        if before is not None:
            # Replaced in its place: of two tracks with one ID, news is of the first.
            fire(before.standing, Event.REASSIGNED)
        self._assignments[held.track_id] = held
        self.unassigned.pop(held.track_id, None)

    def fire(self, held: Assignment, event: Event) -> None:
        """Let something happen to an assignment: its standing changes, or it ends."""
        standing = fire(held.standing, event)
        if standing is None:
            del self._assignments[held.track_id]
        else:
            held.enter(standing)

    def withdraw(self, drone_id: int, event: Event) -> None:
        """No track is this drone any more, nor is it where it was last seen."""
        self.lost.pop(drone_id, None)
        for held in [held for held in self if held.drone_id == drone_id]:
            self.fire(held, event)

    def follow(self, alive: Mapping[int, Track], t: float, camera: int = 0) -> None:
        """The tracks after another scan, of this camera: IDs are taken from those that ended."""
        self.alive = alive
        self._looked[camera] = t
        self.shown = {id: track for id, track in alive.items() if track.camera == camera}
        for ended in [held for held in self if held.track_id not in alive]:
            self.fire(ended, Event.TRACK_ENDED)
            if ended.seen is not None:
                self.lost[ended.drone_id] = ended
        self.lost = {
            drone: ended
            for drone, ended in self.lost.items()
            if ended.seen is not None and t - ended.seen.t < FORGET_S
        }

    def remember_rays(self, view: ObserverCamera) -> None:
        """Where the drones are seen whose tracks were detected."""
        tracks = [
            (held, self.shown[held.track_id]) for held in self if held.stated and held.track_id in self.shown
        ]
        detected = [(held, track) for held, track in tracks if track.coasting_since is None]
        rays = rays_to([(held.drone_id, track) for held, track in detected], view)
        for (held, _), ray in zip(detected, rays, strict=True):
            held.seen = ray

    def leave_unassigned(self, track_id: int, t: float) -> Unassigned:
        """A track has no ID, since t or before."""
        return self.unassigned.setdefault(track_id, Unassigned(t))

    def reconsider_strangers(self) -> None:
        """Whoever was taken for a stranger may be a teammate: this drone was wrong itself."""
        for entry in self.unassigned.values():
            entry.reconsider()

    def keep_unassigned(self, tracks: list[Track], t: float) -> None:
        """Of the tracks shown these take part in the matching: those among them without an ID. Those of other cameras
        stay as they are."""
        nameless = [track.id for track in tracks if track.id not in self._assignments]
        elsewhere = {
            id: entry
            for id, entry in self.unassigned.items()
            if id in self.alive and id not in self.shown and id not in self._assignments
        }
        self.unassigned = {id: self.unassigned.get(id) or Unassigned(t) for id in nameless} | elsewhere
