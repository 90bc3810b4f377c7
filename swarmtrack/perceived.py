"""What may be read of a drone's perception, by anyone and at any time: nothing of it changes anything.

Whoever gets this instead of `Onboard` has no second way in; what each member says is told there.
"""

from __future__ import annotations

from typing import Protocol

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Announcement, Array, SightingReport, Track
from swarmtrack.motion.ego import TeamPose
from swarmtrack.motion.gyro import GyroHistory
from swarmtrack.motion.gyro_bias import BiasEstimate
from swarmtrack.motion.time_offset import CameraClock
from swarmtrack.onboard import Counters
from swarmtrack.tracking.consistency import Consistency


class Perceived(Protocol):
    """Implemented by `Onboard`."""

    @property
    def camera(self) -> PinholeCamera: ...
    @property
    def camera_clock(self) -> CameraClock: ...
    @property
    def gyro(self) -> GyroHistory: ...
    @property
    def gyro_bias(self) -> BiasEstimate | None: ...
    @property
    def gyro_bias_used(self) -> Array: ...
    @property
    def scan_t(self) -> float | None: ...
    @property
    def has_waiting(self) -> bool: ...
    @property
    def consistency(self) -> Consistency | None: ...
    @property
    def teammates(self) -> dict[int, Announcement]: ...
    @property
    def counters(self) -> Counters: ...
    @property
    def part_counters(self) -> dict[str, int]: ...

    def carried(self, t: float) -> tuple[Track, ...]: ...
    def ego_pose(self, t: float) -> TeamPose | None: ...
    def camera_pose(self, t: float) -> Pose | None: ...
    def sighting_report(self, boot: str, sequence: int) -> SightingReport | None: ...
