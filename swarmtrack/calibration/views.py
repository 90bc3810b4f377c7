"""Selection of board views, and what is still missing.

A calibration is as good as its views are different: a board in all corners of the image, near and far, tilted to all
sides. Focal length and distance cannot be told apart by boards that face the camera.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from swarmtrack.calibration.board import Seen
from swarmtrack.messages import Array

CELLS = (5, 4)  # of the image
NOVEL = 0.12  # difference in place, size (shares of the image) or tilt (rad) that makes a view another one
STILL_BOARD_SHARE = 0.006  # of the image's width from one frame to the next: more is blurred
TILTED = 0.25  # rad
NEAR_BOARD_SHARE, FAR_BOARD_SHARE = 0.55, 0.35  # of the image's width
ENOUGH_CELLS, ENOUGH_VIEWS, MOST_VIEWS = 0.85, 15, 60
TILTS = ("its left edge", "its right edge", "its upper edge", "its lower edge")


@dataclass(frozen=True, slots=True, eq=False)
class BoardView:
    """A board in one image, and its pose: place (2,) and size as shares of the image, tilt (2,) rad."""

    seen: Seen
    place: Array
    size: float
    tilt: Array

    @property
    def signature(self) -> Array:
        return np.array([*self.place, self.size, *self.tilt])


@dataclass
class BoardViews:
    """The views kept of images of (width, height) px. still: refuse boards that moved since the frame before."""

    size: tuple[int, int]
    still: bool = True
    kept: list[BoardView] = field(default_factory=list)
    boards: int = 0
    _last: Seen | None = None

    def offer(self, seen: Seen | None) -> bool:
        """Add a view if it is useful; returns whether it was."""
        last, self._last = self._last, seen
        if seen is None:
            return False
        self.boards += 1
        if self.still and not self._is_still(last, seen):
            return False
        view = as_view(seen, self.size)
        if len(self.kept) >= MOST_VIEWS or any(
            float(np.abs(view.signature - other.signature).max()) < NOVEL for other in self.kept
        ):
            return False
        self.kept.append(view)
        return True

    def _is_still(self, last: Seen | None, seen: Seen) -> bool:
        if last is None:
            return False
        _, mine, theirs = np.intersect1d(seen.ids, last.ids, return_indices=True)
        if len(mine) < 4:
            return False
        moved = np.linalg.norm(seen.pixels[mine] - last.pixels[theirs], axis=1)
        return float(moved.mean()) < STILL_BOARD_SHARE * self.size[0]

    def cells(self) -> NDArray[np.bool_]:
        """Cells of the image that contained corners: (rows, columns)."""
        return covered([view.seen.pixels for view in self.kept], self.size)

    def missing(self) -> list[str]:
        """The view to show next; empty where all were shown."""
        wanted = []
        cells = self.cells()
        if cells.mean() < ENOUGH_CELLS:
            wanted.append("the board in the empty parts of the picture")
        tilts = np.array([view.tilt for view in self.kept]).reshape(-1, 2)
        sides = (
            (tilts[:, 0] < -TILTED).any(),
            (tilts[:, 0] > TILTED).any(),
            (tilts[:, 1] < -TILTED).any(),
            (tilts[:, 1] > TILTED).any(),
        )
        if absent := [name for name, shown in zip(TILTS, sides, strict=True) if not shown]:
            wanted.append(f"the board tilted with {' or '.join(absent)} towards you")
        sizes = [view.size for view in self.kept]
        if max(sizes, default=0.0) < NEAR_BOARD_SHARE:
            wanted.append("the board near, filling the picture")
        if min(sizes, default=1.0) > FAR_BOARD_SHARE:
            wanted.append("the board farther away")
        if len(self.kept) < ENOUGH_VIEWS:
            wanted.append(f"{ENOUGH_VIEWS - len(self.kept)} more views")
        return wanted

    def picture(self) -> list[str]:
        """Cells of the image as lines of text: filled where there were corners."""
        return ["".join(" ██" if cell else " ··" for cell in row) for row in self.cells()]


def covered(pixels: list[Array], size: tuple[int, int]) -> NDArray[np.bool_]:
    cells = np.zeros(CELLS[::-1], bool)
    for each in pixels:
        place = (each / size * CELLS).astype(int)
        inside = ((place >= 0) & (place < CELLS)).all(axis=1)
        cells[place[inside, 1], place[inside, 0]] = True
    return cells


def as_view(seen: Seen, size: tuple[int, int]) -> BoardView:
    """Tilt (2,) rad, by a guessed lens: above zero where the right edge (x), the lower edge (y) are the nearer ones."""
    width, height = size
    low, high = seen.pixels.min(axis=0), seen.pixels.max(axis=0)
    place = (low + high) / 2.0 / (width, height)
    extent = float(((high - low) / (width, height)).max())
    K = np.array([[0.9 * width, 0.0, width / 2.0], [0.0, 0.9 * width, height / 2.0], [0.0, 0.0, 1.0]])
    tilt = np.zeros(2)
    found, rvec, _ = cv2.solvePnP(seen.points, seen.pixels, K, None, flags=cv2.SOLVEPNP_IPPE)
    if found:
        normal = cv2.Rodrigues(rvec)[0][:, 2]
        normal = normal if normal[2] > 0.0 else -normal
        tilt = np.arctan2(normal[:2], normal[2])
    return BoardView(seen, place, extent, tilt)
