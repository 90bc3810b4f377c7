"""Teammates in metres for Foxglove's 3D panel and plots: what a drone makes of a scan, and in which frames.

The frames: `map` is east, north, up, as 3D panels want it; `team` is the team's own (north, east, down) in it. Of
drone 1, `drone-1` is its body, `drone-1/camera` its camera, and `drone-1/ned` has its origin there and the team's axes:
in it are its teammates.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from foxglove.messages import (
    Color,
    Duration,
    FrameTransform,
    FrameTransforms,
    Odometry,
    Pose,
    Quaternion,
    SceneEntity,
    SceneUpdate,
    SpherePrimitive,
    TextPrimitive,
    Timestamp,
    Vector3,
)

from swarmtrack.geometry.pose import Pose as Placed
from swarmtrack.geometry.rotation import to_quaternion
from swarmtrack.messages import Array, RelativeState, ScanReport
from swarmtrack.recording.writer import Topic
from swarmtrack.relative.read_out import read_out
from swarmtrack.runtime.palette import colour_of

SCENE = Topic.well_known("/scene", SceneUpdate)
FRAMES = Topic.well_known("/tf", FrameTransforms)

SIGMAS = 3.0
# m: of the ball where the teammate is most probably, and least of an ellipsoid's axes.
BALL, LEAST = 0.3, 0.01
# s: what is not said again by then is seen no more.
LIFETIME = Duration(sec=1, nsec=0)
ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])

Written = tuple[Topic, bytes]


class FoxgloveScene:
    """Of one drone. body_from_camera: body FRD, camera x right, y down, z forward [m]."""

    def __init__(self, drone_id: int, body_from_camera: Placed) -> None:
        self._body, self._ned = f"drone-{drone_id}", f"drone-{drone_id}/ned"
        self._camera = f"drone-{drone_id}/camera"
        self._body_from_camera = body_from_camera

    def of_report(
        self, report: ScanReport, world_from_camera: Placed | None, stamp: Timestamp
    ) -> Iterator[Written]:
        """world_from_camera: at the exposure, in the team frame; None where the drone does not know."""
        if world_from_camera is not None:
            yield FRAMES, self._frames(world_from_camera, stamp).encode()
        states = [entry.relative for entry in report.tracks.tracks if entry.relative is not None]
        if states:
            entities = [self._entity(state, stamp) for state in states]
            yield SCENE, SceneUpdate(entities=entities).encode()
        for state in states:
            topic = Topic.well_known(f"/teammates/{state.drone_id}", Odometry)
            yield topic, self._odometry(state, stamp).encode()

    def _frames(self, world_from_camera: Placed, stamp: Timestamp) -> FrameTransforms:
        body = world_from_camera @ self._body_from_camera.inverse()
        camera = self._body_from_camera
        return FrameTransforms(
            transforms=[
                _transform("map", "team", Placed(ENU_FROM_NED, np.zeros(3)), stamp),
                _transform("team", self._body, body, stamp),
                _transform(self._body, self._camera, camera, stamp),
                _transform("team", self._ned, Placed(np.eye(3), world_from_camera.position), stamp),
            ]
        )

    def _entity(self, state: RelativeState, stamp: Timestamp) -> SceneEntity:
        r, g, b = (value / 255 for value in colour_of(state.drone_id))
        read = read_out(state.position, state.velocity, state.cov)
        variances, axes = np.linalg.eigh(state.cov[:3, :3])
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        diameters = np.maximum(2.0 * SIGMAS * np.sqrt(np.maximum(variances, 0.0)), LEAST)
        label = state.position - (0.0, 0.0, 2.0 * BALL)
        return SceneEntity(
            timestamp=stamp,
            frame_id=self._ned,
            id=str(state.drone_id),
            lifetime=LIFETIME,
            spheres=[
                SpherePrimitive(
                    pose=_pose(state.position, axes),
                    size=_vector(diameters),
                    color=Color(r=r, g=g, b=b, a=0.3),
                ),
                SpherePrimitive(
                    pose=_pose(state.position, np.eye(3)),
                    size=Vector3(x=BALL, y=BALL, z=BALL),
                    color=Color(r=r, g=g, b=b, a=1.0),
                ),
            ],
            texts=[
                TextPrimitive(
                    pose=_pose(label, np.eye(3)),
                    billboard=True,
                    font_size=14.0,
                    scale_invariant=True,
                    color=Color(r=r, g=g, b=b, a=1.0),
                    text=f"{state.drone_id}  {read.distance:.1f} m ± {read.sigma:.1f}",
                )
            ],
        )

    def _odometry(self, state: RelativeState, stamp: Timestamp) -> Odometry:
        """Its attitude is not known: identity, so that velocities have the team's axes, with zero for its covariance as
        the schema has it."""
        return Odometry(
            timestamp=stamp,
            frame_id=self._ned,
            body_frame_id=f"{self._body}/teammate-{state.drone_id}",
            pose=_pose(state.position, np.eye(3)),
            linear_velocity=_vector(state.velocity),
            pose_covariance=_padded(state.cov[:3, :3]),
            velocity_covariance=_padded(state.cov[3:, 3:]),
        )


def _transform(parent: str, child: str, parent_from_child: Placed, stamp: Timestamp) -> FrameTransform:
    return FrameTransform(
        timestamp=stamp,
        parent_frame_id=parent,
        child_frame_id=child,
        translation=_vector(parent_from_child.position),
        rotation=_quaternion(parent_from_child.rotation),
    )


def _pose(position: Array, rotation: Array) -> Pose:
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
