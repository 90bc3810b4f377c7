"""Teammates in metres for Foxglove's 3D panel and plots: what a drone makes of a scan, and in which frames.

The frames: `map` is east, north, up, as 3D panels want it; `team` is the team's own (north, east, down) in it. Of
drone 1, `drone-1` is its body, `drone-1/camera` its camera, and `drone-1/ned` has its origin there and the team's axes:
in it are its teammates. Its second camera is `drone-1/camera-2`, and so on. In the frame of each camera lie the lines
around what it sees, the rays to what it tracks, and its pictures with their calibration.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from foxglove.messages import (
    CameraCalibration,
    Color,
    Duration,
    FrameTransform,
    FrameTransforms,
    LinePrimitive,
    LinePrimitiveLineType,
    Odometry,
    Point3,
    Pose,
    Quaternion,
    SceneEntity,
    SceneUpdate,
    SpherePrimitive,
    TextPrimitive,
    Timestamp,
    Vector3,
)

from swarmtrack.cameras.field_of_view import outline
from swarmtrack.cameras.priors import OUTLINE_POINTS_PER_SIDE
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose as Placed
from swarmtrack.geometry.rotation import ENU_FROM_NED, to_quaternion
from swarmtrack.messages import (
    MOST_CAMERAS,
    Array,
    IdentifiedTrack,
    RelativeState,
    ScanReport,
    TrackStatus,
)
from swarmtrack.outputs.drawing import ELLIPSE_SIGMAS, name_of
from swarmtrack.outputs.palette import Rgb, colour_of
from swarmtrack.recording.outputs import image_topic
from swarmtrack.recording.writer import Topic
from swarmtrack.relative.read_out import read_out

SCENE = Topic.well_known("/scene", SceneUpdate)
FRAMES = Topic.well_known("/tf", FrameTransforms)
CAMERAS_SCENE = Topic.well_known("/cameras", SceneUpdate)
RAYS = Topic.well_known("/rays", SceneUpdate)
CALIBRATIONS = [
    Topic.well_known(image_topic(k).replace("image", "calibration"), CameraCalibration)
    for k in range(MOST_CAMERAS)
]

# m: of the ball where the teammate is most probably, and least of an ellipsoid's axes.
DRONE_BALL_M, LEAST_ELLIPSOID_M = 0.3, 0.01
# s: what is not said again by then is seen no more.
LIFETIME = Duration(sec=1, nsec=0)
# s between two times that the cameras themselves are said, for who begins to look in the middle.
CAMERAS_S = 1.0
# m: how far the lines around a field of view go, and a ray to who knows how far.
VIEW_M, RAY_M = 1.0, 30.0
LINE_OPACITY = 0.8  # their opacity

Written = tuple[Topic, bytes]


class FoxgloveScene:
    """Scene of one drone. lenses, mountings: of its cameras; body FRD from camera x right, y down, z forward [m]."""

    def __init__(self, drone_id: int, lenses: Sequence[PinholeCamera], mountings: Sequence[Placed]) -> None:
        self._body, self._ned = f"drone-{drone_id}", f"drone-{drone_id}/ned"
        self._names = [camera_frame(drone_id, k) for k in range(len(lenses))]
        self._lenses = lenses
        self._mountings = mountings
        self._told_at = -math.inf

    def of_report(
        self, report: ScanReport, world_from_camera: Placed | None, stamp: Timestamp
    ) -> Iterator[Written]:
        """world_from_camera: of the first camera at the exposure, in the team frame; None where the drone does not
        know."""
        if report.tracks.t - self._told_at >= CAMERAS_S:
            self._told_at = report.tracks.t
            yield from self._cameras(stamp)
        rays = self._rays(report, stamp)
        if rays:
            yield RAYS, SceneUpdate(entities=rays).encode()
        if world_from_camera is not None:
            yield FRAMES, self._frames(world_from_camera, stamp).encode()
        states = [entry.relative for entry in report.tracks.tracks if entry.relative is not None]
        if states:
            entities = [teammate_of(state, self._ned, stamp) for state in states]
            yield SCENE, SceneUpdate(entities=entities).encode()
        for state in states:
            topic = Topic.well_known(f"/teammates/{state.drone_id}", Odometry)
            yield topic, self._odometry(state, stamp).encode()

    def _frames(self, world_from_camera: Placed, stamp: Timestamp) -> FrameTransforms:
        body = world_from_camera @ self._mountings[0].inverse()
        cameras = zip(self._names, self._mountings, strict=True)
        return FrameTransforms(
            transforms=[
                map_from_team(stamp),
                transform("team", self._body, body, stamp),
                *(transform(self._body, name, mounting, stamp) for name, mounting in cameras),
                transform("team", self._ned, Placed(np.eye(3), world_from_camera.position), stamp),
            ]
        )

    def _cameras(self, stamp: Timestamp) -> Iterator[Written]:
        """The lines around what each sees, and their calibrations."""
        views = [view_of(name, lens, stamp) for name, lens in zip(self._names, self._lenses, strict=True)]
        yield CAMERAS_SCENE, SceneUpdate(entities=views).encode()
        for topic, name, lens in zip(CALIBRATIONS, self._names, self._lenses, strict=False):
            yield topic, calibration(lens, name, stamp).encode()

    def _rays(self, report: ScanReport, stamp: Timestamp) -> list[SceneEntity]:
        """To what the camera of the scan tracks, as far as that is away, or just on."""
        camera = report.camera
        return rays_of(report.tracks.tracks, camera, self._lenses[camera], self._names[camera], stamp)

    def _odometry(self, state: RelativeState, stamp: Timestamp) -> Odometry:
        """Its attitude is not known: identity, so that velocities have the team's axes, with zero for its covariance as
        the schema has it."""
        return Odometry(
            timestamp=stamp,
            frame_id=self._ned,
            body_frame_id=f"{self._body}/teammate-{state.drone_id}",
            pose=pose_of(state.position, np.eye(3)),
            linear_velocity=_vector(state.velocity),
            pose_covariance=_padded(state.cov[:3, :3]),
            velocity_covariance=_padded(state.cov[3:, 3:]),
        )


def map_from_team(stamp: Timestamp) -> FrameTransform:
    """The team's axes in those of 3D panels."""
    return transform("map", "team", Placed(ENU_FROM_NED, np.zeros(3)), stamp)


