"""How the level frame of one drone stands to that of another: a shift, and a turn about the vertical."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from swarmtrack.geometry import rotation
from swarmtrack.messages import Array


class FrameTransform(NamedTuple):
    """ours_from_theirs: turn rad, clockwise seen from above; shift (3,) m; cov (4, 4) of (shift, turn)."""

    turn: float
    shift: Array
    cov: Array

    def place(self, said: Array) -> tuple[Array, Array]:
        """What it calls said (3,) m, in our frame, and the covariance (3, 3) that the transform's error gives it."""
        moved = self.rotation @ said
        J = np.zeros((3, 4))
        J[:, :3] = np.eye(3)
        J[0, 3], J[1, 3] = -moved[1], moved[0]
        return moved + self.shift, J @ self.cov @ J.T

    @property
    def rotation(self) -> Array:
        """(3, 3)"""
        return rotation.from_euler(0.0, 0.0, self.turn)
