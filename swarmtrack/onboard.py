"""All perception state of one drone.

Theory of operation. The gyro history grows by every IMU sample. The tracker stands at the exposure of the last scan;
the next scan moves it from exposure to exposure by the gyro's rotation between the two. A scan whose exposure the
gyro has not reached yet waits for the sample that brackets it (a few milliseconds, at most `MAX_WAIT`), so that its
result never depends on who arrived first. What holds *now* is that state carried on by the gyro, without being
committed.

The camera's clock and the gyro's bias are learned on the way (`motion/time_offset.py`, `motion/gyro_bias.py`) and used
once they are known well enough. Both are functions of the stamps, so that here too nothing depends on who came first.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.identity.consensus import Consensus, Disagreement, OwnView
from swarmtrack.identity.identities import Identities
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.messages import (
    Announcement,
    Array,
    Detections,
    EgoPose,
    ImuSample,
    Membership,
    Scan,
    SightingReport,
    Track,
    TrackList,
)
from swarmtrack.motion.ego import EgoHistory, TeamPose
from swarmtrack.motion.gyro import GyroHistory, Orientation, rotation_between
from swarmtrack.motion.gyro_bias import BiasEstimate, GyroBias
from swarmtrack.motion.time_offset import CameraClock
from swarmtrack.tracking.base import Tracker
from swarmtrack.tracking.consistency import Consistency

MAX_WAIT = 0.05  # s: a gyro that is silent for longer is not waited for
MAX_SILENCE = 1.0  # s that a scan may stay away beyond the history: by then a target may be anywhere


class ScanReport(NamedTuple):
    """What came of one scan: its frame's sequence number, and the tracks at its exposure."""

    sequence: int
    tracks: TrackList


@dataclass(slots=True)
class Counters:
    """What Onboard refused, and why; published with the health."""

    late_scans: int = 0
    """Older than the last scan, or than the gyro history."""
    scans_ahead_of_gyro: int = 0
    """Tracked on the gyro's last rate, because it was silent for longer than `MAX_WAIT`."""
    scans: int = 0
    detections: int = 0
    announcements_refused: int = 0
    identities_overruled: int = 0
    """Given up because other observers see that drone elsewhere."""


@dataclass(slots=True)
class Mounting:
    """How the camera sits on the drone, and its clock: exposure on the IMU's clock = stamp + time_offset_s.

    estimate_time_offset: find the offset in flight; `time_offset_s` is then where the search begins.
    """

    body_from_camera: Pose
    time_offset_s: float = 0.0
    estimate_time_offset: bool = True
    camera_from_body: Array = field(init=False)

    def __post_init__(self) -> None:
        self.camera_from_body = self.body_from_camera.rotation.T


