"""Where every drone truly is in an observer's image, fast enough to judge thirty of them ten times a second."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Array
from swarmtrack.simulation.sensors import shown
from swarmtrack.simulation.world import World

# Between two knots the others fly straight on: at 10 m/s² that is 3 mm off at most, of drones metres away.
KNOTS_HZ = 20.0
# s before and after, from whose difference a velocity is taken: no later than a judge has the truth.
STEP_S = 0.5 / KNOTS_HZ


class TrueView(NamedTuple):
    """True boxes (4,) [u, v, w, h], centre and size, undistorted px: of drones in view, and of those ahead but not."""

    in_view: dict[int, Array]
    hidden: dict[int, Array]


class SwarmTruth:
    """`simulation.sensors.visible` for every observer of a world, in undistorted pixels, with the hidden ones."""

    def __init__(self, world: World, camera: PinholeCamera, body_from_camera: Pose) -> None:
        self._world = world
        self._camera = camera
        self._body_from_camera = body_from_camera
        self._drones = list(world.drones)
        self._outlines = np.array([world.airframe(drone_id).outline() for drone_id in self._drones])
        self._knots: dict[int, Array] = {}

    def view(self, observer: int, t: float) -> TrueView:
        """At world time t [s]."""
        camera = self._camera
        camera_from_world = (self._world.pose(observer, t) @ self._body_from_camera).inverse()
        world_points = self._points(t)
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
        return TrueView(self._undistorted(in_view), self._undistorted(hidden))

    def relative(self, observer: int, drone_id: int, t: float) -> Array:
        """(6,): a drone's position less that of the observer's camera [m], and its velocity less the observer's [m/s],
        world frame."""
        camera = self._world.pose(observer, t) @ self._body_from_camera
        before, after = (
            self._world.pose(drone_id, at).position - self._world.pose(observer, at).position
            for at in (t - STEP_S, t + STEP_S)
        )
        away = self._world.pose(drone_id, t).position - camera.position
        return np.concatenate([away, (after - before) / (2.0 * STEP_S)])

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

    def _undistorted(self, boxes: dict[int, Array]) -> dict[int, Array]:
        """The centre moves as a point does; the size stays."""
        if self._camera.distortion is None or not boxes:
            return boxes
        centres = self._camera.undistort(np.array([box[:2] for box in boxes.values()]))
        return {
            drone_id: np.concatenate([centre, box[2:]])
            for (drone_id, box), centre in zip(boxes.items(), centres, strict=True)
            if np.isfinite(centre).all()
        }
