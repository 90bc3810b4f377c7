"""What each reader reads of a drone's perception: one view per reader, with only what it uses.

Nothing of a view changes anything, so it may be read at any time. `Onboard` implements them all; what each member
means is stated there.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Protocol

from swarmtrack.cameras.rig import ExpectedTracks
from swarmtrack.formation.setpoint import OwnFlight
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import (
    Announcement,
    Array,
    MotionReport,
    RelativeState,
    SightingReport,
    StrangerReport,
)
from swarmtrack.motion.carried_place import CarriedPlace
from swarmtrack.motion.ego import AutopilotPlace, TeamPose
from swarmtrack.motion.gyro import Orientation
from swarmtrack.motion.gyro_bias import KnownGyroBias
from swarmtrack.motion.time_offset import OffsetEstimate
from swarmtrack.tracking.consistency import Consistency
from swarmtrack.tracking.noise import MeasuredNoise


@dataclass(slots=True)
class Counters:
    """What Onboard refused, and why; published with the health."""

    late_scans: int = 0
    """Older than the last scan, or than the gyro history."""
    scans_ahead_of_gyro: int = 0
    """Tracked on the gyro's last rate, because it was silent for longer than `MAX_WAIT`."""
    stuck_scans: int = 0
    """The same picture again, although the drone has turned."""
    scans: int = 0
    detections: int = 0
    announcements_refused: int = 0


class ClockView(Protocol):
    """A camera's clock against the gyro's."""

    @property
    def found(self) -> OffsetEstimate | None: ...
    @property
    def used_s(self) -> float: ...


class TrackerView(Protocol):
    """Whether a tracker is as good as it states, and what it has learned of the noise."""

    @property
    def consistency(self) -> Consistency | None: ...
    @property
    def measured_noise(self) -> MeasuredNoise | None: ...


class PerceivedCamera(Protocol):
    """One of the drone's cameras."""

    @property
    def lens(self) -> PinholeCamera: ...
    @property
    def body_from_camera(self) -> Pose: ...
    @property
    def clock(self) -> ClockView: ...
    @property
    def tracker(self) -> TrackerView: ...


class GyroView(Protocol):
    """How the first camera turned."""

    def orientation(self, t: float) -> Orientation: ...


class CamerasView(Protocol):
    """For whoever needs the cameras alone."""

    @property
    def cameras(self) -> Sequence[PerceivedCamera]: ...


class DetectorView(CamerasView, Protocol):
    """For the detector: where it should look, and how the picture has turned."""

    @property
    def gyro(self) -> GyroView: ...

    def expected(self, t: float, camera: int) -> ExpectedTracks: ...


class VideoView(CamerasView, Protocol):
    """For live video: where a frame was exposed."""

    def camera_pose(self, t: float, camera: int = 0) -> Pose | None: ...


class HealthView(CamerasView, Protocol):
    """For health: what is estimated of the sensors, and what is counted."""

    @property
    def gyro_bias(self) -> KnownGyroBias: ...
    @property
    def self_doubt(self) -> bool: ...
    @property
    def carried(self) -> CarriedPlace | None: ...
    @property
    def counters(self) -> Counters: ...
    @property
    def part_counters(self) -> dict[str, int]: ...


class FormationView(Protocol):
    """For a follower: its own flight, and all that it must keep clear of."""

    @property
    def team_from_local(self) -> Array: ...

    def anybody(self, now: float) -> dict[int, RelativeState]: ...
    def own_flight(self, now: float) -> OwnFlight | None: ...


class FeedView(Protocol):
    """For an autopilot that is fed: the drone's place."""

    @property
    def place_for_autopilot(self) -> AutopilotPlace | None: ...


class ReportsView(Protocol):
    """What this drone reports to its team."""

    def sighting_report(self, boot: str, sequence: int) -> SightingReport | None: ...
    def motion_report(self, boot: str, sequence: int) -> MotionReport | None: ...
    def stranger_report(self, boot: str, sequence: int) -> StrangerReport | None: ...


class PilotView(ReportsView, Protocol):
    """For the pilot's notices: how much of the team is seen, and where."""

    @property
    def teammates(self) -> dict[int, Announcement]: ...


class TeamView(CamerasView, ReportsView, Protocol):
    """For teamwork: what is published."""

    def ego_pose(self, t: float) -> TeamPose | None: ...
    def announced_pose(self, t: float) -> TeamPose | None: ...
    def neighbours(self, t: float, needed: Collection[int]) -> frozenset[int] | None: ...


class Perceived(DetectorView, VideoView, HealthView, FormationView, FeedView, PilotView, TeamView, Protocol):
    """All views, for those who hand them on."""

    @property
    def has_waiting(self) -> bool: ...
