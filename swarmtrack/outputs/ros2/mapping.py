"""Our messages as ROS 2's: pure functions from records of the wire to leaves for `cdr.encode`.

World ENU and body FLU (REP 103), cameras in optical axes (x right, y down, z forward) like our own. `map` is the team
frame in ENU axes. Frames of drone 1 in the namespace `swarm`:

* `swarm/d1/base_link`: its body; a child of `map` wherever the drone's attitude is known,
* `swarm/d1/camera_optical`, `swarm/d1/camera2_optical` and so on: its cameras, fixed in its body,
* `swarm/d1/camera_enu`: origin at its first camera, axes of `map`. Positions of teammates are in this frame, because
  they are relative to the camera, and need no attitude.

What is unknown has the variance `UNKNOWN_VARIANCE`, and the value zero.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from swarmtrack.geometry.camera import Equidistant, PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import ENU_FROM_NED, to_quaternion
from swarmtrack.messages import Array, Identity
from swarmtrack.outputs.drawing import ELLIPSE_SIGMAS, name_of
from swarmtrack.outputs.palette import colour_of
from swarmtrack.wire.camera import CameraMessage, OtherCamera, mounting_from
from swarmtrack.wire.health import HealthMessage
from swarmtrack.wire.tracks import RelativeMessage, TrackMessage, TracksMessage

Row = tuple[Any, ...]
"""Leaves of a message, or of an element of a sequence."""

MAP_FRAME: Final = "map"
UNKNOWN_VARIANCE: Final = 1e6  # rad², rad²/s² or m²/s²: as large as ROS users write it
FLU_FROM_FRD: Array = np.diag([1.0, -1.0, -1.0])
ROS_RAY_M: Final = 30.0  # length of a ray to what has no known distance
ROS_NAME_ABOVE_M: Final = 0.6  # of a name above its drone
ROS_LIFETIME_S: Final = 1  # s after which a marker that is not repeated disappears
ROS_OPACITY: Final = 0.3  # of ellipsoids
MARKER_SPHERE, MARKER_LINES, MARKER_SPHERES, MARKER_TEXT = 2, 5, 7, 9
_Shape = tuple[int, Sequence[float]]  # type of a marker, and its size, m
_BALLS: Final = (MARKER_SPHERES, (0.3, 0.3, 0.3))
_LINES: Final = (MARKER_LINES, (0.02, 0.0, 0.0))
_TEXT: Final = (MARKER_TEXT, (0.0, 0.0, 0.4))
LEVEL_OK, LEVEL_WARN, LEVEL_ERROR = 0, 1, 2
_LEAST_VARIANCE_M2 = 1e-6  # so that no ellipsoid is flat
_UNKNOWN: Array = np.eye(3) * UNKNOWN_VARIANCE
_LEVEL_QUATERNION = (0.0, 0.0, 0.0, 1.0)


def _entry(i: int, j: int) -> int:
    """Index of an entry in the upper triangle, row by row, of a symmetric (6, 6) matrix."""
    i, j = min(i, j), max(i, j)
    return 6 * i - i * (i - 1) // 2 + j - i


# NED to ENU swaps the first two axes and turns the third. For the covariance of positions and for that of velocities:
# index in (6, 6) of the block in ENU, index in the triangle in NED, sign.
_AXES: Final = ((1, 1.0), (0, 1.0), (2, -1.0))
_BLOCKS: Final = {
    begin: [
        (6 * i + j, _entry(begin + m, begin + n), a * b)
        for i, (m, a) in enumerate(_AXES)
        for j, (n, b) in enumerate(_AXES)
    ]
    for begin in (0, 3)
}
_UNKNOWN_BLOCK: Final = [UNKNOWN_VARIANCE * (k in (21, 28, 35)) for k in range(36)]


@dataclass(frozen=True, slots=True, eq=False)
class DronePlace:
    """Where a drone is at t_utc_s, in the team's NED frame; its velocity (3,) m/s and attitude where they are known.

    position (3,) m, position_cov (3, 3) m²: of its body if the attitude is known, else of its first camera.
    world_from_body (3, 3): from FRD; attitude_cov (3, 3) rad², of a small turn about the team's axes. velocity_cov
    (3, 3) m²/s².
    """

    t_utc_s: float
    position: Array
    position_cov: Array
    world_from_body: Array | None = None
    attitude_cov: Array | None = None
    velocity: Array | None = None
    velocity_cov: Array | None = None


@dataclass(frozen=True, slots=True)
class DroneFrames:
    """Names of a drone's frames, and of its topics, in a namespace."""

    namespace: str
    drone_id: int

    @property
    def prefix(self) -> str:
        return f"{self.namespace}/d{self.drone_id}"

    @property
    def body(self) -> str:
        return f"{self.prefix}/base_link"

    @property
    def level(self) -> str:
        return f"{self.prefix}/camera_enu"

    def optical(self, camera: int) -> str:
        return f"{self.prefix}/{camera_name(camera)}_optical"

    def topic(self, name: str) -> str:
        return f"/{self.prefix}/{name}"

    def camera_topic(self, camera: int, name: str) -> str:
        """Topic of one camera; those of the first have no name of a camera."""
        return self.topic(f"{camera_name(camera)}/{name}" if camera else name)


