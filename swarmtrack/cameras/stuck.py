"""Cameras whose image no longer changes: frozen, although the drone turns or time passes.

No camera that works returns the same boxes twice to the last bit. A scan that does, although the camera has turned
since, is not of now. Without a turn it may be chance, but not for long.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarmtrack.cameras.priors import STUCK_AFTER_S, STUCK_LEAST_TURN_RAD
from swarmtrack.geometry import rotation
from swarmtrack.messages import Detections
from swarmtrack.motion.gyro import Orientation, rotation_between


class _Picture(NamedTuple):
    """What a camera detected, and how the first camera was turned then."""

    detections: Detections
    orientation: Orientation


class StuckCameras:
    """The last scan of each camera that differed from the one before. An `orientation` is that of the first camera."""

    def __init__(self, count: int) -> None:
        """count: of the drone's cameras."""
        self._pictures: dict[int, _Picture] = {}
        self._changed_t = [-math.inf] * count

    def is_stuck(self, detections: Detections, orientation: Orientation) -> bool:
        """Whether a camera shows what it did although it has turned since: then this is no picture of now."""
        before = self._pictures.get(detections.camera)
        if before is None or not _is_same(before.detections, detections):
            return False
        turned = rotation.log(rotation_between(before.orientation, orientation).matrix)
        return bool(np.linalg.norm(turned) > STUCK_LEAST_TURN_RAD)

    def add_scan(
        self, detections: Detections, t: float, orientation: Orientation, *, is_mounted: bool
    ) -> None:
        """A scan exposed at t [s] that was not stuck. is_mounted: the camera is mounted as configured; a scan of one
        that is not shows nothing new."""
        before = self._pictures.get(detections.camera)
        if before is None or not _is_same(before.detections, detections):
            self._pictures[detections.camera] = _Picture(detections, orientation)
            if is_mounted:
                self._changed_t[detections.camera] = t

    def is_live(self, camera: int, t: float) -> bool:
        """Whether a camera's picture has changed shortly before t [s]."""
        return t - self._changed_t[camera] < STUCK_AFTER_S

    def ages(self, now: float) -> tuple[float, ...]:
        """By camera, s since the exposure of its newest scan that showed anything new; inf where there was none."""
        return tuple(now - changed for changed in self._changed_t)


def _is_same(before: Detections, now: Detections) -> bool:
    """Whether both show the same boxes to the last bit, and any."""
    pairs = ((before.centre, now.centre), (before.size, now.size), (before.score, now.score))
    return len(now) > 0 and all(np.array_equal(*pair) for pair in pairs)
