"""Scans wait for the gyro, so that what becomes of them does not depend on who arrived first.

A scan is tracked at its exposure, with the camera's turn up to that instant. The gyro's sample that brackets it may
arrive a few milliseconds after the scan does. It is waited for, but no longer than `GYRO_WAIT_S`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from swarmtrack.messages import Detections
from swarmtrack.motion.gyro import GyroHistory
from swarmtrack.motion.priors import GYRO_WAIT_S
from swarmtrack.motion.time_offset import CameraClock


class WaitingScans:
    """Those of each camera in the order in which they arrived; of all cameras the one first that was exposed first."""

    def __init__(self, camera_clocks: Sequence[CameraClock], gyro: GyroHistory) -> None:
        self._queues = [_Queue(clock, gyro) for clock in camera_clocks]
        self._gyro = gyro

    def __len__(self) -> int:
        return sum(len(queue.waiting) for queue in self._queues)

    def append(self, detections: Detections) -> None:
        """A scan has arrived."""
        self._queues[detections.camera].waiting.append(detections)

    def pop(self, now: float | None = None) -> tuple[Detections, float] | None:
        """The first scan and its exposure [s, IMU clock], once the gyro has reached it or will not reach it in
        time.

        now: the time where the caller cannot wait any longer; None: whatever the gyro says is the time.
        """
        queues = [queue for queue in self._queues if queue.waiting]
        if not queues:
            return None
        queue = min(queues, key=_Queue.exposure)
        exposure = queue.exposure()
        newest = self._gyro.newest
        gyro_is_silent = newest is None or newest < exposure - GYRO_WAIT_S
        gave_up = now is not None and now > exposure + GYRO_WAIT_S
        if newest is not None and newest < exposure and not (gyro_is_silent or gave_up):
            return None
        return queue.pop(), exposure


class _Queue:
    """The scans of one camera that wait."""

    def __init__(self, camera_clock: CameraClock, gyro: GyroHistory) -> None:
        self.waiting: deque[Detections] = deque()
        self._camera_clock = camera_clock
        self._gyro = gyro
        self._exposure: float | None = None

    def exposure(self) -> float:
        """Of the first one. Asked once per scan, after the one in front of it was tracked: both teach the camera's
        clock."""
        if self._exposure is None:
            self._exposure = self._camera_clock.exposure(self.waiting[0].t, self._gyro)
        return self._exposure

    def pop(self) -> Detections:
        self._exposure = None
        return self.waiting.popleft()
