"""The paper's Algorithm 1: each track takes, in one shot, the ID whose announced place is projected nearest to it.

It has no gate, no "unknown", and no one-to-one matching. A track keeps its ID until it ends, and is matched again when
its drone announces itself again.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.identity.consensus import OwnSighting
from swarmtrack.identity.news import NO_NEWS, IdentityNews
from swarmtrack.identity.reprojection import LastSeen, ObserverCamera, rays_to
from swarmtrack.identity.teammates import Teammates
from swarmtrack.messages import (
    AgreedMotion,
    Announcement,
    Array,
    IdentifiedTrack,
    Membership,
    MotionReport,
    OwnFault,
    SightingReport,
    Track,
    TrackStatus,
)
from swarmtrack.motion.ego import TeamPose


class PaperIdentities:
    """Announced poses, and the IDs that tracks have, with the interface of `team.identities.Identities`."""

    self_doubt = False
    fault: OwnFault | None = None

    def __init__(self, drone_id: int, *, cameras: Sequence[tuple[PinholeCamera, Pose]]) -> None:
        """cameras: of each its lens and body_from_camera."""
        self._cameras = tuple(cameras)
        self.teammates = Teammates(drone_id)
        self._names: dict[int, int] = {}
        """By track."""
        self._settled: set[int] = set()
        """The tracks that are not matched again."""
        self._seen: list[LastSeen] = []
        """Of the last scan."""

    def announce(self, announcement: Announcement) -> bool:
        """Take in a teammate's pose. Returns False for our own ID, or for one that is not newer."""
        if not self.teammates.is_news(announcement):
            return False
        self.teammates.announce(announcement)
        self._settled -= {track for track, drone in self._names.items() if drone == announcement.drone_id}
        return True

    def by_fault(self) -> dict[str, float]:
        """Everything is as configured."""
        return {}

    def on_membership(self, event: Membership) -> None:
        """Membership changes. While two processes use one ID, no track has it."""
        self.teammates.on_membership(event)
        self._names = {
            track: drone for track, drone in self._names.items() if drone in self.teammates.announced
        }
        self._settled &= self._names.keys()

    def agree(self, motion: AgreedMotion) -> None:
        """Motion is no part of the algorithm."""

    def on_motion(self, report: MotionReport) -> None:
        """Nor is it when it is reported."""

    def frame(self, drone_id: int) -> None:
        """Nor how frames stand to each other."""

    def directions(self) -> Array:
        """Of no use here: the method takes no reports."""
        return np.zeros((0, 3))

    def p_none(self) -> dict[int, float]:
        """Every track is a teammate."""
        return {}

    def on_report(self, report: SightingReport) -> None:
        """Nor are places later than the announced ones."""

    def step_heading(self, t: float, turned: float) -> None:
        """What was matched stays so."""

    def autopilot_rebooted(self) -> None:
        """Names are kept."""

    def lose_place(self) -> None:
        """Likewise."""

    def turn_unmeasured(self) -> None:
        """Likewise."""

    def observe(self, tracks: Iterable[Track], observer: TeamPose, camera: int = 0) -> IdentityNews:
        """Match the tracks of a scan of a camera that have no ID, or whose drone has announced itself again."""
        view = ObserverCamera.of(observer, *self._cameras[camera], camera)
        alive = {track.id: track for track in tracks}
        self.teammates.forget(observer.t, set(self._names.values()))
        self._names = {
            id: drone
            for id, drone in self._names.items()
            if id in alive and drone in self.teammates.announced
        }
        self._settled &= self._names.keys()
        shown = [
            track
            for track in alive.values()
            if track.camera == camera
            and track.status is TrackStatus.CONFIRMED
            and track.coasting_since is None
        ]
        undecided = [track for track in shown if track.id not in self._settled]
        drones, projected = _projections(list(self.teammates.announced.values()), view)
        if undecided and drones:
            pixels = np.array([track.mean[::2] for track in undecided])
            found = [drones[column] for column in nearest(pixels, projected)]
            self._names |= {track.id: drone for track, drone in zip(undecided, found, strict=True)}
            self._settled |= {track.id for track in undecided}
        self._seen = rays_to([(self._names[t.id], t) for t in shown if t.id in self._names], view)
        return NO_NEWS

    def label(self, tracks: Iterable[Track]) -> tuple[IdentifiedTrack, ...]:
        """The same tracks, with their IDs."""
        return tuple(
            IdentifiedTrack(track, drone, track.probability)
            if (drone := self._names.get(track.id)) is not None
            else IdentifiedTrack(track, None, 0.0)
            for track in tracks
        )

    def sightings(self, t: float) -> list[OwnSighting]:
        """The identified drones that were detected in the scan of t; each is certain."""
        return [OwnSighting(ray, 1.0) for ray in self._seen if ray.t == t]


def nearest(tracks: Array, projected: Array) -> list[int]:
    """For each track (n, 2) px, the row of the nearest projection (k, 2) px, the same one twice if so it falls."""
    rows: list[int] = np.linalg.norm(tracks[:, None] - projected, axis=2).argmin(axis=1).tolist()
    return rows


def _projections(announced: Sequence[Announcement], view: ObserverCamera) -> tuple[list[int], Array]:
    """The drones before the camera, and the pixels (k, 2) of their announced places, undistorted."""
    if not announced:
        return [], np.zeros((0, 2))
    places = view.team_from_camera.inverse().transform(np.array([each.position for each in announced]))
    projected, _, valid = view.camera.project_undistorted(places)
    return [each.drone_id for each, good in zip(announced, valid, strict=True) if good], projected[valid]
