"""The cameras of one drone: a tracker for each, and tracks that go over from one to the next.

Theory of operation. Each track is known in the pixels of one camera, that which would see it now: a chart of the sphere
around the drone. A scan of a camera first takes over from the others whatever should be in its picture; to the tracker
this is one more turn, by the angle between the two cameras, and to the track nothing happened: its number, its motion,
its doubts go along. Where two pictures overlap a track goes back and forth, so that every scan of either updates it.
With one camera nothing of this is ever done, and all is as it was.

Exposures are not synchronised. A track goes over to the time of the scan that takes it, some hundredths of a second
back where that was exposed before its last one.

How exactly the cameras are mounted is told (`mounting_sigma`), and paid for in variance at each seam. The cameras see
from different places, so a track also moves by parallax: as far as its size tells its distance (`parallax`).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Array, Scan, Track
from swarmtrack.motion.gyro import Orientation, rotation_between
from swarmtrack.tracking.base import Tracker
from swarmtrack.tracking.handover import Handover
from swarmtrack.tracking.lifecycle import Reach, probability_in_view
from swarmtrack.tracking.motion_model import POSITION

# s: a scan that was exposed longer before a track's last one does not take it over.
MOST_BACK = 0.3
# m: of an airframe whose box is as wide; by which factor, one sigma, that is wrong; and the distance where there is no
# box.
SPAN, SPAN_SIGMA, UNKNOWN_DISTANCE = 0.45, 0.5, 5.0
# Focal lengths off the axis: what another camera sees farther aside is not looked for in this one's picture.
MOST_ASIDE = 10.0
# m: nobody is nearer.
NEAREST = 0.5


class RigCamera(NamedTuple):
    """camera: its lens; body_from_camera: how it sits; mounting_sigma rad per axis: how exactly that is known."""

    camera: PinholeCamera
    body_from_camera: Pose
    tracker: Tracker
    mounting_sigma: float = 0.0


class Seam(NamedTuple):
    """From one camera to another: rotation (3, 3), to_camera_from_camera; baseline (3,) m: where the one that takes
    over sits beside the other, in its own axes; variance rad² per axis of the rotation."""

    rotation: Array
    baseline: Array
    variance: float


class ExpectedTracks(NamedTuple):
    """Where a camera should see n tracks: centre (n, 2) undistorted px; sigma (n, 2) px of it; size (n, 2) px, NaN
    where it is not known."""

    centre: Array
    sigma: Array
    size: Array

    @classmethod
    def of(cls, tracks: Sequence[Track]) -> ExpectedTracks:
        """In the pixels that they are in."""
        if not tracks:
            return NOTHING_EXPECTED
        variance = np.array([np.diagonal(track.cov)[::2] for track in tracks])
        return cls(
            np.array([track.mean[POSITION] for track in tracks]),
            # Carried back a little it may fall below nothing.
            np.sqrt(np.maximum(variance, 0.0)),
            np.array([track.size for track in tracks]),
        )


NOTHING_EXPECTED = ExpectedTracks(np.empty((0, 2)), np.empty((0, 2)), np.empty((0, 2)))


class Rig:
    """All tracks of a drone. An `orientation` is always that of the first camera."""

    def __init__(self, cameras: Sequence[RigCamera]) -> None:
        self._cameras = tuple(cameras)
        first = self._cameras[0].body_from_camera
        self._from_first = [each.body_from_camera.rotation.T @ first.rotation for each in self._cameras]
        self._reach = [Reach(each.camera) for each in self._cameras]
        self._orientations: list[Orientation | None] = [None] * len(self._cameras)
        """Of the first camera, when each tracker's state holds."""
        self._newest = 0
        self.handed_over = 0

    @property
    def t(self) -> float | None:
        """When the last scan was exposed."""
        return self._cameras[self._newest].tracker.t

    @property
    def counters(self) -> dict[str, int]:
        """What the trackers refused or lost, and how many tracks went over from one camera to another."""
        total: dict[str, int] = {}
        for each in self._cameras:
            for name, count in each.tracker.counters.items():
                total[name] = total.get(name, 0) + count
        return total if len(self._cameras) == 1 else {**total, "tracks_handed_over": self.handed_over}

    def tracker(self, camera: int) -> Tracker:
        return self._cameras[camera].tracker

    def turn_variance(self, camera: int, orientation: Orientation) -> float:
        """rad² per axis: how little is known of the turn since that camera's last scan."""
        return rotation_between(self._orientations[camera] or orientation, orientation).variance

    def predict(self, camera: int, t: float, orientation: Orientation) -> None:
        """Carry one camera's tracks to its next exposure, and take over what should be in its picture then."""
        turn = rotation_between(self._orientations[camera] or orientation, orientation)
        self._cameras[camera].tracker.predict(t, self._own(camera, turn.matrix), turn.variance)
        for other, _ in enumerate(self._cameras):
            if other != camera:
                self._take_over(other, camera, t, orientation)

    def update(self, camera: int, scan: Scan, orientation: Orientation) -> bool:
        """Fold in a scan of a camera, after `predict`; False where it is refused, see `Tracker.update`."""
        self._orientations[camera] = orientation
        self._newest = camera
        return self._cameras[camera].tracker.update(scan)

    def tracks(self, orientation: Orientation) -> tuple[Track, ...]:
        """After a scan: those of its camera as they stand, the others carried on to its exposure."""
        newest = self._cameras[self._newest].tracker
        if newest.t is None or len(self._cameras) == 1:
            return newest.tracks
        others = self._carried(newest.t, orientation, but=self._newest)
        return (*newest.tracks, *others)

    def at(self, t: float, orientation: Orientation) -> tuple[Track, ...]:
        """All tracks carried on to t, each in its camera's pixels; nothing is changed."""
        return tuple(self._carried(t, orientation))

    def expected(self, camera: int, t: float, orientation: Orientation) -> ExpectedTracks:
        """Where a camera should see the tracks at t: its own, and those of the others that are in its picture, too."""
        parts = []
        for giver, each in enumerate(self._cameras):
            then, since = self._orientations[giver], each.tracker.t
            if then is None or since is None or since - t > MOST_BACK:
                continue
            turn = rotation_between(then, orientation)
            part = ExpectedTracks.of(each.tracker.at(t, self._own(giver, turn.matrix), turn.variance))
            parts.append(part if giver == camera else self._seen_through(part, giver, camera))
        if len(parts) == 1:
            return parts[0]
        return ExpectedTracks(*map(np.concatenate, zip(*parts, strict=True))) if parts else NOTHING_EXPECTED

    def _seen_through(self, part: ExpectedTracks, giver: int, taker: int) -> ExpectedTracks:
        """What one camera expects, in another's pixels; without what is behind that."""
        one, other, seam = self._cameras[giver].camera, self._cameras[taker].camera, self.seam(giver, taker)
        there = one.bearing_undistorted(part.centre) @ seam.rotation.T
        centre, _, ahead = other.project_undistorted(there)
        scale = np.array([other.fx / one.fx, other.fy / one.fy])
        size = part.size * scale
        distance = np.maximum(SPAN * other.fx / size[:, 0], NEAREST)
        distance = np.where(np.isnan(distance), UNKNOWN_DISTANCE, distance)
        beside = np.linalg.norm(seam.baseline) / distance
        focal = np.array([other.fx, other.fy])
        more = np.sqrt(seam.variance + beside**2)[:, None] * focal
        sigma = np.hypot(part.sigma * scale, more)
        near = ahead & (np.abs(centre - [other.cx, other.cy]) < MOST_ASIDE * focal).all(axis=1)
        return ExpectedTracks(centre[near], sigma[near], size[near])

    def vouch(self, track_id: int) -> None:
        """See `Tracker.vouch`."""
        for each in self._cameras:
            each.tracker.vouch(track_id)

    def _carried(self, t: float, orientation: Orientation, but: int | None = None) -> chain[Track]:
        return chain.from_iterable(
            each.tracker.at(t, self._own(k, turn.matrix), turn.variance)
            for k, each in enumerate(self._cameras)
            if k != but
            and (then := self._orientations[k]) is not None
            and (turn := rotation_between(then, orientation))
        )

    def _own(self, camera: int, turn: Array) -> Array:
        """A turn in the first camera's axes, in those of a camera."""
        if camera == 0:
            return turn
        own = self._from_first[camera]
        return own @ turn @ own.T

    def seam(self, giver: int, taker: int) -> Seam:
        """How the giver's picture becomes the taker's."""
        one, other = self._cameras[giver], self._cameras[taker]
        rotation = self._from_first[taker] @ self._from_first[giver].T
        apart = other.body_from_camera.position - one.body_from_camera.position
        baseline = other.body_from_camera.rotation.T @ apart
        return Seam(rotation, baseline, one.mounting_sigma**2 + other.mounting_sigma**2)

    def _take_over(self, giver: int, taker: int, t: float, orientation: Orientation) -> None:
        """What the giver knows and the taker should see, or is nearer to while neither sees it."""
        one, other = self._cameras[giver], self._cameras[taker]
        then, since = self._orientations[giver], one.tracker.t
        if then is None or since is None or since - t > MOST_BACK:
            return
        turn, seam = rotation_between(then, orientation), self.seam(giver, taker)
        rotation = seam.rotation @ self._own(giver, turn.matrix)
        mean, cov = one.tracker.extrapolated(t, self._own(giver, turn.matrix), turn.variance)
        if not len(mean):
            return
        rows = self._wanted(mean, cov, giver, taker, seam)
        if not rows.any():
            return
        leaving = one.tracker.release(rows, t, rotation, turn.variance + seam.variance)
        arriving = leaving.in_pixels_of(other.camera, one.camera)
        other.tracker.adopt(arriving.moved(*parallax(arriving, other.camera, seam.baseline)))
        self.handed_over += int(rows.sum())

    def _wanted(self, mean: Array, cov: Array, giver: int, taker: int, seam: Seam) -> NDArray[np.bool_]:
        """(n,) of tracks in the giver's pixels now: those that the taker should see, and of those that nobody sees the
        ones nearer to where it looks."""
        one, other = self._cameras[giver].camera, self._cameras[taker].camera
        ray = one.bearing_undistorted(mean[:, POSITION])
        there = ray @ seam.rotation.T
        pixel, _, ahead = other.project_undistorted(there)
        seen_here = probability_in_view(mean, cov, one)
        sigma = np.sqrt((cov[:, 0, 0] / one.fx**2 + cov[:, 2, 2] / one.fy**2) / 2.0 + seam.variance)
        moved, spread = np.zeros_like(mean), np.tile(np.eye(4), (len(mean), 1, 1))
        moved[:, POSITION] = np.where(ahead[:, None], pixel, 1e6)
        spread[:, 0, 0], spread[:, 2, 2] = (sigma * other.fx) ** 2, (sigma * other.fy) ** 2
        wanted = ahead & (probability_in_view(moved, spread, other) > 0.5)
        nearer = (there[:, 2] > ray[:, 2]) & (seen_here < 0.5) & ahead
        return np.asarray((wanted | nearer) & self._reach[taker].holds(moved, spread))


def parallax(arriving: Handover, camera: PinholeCamera, baseline: Array) -> tuple[Array, Array]:
    """By how far (n, 2) px tracks move that are looked at from `baseline` (3,) m beside, camera axes, and the
    covariance (n, 2, 2) px² of that: a box tells the distance within a factor, without one it is hardly known."""
    table = arriving.table
    n = len(table)
    if not baseline.any():
        return np.zeros((n, 2)), np.zeros((n, 2, 2))
    pixel = table.mean[:, POSITION]
    ray = camera.bearing_undistorted(pixel)
    distance = np.maximum(SPAN * camera.fx / table.size[:, 0], NEAREST)
    distance = np.where(np.isnan(distance), UNKNOWN_DISTANCE, distance)
    seen, _, ahead = camera.project_undistorted(distance[:, None] * ray - baseline)
    by = np.where(ahead[:, None], seen - pixel, 0.0)
    outer = by[:, :, None] * by[:, None, :]
    return by, SPAN_SIGMA**2 * outer
