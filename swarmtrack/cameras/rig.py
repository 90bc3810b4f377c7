"""The cameras of one drone: a tracker for each, and tracks that go over from one to the next.

Theory of operation. Each track is known in the pixels of one camera, that which would see it now: a chart of the
sphere around the drone. A scan of a camera first takes over from the others whatever should be in its picture; to the
tracker this is one more turn, by the angle between the two cameras, and to the track nothing happened: its number, its
motion, its doubts go along. Where two pictures overlap a track goes back and forth, so that every scan of either
updates it. The exact border of a picture is unknown: a track that only may be in it is lent for one scan, so that it
explains its detection, and if it is not detected it never was away. With one camera nothing of this is ever done, and
all is as it was.

Exposures are not synchronised. A track goes over to the time of the scan that takes it, some hundredths of a second
back where that was exposed before its last one.

How exactly the cameras are mounted is told, learned in flight, and paid for in variance at each seam (`seams.py`). The
cameras see from different places, so a track also moves by parallax: as far as its size tells its distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.cameras.priors import (
    CAMERA_SETTLED_S,
    COMPARED_BEND_RAD_S2,
    COMPARED_WITHIN_S,
    EXPECTED_BORDER_SHARE,
    EXPECTED_ENDED_SCANS,
    EXPECTED_MISSED_SCANS,
    MAY_BE_SEEN_PROBABILITY,
    MOST_REMEMBERED_TRACKS,
    OUTSIDE_EVERY_PICTURE_PX,
    SEAM_DISTANCE_SIGMA,
    SEAM_DRONE_SPAN_M,
    SEAM_LEAST_SHIFT_PX2,
    SEAM_MOST_ASIDE,
    SEAM_NEAREST_M,
    SEAM_UNKNOWN_DISTANCE_M,
    SURELY_SEEN_PROBABILITY,
    TAKEOVER_LONGEST_BACK_S,
)
from swarmtrack.cameras.seams import FoundTurn, Seam, SeamComparison, SeamDisagreement, SeamNews
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Array, Scan, Track
from swarmtrack.motion.gyro import Orientation, rotation_between
from swarmtrack.tracking.base import Tracker
from swarmtrack.tracking.lifecycle import Reach, probability_in_view
from swarmtrack.tracking.motion_model import POSITION, optical_flow
from swarmtrack.tracking.passage import Passage

TURNED_SEAM, LOST_SIGHT_SEAM = "turned", "lost sight"


class RigCamera(NamedTuple):
    """camera: its lens; body_from_camera: how it sits; mounting_sigma rad per axis: how exactly it is known how it is
    turned."""

    camera: PinholeCamera
    body_from_camera: Pose
    tracker: Tracker
    mounting_sigma: float = 0.0


class Foretold(NamedTuple):
    """A track that has come from another camera and was not detected since: from which, the pixel (2,) where the scan
    that comes should show it, and its covariance (2, 2) px² but for the seam; angle (3,): see `_Arrived`."""

    giver: int
    pixel: Array
    cov: Array
    angle: Array


@dataclass(slots=True)
class _Arrived:
    """From one camera to another; since when it had been with the first, s; by which angle (3,) rad of the seam; scans
    of the second which should have shown it."""

    giver: int
    taker: int
    since: float
    angle: Array
    scans: int = 0


class _Home(NamedTuple):
    """The camera that a track is with, and when that last detected it, s."""

    camera: int
    t: float


class _TrackLook(NamedTuple):
    """A detection z (2,) px, R (2, 2) px², of a track, by a camera at t [s]; orientation: of the first camera then."""

    camera: int
    t: float
    z: Array
    R: Array
    orientation: Orientation


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
            np.sqrt(variance),
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
        self._seams = {
            (i, j): Seam(
                self._from_first[j] @ self._from_first[i].T,
                float(np.hypot(self._cameras[i].mounting_sigma, self._cameras[j].mounting_sigma)),
            )
            for i, j in combinations(range(len(self._cameras)), 2)
        }
        self._came: dict[int, float] = {}
        """By track: when it last came from another camera, s."""
        self._arrived: dict[int, _Arrived] = {}
        """By track that has yet to be detected, and will tell of a seam then."""
        self._lent: list[_Lent] = []
        """To the camera of the scan that comes; nobody between two scans."""
        self._said: set[tuple[int, int, str]] = set()
        self._foretold: dict[int, Foretold] = {}
        """Those among them of the camera of the scan that comes."""
        self._looks: dict[int, list[_TrackLook]] = {}
        """By track: its last detections that were not compared yet, in the order of exposure."""
        self._apart: frozenset[int] = frozenset()
        """Cameras that neither give nor take tracks."""
        self._homes: dict[int, _Home] = {}
        """By track."""
        self.handed_over = 0
        """Tracks that have left one camera and are with another. Where pictures overlap, both have them, and go on
        having them."""

    @property
    def t(self) -> float | None:
        """When the last scan was exposed."""
        return self._cameras[self._newest].tracker.t

    @property
    def counters(self) -> dict[str, int]:
        """Rejections and losses of the trackers, and the number of tracks handed over from one camera to another."""
        total: dict[str, int] = {}
        for each in self._cameras:
            for name, count in each.tracker.counters.items():
                total[name] = total.get(name, 0) + count
        return total if len(self._cameras) == 1 else {**total, "tracks_handed_over": self.handed_over}

    @property
    def from_first(self) -> list[Array]:
        """Configured axes (3, 3) of each camera from the first one's."""
        return self._from_first

    @property
    def found_turns(self) -> dict[tuple[int, int], FoundTurn]:
        """By pairs of cameras between which tracks have gone: the second's rotation relative to the configured one."""
        return {pair: seam.found for pair, seam in self._seams.items() if seam.crossings or seam.compared}

    def turn_variance(self, camera: int, orientation: Orientation) -> float:
        """rad² per axis: how little is known of the turn since that camera's last scan."""
        return rotation_between(self._orientations[camera] or orientation, orientation).variance

    def set_apart(self, cameras: frozenset[int]) -> None:
        """From now on these cameras' pictures are each a world of its own: no track is handed over to them, or from
        them. For those that do not sit as they were told.
        """
        self._apart = cameras
        self._arrived = {id: way for id, way in self._arrived.items() if not {way.giver, way.taker} & cameras}
        self._looks.clear()

    def update(self, camera: int, scan: Scan, orientation: Orientation) -> list[SeamNews] | None:
        """Fold in a scan of a camera, orientation: when it was exposed: carry its tracks there, and take over what
        should be in its picture. Returns what is new of seams, each once. A scan that the camera's tracker refuses
        (None, see `Tracker.update`) changes nothing."""
        tracker = self._cameras[camera].tracker
        if tracker.refuses(scan.t):
            tracker.update(scan)
            return None
        self._predict(camera, scan.t, orientation)
        self._orientations[camera] = orientation
        self._newest = camera
        tracker.update(scan)
        if self._lent:
            self._give_back(tracker)
        crossed = self._learn_seams(camera, tracker) if self._foretold else frozenset()
        if len(self._cameras) > 1:
            self._compare_looks(camera, scan.t, orientation, crossed)
            self._count_moves(camera, scan.t)
            self._keep_in_sight(camera, scan.t)
            self._end_unseen(scan.t)
        return self._seam_news()

    def _predict(self, camera: int, t: float, orientation: Orientation) -> None:
        """Carry one camera's tracks to its next exposure, and take over what should be in its picture then."""
        turn = rotation_between(self._orientations[camera] or orientation, orientation)
        self._cameras[camera].tracker.predict(t, self._own(camera, turn.matrix), turn.variance)
        for other, _ in enumerate(self._cameras):
            if other != camera:
                self._take_over(other, camera, t, orientation)
        self._foretold = self._arrivals_at(camera) if self._arrived else {}

    def _count_moves(self, camera: int, t: float) -> None:
        """Who is detected by a camera, and by the one before no longer, has moved."""
        tracker = self._cameras[camera].tracker
        for track_id in tracker.estimates[0][~tracker.missed].tolist():
            home = self._homes.get(track_id)
            if home is None or home.camera == camera:
                self._homes[track_id] = _Home(camera, t)
            elif t - home.t > CAMERA_SETTLED_S:
                self.handed_over += 1
                self._homes[track_id] = _Home(camera, t)
        if len(self._homes) > MOST_REMEMBERED_TRACKS:
            held = {id for each in self._cameras for id in each.tracker.estimates[0].tolist()}
            self._homes = {id: home for id, home in self._homes.items() if id in held}

    def _end_unseen(self, t: float) -> None:
        """Who was with a camera that has died ends as one that it misses: else it would live for as long as the other
        cameras tell the time. A camera whose scan may still come tells that itself."""
        for each in self._cameras:
            if each.tracker.t is not None and t - each.tracker.t > TAKEOVER_LONGEST_BACK_S:
                each.tracker.end_unseen(t)

    def _compare_looks(
        self, camera: int, t: float, orientation: Orientation, crossed: frozenset[int]
    ) -> None:
        """Where pictures overlap, the detections of two cameras tell how these are turned. Not of those that have just
        told it by crossing."""
        for seam in self._seams.values():
            seam.end_stays(t)
        tracker = self._cameras[camera].tracker
        for track_id, z, R in tracker.surely_detected:
            if track_id in crossed:
                self._looks.pop(track_id, None)
                continue
            looks = self._looks.setdefault(track_id, [])
            looks.append(_TrackLook(camera, t, z.copy(), R, orientation))
            looks.sort(key=lambda look: look.t)
            del looks[:-3]
            if len(looks) == 3 and _is_between(*looks):
                self._compare(track_id, *looks)
                looks.clear()
        if len(self._looks) > MOST_REMEMBERED_TRACKS:
            self._looks = {
                id: seen for id, seen in self._looks.items() if seen and t - seen[-1].t < COMPARED_WITHIN_S
            }

    def _compare(self, track_id: int, before: _TrackLook, middle: _TrackLook, after: _TrackLook) -> None:
        """Two detections of one camera, and one of another between them, all at the middle one's time in the pixels of
        the second of the two cameras."""
        first, second = sorted((before.camera, middle.camera))
        share = (middle.t - before.t) / (after.t - before.t)
        (p, P), (m, M), (q, Q) = (self._seen_at(look, middle, second) for look in (before, middle, after))
        outer, noise = (1.0 - share) * p + share * q, (1.0 - share) ** 2 * P + share**2 * Q + M
        bend = 0.5 * COMPARED_BEND_RAD_S2 * share * (1.0 - share) * (after.t - before.t) ** 2
        noise += np.diag((bend * self._cameras[second].camera.per_radian(m[None]).reshape(2)) ** 2)
        if not (np.isfinite(outer).all() and np.isfinite(noise).all() and np.isfinite(m).all()):
            return
        foretold, z = (outer, m) if middle.camera == second else (m, outer)
        camera = self._cameras[second].camera
        size = self._size_of(track_id, foretold, second)
        by, _ = parallax(foretold[None], size, camera, self._baseline(first, second))
        compared = SeamComparison(middle.t, foretold + by[0], z, noise, by[0])
        self._seams[first, second].compare(track_id, compared, camera)

    def _seen_at(self, look: _TrackLook, when: _TrackLook, camera: int) -> tuple[Array, Array]:
        """A detection (2,) px of whatever is at rest, (2, 2) px², in the pixels of a camera when another was made."""
        own, shown = self._cameras[look.camera].camera, self._cameras[camera].camera
        turn = rotation_between(look.orientation, when.orientation)
        turned = self._own(look.camera, turn.matrix)
        if look.camera != camera:
            turned = self._turn_to(camera, look.camera) @ turned
        pixel, by_ray, _ = shown.project_undistorted(own.bearing_undistorted(look.z[None]) @ turned.T)
        by_pixel = by_ray[0] @ turned @ own.bearing_by_place(look.z[None])[0] / np.array([own.fx, own.fy])
        flow = optical_flow(pixel, shown)[0]
        return pixel[0], by_pixel @ look.R @ by_pixel.T + turn.variance * flow @ flow.T

    def _size_of(self, track_id: int, pixel: Array, camera: int) -> Array:
        """(1, 2) px of a track's box as it would be at a pixel (2,) of a camera; NaN where it is not known."""
        for each in self._cameras:
            ids, mean, _ = each.tracker.estimates
            rows = np.flatnonzero(ids == track_id)
            if rows.size:
                shown = self._cameras[camera].camera
                larger = _of_boxes(mean[rows[:1], POSITION], each.camera, pixel[None], shown)
                return np.asarray(each.tracker.sizes[rows[:1]] * larger)
        return np.full((1, 2), np.nan)

    def _keep_in_sight(self, giver: int, t: float) -> None:
        """Who has just left a picture, and should be in that of a camera which has not exposed since, is not lost."""
        tracker = self._cameras[giver].tracker
        since = tracker.gone_since
        if np.isnan(since).all():
            return
        _, mean, cov = tracker.estimates
        for taker, other in enumerate(self._cameras):
            last = other.tracker.t
            if self._apart & {giver, taker}:
                continue
            if (
                taker != giver
                and last is not None
                and t - last < TAKEOVER_LONGEST_BACK_S
                and (since > last).any()
            ):
                shown = self._shown_by(mean, cov, giver, taker, self._turn_to(taker, giver))
                tracker.not_lost((since > last) & (shown.seen > 0.5))

    def _give_back(self, taker: Tracker) -> None:
        """What was lent for this scan and is not in it: as it was."""
        for lent in self._lent:
            ids = taker.estimates[0]
            gone = np.isin(lent.ids, ids[~taker.missed], invert=True)
            if not gone.any():
                continue
            back = lent.ids[gone]
            assert taker.t is not None
            taker.release(np.isin(ids, back), taker.t, np.eye(3), 0.0)
            self._cameras[lent.giver].tracker.adopt(lent.as_it_was.select(gone))
            for track_id in back.tolist():
                self._foretold.pop(track_id, None)
                _restore(self._arrived, track_id, lent.arrived)
                _restore(self._came, track_id, lent.came)
        self._lent = []

    def _arrivals_at(self, camera: int) -> dict[int, Foretold]:
        """Where tracks are foretold that have come to a camera and were not detected since."""
        ids, mean, cov = self._cameras[camera].tracker.estimates
        rows = {track_id: row for row, track_id in enumerate(ids.tolist())}
        for track_id in [id for id, way in self._arrived.items() if way.taker == camera and id not in rows]:
            way = self._arrived.pop(track_id)
            if way.scans >= EXPECTED_ENDED_SCANS:
                self._seam(way.giver, camera).lost += 1
        found = {}
        for track_id, way in self._arrived.items():
            if way.taker == camera:
                pixel, P = mean[rows[track_id], POSITION], cov[rows[track_id], POSITION, POSITION]
                of_seam = self._of_seam(pixel[None], way.giver, camera)[0]
                found[track_id] = Foretold(way.giver, pixel.copy(), P - of_seam, way.angle)
        return found

    def _learn_seams(self, taker: int, tracker: Tracker) -> frozenset[int]:
        """From the tracks that have come to a camera, by its scan: those it shows, which are returned, and those it
        does not."""
        camera, crossed = self._cameras[taker].camera, set()
        for track_id, z, R in tracker.surely_detected:
            foretold = self._foretold.pop(track_id, None)
            if foretold is not None:
                del self._arrived[track_id]
                crossed.add(track_id)
                giver, pixel, cov, angle = foretold
                self._seam(giver, taker).update(pixel, cov + R, z, camera, to_second=giver < taker, by=angle)
        low, high = camera.frame_bounds
        border = EXPECTED_BORDER_SHARE * (high - low)
        for track_id, (giver, pixel, _, _) in self._foretold.items():
            way = self._arrived[track_id]
            (at,) = camera.framed(pixel[None]).at
            way.scans += bool(((at > low + border) & (at < high - border)).all())
            if way.scans >= EXPECTED_MISSED_SCANS:
                del self._arrived[track_id]
                self._seam(giver, taker).lost += 1
        return frozenset(crossed)

    def _seam_news(self) -> list[SeamNews]:
        """News of seams; each is returned once."""
        news = []
        for (first, second), seam in self._seams.items():
            if self._apart & {first, second}:
                continue
            said = None if seam.fits else LOST_SIGHT_SEAM
            said = TURNED_SEAM if said is None and seam.is_turned else said
            if said is not None and (first, second, said) not in self._said:
                self._said.add((first, second, said))
                news.append(self._news(first, second, said))
        return news

    def _news(self, first: int, second: int, said: str) -> SeamNews:
        if said == LOST_SIGHT_SEAM:
            return SeamNews(first, second, None, None)
        seam = self._seams[first, second]
        body_from_first = self._cameras[first].body_from_camera.rotation
        return SeamNews(first, second, seam.found, body_from_first @ seam.second_from_first.T)

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
        """Tracks expected in a camera's image at t: its own, and those of the others."""
        parts = []
        for giver, each in enumerate(self._cameras):
            then, since = self._orientations[giver], each.tracker.t
            if then is None or since is None or since - t > TAKEOVER_LONGEST_BACK_S:
                continue
            if giver != camera and self._apart & {giver, camera}:
                continue
            turn = rotation_between(then, orientation)
            part = ExpectedTracks.of(each.tracker.at(t, self._own(giver, turn.matrix), turn.variance))
            parts.append(part if giver == camera else self._seen_through(part, giver, camera))
        if len(parts) == 1:
            return parts[0]
        return ExpectedTracks(*map(np.concatenate, zip(*parts, strict=True))) if parts else NOTHING_EXPECTED

    def _seen_through(self, part: ExpectedTracks, giver: int, taker: int) -> ExpectedTracks:
        """What one camera expects, in another's pixels; without what is behind that."""
        one, other = self._cameras[giver].camera, self._cameras[taker].camera
        there = one.bearing_undistorted(part.centre) @ self._turn_to(taker, giver).T
        centre, _, ahead = other.project_undistorted(there)
        focal = other.per_radian(centre)
        scale = focal / one.per_radian(part.centre)
        size = part.size * _of_boxes(part.centre, one, centre, other)
        by, by_cov = parallax(centre, size, other, self._baseline(giver, taker))
        variance = (part.sigma * scale) ** 2 + (self._seam(giver, taker).found.sigma * focal) ** 2
        sigma = np.sqrt(variance + by_cov.diagonal(axis1=1, axis2=2))
        near = ahead & (
            np.abs(centre - [other.cx, other.cy]) < SEAM_MOST_ASIDE * np.array([other.fx, other.fy])
        ).all(axis=1)
        return ExpectedTracks((centre + by)[near], sigma[near], size[near])

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

    def _seam(self, one: int, other: int) -> Seam:
        return self._seams[min(one, other), max(one, other)]

    def _turn_to(self, taker: int, giver: int) -> Array:
        """(3, 3): the taker's axes from the giver's, as it is known by now."""
        second_from_first = self._seam(giver, taker).second_from_first
        return second_from_first if giver < taker else second_from_first.T

    def _take_over(self, giver: int, taker: int, t: float, orientation: Orientation) -> None:
        """What the giver knows and the taker should see, or is nearer to while neither sees it."""
        one, other = self._cameras[giver], self._cameras[taker]
        then, since = self._orientations[giver], one.tracker.t
        if (
            then is None
            or since is None
            or since - t > TAKEOVER_LONGEST_BACK_S
            or self._apart & {giver, taker}
        ):
            return
        turn = rotation_between(then, orientation)
        own, seam = self._own(giver, turn.matrix), self._turn_to(taker, giver)
        mean, cov = one.tracker.extrapolated(t, own, turn.variance)
        rows, lent = self._wanted(mean, cov, giver, taker, seam)
        if not rows.any():
            return
        if lent.any():
            ids = one.tracker.estimates[0][lent]
            self._lent.append(_Lent(giver, ids, one.tracker.copied(lent), {**self._arrived}, {**self._came}))
        if one.camera.is_wide == other.camera.is_wide:
            leaving = one.tracker.release(rows, t, seam @ own, turn.variance)
            arriving = leaving.in_pixels_of(other.camera, one.camera)
        else:
            # What is ahead of one camera only has no place in the tangent plane of the other.
            leaving = one.tracker.release(rows, t, own, turn.variance)
            arriving = leaving.turned_into(other.camera, one.camera, seam)
        baseline = self._baseline(giver, taker)
        pixel = arriving.table.mean[:, POSITION].copy()
        by, by_cov = parallax(pixel, arriving.table.size, other.camera, baseline)
        cov = by_cov + self._of_seam(pixel + by, giver, taker)
        for row, track_id in enumerate(arriving.table.id.tolist()):
            known = self._seam(giver, taker).disagreement(track_id, t)
            if known is not None:
                by[row], cov[row] = self._as_known(known, pixel[row], by[row], giver, taker)
        arriving = arriving.moved(by, cov)
        self._note_arrivals(arriving, giver, taker, t)
        other.tracker.adopt(arriving)

    def _as_known(
        self, known: SeamDisagreement, pixel: Array, by: Array, giver: int, taker: int
    ) -> tuple[Array, Array]:
        """By how far (2,) px a track at a pixel (2,) of the taker moves whose target both cameras have seen for a
        while, and the covariance (2, 2) px² of that; by (2,) px: the parallax alone."""
        camera = self._cameras[taker].camera
        flow = self._seam(giver, taker).flow(pixel[None], camera, to_second=giver < taker)[0]
        shifted = np.eye(2)
        if taker < giver:
            # The shift is in the second one's pixels, and so the other way round.
            shown, ray = self._cameras[giver].camera, camera.bearing_undistorted(pixel[None])
            there, _, _ = shown.project_undistorted(ray @ self._turn_to(giver, taker).T)
            back = self._turn_to(taker, giver)
            _, by_ray, _ = camera.project_undistorted(ray)
            by_place = back @ shown.bearing_by_place(there)[0] / np.array([shown.fx, shown.fy])
            shifted = -by_ray[0] @ by_place
        H = np.column_stack([flow, by, shifted])
        moved = by * (1.0 + known.s) + shifted @ known.shift
        return moved, H @ known.cov @ H.T + SEAM_LEAST_SHIFT_PX2 * np.eye(2)

    def _baseline(self, giver: int, taker: int) -> Array:
        """(3,) m: where the taker sits beside the giver, in its own axes."""
        one, other = (self._cameras[k].body_from_camera for k in (giver, taker))
        return other.rotation.T @ (other.position - one.position)

    def _of_seam(self, pixel: Array, giver: int, taker: int) -> Array:
        """(n, 2, 2) px² at pixels (n, 2) of the taker: by what the seam is not known."""
        camera = self._cameras[taker].camera
        return self._seam(giver, taker).flow_cov(pixel, camera, to_second=giver < taker)

    def _note_arrivals(self, arriving: Passage, giver: int, taker: int, t: float) -> None:
        table = arriving.table
        for track_id, confirmed in zip(table.id.tolist(), table.confirmed.tolist(), strict=True):
            way, since = self._arrived.pop(track_id, None), self._came.get(track_id, -np.inf)
            if way is not None and (way.giver, way.taker) == (taker, giver):
                # Taken back before the other camera had seen it: it never was away.
                self._came[track_id] = way.since
                continue
            if confirmed and t - since > CAMERA_SETTLED_S:
                self._arrived[track_id] = _Arrived(giver, taker, since, self._seam(giver, taker).angle)
            self._came[track_id] = t
        if len(self._came) > MOST_REMEMBERED_TRACKS:
            self._came = {
                track_id: came for track_id, came in self._came.items() if t - came < CAMERA_SETTLED_S
            }

    def _wanted(
        self, mean: Array, cov: Array, giver: int, taker: int, seam: Array
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """(n,) of tracks in the giver's pixels now: those that the taker may see, and of those that nobody sees the
        ones nearer to its field of view; and which of these are only lent. seam (3, 3): the taker's axes from the
        giver's.
        """
        one = self._cameras[giver].camera
        shown = self._shown_by(mean, cov, giver, taker, seam)
        seen_here = probability_in_view(mean, cov, one)
        nearer = shown.closer & (seen_here < 0.5)
        for_good = nearer | (
            (shown.seen > 0.5) & (shown.seen >= np.minimum(seen_here, SURELY_SEEN_PROBABILITY))
        )
        lent = shown.possible & ~for_good & (shown.seen > MAY_BE_SEEN_PROBABILITY)
        return np.asarray(lent | (shown.possible & for_good)), np.asarray(lent)

    def _shown_by(self, mean: Array, cov: Array, giver: int, taker: int, seam: Array) -> _Shown:
        """Tracks in the giver's pixels (n, 4), (n, 4, 4), as the taker would have them."""
        one, other = self._cameras[giver].camera, self._cameras[taker].camera
        ray = one.bearing_undistorted(mean[:, POSITION])
        there = ray @ seam.T
        pixel, _, ahead = other.project_undistorted(there)
        if not ahead.any():
            return _Shown(np.zeros(len(mean)), np.asarray(ahead), np.asarray(ahead))
        size = self._cameras[giver].tracker.sizes * _of_boxes(mean[:, POSITION], one, pixel, other)
        by, by_cov = parallax(pixel, size, other, self._baseline(giver, taker))
        pixel = pixel + by
        moved, spread = np.zeros_like(mean), np.tile(np.eye(4), (len(mean), 1, 1))
        moved[:, POSITION] = np.where(ahead[:, None], pixel, OUTSIDE_EVERY_PICTURE_PX)
        here, beyond = one.per_radian(mean[:, POSITION]), other.per_radian(pixel)
        variance = (cov[:, 0, 0] / here[..., 0] ** 2 + cov[:, 2, 2] / here[..., 1] ** 2) / 2.0
        by_cov[ahead] += self._of_seam(pixel[ahead], giver, taker)
        spread[:, 0, 0] = variance * beyond[..., 0] ** 2 + by_cov[:, 0, 0]
        spread[:, 2, 2] = variance * beyond[..., 1] ** 2 + by_cov[:, 1, 1]
        seen = probability_in_view(moved, spread, other)
        possible = ahead & self._reach[taker].holds(moved, spread)
        nearer = _beyond(there, other) < _beyond(ray, one)
        return _Shown(np.where(possible, seen, 0.0), np.asarray(possible), np.asarray(nearer))


class _Shown(NamedTuple):
    """Of tracks (n,): the probability that another camera shows them, whether it can have them at all, and whether they
    are nearer to its field of view."""

    seen: Array
    possible: NDArray[np.bool_]
    closer: NDArray[np.bool_]


class _Lent(NamedTuple):
    """Tracks (n,) of a camera that another one has for one scan, all of them as they were, and what was known of
    theirs and others' crossings."""

    giver: int
    ids: NDArray[np.int64]
    as_it_was: Passage
    arrived: dict[int, _Arrived]
    came: dict[int, float]


def _is_between(before: _TrackLook, middle: _TrackLook, after: _TrackLook) -> bool:
    """Whether a detection of one camera lies between two of another one, soon after each other."""
    same = before.camera == after.camera != middle.camera
    return same and before.t < middle.t < after.t < before.t + COMPARED_WITHIN_S


def _restore(now: dict[int, Any], track_id: int, then: dict[int, Any]) -> None:
    if track_id in then:
        now[track_id] = then[track_id]
    else:
        now.pop(track_id, None)


def _beyond(ray: Array, camera: PinholeCamera) -> Array:
    """(n,) rad: how far rays (n, 3) are outside a camera's field of view, as if that were round."""
    return np.asarray(np.arccos(np.clip(ray[:, 2], -1.0, 1.0)) - 0.5 * camera.field[0])


def _of_boxes(here: Array, one: PinholeCamera, there: Array, other: PinholeCamera) -> Array:
    """By how much larger boxes are, wide and high, at pixels (n, 2) of the other camera than at those of the one."""
    return np.asarray(other.box_per_radian(there) / one.box_per_radian(here))


def parallax(pixel: Array, size: Array, camera: PinholeCamera, baseline: Array) -> tuple[Array, Array]:
    """Shift (n, 2) px of tracks at pixels (n, 2), with boxes (n, 2) px wide and high, when seen from `baseline`
    (3,) m away, camera axes, and its covariance (n, 2, 2) px²: a box tells the distance within a factor, without
    one it is hardly known.
    """
    n = len(pixel)
    if not baseline.any():
        return np.zeros((n, 2)), np.zeros((n, 2, 2))
    ray = camera.bearing_undistorted(pixel)
    distance = np.maximum(
        SEAM_DRONE_SPAN_M * camera.box_per_radian(pixel)[..., 0] / size[:, 0], SEAM_NEAREST_M
    )
    distance = np.where(np.isnan(distance), SEAM_UNKNOWN_DISTANCE_M, distance)
    seen, _, ahead = camera.project_undistorted(distance[:, None] * ray - baseline)
    by = np.where(ahead[:, None], seen - pixel, 0.0)
    outer = by[:, :, None] * by[:, None, :]
    return by, SEAM_DISTANCE_SIGMA**2 * outer
