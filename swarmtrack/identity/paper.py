"""The paper's Algorithm 1: each track takes, in one shot, the ID whose announced place is projected nearest to it.

It has no gate, no "unknown", and no one-to-one matching. A track keeps its ID until it ends, and is matched again when
its drone announces itself again.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
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
        self._teammates = Teammates(drone_id)
        self._names: dict[int, int] = {}
        """By track."""
        self._settled: set[int] = set()
        """The tracks that are not matched again."""
        self._seen: list[LastSeen] = []
        """Of the last scan."""

    @property
    def has_own_clash(self) -> bool:
        """Whether another process uses this drone's ID."""
        return bool(self._teammates.own_clash)

    @property
    def announced(self) -> dict[int, Announcement]:
        """The latest announcement of every teammate."""
        return dict(self._teammates.announced)

    def announce(self, announcement: Announcement) -> bool:
        """Take in a teammate's pose. Returns False for our own ID, or for one that is not newer."""
        if not self._teammates.is_news(announcement):
            return False
        self._teammates.announce(announcement)
        self._settled -= {track for track, drone in self._names.items() if drone == announcement.drone_id}
        return True

    def on_membership(self, event: Membership) -> None:
        """Membership changes. While two processes use one ID, no track has it."""
        self._teammates.on_membership(event)
        self._names = {track: drone for track, drone in self._names.items() if drone in self.announced}
        self._settled &= self._names.keys()

    def agree(self, motion: AgreedMotion) -> None:
        """Motion is no part of the algorithm."""

    def on_motion(self, report: MotionReport) -> None:
        """Nor is it when it is reported."""

    def on_report(self, report: SightingReport) -> None:
        """Nor are places later than the announced ones."""

    def step_heading(self, t: float, turned: float) -> None:
        """What was matched stays so."""

    def lose_place(self) -> None:
        """Likewise."""

    def turn_unmeasured(self) -> None:
        """Likewise."""

    def observe(self, tracks: Iterable[Track], observer: TeamPose, camera: int = 0) -> IdentityNews:
        """Match the tracks of a scan of a camera that have no ID, or whose drone has announced itself again."""
        view = ObserverCamera.of(observer, *self._cameras[camera], camera)
        alive = {track.id: track for track in tracks}
        self._teammates.forget(observer.t, set(self._names.values()))
        self._names = {
            id: drone for id, drone in self._names.items() if id in alive and drone in self.announced
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
        pixels = np.array([track.mean[::2] for track in undecided]).reshape(-1, 2)
        found = nearest(pixels, list(self.announced.values()), view)
        self._names |= {undecided[row].id: drone for row, drone in found.items()}
        self._settled |= {undecided[row].id for row in found}
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

    def sightings(self, t: float) -> list[tuple[LastSeen, float]]:
        """The rays to identified drones that were detected in the scan of t; each is certain."""
        return [(ray, 1.0) for ray in self._seen if ray.t == t]


def nearest(pixels: Array, announced: Sequence[Announcement], view: ObserverCamera) -> dict[int, int]:
    """By row of pixels (n, 2), undistorted: the ID whose announced place is projected nearest, the same one twice if so
    it falls. Places behind the camera are none."""
    if not announced:
        return {}
    places = view.team_from_camera.inverse().transform(np.array([each.position for each in announced]))
    projected, _, valid = view.camera.project_undistorted(places)
    drones = [each.drone_id for each, good in zip(announced, valid, strict=True) if good]
    if not drones:
        return {}
    apart = np.linalg.norm(pixels[:, None] - projected[valid], axis=2)
    return {row: drones[column] for row, column in enumerate(apart.argmin(axis=1).tolist())}