def camera_name(camera: int) -> str:
    """Name of a camera, counted from 0; people count from 1."""
    return "camera" if camera == 0 else f"camera{camera + 1}"


def cameras_of(camera: CameraMessage) -> Sequence[CameraMessage | OtherCamera]:
    """All cameras of a drone, the first one first."""
    return [camera, *camera.others]


def header(t_utc_s: float, frame: str) -> Row:
    """std_msgs/Header."""
    seconds, part = divmod(t_utc_s, 1.0)
    return int(seconds), min(round(part * 1e9), 999_999_999), frame


class MapPose(NamedTuple):
    """x, y, z, qx, qy, qz, qw in `map`, and the covariance (6, 6), row by row."""

    pose: Row
    cov: list[float]


def map_pose(place: DronePlace) -> MapPose:
    """Pose of the body, or of the level frame, whose axes are known."""
    # Twenty times per second, between other work, a small matrix product takes five times as long as these sums.
    position, cov = enu(place.position.tolist()), [0.0] * 36
    _fill(cov, 0, place.position_cov)
    if place.world_from_body is None:
        return MapPose((*position, *_LEVEL_QUATERNION), cov)
    if place.attitude_cov is None:
        cov[21] = cov[28] = cov[35] = UNKNOWN_VARIANCE
    else:
        _fill(cov, 21, place.attitude_cov)
    north, east, down = place.world_from_body.tolist()
    rows = [(row[0], -row[1], -row[2]) for row in (east, north, [-entry for entry in down])]
    return MapPose((*position, *_quaternion(rows)), cov)


def odometry(place: DronePlace, pose: MapPose, frames: DroneFrames) -> Row:
    """nav_msgs/Odometry in `map`; twist in the axes of its child, as ROS wants it. pose: of `map_pose`."""
    child, axes = frames.level, ENU_FROM_NED
    if place.world_from_body is not None:
        child, axes = frames.body, FLU_FROM_FRD @ place.world_from_body.T
    velocity, cov = np.zeros(3), _UNKNOWN
    if place.velocity is not None and place.velocity_cov is not None:
        velocity, cov = axes @ place.velocity, axes @ place.velocity_cov @ axes.T
    return (
        *header(place.t_utc_s, MAP_FRAME),
        child,
        *pose.pose,
        *pose.cov,
        *velocity.tolist(),
        *(0.0, 0.0, 0.0),
        *_both(cov, _UNKNOWN),
    )


def transforms(place: DronePlace, pose: MapPose, camera: CameraMessage | None, frames: DroneFrames) -> Row:
    """tf2_msgs/TFMessage of what moves: the body where its attitude is known, and the level frame at its camera."""
    head = header(place.t_utc_s, MAP_FRAME)
    if place.world_from_body is None:
        return ([(*head, frames.level, *pose.pose)],)
    rows = [(*head, frames.body, *pose.pose)]
    if camera is not None:
        at = place.position + place.world_from_body @ np.array(camera.position_m)
        rows.append((*head, frames.level, *enu(at.tolist()), *_LEVEL_QUATERNION))
    return (rows,)


