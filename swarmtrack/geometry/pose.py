"""Pose of one frame in another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from swarmtrack.geometry.rotation import is_rotation
from swarmtrack.messages import Array


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """`a_from_b`: rotation (3, 3), and position (3,) [m] of b's origin in a.

    So `world_from_body @ body_from_camera` is `world_from_camera`.
    """

    rotation: Array
    position: Array

    def __post_init__(self) -> None:
        # In one order: products of the same numbers then round alike, also where they were written and read.
        object.__setattr__(self, "rotation", np.ascontiguousarray(self.rotation, dtype=float))
        object.__setattr__(self, "position", np.ascontiguousarray(self.position, dtype=float))
        if not is_rotation(self.rotation, tolerance=1e-6):
            raise ValueError("Pose.rotation: not orthonormal with determinant +1, expected a (3, 3) rotation")
        if self.position.shape != (3,) or not np.isfinite(self.position).all():
            raise ValueError(f"Pose.position: {self.position}, expected 3 finite numbers [m]")

    @classmethod
    def identity(cls) -> Pose:
        return cls(np.eye(3), np.zeros(3))

    def __matmul__(self, other: Pose) -> Pose:
        """a_from_b @ b_from_c = a_from_c."""
        return _sound(self.rotation @ other.rotation, self.rotation @ other.position + self.position)

    def inverse(self) -> Pose:
        """b_from_a."""
        return _sound(self.rotation.T.copy(), -self.rotation.T @ self.position)

    def transform(self, points: Array) -> Array:
        """Coordinates in b to coordinates in a. points (n, 3) m -> (n, 3) m."""
        return np.asarray(points, dtype=float) @ self.rotation.T + self.position


def _sound(rotation: Array, position: Array) -> Pose:
    """Made of sound poses, arrays in C order: needs no check, which costs as much as all else."""
    pose = object.__new__(Pose)
    object.__setattr__(pose, "rotation", rotation)
    object.__setattr__(pose, "position", position)
    return pose