def view_of(frame: str, lens: PinholeCamera, stamp: Timestamp) -> SceneEntity:
    """The lines around what a camera sees, in its frame."""
    border = VIEW_M * outline(lens)
    edges = [point for corner in border[::OUTLINE_POINTS_PER_SIDE] for point in (np.zeros(3), corner)]
    return SceneEntity(
        timestamp=stamp,
        frame_id=frame,
        id=frame,
        lines=[
            _line(LinePrimitiveLineType.LineLoop, border, shade(colour_of(None), LINE_OPACITY)),
            _line(LinePrimitiveLineType.LineList, edges, shade(colour_of(None), LINE_OPACITY)),
        ],
    )


def rays_of(
    entries: Sequence[IdentifiedTrack],
    camera: int,
    lens: PinholeCamera,
    frame: str,
    stamp: Timestamp,
    *,
    owner: str = "",
) -> list[SceneEntity]:
    """To what a camera tracks. owner: begins the entities' names, where several drones share a topic."""
    shown = [
        entry
        for entry in entries
        if entry.track.camera == camera and entry.track.status is not TrackStatus.TENTATIVE
    ]
    pixels = np.array([entry.track.mean[::2] for entry in shown]).reshape(-1, 2)
    return [
        _ray(entry, ray, frame, stamp, owner)
        for entry, ray in zip(shown, lens.bearing_undistorted(pixels), strict=True)
        if np.isfinite(ray).all()
    ]


def _ray(entry: IdentifiedTrack, ray: Array, frame: str, stamp: Timestamp, owner: str) -> SceneEntity:
    state = entry.relative
    far = RAY_M if state is None else float(np.linalg.norm(state.position))
    return SceneEntity(
        timestamp=stamp,
        frame_id=frame,
        id=f"{owner}{entry.track.id}",
        lifetime=LIFETIME,
        lines=[
            _line(
                LinePrimitiveLineType.LineStrip,
                (np.zeros(3), far * ray),
                shade(colour_of(entry.identity), LINE_OPACITY),
            )
        ],
    )


