"""Rotation of a camera over many frames, from images alone (`detection/visual_gyro.py`)."""

from __future__ import annotations

import numpy as np

from swarmtrack.detection.visual_gyro import VisualGyro
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Frame, Image, StampKind, VisualTurn
from swarmtrack.motion.hand_eye import Turns

LONGEST_FRAME_GAP_S = 0.25  # s between two frames that are compared
UNSURE_TURN_PX = 2.0  # px: a rotation that is known no better is none


class ImageMotion:
    """Takes frames in order; accumulates the camera's rotations."""

    def __init__(self, camera: PinholeCamera) -> None:
        self._gyro = VisualGyro(camera)
        self._unsure = (UNSURE_TURN_PX / camera.fx) ** 2
        self.found: list[VisualTurn] = []
        self.frames = 0

    def add_frame(self, t: float, image: Image) -> VisualTurn | None:
        """A frame stamped t, (h, w) or (h, w, 3), of the camera's size. None where no rotation was found."""
        self.frames += 1
        turn = self._gyro.turn_to(Frame(t, 0.0, self.frames, image, StampKind.EXPOSURE))
        if turn is None or turn.t - turn.since > LONGEST_FRAME_GAP_S or turn.variance > self._unsure:
            return None
        self.found.append(turn)
        return turn

    def turns(self) -> Turns:
        """All rotations so far. Any thread may call while frames are added."""
        found = self.found.copy()
        return Turns(
            np.array([turn.since for turn in found]),
            np.array([turn.t for turn in found]),
            np.array([turn.turn for turn in found]).reshape(-1, 3),
        )
