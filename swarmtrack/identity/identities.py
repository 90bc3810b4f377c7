"""Who is who: gives drones' IDs to tracks, keeps them, and asks again when something changed.

A track gets an ID when the same matching was found in several scans in a row, and keeps it for life: an announced pose
tells where a drone *was*, the track carries it from there. A drone's ID that a live track holds is not given twice.
What speaks for asking again (a new boot, a new announcement) frees the ID concerned.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.identity.matching import Assignment, gated_one_to_one, nearest
from swarmtrack.identity.reprojection import reproject
from swarmtrack.messages import Announcement, IdentifiedTrack, Track, TrackStatus
from swarmtrack.motion.ego import TeamPose


@dataclass(frozen=True, slots=True, kw_only=True)
class IdentityParameters:
    """profile `paper`: Algorithm 1 as printed, in one shot; `default`: gated, one-to-one, with "unknown"."""

    profile: str = "default"
    probability: float = 0.95
    """An ID is stated only above it."""
    scans: int = 3
    """Scans in a row that must agree."""
    drift_speed: float = 0.5
    """m/s: how fast an announced drone that has left its pose may be moving."""
    stay_s: float = 30.0
    """s after which half of the announced drones have left their pose: they wait for take-off."""

    def __post_init__(self) -> None:
        if self.profile not in ("default", "paper"):
            raise ValueError(f"identity.profile: found {self.profile!r}, expected one of default, paper")
        if not 0.5 <= self.probability < 1.0:
            raise ValueError(
                f"identity.probability: found {self.probability!r}, expected 0.5 or more, below 1"
            )
        if self.scans < 1:
            raise ValueError(f"identity.scans: found {self.scans!r}, expected 1 or more")
        if not self.drift_speed >= 0.0:
            raise ValueError(f"identity.drift_speed: found {self.drift_speed!r}, expected 0 or more")
        if not self.stay_s > 0.0:
            raise ValueError(f"identity.stay_s: found {self.stay_s!r}, expected a number of seconds above 0")


@dataclass(slots=True)
class _Candidate:
    drone_id: int
    scans: int


class Identities:
    """Announced poses and the identities given to tracks."""

    def __init__(
        self, drone_id: int, *, camera: PinholeCamera, body_from_camera: Pose, parameters: IdentityParameters
    ) -> None:
        self._drone_id = drone_id
        self._camera = camera
        self._body_from_camera = body_from_camera
        self._parameters = parameters
        self._announced: dict[int, Announcement] = {}
        self._given: dict[int, tuple[int, float]] = {}
        self._candidates: dict[int, _Candidate] = {}

    @property
    def announced(self) -> dict[int, Announcement]:
        """The latest announcement of every teammate."""
        return dict(self._announced)

    def announce(self, announcement: Announcement) -> bool:
        """Take in a teammate's pose. Returns False for our own ID, or for one that is not newer."""
        known = self._announced.get(announcement.drone_id)
        ours = announcement.drone_id == self._drone_id
        if ours or (known and known.boot == announcement.boot and known.sequence >= announcement.sequence):
            return False
        self._announced[announcement.drone_id] = announcement
        self._given = {
            track: given for track, given in self._given.items() if given[0] != announcement.drone_id
        }
        return True

    def observe(self, tracks: Iterable[Track], observer: TeamPose) -> None:
        """Look at the tracks of a scan, with this drone's own pose at its exposure."""
        alive = {track.id: track for track in tracks}
        self._given = {id: given for id, given in self._given.items() if id in alive}
        taken = {drone for drone, _ in self._given.values()}
        nameless = [
            t for t in alive.values() if t.status is TrackStatus.CONFIRMED and t.id not in self._given
        ]
        free = [a for id, a in self._announced.items() if id not in taken]
        found = self._match(nameless, free, observer)
        self._candidates = {
            nameless[row].id: _Candidate(drone, self._agreeing(nameless[row].id, drone) + 1)
            for row, (drone, _) in found.items()
        }
        for row, given in found.items():
            track = nameless[row]
            if self._candidates[track.id].scans >= self._scans_needed:
                self._given[track.id] = given

    def label(self, tracks: Iterable[Track]) -> tuple[IdentifiedTrack, ...]:
        """The same tracks, with who they are."""
        unknown = (None, 0.0)
        return tuple(IdentifiedTrack(track, *self._given.get(track.id, unknown)) for track in tracks)

    @property
    def _scans_needed(self) -> int:
        return 1 if self._parameters.profile == "paper" else self._parameters.scans

    def _agreeing(self, track_id: int, drone: int) -> int:
        candidate = self._candidates.get(track_id)
        return candidate.scans if candidate and candidate.drone_id == drone else 0

    def _match(self, tracks: list[Track], announced: list[Announcement], observer: TeamPose) -> Assignment:
        if not tracks or not announced:
            return {}
        projected = reproject(
            announced,
            observer,
            camera=self._camera,
            body_from_camera=self._body_from_camera,
            drift_speed=self._parameters.drift_speed,
            stay_s=self._parameters.stay_s,
        )
        mean = np.array([track.mean for track in tracks])
        if self._parameters.profile == "paper":
            return nearest(mean, projected)
        cov = np.array([track.cov for track in tracks])
        return gated_one_to_one(
            mean, cov, projected, camera=self._camera, probability=self._parameters.probability
        )
