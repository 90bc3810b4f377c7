"""Where teammates should appear in this drone's image: by what they announced, or by where it saw them last.

What is known of a drone's motion since is a mixture of Gaussians (decision 5). One that announced itself from its pad
is as sure after a minute as at once, so age alone must not blur it: it is still there, or it has flown off slowly, or
fast.
"""

from __future__ import annotations

import math
from collections.abc import Container, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Announcement, Array, Track
from swarmtrack.motion.ego import TeamPose
from swarmtrack.tracking.motion_model import optical_flow

# s after which half of the drones that announced themselves in flight have left their pose.
STAY_IN_FLIGHT = 0.1
# Of the drones that have left their pose.
SHARE_FAST = 0.2
# Times drift_speed.
FAST = 10.0
# s that a drone which went out of sight keeps its velocity.
COURSE_S = 1.0
# Of the drones that went out of sight, those that may be nearly anywhere.
LOST_SHARE = 0.1
# rad: how far these are at once.
TURNED_AWAY = 0.3
# s over which a track's velocity becomes a turn of its ray.
AHEAD_S = 0.1
# px: of what lies further off, there is nothing more to tell.
WIDE_PX = 300.0
# px, and the share of drones: whose place is not at all what they say.
ANYWHERE_PX, ASTRAY = 1e5, 0.003
# m: of a place that is vaguer, a projection tells nothing. A drone that doubts its own start says so with a kilometre.
VAGUE_M = 100.0
# Of starts: how many are as good as their sigma says, off by some of it, and off by metres; and these two, in sigmas
# and m at least.
START_SHARES = (0.84, 0.13, 0.03)
START_OFF = ((3.0, 0.3), (5.0, 1.5))
# m: no teammate is closer, so the observer's motion turns no bearing by more than one at it.
NEAREST = 2.0


class Predictions(NamedTuple):
    """Teammates that lie in front of the camera: key (k,) of whatever each was predicted from, its drone_id (k,), and
    pixel (k, 2), undistorted; a mixture of c Gaussians around it: share (c, k), cov (c, k, 2, 2) px². distance (k, 2) m
    from the camera and its sigma, NaN where nobody knows. turn (k, 2) px/rad: of the observer's heading, which is in
    cov; zero where a heading that is off does not count."""

    key: list[tuple[object, ...]]
    drone_id: list[int]
    pixel: Array
    share: Array
    cov: Array
    distance: Array
    turn: Array

    @property
    def spread(self) -> Array:
        """(k,) px²: of the whole mixture, mean over both axes; where the share is tiny, however wide."""
        variance = np.minimum(np.trace(self.cov, axis1=2, axis2=3) / 2.0, WIDE_PX**2)
        return np.asarray((self.share * variance).sum(axis=0))

    def without_heading(self, view: ObserverCamera) -> Predictions:
        """The same for an observer that knows its heading: what its variance adds is taken off."""
        outer = self.turn[:, :, None] * self.turn[:, None, :]
        return self._replace(cov=self.cov - float(view.observer.attitude_cov[2, 2]) * outer)

    def only(self, columns: Sequence[int]) -> Predictions:
        """Those of these columns."""
        return Predictions(
            [self.key[j] for j in columns],
            [self.drone_id[j] for j in columns],
            self.pixel[columns],
            self.share[:, columns],
            self.cov[:, columns],
            self.distance[columns],
            self.turn[columns],
        )


NOBODY = Predictions(
    [], [], np.empty((0, 2)), np.empty((1, 0)), np.empty((1, 0, 2, 2)), np.empty((0, 2)), np.empty((0, 2))
)


@dataclass(frozen=True, slots=True, eq=False)
class LastSeen:
    """An identified drone that went out of sight at t.

    direction (3,): unit vector from the observer's camera, team frame; rate (3,) rad/s: its derivative; sigma [rad];
    origin (3,) m: where the camera was.
    """

    drone_id: int
    t: float
    direction: Array
    rate: Array
    sigma: float
    origin: Array


@dataclass(frozen=True, slots=True)
class ObserverCamera:
    """An observer's camera at the time of a scan."""

    observer: TeamPose
    camera: PinholeCamera
    team_from_camera: Pose
    number: int = 0
    """Which of the observer's cameras it is."""

    @classmethod
    def of(
        cls, observer: TeamPose, camera: PinholeCamera, body_from_camera: Pose, number: int = 0
    ) -> ObserverCamera:
        pose = Pose(observer.world_from_body, observer.position) @ body_from_camera
        return cls(observer, camera, pose, number)

    def rays(self, pixel: Array) -> Array:
        """Unit vectors (n, 3) in the team frame of undistorted pixels (n, 2)."""
        ray = self.camera.bearing_undistorted(pixel)
        return np.asarray(ray @ self.team_from_camera.rotation.T)


