"""Rotation of a camera from one frame to the next, from images alone.

Corners are tracked by Lucas and Kanade's optical flow, forward and back; those that do not return are left out. The
lens model turns them into bearings, and one rotation takes those of one frame to those of the other (Wahba's problem,
for the rotation alone: near points, which shift when the camera also moves, are outvoted). A few hundred pairs of
corners propose, the rotation with the most inliers is the initial guess, and Cauchy weights refine it.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array, Image
from swarmtrack.motion.hand_eye import Turns

FOLLOWED_CORNERS = 200
LEAST_FOLLOWED_CORNERS = 25  # that agree; with fewer the image says nothing
SPACING = 8.0  # px between corners, in an image 320 px wide
FLOW_WIDTH_PX = 480  # px: larger images are halved until they are about so wide
THERE_AND_BACK = 0.5  # px
PROPOSALS = 100
AGREES = 2.0  # px from where the rotation puts it
LONGEST_FRAME_GAP_S = 0.25  # s between two frames that are compared
FLOW_WINDOW_PX = (21, 21)
LEVELS = 3


class Turn(NamedTuple):
    """Rotation from the frame stamped `start` to that of `end`: vector (3,) rad as in `Turns`; share of corners
    that agree.
    """

    start: float
    end: float
    vector: Array
    agreeing: float


class ImageMotion:
    """Takes frames in order; accumulates the camera's rotations."""

    def __init__(self, camera: PinholeCamera) -> None:
        halvings = max(0, round(np.log2(camera.width / FLOW_WIDTH_PX)))
        self._size = (camera.width >> halvings, camera.height >> halvings)
        self._camera = camera.scaled(*self._size)
        self._rng = np.random.default_rng(0)
        self._last: tuple[float, Image] | None = None
        self.found: list[Turn] = []
        self.frames = 0

    def add_frame(self, t: float, image: Image) -> Turn | None:
        """A frame stamped t, (h, w) or (h, w, 3), of the camera's size. None where no rotation was found."""
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image, np.uint8)
        if grey.shape[::-1] != self._size:
            grey = np.asarray(cv2.resize(grey, self._size, interpolation=cv2.INTER_AREA), np.uint8)
        last, self._last = self._last, (t, grey)
        self.frames += 1
        if last is None or not 0.0 < t - last[0] <= LONGEST_FRAME_GAP_S:
            return None
        turn = self._between(*last, t, grey)
        if turn is not None:
            self.found.append(turn)
        return turn

    def turns(self) -> Turns:
        """All rotations so far. Any thread may call while frames are added."""
        found = self.found.copy()
        return Turns(
            np.array([turn.start for turn in found]),
            np.array([turn.end for turn in found]),
            np.array([turn.vector for turn in found]).reshape(-1, 3),
        )

    def _between(self, start: float, before: Image, end: float, after: Image) -> Turn | None:
        pixels, moved = _followed(before, after)
        if len(pixels) < LEAST_FOLLOWED_CORNERS:
            return None
        b0, b1 = self._camera.bearing(pixels), self._camera.bearing(moved)
        sound = np.isfinite(b0).all(axis=1) & np.isfinite(b1).all(axis=1)
        b0, b1 = b0[sound], b1[sound]
        if len(b0) < LEAST_FOLLOWED_CORNERS:
            return None
        limit = AGREES / self._camera.fx
        R, agreeing = _rotation(b0, b1, limit, self._rng)
        if agreeing.sum() < LEAST_FOLLOWED_CORNERS:
            return None
        return Turn(start, end, rotation.log(R), float(agreeing.mean()))


def _followed(before: Image, after: Image) -> tuple[Array, Array]:
    """Corners (n, 2) px in the one image, and where they are in the other."""
    spacing = SPACING * before.shape[1] / 320.0
    corners = cv2.goodFeaturesToTrack(before, FOLLOWED_CORNERS, 0.01, spacing)
    if corners is None:
        return np.empty((0, 2)), np.empty((0, 2))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        before,
        after,
        corners,
        np.empty_like(corners),
        winSize=FLOW_WINDOW_PX,
        maxLevel=LEVELS,
        criteria=criteria,
    )
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(
        after,
        before,
        there,
        np.empty_like(corners),
        winSize=FLOW_WINDOW_PX,
        maxLevel=LEVELS,
        criteria=criteria,
    )
    apart = np.linalg.norm((corners - back).reshape(-1, 2), axis=1)
    good = (found.ravel() == 1) & (found_back.ravel() == 1) & (apart < THERE_AND_BACK)
    return (
        np.asarray(corners.reshape(-1, 2)[good], dtype=float),
        np.asarray(there.reshape(-1, 2)[good], dtype=float),
    )


def _rotation(
    b0: Array, b1: Array, limit: float, rng: np.random.Generator
) -> tuple[Array, NDArray[np.bool_]]:
    """(3, 3), the earlier camera from the later one, and who agrees. b0, b1 (n, 3): bearings then and now."""
    pairs = rng.integers(0, len(b0), (PROPOSALS, 2))
    proposed = _triad(b0[pairs[:, 0]], b0[pairs[:, 1]]) @ np.swapaxes(
        _triad(b1[pairs[:, 0]], b1[pairs[:, 1]]), 1, 2
    )
    miss = np.linalg.norm(np.einsum("pij,nj->pni", proposed, b1) - b0, axis=2)
    R = proposed[np.nan_to_num(np.minimum(miss, limit), nan=limit).sum(axis=1).argmin()]
    for _ in range(5):
        apart = np.linalg.norm(b1 @ R.T - b0, axis=1)
        agreeing = apart < limit
        scale = max(float(np.median(apart[agreeing])) if agreeing.any() else limit, 1e-9)
        weight = np.where(agreeing, 1.0 / (1.0 + (apart / (2.0 * scale)) ** 2), 0.0)
        U, _, Vt = np.linalg.svd(b0.T @ (weight[:, None] * b1))
        R = U @ np.diag([1.0, 1.0, float(np.sign(np.linalg.det(U @ Vt)))]) @ Vt
    return R, np.linalg.norm(b1 @ R.T - b0, axis=1) < limit


def _triad(a: Array, b: Array) -> Array:
    """Orthonormal axes (n, 3, 3), as columns, that two directions span; NaN where they are one."""
    with np.errstate(invalid="ignore", divide="ignore"):
        normal = np.cross(a, b)
        normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    return np.stack([a, normal, np.cross(a, normal)], axis=2)