def static_transforms(camera: CameraMessage, t_utc_s: float, frames: DroneFrames) -> Row:
    """tf2_msgs/TFMessage of its cameras in its body."""
    rows = []
    for k, one in enumerate(cameras_of(camera)):
        mounting = mounting_from(one)
        pose = Pose(FLU_FROM_FRD @ mounting.rotation, FLU_FROM_FRD @ mounting.position)
        rows.append((*header(t_utc_s, frames.body), frames.optical(k), *_pose(pose.position, pose.rotation)))
    return (rows,)


def named(tracks: TracksMessage) -> dict[int, RelativeMessage]:
    """Position of each named teammate; of several tracks with one name, the most probable counts."""
    best: dict[int, tuple[float, RelativeMessage]] = {}
    relatives = {relative.track_id: relative for relative in tracks.relatives}
    for track in tracks.tracks:
        relative = relatives.get(track.id)
        if relative is not None and isinstance(track.identity, int):
            candidate = track.identity_probability, relative
            best[track.identity] = max(
                best.get(track.identity, candidate), candidate, key=lambda each: each[0]
            )
    return {drone_id: relative for drone_id, (_, relative) in sorted(best.items())}


def teammates(known: Mapping[int, RelativeMessage], t_utc_s: float, frames: DroneFrames) -> Row:
    """geometry_msgs/PoseArray of the named teammates, in order of their IDs."""
    poses = [(*enu(each.position_m), *_LEVEL_QUATERNION) for each in known.values()]
    return (*header(t_utc_s, frames.level), poses)


def teammate_pose(relative: RelativeMessage, t_utc_s: float, frames: DroneFrames) -> Row:
    """geometry_msgs/PoseWithCovarianceStamped; the attitude is unknown."""
    return (
        *header(t_utc_s, frames.level),
        *enu(relative.position_m),
        *_LEVEL_QUATERNION,
        *_six_of_triangle(relative.cov, 0),
    )


def teammate_twist(relative: RelativeMessage, t_utc_s: float, frames: DroneFrames) -> Row:
    """geometry_msgs/TwistWithCovarianceStamped relative to the observer; rates of turn are unknown."""
    return (
        *header(t_utc_s, frames.level),
        *enu(relative.velocity_m_s),
        *(0.0, 0.0, 0.0),
        *_six_of_triangle(relative.cov, 3),
    )


def markers(tracks: TracksMessage, rays: Mapping[int, Array], t_utc_s: float, frames: DroneFrames) -> Row:
    """visualization_msgs/MarkerArray: balls at the drone and at each named teammate, with names, ellipsoids of their
    covariances and rays to them.

    rays: of other tracks by their index, unit vectors (3,) in the axes of their cameras, wherever the drone's attitude
    is known.
    """
    head, known, here = header(t_utc_s, frames.level), named(tracks), (0.0, 0.0, 0.0)
    places = {frames.drone_id: here, **{name: enu(each.position_m) for name, each in known.items()}}

    def marker(kind: str, number: int, shape: _Shape, *rest: Any, frame: Row = head, **more: Any) -> Row:
        return _marker(frame, (f"{frames.prefix}/{kind}", number), shape, *rest, **more)

    rows = [marker("balls", 0, _BALLS, points=[(at, _colour(name)) for name, at in places.items()])]
    for name, (x, y, z) in places.items():
        above = (x, y, z + ROS_NAME_ABOVE_M)
        rows.append(marker("names", name, _TEXT, _colour(name), at=above, text=name_of(name)))
    for name, size, turn in _ellipsoids(known):
        colour = _colour(name, ROS_OPACITY)
        rows.append(marker("ellipsoids", name, (MARKER_SPHERE, size), colour, at=places[name], turn=turn))
    rows.append(marker("rays", 0, _LINES, points=_lines((name, places[name]) for name in known)))
    by_camera: dict[int, list[tuple[Identity, Row]]] = {}
    for i, ray in rays.items():
        end = tracks.tracks[i].identity, tuple((ROS_RAY_M * ray).tolist())
        by_camera.setdefault(tracks.camera_of(i), []).append(end)
    for k, ends in by_camera.items():
        seen_by = header(t_utc_s, frames.optical(k))
        rows.append(marker("other_rays", k, _LINES, points=_lines(ends), frame=seen_by))
    return (rows,)