def is_vague(announcement: Announcement) -> bool:
    """Whether its sender hardly knows where it is."""
    return float(np.trace(announcement.position_cov)) > 3.0 * VAGUE_M**2


def key_of(announcement: Announcement) -> tuple[object, ...]:
    """What its predictions are known by."""
    return (announcement.drone_id, announcement.boot, announcement.sequence, announcement.t)


def reproject(
    announcements: Sequence[Announcement],
    view: ObserverCamera,
    *,
    on_pad: Container[int],
    drift_speed: float,
    stay_s: float,
) -> Predictions:
    """Announced positions in the observer's image.

    The covariance is that of the announced position, of the observer's own and of its attitude; for a drone that has
    flown off also of how far it may be: drift_speed [m/s] times the age of the pose, or `FAST` times that. Of those
    on_pad half are still there after stay_s [s]; the others fly. One start in six or so was measured worse than its
    sigma says. Whose place is vaguer than `VAGUE_M` may be anywhere in the image.
    """
    vague = [a for a in announcements if is_vague(a)]
    if vague:
        placed = [a for a in announcements if a not in vague]
        known = reproject(placed, view, drift_speed=drift_speed, stay_s=stay_s, on_pad=on_pad)
        return joined(known, _somewhere(vague, view.camera))
    if not announcements:
        return NOBODY
    observer, camera = view.observer, view.camera
    camera_from_team = view.team_from_camera.inverse()
    positions = np.array([a.position for a in announcements]).reshape(-1, 3)
    pixel, jacobian, valid = camera.project_undistorted(camera_from_team.transform(positions))
    by_team = jacobian @ camera_from_team.rotation
    metres = by_team @ by_team.swapaxes(1, 2)  # px² for 1 m²
    spread = np.array([a.position_cov for a in announcements]).reshape(-1, 3, 3)
    still = by_team @ (spread + observer.position_cov) @ by_team.swapaxes(1, 2)
    # px for a turn of the observer by 1 rad about each axis of the team frame.
    by_turn = optical_flow(pixel, camera) @ camera_from_team.rotation
    still += by_turn @ observer.attitude_cov @ by_turn.swapaxes(1, 2)
    age = np.array([abs(observer.t - a.t) + a.t_sigma for a in announcements])
    drifted = ((drift_speed * age) ** 2)[:, None, None] * metres
    stay = np.array([stay_s if a.drone_id in on_pad else STAY_IN_FLIGHT for a in announcements])
    p_still = stay / (stay + age)
    start_sigma = np.sqrt(np.trace(spread, axis1=1, axis2=2) / 3.0)
    off = [np.maximum(sigmas * start_sigma, m)[:, None, None] ** 2 * metres for sigmas, m in START_OFF]
    gone = (1.0 - p_still) * np.array([[1.0 - SHARE_FAST], [SHARE_FAST]])
    share = np.concatenate([p_still * np.reshape(START_SHARES, (-1, 1)), gone])
    cov = np.stack([still, *(still + more for more in off), still + drifted, still + FAST**2 * drifted])
    distance = np.linalg.norm(positions - view.team_from_camera.position, axis=1)
    along = np.trace(spread + observer.position_cov, axis1=1, axis2=2) / 3.0 + (drift_speed * age) ** 2
    in_front = [a for a, good in zip(announcements, valid, strict=True) if good]
    return Predictions(
        [key_of(a) for a in in_front],
        [a.drone_id for a in in_front],
        pixel[valid],
        share[:, valid],
        cov[:, valid],
        np.column_stack([distance, np.sqrt(along)])[valid],
        by_turn[valid][:, :, 2],
    )


def anywhere(drones: Sequence[int]) -> Predictions:
    """Drones whose place is wrong by more than it says: so wide that no track is out of their gate."""
    k = len(drones)
    return Predictions(
        [("anywhere", drone) for drone in drones],
        list(drones),
        np.zeros((k, 2)),
        np.full((1, k), ASTRAY),
        np.broadcast_to(ANYWHERE_PX**2 * np.eye(2), (1, k, 2, 2)),
        np.full((k, 2), np.nan),
        np.zeros((k, 2)),
    )


def _somewhere(announcements: Sequence[Announcement], camera: PinholeCamera) -> Predictions:
    """Drones of which nobody knows where they are: as likely here as there."""
    k = len(announcements)
    return Predictions(
        [key_of(a) for a in announcements],
        [a.drone_id for a in announcements],
        np.tile([0.5 * camera.width, 0.5 * camera.height], (k, 1)),
        np.ones((1, k)),
        np.broadcast_to(np.diag([camera.width**2, camera.height**2]).astype(float), (1, k, 2, 2)),
        np.full((k, 2), np.nan),
        np.zeros((k, 2)),
    )


