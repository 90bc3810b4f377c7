"""The motion model as a tracker's parameters set it, for one camera."""

from __future__ import annotations

import math
from functools import partial

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array
from swarmtrack.tracking.motion_model import Course, propagate, turn_by_flow, turn_exactly
from swarmtrack.tracking.parameters import CommonParameters

TURNS = {"default": turn_exactly, "paper": turn_by_flow}


class TargetMotion:
    """Constant velocity, disturbed by white acceleration; and the camera's turn."""

    def __init__(self, camera: PinholeCamera, parameters: CommonParameters) -> None:
        self._psd = parameters.acceleration_psd
        turn = TURNS[parameters.profile]
        self._propagate = partial(propagate, camera=camera, turn=turn)
        self._course = partial(Course, psd=self._psd, camera=camera, turn=turn)

    def course(self, mean: Array, cov: Array) -> Course:
        """Where means (n, 4) and covariances (n, 4, 4) go, to be asked for many times."""
        return self._course(mean, cov)

    def carried(
        self, mean: Array, cov: Array, dt: float, rotation: Array | None, rotation_variance: float
    ) -> tuple[Array, Array]:
        """Means (n, 4) and covariances (n, 4, 4) dt seconds later; rotation, rotation_variance: see `propagate`."""
        return self._propagate(
            mean, cov, dt, psd=self._psd, rotation=rotation, rotation_variance=rotation_variance
        )

    def handed_over(
        self, mean: Array, cov: Array, dt: float, rotation: Array | None, rotation_variance: float
    ) -> tuple[Array, Array]:
        """As `carried`; but where dt is negative nothing gets more certain: who looks back knows as little as who looks
        ahead."""
        psd = math.copysign(self._psd, dt)
        return self._propagate(mean, cov, dt, psd=psd, rotation=rotation, rotation_variance=rotation_variance)
