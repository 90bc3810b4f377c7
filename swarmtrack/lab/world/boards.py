"""A board for calibrations as a camera sees it: the truth for intrinsics."""

from __future__ import annotations

import cv2
import numpy as np

from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Array, Image

FINER = 2  # times: pixels are averaged of so many, each way
WALL = 105.0  # grey level behind the board
BOARD_BORDER_SQUARES = 0.5  # squares of white paper around it


class BoardScene:
    """A flat picture of `square_px` a square, drawn on paper, before a grey wall."""

    def __init__(self, picture: Image, square_px: int, square_m: float, camera: PinholeCamera) -> None:
        border = round(BOARD_BORDER_SQUARES * square_px)
        paper = cv2.copyMakeBorder(
            picture, border, border, border, border, cv2.BORDER_CONSTANT, value=[255.0]
        )
        self._paper = np.asarray(cv2.GaussianBlur(paper, (0, 0), square_px / 40.0), np.uint8)
        self._border, self._px_per_m = border, square_px / square_m
        self._camera = camera
        fine = camera.scaled(FINER * camera.width, FINER * camera.height)
        u, v = np.meshgrid(np.arange(fine.width), np.arange(fine.height))
        self._rays = fine.bearing(np.stack([u.ravel(), v.ravel()], axis=1).astype(float)).astype(np.float32)
        self._shape = (fine.height, fine.width)

    def image(self, camera_from_board: Pose, rng: np.random.Generator, noise: float = 2.0) -> Image:
        """(h, w) grey with noise of so many grey levels. Board: x right, y down from its upper left corner, z = 0."""
        eye = camera_from_board.inverse()
        rays = self._rays @ eye.rotation.T.astype(np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            far = -np.float32(eye.position[2]) / rays[:, 2]
            x, y = (np.float32(eye.position[i]) + far * rays[:, i] for i in (0, 1))
        # A texel's middle is an integer, the board's corner lies half a texel before it.
        columns, rows = (
            np.where(far > 0.0, each * self._px_per_m - 0.5 + self._border, -1e4).reshape(self._shape)
            for each in (x, y)
        )
        columns, rows = (np.nan_to_num(each, nan=-1e4).astype(np.float32) for each in (columns, rows))
        seen = cv2.remap(
            self._paper, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=[WALL]
        )
        size = (self._camera.width, self._camera.height)
        image = cv2.resize(seen, size, interpolation=cv2.INTER_AREA).astype(float)
        # Not all of the contrast there is: a sensor saturates at neither end.
        image = 25.0 + 0.8 * image + rng.normal(0.0, noise, image.shape)
        return np.asarray(np.clip(np.rint(image), 0, 255), np.uint8)


def board_poses(
    rng: np.random.Generator, camera: PinholeCamera, size_m: tuple[float, float], count: int
) -> list[Pose]:
    """camera_from_board of a board that somebody shows in all parts of the image, near, far and tilted."""
    poses = []
    for k in range(count):
        cell = np.array([k % 4, (k // 4) % 3])
        share = (cell + rng.uniform(0.2, 0.8, 2)) / (4, 3)
        fill = (0.35, 0.5, 0.7, 0.9)[k % 4] * rng.uniform(0.85, 1.1)
        distance = camera.fx * size_m[0] / (fill * camera.width)
        pixel = np.array([[camera.width, camera.height]]) * (0.5 + (share - 0.5) * (1.15 - 0.55 * fill))
        ray = camera.bearing(pixel)[0]
        if not np.isfinite(ray).all():
            ray = np.array([0.0, 0.0, 1.0])
        R = rotation.exp([*rng.uniform(-0.65, 0.65, 2), rng.uniform(-0.4, 0.4)])
        middle: Array = np.array([size_m[0] / 2.0, size_m[1] / 2.0, 0.0])
        poses.append(Pose(R, ray * distance - R @ middle))
    return poses