def teammate_of(state: RelativeState, frame: str, stamp: Timestamp, *, owner: str = "") -> SceneEntity:
    """Its ellipsoid with name and distance. frame: the observer's, in the team's axes; owner: as of `rays_of`."""
    colour = colour_of(state.drone_id)
    read = read_out(state.position, state.velocity, state.cov)
    variances, axes = np.linalg.eigh(state.cov[:3, :3])
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    diameters = np.maximum(2.0 * ELLIPSE_SIGMAS * np.sqrt(np.maximum(variances, 0.0)), LEAST_ELLIPSOID_M)
    text = f"{name_of(state.drone_id)} {read.distance:.1f} m ± {read.sigma:.1f}"
    return SceneEntity(
        timestamp=stamp,
        frame_id=frame,
        id=f"{owner}{state.drone_id}",
        lifetime=LIFETIME,
        spheres=[
            SpherePrimitive(
                pose=pose_of(state.position, axes),
                size=_vector(diameters),
                color=shade(colour, 0.3),
            ),
            ball(state.position, colour),
        ],
        texts=[label(state.position, text, colour)],
    )


def ball(position: Array, colour: Rgb) -> SpherePrimitive:
    """Where a drone is."""
    size = Vector3(x=DRONE_BALL_M, y=DRONE_BALL_M, z=DRONE_BALL_M)
    return SpherePrimitive(pose=pose_of(position, np.eye(3)), size=size, color=shade(colour))


def label(position: Array, text: str, colour: Rgb) -> TextPrimitive:
    """Above a drone; position (3,) m, down positive."""
    return TextPrimitive(
        pose=pose_of(position - (0.0, 0.0, 2.0 * DRONE_BALL_M), np.eye(3)),
        billboard=True,
        font_size=14.0,
        scale_invariant=True,
        color=shade(colour),
        text=text,
    )


def camera_frame(drone_id: int, camera: int) -> str:
    """In which a camera's pictures lie; people count cameras from 1."""
    return f"drone-{drone_id}/camera" + (f"-{camera + 1}" if camera else "")


def calibration(lens: PinholeCamera, frame_id: str, stamp: Timestamp) -> CameraCalibration:
    """With which a viewer lays pictures into space."""
    distortion = lens.distortion
    model, coefficients = "plumb_bob", [0.0] * 5
    if distortion is not None:
        coefficients = list(distortion.coefficients)
        if distortion.name == "equidistant":
            model = "kannala_brandt"
        elif len(coefficients) == 8:
            model = "rational_polynomial"
        else:
            coefficients += [0.0] * (5 - len(coefficients))
    return CameraCalibration(
        timestamp=stamp,
        frame_id=frame_id,
        width=lens.width,
        height=lens.height,
        distortion_model=model,
        D=coefficients,
        K=lens.K.ravel().tolist(),
        R=np.eye(3).ravel().tolist(),
        P=np.column_stack([lens.K, np.zeros(3)]).ravel().tolist(),
    )


def _line(kind: LinePrimitiveLineType, points: Sequence[Array] | Array, color: Color) -> LinePrimitive:
    return LinePrimitive(
        type=kind,
        pose=pose_of(np.zeros(3), np.eye(3)),
        thickness=1.0,
        scale_invariant=True,
        points=[Point3(x=x, y=y, z=z) for x, y, z in np.asarray(points).tolist()],
        color=color,
    )


def shade(colour: Rgb, opacity: float = 1.0) -> Color:
    """A colour as Foxglove has it. opacity: 0 … 1."""
    r, g, b = (value / 255 for value in colour)
    return Color(r=r, g=g, b=b, a=opacity)


def transform(parent: str, child: str, parent_from_child: Placed, stamp: Timestamp) -> FrameTransform:
    """Pose of a frame in its parent."""
    return FrameTransform(
        timestamp=stamp,
        parent_frame_id=parent,
        child_frame_id=child,
        translation=_vector(parent_from_child.position),
        rotation=_quaternion(parent_from_child.rotation),
    )


def pose_of(position: Array, rotation: Array) -> Pose:
    """As Foxglove has it."""
    return Pose(position=_vector(position), orientation=_quaternion(rotation))


def _vector(v: Array) -> Vector3:
    x, y, z = v.tolist()
    return Vector3(x=x, y=y, z=z)


def _quaternion(rotation: Array) -> Quaternion:
    w, x, y, z = to_quaternion(rotation).tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def _padded(cov: Array) -> list[float]:
    """(3, 3) -> 36 numbers of (6, 6), zero beyond."""
    whole = np.zeros((6, 6))
    whole[:3, :3] = cov
    return whole.ravel().tolist()
