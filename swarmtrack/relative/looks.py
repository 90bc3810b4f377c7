"""What a scan tells of named teammates: rays in team axes, and the range that the width of a box stands for."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Array
from swarmtrack.relative.priors import LEAST_DRONE_SHARE, MOST_ROLL_RAD, WHOLE_BOX_BORDER_PX


class NamedBox(NamedTuple):
    """A teammate as a scan shows it: its name's track, the undistorted pixel z (2,) with R (2, 2) px², and the box's
    size (2,) px; all NaN where it was not detected."""

    drone_id: int
    track_id: int
    z: Array
    R: Array
    size: Array


@dataclass(frozen=True, slots=True, eq=False)
class TeamLook:
    """One scan, at t [s]. camera (3,) m and velocity (3,) m/s: of the own camera along the team's axes; keys: of n
    teammates drone and track; ray (n, 3) and ray_cov (n, 3, 3) in team axes, width (n,) rad without padding; NaN where
    unknown. gain (n,): by how much more, as a share, that width is off than the whole box. walk [m²/s] per axis: by how
    much the variance of the own way since the last scan grows, of a drone that teammates carry."""

    t: float
    camera: Array
    velocity: Array
    keys: tuple[tuple[int, int], ...]
    ray: Array
    ray_cov: Array
    width: Array
    gain: Array
    walk: float = 0.0

    @classmethod
    def of(
        cls,
        t: float,
        boxes: Sequence[NamedBox],
        camera: PinholeCamera,
        team_from_camera: Pose,
        velocity: Array,
        *,
        padding_px: float = 0.0,
        walk: float = 0.0,
    ) -> TeamLook:
        """boxes: of all named tracks, detected or not; padding_px: of their width and height is no drone."""
        z = np.array([box.z for box in boxes]).reshape(-1, 2)
        R = np.array([box.R for box in boxes]).reshape(-1, 2, 2)
        size = np.array([box.size for box in boxes]).reshape(-1, 2)
        rays = camera.bearing_undistorted(z)
        by_place = camera.bearing_by_place(z)
        by_pixel = team_from_camera.rotation @ by_place / np.array([camera.fx, camera.fy])
        return cls(
            t,
            team_from_camera.position,
            velocity,
            tuple((box.drone_id, box.track_id) for box in boxes),
            rays @ team_from_camera.rotation.T,
            by_pixel @ R @ by_pixel.swapaxes(1, 2),
            widths(z, size, camera, team_from_camera.rotation, padding_px),
            gains(size, padding_px),
            walk,
        )

    def without(self, tracks: Collection[int]) -> TeamLook:
        """The same look, but for these tracks."""
        stay = [i for i, key in enumerate(self.keys) if key[1] not in tracks]
        if len(stay) == len(self.keys):
            return self
        return replace(
            self,
            keys=tuple(self.keys[i] for i in stay),
            ray=self.ray[stay],
            ray_cov=self.ray_cov[stay],
            width=self.width[stay],
            gain=self.gain[stay],
        )


def gains(size: Array, padding_px: float) -> Array:
    """(n,): of boxes of size (n, 2) px, their width over what is left of it without the padding; 1 where they are none
    or tell nothing."""
    with np.errstate(invalid="ignore"):
        usable = size[:, 0] - padding_px > LEAST_DRONE_SHARE * size[:, 0]
    return np.asarray(np.where(usable, size[:, 0] / np.where(usable, size[:, 0] - padding_px, 1.0), 1.0))


def widths(
    z: Array, size: Array, camera: PinholeCamera, team_from_camera: Array, padding_px: float = 0.0
) -> Array:
    """(n,) rad: how wide what the boxes of size (n, 2) px at undistorted z (n, 2) are around is, level as seen in the
    world.

    A drone is wider than high, so that the box of a camera that rolls by ρ has sides w² = W² cos² ρ + H² sin² ρ and h²
    = W² sin² ρ + H² cos² ρ, as of an ellipse: turned back, W² = (w² cos² ρ − h² sin² ρ) / cos 2ρ. NaN where the camera
    rolls by more than `MOST_ROLL_RAD`, of a box at the border, which may be cut off, and of one that is nearly all
    padding.
    """
    roll = camera_roll(team_from_camera)
    if abs(roll) > MOST_ROLL_RAD:
        return np.full(len(z), np.nan)
    cosine, sine = math.cos(roll) ** 2, math.sin(roll) ** 2
    with np.errstate(invalid="ignore"):
        drone = size - padding_px
        drone = np.where(drone > LEAST_DRONE_SHARE * size, drone, [[math.nan, 0.0]])
        square = drone[:, 0] ** 2 * cosine - drone[:, 1] ** 2 * sine
        level = np.sqrt(np.where(square > 0.0, square, np.nan) / math.cos(2.0 * roll))
        low, high = camera.frame_bounds
        at = camera.framed(z).at
        whole = (at - 0.5 * size > low + WHOLE_BOX_BORDER_PX).all(axis=1) & (
            at + 0.5 * size < high - WHOLE_BOX_BORDER_PX
        ).all(axis=1)
    edge = np.zeros_like(z)
    edge[:, 0], edge[:, 1] = 0.5 * level * math.cos(roll), -0.5 * level * math.sin(roll)
    left, right = np.split(camera.rays_in_frame(np.concatenate([at - edge, at + edge])), 2)
    apart = 2.0 * np.arcsin(np.minimum(0.5 * np.sqrt(((right - left) ** 2).sum(axis=1)), 1.0))
    return np.asarray(np.where(whole & (apart > 0.0), apart, np.nan))


def camera_roll(team_from_camera: Array) -> float:
    """How far the camera is turned about its axis against the horizon, rad, clockwise as seen along the axis: by that
    much what is level appears turned the other way. Of one that looks straight up or down, 0."""
    down = team_from_camera[2]
    if math.hypot(down[0], down[1]) < 0.1:
        return 0.0
    return math.atan2(down[0], down[1])
