"""Two families of axes: the project's own, and those of ROS (REP 103)."""

from __future__ import annotations

import enum

import numpy as np

from swarmtrack.geometry.rotation import ENU_FROM_NED
from swarmtrack.messages import Array


class Axes(enum.Enum):
    """Axes of the world and the body of a drone. A camera's are always x right, y down, z forward."""

    NED = "ned"
    """World north, east, down; body forward, right, down (FRD)."""
    ENU = "enu"
    """World east, north, up; body forward, left, up (FLU)."""

    @property
    def world_from_ned(self) -> Array:
        """Rotation matrix (3, 3)."""
        return np.eye(3) if self is Axes.NED else ENU_FROM_NED

    @property
    def body_from_frd(self) -> Array:
        """Rotation matrix (3, 3)."""
        return np.eye(3) if self is Axes.NED else _FLU_FROM_FRD


_FLU_FROM_FRD: Array = np.diag([1.0, -1.0, -1.0])
