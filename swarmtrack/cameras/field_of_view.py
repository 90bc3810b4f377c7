"""Field of view of a camera: the border of its image as directions, for any lens."""

from __future__ import annotations

import math

import numpy as np

from swarmtrack.cameras.priors import BORDER_HALVINGS, OUTLINE_POINTS_PER_SIDE
from swarmtrack.geometry.camera import Mask, PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Array


def outline(camera: PinholeCamera, per_side: int = OUTLINE_POINTS_PER_SIDE) -> Array:
    """Unit vectors (4 · per_side, 3) in the camera frame, once around the picture from its top left corner, clockwise.

    Where the picture goes on beyond the lens model's reach, what is seen ends with that reach.
    """
    left, top, right, bottom = -0.5, -0.5, camera.width - 0.5, camera.height - 0.5
    share = np.arange(per_side) / per_side
    across, down = left + share * (right - left), top + share * (bottom - top)
    border = np.concatenate(
        [
            np.column_stack([across, np.full(per_side, top)]),
            np.column_stack([np.full(per_side, right), down]),
            np.column_stack([right + left - across, np.full(per_side, bottom)]),
            np.column_stack([np.full(per_side, left), bottom + top - down]),
        ]
    )
    return _rays_within_reach(camera, border)


def half_angles(camera: PinholeCamera) -> tuple[float, float]:
    """Half of the width and of the height of what the camera sees, through the middle of its lens [rad]; of a lens
    that does not sit in the middle, half of the whole, and of one outside the picture, through what is nearest
    to it.
    """
    u, v = camera.middle
    right, bottom = camera.width - 0.5, camera.height - 0.5
    ends = np.array([[-0.5, v], [right, v], [u, -0.5], [u, bottom]])
    rays = _rays_within_reach(camera, ends)
    (axis,) = camera.bearing(camera.middle[None])
    angles = np.arctan2(np.linalg.norm(np.cross(axis, rays), axis=1), rays @ axis)
    return 0.5 * float(angles[0] + angles[1]), 0.5 * float(angles[2] + angles[3])


def around(body_from_camera: Pose, rays: Array) -> Array:
    """Directions (n, 3) in the camera frame as (n, 2): to the right of the nose (-π … π) and up [rad]."""
    body = rays @ np.asarray(body_from_camera.rotation).T
    azimuth = np.arctan2(body[:, 1], body[:, 0])
    return np.column_stack([azimuth, np.arctan2(-body[:, 2], np.hypot(body[:, 0], body[:, 1]))])


def outline_around(camera: PinholeCamera, body_from_camera: Pose) -> Array:
    """The border of what a camera sees as (n, 2): right of the nose and up [rad], a closed line that does not jump at
    the back: what lies behind goes on beyond ±π.

    Of a camera that has what is right above or below the drone in view, the line goes around by 2π and closes along
    that pole. Of one that sees both, it runs along both, and in between along what that camera does not see.
    """
    border = around(body_from_camera, outline(camera))
    line = np.vstack([border, border[:1]])
    line[:, 0] = np.unwrap(line[:, 0])
    up, down = _sees(camera, body_from_camera, np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]))
    if up and down:
        ((axis, _),) = around(body_from_camera, np.array([[0.0, 0.0, 1.0]]))
        return _all_but(line[:-1], float(axis))
    if abs(line[-1, 0] - line[0, 0]) < math.pi:
        return line
    pole = 0.5 * math.pi if up else -0.5 * math.pi
    return np.vstack([line, [[line[-1, 0], pole], [line[0, 0], pole], line[0]]])


def _all_but(hole: Array, axis: float) -> Array:
    """All directions from axis - π to axis + π but those within a line (n, 2) around the back, as one closed line."""
    opposite = axis + math.pi
    centred = np.column_stack(
        [opposite + np.remainder(hole[:, 0] - opposite + math.pi, 2.0 * math.pi) - math.pi, hole[:, 1]]
    )
    ring = np.roll(centred, -int(np.argmax(centred[:, 1])), axis=0)
    lowest = int(np.argmin(ring[:, 1]))
    one, other = ring[: lowest + 1], np.vstack([ring[lowest:], ring[:1]])[::-1]
    if one[:, 0].mean() > other[:, 0].mean():
        one, other = other, one
    left, right, top = opposite - 2.0 * math.pi, opposite, 0.5 * math.pi
    frame = np.array([(left, top), (right, top)]), np.array([(right, -top), (left, -top)])
    closing = np.array([(left, top)])
    return np.vstack([frame[0], one, frame[1], other[::-1] - [2.0 * math.pi, 0.0], closing])


def _sees(camera: PinholeCamera, body_from_camera: Pose, directions: Array) -> Mask:
    """Which directions (n, 3) in body axes are in the picture (n,)."""
    pixels, _, valid = camera.project(directions @ np.asarray(body_from_camera.rotation))
    return np.asarray(valid & camera.contains(np.where(valid[:, None], pixels, -1e9)))


def _rays_within_reach(camera: PinholeCamera, border: Array) -> Array:
    """Unit vectors (n, 3) of pixels (n, 2) on the border, or of what is as far towards it from the middle of the lens
    as that sees; all are finite."""
    middle = camera.middle
    whole = _is_seen(camera, border)
    low, high = np.zeros(len(border)), np.ones(len(border))
    for _ in range(BORDER_HALVINGS if not whole.all() else 0):
        half = 0.5 * (low + high)
        seen = _is_seen(camera, middle + half[:, None] * (border - middle))
        low, high = np.where(seen, half, low), np.where(seen, high, half)
    share = np.where(whole, 1.0, low)
    rays = camera.bearing(middle + share[:, None] * (border - middle))
    # A lens that is none, of coefficients in the billions, answers with luck: now it does, now it does not.
    return np.where(np.isfinite(rays), rays, camera.bearing(middle[None]))


def _is_seen(camera: PinholeCamera, pixels: Array) -> Mask:
    return np.asarray(np.isfinite(camera.bearing(pixels)).all(axis=1))
