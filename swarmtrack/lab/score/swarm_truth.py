"""Where every drone truly is in an observer's image, fast enough to judge thirty of them ten times a second."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.lab.world.sensors import shown
from swarmtrack.lab.world.world import World
from swarmtrack.messages import Array

# Between two knots the others fly straight on: at 10 m/s² that is 3 mm off at most, of drones metres away.
KNOTS_HZ = 20.0
# s before and after, from whose difference a velocity is taken: no later than a judge has the truth.
TRUTH_STEP_S = 0.5 / KNOTS_HZ


class CarriedCamera(Protocol):
    """One of the cameras that every drone carries."""

    @property
    def lens(self) -> PinholeCamera: ...

    @property
    def body_from_camera(self) -> Pose: ...


class TrueView(NamedTuple):
    """True boxes (4,) [u, v, w, h], centre and size, undistorted px: of drones in view of any camera, and of those
    ahead of one but not in view of any, in the pixels of the first camera for which that holds. cameras: of each
    camera, of all that are ahead of it, seen or not."""

    in_view: dict[int, Array]
    hidden: dict[int, Array]
    cameras: tuple[dict[int, Array], ...]


class SwarmTruth:
    """`simulation.sensors.visible` for every observer of a world, in undistorted pixels, with the hidden ones."""

    def __init__(self, world: World, cameras: Sequence[CarriedCamera]) -> None:
        """cameras: of every observer, in the order in which tracks count them."""
        self._world = world
        self._cameras = tuple(cameras)
        self._drones = list(world.drones)
        self._outlines = np.array([world.airframe(drone_id).outline() for drone_id in self._drones])
        self._knots: dict[int, Array] = {}

    def view(self, observer: int, t: float) -> TrueView:
        """At world time t [s]."""
        eye, world_points = self._world.pose(observer, t), self._points(t)
        views = [self._seen_by(camera, observer, eye, world_points) for camera in self._cameras]
        in_view, ahead = dict[int, Array](), dict[int, Array]()
        for seen, others in views:
            in_view |= {drone_id: box for drone_id, box in seen.items() if drone_id not in in_view}
            ahead |= {drone_id: box for drone_id, box in others.items() if drone_id not in ahead}
        hidden = {drone_id: box for drone_id, box in ahead.items() if drone_id not in in_view}
        return TrueView(in_view, hidden, tuple({**seen, **others} for seen, others in views))

    def _seen_by(
        self, mounted: CarriedCamera, observer: int, eye: Pose, world_points: Array
    ) -> tuple[dict[int, Array], dict[int, Array]]:
        """Boxes by drone, nearest first: of those in view of one camera, and of the others ahead of it. eye: of the
        observer's body."""
        camera = mounted.lens
        camera_from_world = (eye @ mounted.body_from_camera).inverse()
        n, per_drone, _ = world_points.shape
        points = camera_from_world.transform(world_points.reshape(-1, 3))
        pixels, _, valid = camera.project(points)
        pixels = pixels.reshape(n, per_drone, 2)
        ahead = np.asarray(valid.reshape(n, per_drone).all(axis=1))
        distance = np.linalg.norm(points.reshape(n, per_drone, 3).mean(axis=1), axis=1)
        boxes: dict[int, Array] = {}
        for row in np.argsort(distance, kind="stable"):
            if ahead[row] and self._drones[row] != observer:
                low, high = pixels[row].min(axis=0), pixels[row].max(axis=0)
                boxes[self._drones[row]] = np.concatenate([(low + high) / 2.0, high - low])
        in_view = shown(boxes, camera)
        hidden = {drone_id: box for drone_id, box in boxes.items() if drone_id not in in_view}
        return _undistorted(camera, in_view), _undistorted(camera, hidden)

    def relative(self, observer: int, drone_id: int, t: float) -> Array:
        """(6,): a drone's position less that of the observer's first camera [m], and its velocity less the observer's
        [m/s], world frame."""
        camera = self._world.pose(observer, t) @ self._cameras[0].body_from_camera
        before, after = (
            self._world.pose(drone_id, at).position - self._world.pose(observer, at).position
            for at in (t - TRUTH_STEP_S, t + TRUTH_STEP_S)
        )
        away = self._world.pose(drone_id, t).position - camera.position
        return np.concatenate([away, (after - before) / (2.0 * TRUTH_STEP_S)])

    def _points(self, t: float) -> Array:
        """Outlines of all drones at t, (n, points, 3) m, world frame."""
        knot = math.floor(t * KNOTS_HZ)
        share = t * KNOTS_HZ - knot
        return (1.0 - share) * self._at_knot(knot) + share * self._at_knot(knot + 1)

    def _at_knot(self, knot: int) -> Array:
        if knot not in self._knots:
            if len(self._knots) > 64:  # observers run abreast: old ones are not asked for again
                self._knots = {k: points for k, points in self._knots.items() if k >= knot - 32}
            poses = [self._world.pose(drone_id, knot / KNOTS_HZ) for drone_id in self._drones]
            self._knots[knot] = np.array(
                [pose.transform(outline) for pose, outline in zip(poses, self._outlines, strict=True)]
            )
        return self._knots[knot]


def _undistorted(camera: PinholeCamera, boxes: dict[int, Array]) -> dict[int, Array]:
    """The centre moves as a point does; the size stays."""
    if camera.distortion is None or not boxes:
        return boxes
    centres = camera.undistort(np.array([box[:2] for box in boxes.values()]))
    return {
        drone_id: np.concatenate([centre, box[2:]])
        for (drone_id, box), centre in zip(boxes.items(), centres, strict=True)
        if np.isfinite(centre).all()
    }