def camera_info(lens: PinholeCamera, width: int, height: int, t_utc_s: float, frame: str) -> Row:
    """sensor_msgs/CameraInfo for pictures of this size, which are the whole image scaled."""
    camera, distortion = lens.scaled(width, height), lens.distortion
    coefficients = [] if distortion is None else list(map(float, distortion.coefficients))
    if isinstance(distortion, Equidistant):
        model = "equidistant"
    else:
        model = "rational_polynomial" if len(coefficients) == 8 else "plumb_bob"
        coefficients += [0.0] * (5 - len(coefficients))
    K = camera.K
    P = np.column_stack([K, np.zeros(3)])
    return (
        *header(t_utc_s, frame), height, width, model, coefficients,
        *K.ravel().tolist(), *np.eye(3).ravel().tolist(), *P.ravel().tolist(), 0, 0, 0, 0, 0, 0, False,
    )  # fmt: skip


def compressed_image(jpeg: bytes, t_utc_s: float, frame: str) -> Row:
    """sensor_msgs/CompressedImage."""
    return (*header(t_utc_s, frame), "jpeg", jpeg)


def detections(shown: Iterable[tuple[TrackMessage, Sequence[float]]], t_utc_s: float, frame: str) -> Row:
    """vision_msgs/Detection2DArray of the tracks in one image, each with its centre as the camera gave it, px.

    A result's class is a drone's ID, `foreign` or `unknown`, its score the probability of that; the detection's id is
    the track's.
    """
    head = header(t_utc_s, frame)
    nowhere = (*(0.0,) * 3, *_LEVEL_QUATERNION, *(0.0,) * 36)
    rows = []
    for track, (u, v) in shown:
        known = track.identity is not None
        score = track.identity_probability if known else track.probability
        result = (str(track.identity) if known else "unknown", score, *nowhere)
        rows.append((*head, [result], u, v, 0.0, track.w_px, track.h_px, str(track.id)))
    return (*head, rows)


def diagnostics(health: HealthMessage, t_utc_s: float, drone_id: int) -> Row:
    """diagnostic_msgs/DiagnosticArray: the drone as a whole, then each of its links."""
    readiness = health.readiness
    ready = readiness is None or readiness.ready
    reasons = "" if readiness is None else "; ".join(readiness.reasons)
    values = {
        "uptime_s": health.uptime_s,
        "cpu_percent": health.cpu_percent,
        "rss_mb": health.rss_mb,
        **{f"{name}_hz": rate.got_hz for name, rate in health.rates.items()},
        **{f"{name}_p95_s": latency.p95_s for name, latency in health.latencies.items()},
        **{f"dropped {name}": count for name, count in health.drops.items()},
    }
    name, hardware = f"swarmtrack: drone {drone_id}", f"drone {drone_id}"
    rows = [
        (LEVEL_OK if ready else LEVEL_WARN, name, reasons or "ready", hardware, _key_values(values)),
        *(
            (LEVEL_OK if link.ok else LEVEL_ERROR, f"{name}: {link.name}", link.text, hardware,
             _key_values(link.counters))
            for link in health.links
        ),
    ]  # fmt: skip
    return (*header(t_utc_s, ""), rows)


def enu(ned: Sequence[float]) -> tuple[float, float, float]:
    """A vector's components east, north, up from those north, east, down."""
    north, east, down = ned
    return east, north, -down


