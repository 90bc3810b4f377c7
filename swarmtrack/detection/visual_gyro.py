"""Rotation of a camera from one image to the next, by what is far away in both.

Theory of operation. Corners of the earlier image, spread over a grid of cells, are found again in the later one by
pyramidal Lucas-Kanade flow, which starts at the shift of the whole image by phase correlation. The corners are those of
Shi and Tomasi (1994), down to the faint edges of clouds, which are the farthest that there is. As unit vectors, corners
of the distant background differ by one rotation; near ones, drones, and what is burned into the picture do not. The
rotation that most corners share is taken from random pairs of them (RANSAC, Fischler & Bolles, 1981) and refined by
least squares with redescending weights.

The variance is a claim. When the camera also moves, parallax shifts all that is near one way, and part of that is taken
for rotation: by as much as the corners scatter, however many they are. So the rotation is claimed to be known no better
than by one corner. If all is at one distance, as a wall along which the camera flies, nothing scatters, and the shift
is taken for a turn. Where too few corners agree, or in too few cells, as in front of a clear sky, nothing is known: the
variance is that of an unknown angle.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array, Frame, VisualTurn
from swarmtrack.motion.priors import UNKNOWN_ANGLE_VARIANCE_RAD2

# px: of the longer side of the image in which corners are followed; and in which the common shift is sought.
FLOW_IMAGE_PX, SHIFT_IMAGE_PX = 320, 128
# px: of the shorter side of an image that has room for all windows.
FLOW_LEAST_IMAGE_PX = 48
# Cells across and down, and corners of each.
FLOW_CELLS, FLOW_CELL_CORNERS = (8, 6), 3
# Window in which a corner is judged, px of the reduced image, and the least eigenvalue of its gradients by
# `cv2.cornerMinEigenVal`: of 0.7 grey levels per px. The noise of a good sensor makes half of that.
CORNER_WINDOW_PX, CORNER_LEAST_EIGENVALUE = 9, 3e-5
# px of the reduced image: window of the flow, and halvings of it.
FLOW_WINDOW_PX, FLOW_PYRAMID = 15, 3
FLOW_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 12, 0.02)
# Mean difference of a corner's window from where it was found again, over the standard deviation within that window: of
# noise it is 1.1.
CORNER_MOST_DIFFERENCE = 0.6
# Pairs of corners that are tried, and rad: closer ones hardly determine a rotation about their direction.
FLOW_TRIED_PAIRS, FLOW_LEAST_APART_RAD = 48, 0.05
# px of the reduced image: within the first a corner agrees with a rotation, within the second it has its full weight.
FLOW_AGREES_PX, FLOW_SIGMA_PX = 1.0, 0.1
FLOW_ITERATIONS = 7
# Corners and cells that must agree, and the share of all corners.
FLOW_LEAST_CORNERS, FLOW_LEAST_CELLS, FLOW_LEAST_SHARE = 10, 5, 0.5
# Squared distance in the plane that three of four stay below, over the variance per axis: 2 ln 4.
UPPER_QUARTILE_OF_TWO = 2.772588722239781
# px of the reduced image: no flow is better than that.
FLOW_LEAST_SIGMA_PX = 0.02


class _SeenImage(NamedTuple):
    """What is kept of an image: its time, itself at two sizes, its corners (n, 2) px of the reduced image, and the cell
    of each (n,)."""

    t: float
    grey: NDArray[Any]
    small: NDArray[Any]
    corners: NDArray[np.float32]
    cell: NDArray[np.intp]


class VisualGyro:
    """The rotation of one camera, from image to image."""

    def __init__(self, lens: PinholeCamera) -> None:
        self._lens = lens
        self._last: _SeenImage | None = None
        self._window: NDArray[Any] | None = None

    def turn_to(self, frame: Frame) -> VisualTurn | None:
        """From the frame before to this one; None for the first one, for one that is no image, or where the clock or
        the size has jumped."""
        usable = (
            frame.image.dtype == np.uint8 and min(frame.image.shape[:2], default=0) >= FLOW_LEAST_IMAGE_PX
        )
        last, now = self._last, self._seen(frame) if usable else None
        self._last = now
        if last is None or now is None or now.t <= last.t or last.grey.shape != now.grey.shape:
            return None
        return self._between(last, now, frame.image.shape[1] / now.grey.shape[1])

    def _seen(self, frame: Frame) -> _SeenImage:
        image: NDArray[Any] = frame.image
        height, width = image.shape[:2]
        scale = min(FLOW_IMAGE_PX / max(height, width), 1.0)
        if scale < 1.0:
            image = cv2.resize(
                image, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA
            )
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 and image.shape[2] > 1 else image
        grey = np.ascontiguousarray(grey.reshape(grey.shape[:2]), np.uint8)
        least = min(SHIFT_IMAGE_PX / max(grey.shape), 1.0)
        size = round(grey.shape[1] * least), round(grey.shape[0] * least)
        small: NDArray[Any] = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        corners, cell = _corners(grey)
        return _SeenImage(frame.t, grey, small, corners, cell)

    def _between(self, then: _SeenImage, now: _SeenImage, enlarged: float) -> VisualTurn:
        unknown = VisualTurn(then.t, now.t, np.zeros(3), UNKNOWN_ANGLE_VARIANCE_RAD2)
        if len(then.corners) < FLOW_LEAST_CORNERS:
            return unknown
        found, good = self._followed(then, now)
        if good.sum() < FLOW_LEAST_CORNERS:
            return unknown
        one, other = then.corners[good], found[good]
        rays, rays_now = (
            self._lens.bearing((p.astype(np.float64) + 0.5) * enlarged - 0.5) for p in (one, other)
        )
        sound = np.isfinite(rays).all(axis=1) & np.isfinite(rays_now).all(axis=1)
        focal = np.sqrt(self._lens.fx * self._lens.fy) / enlarged
        fitted = common_rotation(rays[sound], rays_now[sound], then.cell[good][sound], focal)
        return unknown if fitted is None else VisualTurn(then.t, now.t, *fitted)

    def _followed(self, then: _SeenImage, now: _SeenImage) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Where the corners (n, 2) are now, and which (n,) were found."""
        if self._window is None or self._window.shape != then.small.shape:
            self._window = cv2.createHanningWindow(then.small.shape[::-1], cv2.CV_32F)
        shift, _ = cv2.phaseCorrelate(then.small, now.small, self._window)
        enlarged = then.grey.shape[1] / then.small.shape[1]
        start = then.corners + enlarged * np.array(shift, np.float32)
        there, status, difference = cv2.calcOpticalFlowPyrLK(
            then.grey,
            now.grey,
            then.corners[:, None],
            start[:, None].astype(np.float32),
            winSize=(FLOW_WINDOW_PX, FLOW_WINDOW_PX),
            maxLevel=FLOW_PYRAMID,
            criteria=FLOW_STOP,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        found: NDArray[np.float32] = there[:, 0].astype(np.float32)
        inside = ((found >= 0) & (found <= np.array(now.grey.shape[::-1]) - 1)).all(axis=1)
        with np.errstate(invalid="ignore"):  # of those that were not found it is anything
            same = difference[:, 0] < CORNER_MOST_DIFFERENCE * _contrast(then.grey, then.corners)
        return found, (status[:, 0] > 0) & inside & same


def _corners(grey: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """The clearest of each cell (n, 2) px, and the cells (n,)."""
    window = CORNER_WINDOW_PX
    clearness = cv2.cornerMinEigenVal(grey, window, ksize=3)
    inner = np.zeros_like(clearness)
    within = slice(window, -window), slice(window, -window)
    inner[within] = clearness[within]
    highest = cv2.dilate(inner, np.ones((window, window), np.uint8))
    v, u = np.nonzero((inner == highest) & (inner > CORNER_LEAST_EIGENVALUE))
    (columns, rows), (height, width) = FLOW_CELLS, grey.shape
    cell = u * columns // width + columns * (v * rows // height)
    order = np.lexsort((-inner[v, u], cell))
    cell = cell[order]
    clearest = np.arange(len(cell)) - np.searchsorted(cell, cell) < FLOW_CELL_CORNERS
    corners = np.stack([u, v], axis=1)[order][clearest]
    return corners.astype(np.float32), cell[clearest]


def _contrast(grey: NDArray[Any], corners: NDArray[np.float32]) -> Array:
    """(n,) grey levels, standard deviation of the window around each corner (n, 2) px."""
    u, v = corners.astype(np.intp).T - FLOW_WINDOW_PX // 2
    windows = np.lib.stride_tricks.sliding_window_view(grey, (FLOW_WINDOW_PX, FLOW_WINDOW_PX))[v, u]
    return np.asarray(windows.reshape(len(u), -1).std(axis=1))


def common_rotation(
    then: Array, now: Array, cell: NDArray[np.intp], focal_px: float
) -> tuple[Array, float] | None:
    """Rotation vector (3,) rad of a camera that sees directions (n, 3) at other places (n, 3), by most of them, and its
    variance per axis, rad²; None where too few agree. cell (n,): where each was seen; focal_px: of the image in which
    they were followed.
    """
    scale = FLOW_AGREES_PX / focal_px
    R = _most_common(then, now, scale)
    if R is None:
        return None
    for _ in range(FLOW_ITERATIONS):
        scale = max(0.5 * scale, FLOW_SIGMA_PX / focal_px)
        turned = then @ R.T
        error = now - turned
        weight = 1.0 / (1.0 + (error**2).sum(axis=1) / scale**2) ** 2
        # d (exp(φ) b) / dφ = −[b]×, so the normal equations are Σ w (I − b bᵀ) φ = Σ w b × e.
        normal = weight.sum() * np.eye(3) - (turned * weight[:, None]).T @ turned
        R = rotation.exp(np.linalg.solve(normal, weight @ np.cross(turned, error))) @ R
    squared = ((now - then @ R.T) ** 2).sum(axis=1)
    agreeing = squared < (FLOW_AGREES_PX / focal_px) ** 2
    enough = agreeing.sum() >= max(FLOW_LEAST_CORNERS, FLOW_LEAST_SHARE * len(then))
    if not enough or len(np.unique(cell[agreeing])) < FLOW_LEAST_CELLS:
        return None
    variance = float(np.quantile(squared, 0.75)) / UPPER_QUARTILE_OF_TWO
    return -rotation.log(R), max(variance, (FLOW_LEAST_SIGMA_PX / focal_px) ** 2)


def _most_common(then: Array, now: Array, agrees: float) -> Array | None:
    """(3, 3) that most of the directions share, by pairs of them; None where no pair determines one."""
    n = len(then)
    if n < 2:
        return None
    i, j = np.random.default_rng(n).integers(n, size=(2, FLOW_TRIED_PAIRS))
    (one, apart), (other, apart_now) = (_axes_of_pairs(rays[i], rays[j]) for rays in (then, now))
    usable = np.minimum(apart, apart_now) > FLOW_LEAST_APART_RAD
    if not usable.any():
        return None
    R = other[usable] @ one[usable].transpose(0, 2, 1)
    error = (then @ R.transpose(0, 2, 1) - now) / agrees
    votes = 1.0 / (1.0 + (error**2).sum(axis=2))
    return np.asarray(R[votes.sum(axis=1).argmax()])


def _axes_of_pairs(one: Array, other: Array) -> tuple[Array, Array]:
    """Orthogonal axes (k, 3, 3) in columns, of k pairs of directions (k, 3), and the sine (k,) between these."""
    across = np.cross(one, other)
    sine = np.linalg.norm(across, axis=1)
    across = across / np.maximum(sine, 1e-12)[:, None]
    return np.stack([one, across, np.cross(one, across)], axis=2), sine