def rays_to(named: Sequence[tuple[int, Track]], view: ObserverCamera) -> list[LastSeen]:
    """The rays to tracks, each with the ID of the drone that it is, and how these rays turn."""
    if not named:
        return []
    mean = np.array([track.mean for _, track in named])
    soon = mean[:, ::2] + AHEAD_S * mean[:, 1::2]
    here, there = np.split(view.rays(np.concatenate([mean[:, ::2], soon])), 2)
    focal = view.camera.per_radian(mean[:, ::2])[..., 0]
    sigma = np.sqrt([np.trace(track.cov[::2, ::2]) / 2.0 for _, track in named]) / focal
    origin = view.team_from_camera.position
    return [
        LastSeen(drone, track.t, here[i], (there[i] - here[i]) / AHEAD_S, float(sigma[i]), origin)
        for i, (drone, track) in enumerate(named)
    ]


def seen_from(ray: LastSeen, place: Array, view: ObserverCamera) -> LastSeen:
    """What another camera of the observer saw a moment ago, as if this one saw it now: less surely by as far as it has
    gone on since. place (3,) m: where the drone says it is, which tells its distance well enough for the way between
    two cameras."""
    t, origin = view.observer.t, view.team_from_camera.position
    on = (t - ray.t) * ray.rate
    direction = ray.direction + on
    distance = max(float(np.linalg.norm(place - ray.origin)), NEAREST)
    apart = ray.origin - origin
    towards = distance * direction / np.linalg.norm(direction) + apart
    beside = float(np.linalg.norm(apart)) / distance
    return LastSeen(
        ray.drone_id,
        t,
        towards / np.linalg.norm(towards),
        ray.rate,
        math.hypot(ray.sigma, 0.5 * beside, float(np.linalg.norm(on))),
        origin,
    )


def retrace(seen: Sequence[LastSeen], view: ObserverCamera, *, turn_rate: float) -> Predictions:
    """Drones that went out of sight, where they should come back: on along their course, as seen from here.

    turn_rate [rad/s]: how far their bearing may have left that course, for each second, or for a tenth of them `FAST`
    times as far. Distances are not known, so a drone that is out of sight while the observer moves may appear to have
    moved as much as a drone at `NEAREST`. A heading that is off was off as much when the ray was seen, so that only the
    tilt's error counts.
    """
    if not seen:
        return NOBODY
    camera = view.camera
    age = np.array([view.observer.t - s.t for s in seen])
    travelled = COURSE_S * -np.expm1(-age / COURSE_S)
    direction, rate = (
        np.array(v).reshape(-1, 3) for v in ([s.direction for s in seen], [s.rate for s in seen])
    )
    direction = direction + travelled[:, None] * rate
    in_camera = direction @ view.team_from_camera.rotation
    pixel, _, valid = camera.project_undistorted(in_camera)
    moved = np.array([np.linalg.norm(view.team_from_camera.position - s.origin) for s in seen])
    sigma0 = np.array([s.sigma for s in seen])
    on_course = sigma0**2 + view.observer.tilt_sigma**2 + (moved / NEAREST) ** 2
    off_course = on_course + (turn_rate * age) ** 2
    lost = off_course + (TURNED_AWAY + FAST * turn_rate * age) ** 2
    per_radian = _per_radian(pixel, camera)
    cov = np.stack([off_course, lost])[:, :, None, None] * per_radian
    share = np.repeat([[1.0 - LOST_SHARE], [LOST_SHARE]], len(seen), axis=1)
    in_front = [s for s, good in zip(seen, valid, strict=True) if good]
    return Predictions(
        [(s.drone_id, s.t) for s in in_front],
        [s.drone_id for s in in_front],
        pixel[valid],
        share[:, valid],
        cov[:, valid],
        np.full((len(in_front), 2), np.nan),
        np.zeros((len(in_front), 2)),
    )


def joined(first: Predictions, second: Predictions) -> Predictions:
    """Both as one, in order; the shorter mixture is filled up with shares of zero."""
    if not first.key or not second.key:
        return first if first.key else second
    c = max(len(first.share), len(second.share))
    return Predictions(
        first.key + second.key,
        first.drone_id + second.drone_id,
        np.concatenate([first.pixel, second.pixel]),
        np.concatenate([_filled(first.share, c, 0.0), _filled(second.share, c, 0.0)], axis=1),
        np.concatenate([_filled(first.cov, c, np.eye(2)), _filled(second.cov, c, np.eye(2))], axis=1),
        np.concatenate([first.distance, second.distance]),
        np.concatenate([first.turn, second.turn]),
    )


def _filled(parts: Array, c: int, blank: float | Array) -> Array:
    missing = np.broadcast_to(blank, (c - len(parts), *parts.shape[1:]))
    return np.concatenate([parts, missing])


def _per_radian(pixel: Array, camera: PinholeCamera) -> Array:
    """px² (n, 2, 2) for a turn of the camera by 1 rad about each axis, independently."""
    flow = optical_flow(pixel, camera)
    return np.asarray(flow @ flow.swapaxes(1, 2))
