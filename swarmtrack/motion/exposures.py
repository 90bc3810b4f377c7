"""Scans wait for the gyro, so that what becomes of them does not depend on who arrived first.

A scan is tracked at its exposure, with the camera's turn up to that instant. The gyro's sample that brackets it may
arrive a few milliseconds after the scan does. It is waited for, but no longer than `MAX_WAIT`.
"""

from __future__ import annotations

from collections import deque

from swarmtrack.messages import Detections
from swarmtrack.motion.gyro import GyroHistory
from swarmtrack.motion.time_offset import CameraClock

# s: a gyro that is silent for longer is not waited for.
MAX_WAIT = 0.05


class WaitingScans:
    """In the order in which they arrived."""

    def __init__(self, camera_clock: CameraClock, gyro: GyroHistory) -> None:
        self._camera_clock = camera_clock
        self._gyro = gyro
        self._waiting: deque[Detections] = deque()
        self._first_exposure: float | None = None

    def __len__(self) -> int:
        return len(self._waiting)

    def append(self, detections: Detections) -> None:
        """A scan has arrived."""
        self._waiting.append(detections)

    def pop(self, now: float | None = None) -> tuple[Detections, float] | None:
        """The first scan and its exposure [s, IMU clock], once the gyro has reached it or will not reach it in time.

        now: the time where somebody cannot wait any longer; None: whatever the gyro says is the time.
        """
        if not self._waiting:
            return None
        # Asked once per scan, after the one in front of it was tracked: both teach the camera's clock.
        if self._first_exposure is None:
            self._first_exposure = self._camera_clock.exposure(self._waiting[0].t, self._gyro)
        exposure = self._first_exposure
        newest = self._gyro.newest
        gyro_is_silent = newest is None or newest < exposure - MAX_WAIT
        gave_up = now is not None and now > exposure + MAX_WAIT
        if newest is not None and newest < exposure and not (gyro_is_silent or gave_up):
            return None
        self._first_exposure = None
        return self._waiting.popleft(), exposure