def _key_values(values: Mapping[str, float]) -> list[tuple[str, str]]:
    return [(key, f"{value:g}") for key, value in values.items()]


def _pose(position: Array, rotation: Array) -> Row:
    return (*position.tolist(), *_quaternion(rotation))


def _quaternion(rotation: ArrayLike) -> Row:
    w, x, y, z = to_quaternion(rotation).tolist()
    return x, y, z, w


def _fill(whole: list[float], begin: int, block: Array) -> None:
    """Write a covariance (3, 3) in NED into one of (6, 6) in ENU, row by row, from an index on."""
    rows = block.tolist()
    for i, (m, a) in enumerate(_AXES):
        for j, (n, b) in enumerate(_AXES):
            whole[begin + 6 * i + j] = a * b * rows[m][n]


def _both(first: Array, second: Array) -> list[float]:
    """(6, 6) row by row from its two blocks (3, 3)."""
    whole = np.zeros((6, 6))
    whole[:3, :3], whole[3:, 3:] = first, second
    return whole.ravel().tolist()


def _six_of_triangle(triangle: Sequence[float], begin: int) -> list[float]:
    """(6, 6) in ENU with a block of a covariance in NED, which begins at a row; the rest is unknown."""
    whole = _UNKNOWN_BLOCK.copy()
    for to, entry, sign in _BLOCKS[begin]:
        whole[to] = sign * triangle[entry]
    return whole


def _ellipsoids(known: Mapping[int, RelativeMessage]) -> Iterator[tuple[int, list[float], Row]]:
    """Teammate, diameters [m] and attitude of the ellipsoid of its position's covariance, in ENU."""
    if not known:
        return
    six = np.array([_six_of_triangle(each.cov, 0) for each in known.values()]).reshape(-1, 6, 6)
    variances, axes = np.linalg.eigh(six[:, :3, :3])
    axes[:, :, 0] *= np.linalg.det(axes)[:, None]
    diameters = 2.0 * ELLIPSE_SIGMAS * np.sqrt(np.maximum(variances, _LEAST_VARIANCE_M2))
    for name, size, rotation in zip(known, diameters.tolist(), axes, strict=True):
        yield name, size, _quaternion(rotation)


def _lines(ends: Iterable[tuple[Identity, Row]]) -> list[tuple[Row, Row]]:
    """Points and colours of lines from the origin."""
    return [(point, _colour(name)) for name, end in ends for point in ((0.0, 0.0, 0.0), end)]


def _colour(identity: Identity, opacity: float = 1.0) -> Row:
    r, g, b = colour_of(identity)
    return r / 255, g / 255, b / 255, opacity


def _marker(
    head: Row,
    label: tuple[str, int],
    shape: _Shape,
    colour: Row = (1.0, 1.0, 1.0, 1.0),
    *,
    at: Row = (0.0, 0.0, 0.0),
    turn: Row = _LEVEL_QUATERNION,
    points: Sequence[tuple[Row, Row]] = (),
    text: str = "",
) -> Row:
    """visualization_msgs/Marker that is added, with nothing in its fields for meshes and textures. points: each with
    its colour.
    """
    kind, size = shape
    return (
        *head, *label, kind, 0, *at, *turn, *size, *colour, ROS_LIFETIME_S, 0, False,
        [point for point, _ in points], [each for _, each in points],
        "", 0, 0, "", "", b"", (), text, "", "", b"", False,
    )  # fmt: skip


def track_rays(tracks: TracksMessage, lenses: Sequence[PinholeCamera]) -> Iterator[tuple[int, Array]]:
    """Index and unit vector (3,), in its camera's axes, of each confirmed track without a known distance."""
    far = {relative.track_id for relative in tracks.relatives}
    for i, track in enumerate(tracks.tracks):
        number = tracks.camera_of(i)
        if track.status == "tentative" or track.id in far or number >= len(lenses):
            continue
        (ray,) = lenses[number].bearing_undistorted(np.array([(track.u_px, track.v_px)]))
        if np.isfinite(ray).all():
            yield i, ray