class Onboard:
    """Told what happened; never asks, waits or sends."""

    def __init__(
        self,
        drone_id: int,
        *,
        camera: PinholeCamera,
        mounting: Mounting,
        tracker: Tracker,
        gyro: GyroHistory,
        ego: EgoHistory,
        identity: IdentityParameters,
        estimate_gyro_bias: bool = True,
    ) -> None:
        """estimate_gyro_bias: from the autopilot's attitudes; that of `gyro` is where it begins."""
        self.counters = Counters()
        self.gyro = gyro
        self.camera_clock = CameraClock(mounting.time_offset_s, estimates=mounting.estimate_time_offset)
        self._bias = GyroBias(gyro, estimates=estimate_gyro_bias)
        self.camera = camera
        self._mounting = mounting
        self._tracker = tracker
        self._ego = ego
        self._identities = Identities(
            drone_id, camera=camera, body_from_camera=mounting.body_from_camera, parameters=identity
        )
        self._drone_id = drone_id
        self._consensus = Consensus()
        self._view: OwnView | None = None
        self._disagreements: list[Disagreement] = []
        self._orientation: Orientation | None = None  # of the camera at the tracker's time
        self._waiting: deque[Detections] = deque()
        self._next_exposure: float | None = None  # of the first that waits
        self._reports: list[ScanReport] = []

    def on_imu(self, sample: ImuSample) -> None:
        """One gyro sample."""
        x, y, z = (self._mounting.camera_from_body @ sample.gyro).tolist()
        self.gyro.append(sample.t, (x, y, z))
        self._bias.settle()
        self._settle()

    def on_pose(self, pose: EgoPose) -> None:
        """Where this drone is, by its autopilot."""
        self._ego.append(pose)
        attitude = pose.world_from_body @ self._mounting.body_from_camera.rotation
        self._bias.see(pose.t, attitude, pose.attitude_sigma)

    def on_autopilot_reboot(self) -> None:
        """Its clock and its frame begin anew; the drone itself is where it was."""
        self._ego.restart()
        self._bias.restart()

    def on_detections(self, detections: Detections) -> None:
        """What the detector saw in one frame, however long ago it was exposed."""
        self._waiting.append(detections)
        self._settle()

    def on_announcement(self, announcement: Announcement) -> None:
        """A teammate's ID and initial pose."""
        if not self._identities.announce(announcement):
            self.counters.announcements_refused += 1

    def on_membership(self, event: Membership) -> None:
        """Who lives. While two processes speak as one drone, nobody is identified as it."""
        self._identities.on_membership(event)

    def on_sightings(self, report: SightingReport) -> None:
        """Whom a teammate sees, and where it stands: do we see the same?"""
        for disagreement in self._consensus.compare(report):
            self._disagreements.append(disagreement)
            if disagreement.overruled:
                drone = disagreement.drone_id
                self.counters.identities_overruled += 1
                self._consensus.forget(drone)
                self._identities.overrule(drone, report.t)

    def sighting_report(self, boot: str, sequence: int) -> SightingReport | None:
        """Whom this drone saw in its last scan; None where it does not know where it stands."""
        view = self._view
        if view is None:
            return None
        return view.report(self._drone_id, boot, sequence, self._identities.announced)

    def take_wanted(self) -> tuple[int, ...]:
        """The drones whose pose is wanted anew; each is told once."""
        return self._identities.take_wanted()

    def take_disagreements(self) -> list[Disagreement]:
        """What others see differently, since the last call."""
        found, self._disagreements = self._disagreements, []
        return found

    def tracks(self, now: float) -> TrackList:
        """Everything tracked, carried on to now; nothing once the scans have stayed away for too long."""
        self._settle(now)
        if self._tracker.t is None:
            return TrackList(now, now, ())
        if now - self._tracker.t > self.gyro.history_s + MAX_SILENCE:
            return TrackList(now, self._tracker.t, ())
        return TrackList(now, self._tracker.t, self._identities.label(self.carried(now)))

    def carried(self, t: float) -> tuple[Track, ...]:
        """The tracks of the last scan, carried on by the gyro to t; no scan that waits is looked at."""
        if self._tracker.t is None or self._orientation is None:
            return ()
        turn = rotation_between(self._orientation, self.gyro.orientation(t))
        return self._tracker.at(t, turn.matrix, turn.variance)

    def ego_pose(self, t: float) -> TeamPose | None:
        """Where this drone itself was at t, in the team frame."""
        return self._ego.at(t)

    def camera_pose(self, t: float) -> Pose | None:
        """world_from_camera at t, in the team frame; None where the drone does not know."""
        ego = self._ego.at(t)
        if ego is None:
            return None
        return Pose(ego.world_from_body, ego.position) @ self._mounting.body_from_camera

    @property
    def scan_t(self) -> float | None:
        """Exposure of the last scan."""
        return self._tracker.t

    @property
    def has_waiting(self) -> bool:
        """Whether a scan waits for the gyro; only then does asking for tracks change anything."""
        return bool(self._waiting)

    @property
    def gyro_bias(self) -> BiasEstimate | None:
        """What the gyro says at rest, body axes; None while nothing says so."""
        found = self._bias.found
        return found and found._replace(bias=self._mounting.body_from_camera.rotation @ found.bias)

    @property
    def gyro_bias_used(self) -> Array:
        """(3,) rad/s, body axes: what is taken off every sample now."""
        used: Array = self._mounting.body_from_camera.rotation @ self.gyro.bias
        return used

    @property
    def consistency(self) -> Consistency | None:
        """Whether the tracker is as good as it thinks."""
        return self._tracker.consistency

    @property
    def teammates(self) -> dict[int, Announcement]:
        """The latest announcement of every teammate."""
        return self._identities.announced

    @property
    def part_counters(self) -> dict[str, int]:
        """What its parts refused or had to mend."""
        gyro, ego = self.gyro, self._ego
        return {
            **self._tracker.counters,
            "gyro_gaps": gyro.gaps,
            "gyro_out_of_order": gyro.out_of_order,
            "gyro_restarts": gyro.restarts,
            "poses_out_of_order": ego.out_of_order,
            "poses_without_place": ego.without_position,
            "heading_jumps": ego.heading_jumps,
            "attitudes_refused": self._bias.refused,
            "sightings_agreed": self._consensus.agreed,
            "sightings_disagreed": self._consensus.disagreed,
        }

    def take_reports(self) -> list[ScanReport]:
        """Hand over what came of the scans since the last call."""
        reports, self._reports = self._reports, []
        return reports

    def _settle(self, now: float | None = None) -> None:
        """Track every waiting scan whose exposure the gyro has reached, or will not reach in time."""
        while self._waiting:
            if self._next_exposure is None:
                self._next_exposure = self.camera_clock.exposure(self._waiting[0].t, self.gyro)
            exposure = self._next_exposure
            newest = self.gyro.newest
            gyro_is_silent = newest is None or newest < exposure - MAX_WAIT
            gave_up = now is not None and now > exposure + MAX_WAIT
            if newest is not None and newest < exposure and not (gyro_is_silent or gave_up):
                return
            self._next_exposure = None
            self._track(self._waiting.popleft(), exposure)

    def _track(self, detections: Detections, t: float) -> None:
        newest = self.gyro.newest
        before = self._tracker.t
        too_old = newest is not None and t < newest - self.gyro.history_s
        if too_old or (before is not None and t <= before):
            self.counters.late_scans += 1
            return
        self.counters.scans_ahead_of_gyro += newest is not None and newest < t
        orientation = self.gyro.orientation(t)
        turn = rotation_between(self._orientation or orientation, orientation)
        self._tracker.predict(t, turn.matrix, turn.variance)
        scan = _scan(detections, t, self.camera, self._tracker)
        self.camera_clock.see(detections.t, scan, self.camera)
        self._tracker.update(scan)
        self._orientation = orientation
        self.counters.scans += 1
        self.counters.detections += len(detections)
        tracks = self._tracker.tracks
        observer = self._ego.at(t)
        if observer is not None:
            self._identities.observe(tracks, observer)
            self._look_around(observer)
        labelled = self._identities.label(tracks)
        self._reports.append(ScanReport(detections.sequence, TrackList(t, t, labelled)))

    def _look_around(self, observer: TeamPose) -> None:
        """Note the rays on which this drone sees its teammates now."""
        seen = self._identities.sightings(observer.t)
        self._view = OwnView.of(observer, self._mounting.body_from_camera, seen)
        self._consensus.remember(self._view)


def _scan(detections: Detections, t: float, camera: PinholeCamera, tracker: Tracker) -> Scan:
    """The detections in undistorted pixels; what the distortion cannot undo is left out."""
    z = camera.undistort(detections.centre)
    good = np.isfinite(z).all(axis=1)
    R = detections.covariance
    if R is None and camera.distortion is not None:
        # Towards the border of a wide image one of its pixels is several undistorted ones.
        R = tracker.measurement_noise(detections.size, detections.score)
    if R is not None:
        J = camera.undistort_jacobian(detections.centre[good])
        R = J @ R[good] @ J.swapaxes(1, 2)
    return Scan(t, z[good], R, detections.size[good], detections.score[good], detections.coverage)
