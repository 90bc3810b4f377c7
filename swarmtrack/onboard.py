"""All perception state of one drone.

Theory of operation. The gyro history grows by every IMU sample. The tracker stands at the exposure of the last scan;
the next scan moves it from exposure to exposure by the gyro's rotation between the two. A scan whose exposure the
gyro has not reached yet waits for it (`motion/exposures.py`), so that its result never depends on who arrived first.
What holds *now* is that state carried on by the gyro, without being committed.

The camera's clock and the gyro's bias are learned on the way (`motion/time_offset.py`, `motion/gyro_bias.py`) and used
once they are known well enough. Both are functions of the stamps, so that here too nothing depends on who came first.

`tell` and `tracks` change what is known; `tracks` only where a scan has waited for too long. All else only looks.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, assert_never

import numpy as np

from swarmtrack.cameras.picture_turn import MountingNews, PictureTurns
from swarmtrack.cameras.rig import NOTHING_EXPECTED, ExpectedTracks, Rig, RigCamera
from swarmtrack.cameras.seams import SeamNews
from swarmtrack.formation.setpoint import NO_SWAY, OwnFlight, OwnSway
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.identity.consensus import Consensus, Disagreement, OwnView
from swarmtrack.identity.identities import Identities
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.identity.proof import Astray
from swarmtrack.messages import (
    ASSUMED_TILT,
    AgreedMotion,
    Announcement,
    Array,
    AutopilotRebooted,
    Detections,
    DoubtNews,
    EgoPose,
    FlightState,
    HeadingNews,
    IdClash,
    IdentifiedTrack,
    ImuSample,
    Input,
    Membership,
    MotionReport,
    PeerArrived,
    PeerDeparted,
    PeerExpelled,
    PoseWanted,
    RangeReport,
    RelativeState,
    Scan,
    ScanReport,
    SightingReport,
    Track,
    TrackList,
    TrackStatus,
)
from swarmtrack.motion.ego import EgoHistory, TeamPose
from swarmtrack.motion.exposures import WaitingScans
from swarmtrack.motion.gyro import GyroHistory, Orientation, rotation_between
from swarmtrack.motion.gyro_bias import BiasEstimate, GyroBias
from swarmtrack.motion.heading import HeadingBulletin, HeadingSteps
from swarmtrack.motion.mounting import Mounting
from swarmtrack.motion.time_offset import CameraClock
from swarmtrack.relative.detected import named_boxes
from swarmtrack.relative.frames import FrameNews, Frames
from swarmtrack.relative.heights import HeightSight, SaidHeights
from swarmtrack.relative.looks import NamedBox, TeamLook
from swarmtrack.relative.parallax import FarOff
from swarmtrack.relative.parameters import RelativeParameters
from swarmtrack.relative.range_watch import RangeNews, RangeWatch
from swarmtrack.relative.reading import OwnMotion
from swarmtrack.relative.states import RelativeStates
from swarmtrack.tracking.base import Tracker
from swarmtrack.tracking.consistency import Consistency
from swarmtrack.tracking.noise import MeasuredNoise
from swarmtrack.tracking.scan import make_scan

# s that a scan may stay away beyond the history: by then a target may be anywhere.
MAX_SILENCE = 1.0
# m: how well a drone knows its place that doubts its start or heading. For whoever hears it, that is nowhere.
DOUBTED_M = 1000.0
# Of the own codes, so many are kept; and s, from whose difference the velocity of a sway is taken.
MOST_CODES, SWAY_S = 32, 0.05
# s: a measurement of the range finder that is older tells nothing of the ground that is below now.
OLDEST_GROUND_S = 1.0
# m/s per axis: nobody whose name is not known is taken to be calmer. Who has hovered for long and then comes straight
# on grows in the image, and no more; a filter that knows it to be calm takes that for an error of its boxes.
STRANGERS_SPEED = 1.0
# rad: two pixels or so. A camera that has turned by more shows nobody at the very same place.
STUCK_TURN = 5e-3
# s: nor one that has not turned, for so long.
STUCK_S = 1.0
# rad: of a turn between two scans that is known no better, tracks may have taken up each other's detections.
UNMEASURED = 0.35


Output = (
    ScanReport
    | Disagreement
    | PoseWanted
    | HeadingNews
    | DoubtNews
    | Astray
    | FrameNews
    | RangeNews
    | SeamNews
    | MountingNews
)


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
    identities_overruled: int = 0
    """Given up because other observers see that drone elsewhere."""


class _Picture(NamedTuple):
    """What a camera detected, and how the first camera was turned then."""

    detections: Detections
    orientation: Orientation


class GroundBelow(NamedTuple):
    """Where the range finder found the ground at t [s]: m, down in the team frame."""

    t: float
    down: float


class OnboardCamera(NamedTuple):
    """One of a drone's cameras: its lens, how it sits, and the tracker of what it sees."""

    camera: PinholeCamera
    mounting: Mounting
    tracker: Tracker

    def on_a_rig(self) -> RigCamera:
        mounting = self.mounting
        return RigCamera(self.camera, mounting.body_from_camera, self.tracker, mounting.sigma)

    def make_clock(self) -> CameraClock:
        return CameraClock(self.mounting.time_offset_s, estimates=self.mounting.estimate_time_offset)


class Onboard:
    """Told what happened; never asks, waits or sends."""

    def __init__(
        self,
        drone_id: int,
        *,
        cameras: Sequence[OnboardCamera],
        gyro: GyroHistory,
        ego: EgoHistory,
        identity: IdentityParameters,
        relative: RelativeParameters | None = None,
        start_sigma_m: float = 0.0,
        estimate_gyro_bias: bool = True,
        places_anybody: bool = False,
    ) -> None:
        """cameras: in the order of the config, as `Detections.camera` counts them; the gyro's axes are the first one's.
        start_sigma_m: how well the drone knows where it starts, m per axis, beside what its autopilot says.
        estimate_gyro_bias: from the autopilot's attitudes; that of `gyro` is where it begins. places_anybody: find
        where confirmed tracks are by their size also while they have no name, for who has to keep clear of them."""
        self.counters = Counters()
        self.gyro = gyro
        self._cameras = tuple(cameras)
        camera, mounting, _ = cameras[0]
        self.camera_clocks = tuple(each.make_clock() for each in cameras)
        self._bias = GyroBias(gyro, estimates=estimate_gyro_bias)
        self.camera = camera
        self._heading_steps = HeadingSteps(gyro, mounting.body_from_camera.rotation)
        self._heading_bulletin = HeadingBulletin()
        self._mounting = mounting
        self._rig = Rig([each.on_a_rig() for each in cameras])
        self._picture_turns = PictureTurns(self._rig.from_first)
        self._ego = ego
        self._identities = Identities(
            drone_id,
            cameras=[(each.camera, each.mounting.body_from_camera) for each in cameras],
            parameters=identity,
            start_sigma_m=start_sigma_m,
        )
        relative = relative or RelativeParameters()
        self._tilt_var = relative.tilt_sigma**2
        self._padding_px = relative.box_width.padding_px
        self._relative = RelativeStates(relative)
        strangers = replace(relative, least_speed=STRANGERS_SPEED)
        self._anybody = RelativeStates(strangers) if places_anybody else None
        self._far_off = FarOff()
        self._frames = Frames(drone_id, relative)
        self._range_watch = RangeWatch()
        self._said_heights = SaidHeights()
        self._height_sights: tuple[HeightSight, ...] = ()
        self._ground: GroundBelow | None = None
        self._own_codes: deque[AgreedMotion] = deque(maxlen=MOST_CODES)
        self._drone_id = drone_id
        self._consensus = Consensus()
        self._view: OwnView | None = None
        self._doubted = False
        self._heading_stepped_at = -math.inf
        self._clashing: frozenset[str] = frozenset()
        # Of the first camera, at the last scan.
        self._orientation: Orientation | None = None
        self._pictures: dict[int, _Picture] = {}
        """By camera, its last that was another than the one before."""
        self._changed_t = [-math.inf] * len(cameras)
        """By camera, exposure of its last scan that was not the one before to the last bit: no camera that lives shows
        that."""
        self._waiting = WaitingScans(self.camera_clocks, gyro)
        self._events: list[Output] = []

    def tell(self, event: Input) -> None:
        """Something happened: the one way in."""
        match event:
            case ImuSample():
                x, y, z = (self._mounting.camera_from_body @ event.gyro).tolist()
                self.gyro.append(event.t, (x, y, z))
                self._bias.settle()
                self._settle()
            case EgoPose():
                self._ego.append(event)
                self._see_ground(event)
                if self._doubted:
                    # Where its place goes on from it is not, it seems: what is left is its autopilot's word.
                    self._ego.believe_leaps()
                attitude = event.world_from_body @ self._mounting.body_from_camera.rotation
                self._bias.see(event.t, attitude, event.attitude_sigma)
                self._watch_heading(event)
            case FlightState():
                self._ego.fly(event)
            case Detections():
                self._waiting.append(event)
                self._settle()
            case SightingReport():
                self._identities.on_report(event)
                self._said_heights.hear_sightings(event)
                self._compare(event)
                self._hear_place(event)
            case MotionReport():
                self._identities.on_motion(event)
                if event.drone_id != self._drone_id:
                    self._said_heights.hear_motion(event)
                    self._relative.hear_motion(self._frames.motion_in_ours(event))
            case RangeReport():
                self._hear_range(event)
            case AgreedMotion():
                if event.drone_id == self._drone_id:
                    self._own_codes.append(event)
                else:
                    self._identities.agree(event)
            case Announcement():
                if self._identities.announce(event):
                    self._frames.announce(event)
                    if self._frames.transform(event.drone_id) is None:
                        self._relative.hear_announcement(event)
                else:
                    self.counters.announcements_refused += 1
            case PeerArrived() | PeerDeparted() | IdClash() | PeerExpelled():
                self._identities.on_membership(event)
                self._watch_clash(event)
                if isinstance(event, IdClash | PeerExpelled):
                    self._relative.forget(event.drone_id)
                    self._said_heights.forget(event.drone_id)
            case AutopilotRebooted():
                self._ego.restart()
                self._bias.restart()
                self._heading_steps.restart()
                self._identities.lose_place()
            case _:
                assert_never(event)

    def events(self) -> Sequence[Output]:
        """What came of it since the last call: the one way out."""
        events, self._events = tuple(self._events), []
        return events

    def sighting_report(self, boot: str, sequence: int) -> SightingReport | None:
        """Whom this drone saw in its last scan; None where it does not know where it stands."""
        view, known = self._view, self._identities.announced
        return None if view is None else view.report(self._drone_id, boot, sequence, known)

    def motion_report(self, boot: str, sequence: int) -> MotionReport | None:
        """How this drone itself moves; None where it does not know."""
        return self._ego.moved(self._drone_id, boot, sequence)

    def tracks(self, now: float) -> TrackList:
        """Everything tracked, carried on to now; nothing once the scans have stayed away for too long."""
        self._settle(now)
        if self._rig.t is None:
            return TrackList(now, now, ())
        if now - self._rig.t > self.gyro.history_s + MAX_SILENCE:
            return TrackList(now, self._rig.t, ())
        labelled = self._labelled(self.carried(now))
        return TrackList(now, self._rig.t, self._placed(labelled, now))

    def carried(self, t: float) -> tuple[Track, ...]:
        """The tracks of the last scan, carried on by the gyro to t; no scan that waits is looked at."""
        if self._rig.t is None or self._orientation is None:
            return ()
        return self._rig.at(t, self.gyro.orientation(t))

    def expected(self, t: float, camera: int) -> ExpectedTracks:
        """Where one of the cameras should see the tracks at t, that of its last scan at the earliest."""
        if self._rig.t is None:
            return NOTHING_EXPECTED
        own = self._cameras[camera].tracker.t
        t = t if own is None else max(t, own)
        return self._rig.expected(camera, t, self.gyro.orientation(t))

    def ego_pose(self, t: float) -> TeamPose | None:
        """Where this drone itself was at t, in the team frame, and how well it knows that: not at all while it doubts
        it."""
        pose = self._ego.at(t)
        return pose if pose is None else self._as_sure_as_it_is(pose)

    def camera_pose(self, t: float, camera: int = 0) -> Pose | None:
        """world_from_camera at t of one of the cameras, in the team frame; None where the drone does not know."""
        ego = self._ego.at(t)
        return None if ego is None else ego.pose @ self._cameras[camera].mounting.body_from_camera

    @property
    def lenses(self) -> tuple[PinholeCamera, ...]:
        """Of all cameras, in the order of the config."""
        return tuple(each.camera for each in self._cameras)

    @property
    def mountings(self) -> tuple[Pose, ...]:
        """body_from_camera of all cameras."""
        return tuple(each.mounting.body_from_camera for each in self._cameras)

    @property
    def body_from_camera(self) -> Pose:
        """How the camera is mounted: body FRD."""
        return self._mounting.body_from_camera

    def anybody(self, now: float) -> dict[int, RelativeState]:
        """By track: where confirmed ones are by their size, whoever they are (drone 0), seen from the own camera now;
        nobody unless `places_anybody`. Left out is what has no name and is far off by parallax, whatever its size says:
        a part of a house."""
        observer = self._ego.at(now)
        if self._anybody is None or observer is None:
            return {}
        far = self._far_off.tracks
        states = self._anybody.at(now, self._own_motion(observer, now))
        return {track: state for track, state in states.items() if track not in far} if far else states

    def own_flight(self, now: float) -> OwnFlight | None:
        """How this drone flies now, and how old what it knows of that is; None where it knows no place."""
        pose = self._ego.at(now)
        if pose is None:
            return None
        way, velocity, _ = self._ego.flown_on(now)
        axis = pose.world_from_body @ self._mounting.body_from_camera.rotation[:, 2]
        newest, gyro = self._ego.newest_t, self.gyro.newest
        north, east, down = (pose.position + way).tolist()
        vn, ve, vd = velocity.tolist()
        return OwnFlight(
            (north, east, down),
            (vn, ve, vd),
            math.atan2(float(axis[1]), float(axis[0])),
            position_sigma=self._as_sure_as_it_is(pose).position_sigma,
            pose_age=math.inf if newest is None else now - newest,
            gyro_age=math.inf if gyro is None else now - gyro,
            scan_ages=tuple(now - changed for changed in self._changed_t),
            heading_step_age=now - self._heading_stepped_at,
            leap_age=now - self._ego.leapt_at,
            clash=bool(self._clashing),
            doubted=self._doubted,
            sways=self._own_sway(now),
            ground=self._ground_below(now, pose.position[2] + way[2]),
            height_sights=self._height_sights,
        )

    def _see_ground(self, pose: EgoPose) -> None:
        here = self._ego.at(pose.t) if pose.ground else None
        if here is not None and pose.ground is not None:
            self._ground = GroundBelow(pose.t, float(here.position[2]) + pose.ground)

    def _ground_below(self, now: float, down: float) -> float | None:
        """m below a drone that is at `down` [m], by its range finder; None where that said nothing lately."""
        ground = self._ground
        fresh = ground is not None and 0.0 <= now - ground.t <= OLDEST_GROUND_S
        return float(ground.down - down) if ground is not None and fresh else None

    def _own_sway(self, now: float) -> OwnSway:
        """By its code, where it sways just now."""
        for code in self._own_codes:
            if code.t[0] < now < code.t[-1]:
                times = [now - SWAY_S, now, now + SWAY_S]
                before, at, after = np.interp(times, code.t, code.displacement[:, 2]).tolist()
                return OwnSway(at, (after - before) / (2.0 * SWAY_S))
        return NO_SWAY

    @property
    def team_from_local(self) -> Array:
        """(3, 3): from the axes of the autopilot's local frame to the team's."""
        return self._ego.team_from_local

    @property
    def scan_t(self) -> float | None:
        """Exposure of the last scan."""
        return self._rig.t

    @property
    def self_doubt(self) -> bool:
        """Whether what this drone sees tells that its own start or heading is wrong."""
        return self._identities.self_doubt

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
    def consistencies(self) -> tuple[Consistency | None, ...]:
        """By camera, whether its tracker is as good as it thinks."""
        return tuple(each.tracker.consistency for each in self._cameras)

    @property
    def measured_noises(self) -> tuple[MeasuredNoise | None, ...]:
        """By camera, what its tracker has learned of the noise that it was told."""
        return tuple(each.tracker.measured_noise for each in self._cameras)

    @property
    def camera_clock(self) -> CameraClock:
        """That of the first camera."""
        return self.camera_clocks[0]

    @property
    def teammates(self) -> dict[int, Announcement]:
        """The latest announcement of every teammate."""
        return self._identities.announced

    @property
    def part_counters(self) -> dict[str, int]:
        """What its parts refused or had to mend."""
        parts = (
            self._rig, self.gyro, self._ego, self._bias, self._heading_steps, self._consensus, self._relative
        )  # fmt: skip
        return {name: count for part in parts for name, count in part.counters.items()}

    def _settle(self, now: float | None = None) -> None:
        """Track every scan that need not wait for the gyro any longer."""
        while (scan := self._waiting.pop(now)) is not None:
            self._track(*scan)

    def _watch_heading(self, pose: EgoPose) -> None:
        """Has the autopilot's heading jumped, or has it been aligned in flight? Then the team should hear of it."""
        steps = self._heading_steps.see(pose)
        for step in steps:
            self._ego.step_heading(pose.t, step)
            self._identities.step_heading(pose.t)
            self._heading_stepped_at = pose.t
        aligned = self._ego.heading.is_aligned(pose.t)
        news = self._heading_bulletin.news(pose.t, steps, is_aligned=aligned)
        if news is not None:
            self._events.append(news)

    def _watch_clash(self, event: Membership) -> None:
        """Who else speaks as this drone: told with all of them, and over once all but one are gone."""
        if isinstance(event, IdClash) and event.ours:
            self._clashing = frozenset(event.boots)
        elif isinstance(event, PeerDeparted) and event.drone_id == self._drone_id:
            left = self._clashing - {event.boot}
            self._clashing = left if len(left) > 1 else frozenset()

    def _watch_doubt(self, t: float) -> None:
        if self.self_doubt != self._doubted:
            self._doubted = self.self_doubt
            self._events.append(DoubtNews(t, self._doubted))

    def _as_sure_as_it_is(self, pose: TeamPose) -> TeamPose:
        more = DOUBTED_M**2 * np.eye(3) if self._doubted else 0.0
        return replace(pose, position_cov=pose.position_cov + more)

    def _compare(self, report: SightingReport) -> None:
        """Whom a teammate sees, and where it stands: do we see the same?"""
        for disagreement in self._consensus.compare(report):
            self._events.append(disagreement)
            if disagreement.overruled:
                drone = disagreement.drone_id
                self.counters.identities_overruled += 1
                self._consensus.forget(drone)
                if self._identities.overrule(drone, report.t):
                    self._events.append(PoseWanted(drone))

    def _hear_range(self, report: RangeReport) -> None:
        """A distance from this drone, by its own radio."""
        if report.drone_id != self._drone_id:
            return
        refused = self._relative.refused
        believed = self._relative.hear_range(report)
        if believed or self._relative.refused > refused:
            news = self._range_watch.see(report, believed=believed)
            if news is not None:
                self._events.append(news)

    def _hear_place(self, report: SightingReport) -> None:
        """A teammate says where it is: in which frame, and where is it then?"""
        if report.observer == self._drone_id:
            return
        news = self._frames.hear(report)
        if news is not None:
            self._relative.forget(report.observer)
            self._events.append(news)
        self._identities.align(report.observer, self._frames.transform(report.observer))
        self._relative.hear_sightings(self._frames.report_in_ours(report))

    def _track(self, detections: Detections, t: float) -> None:
        number = detections.camera
        camera, mounting, tracker = self._cameras[number]
        newest = self.gyro.newest
        too_old = newest is not None and t < newest - self.gyro.history_s
        if too_old or tracker.refuses(t):
            self.counters.late_scans += 1
            return
        self.counters.scans_ahead_of_gyro += newest is not None and newest < t
        orientation = self.gyro.orientation(t)
        if self._is_stuck(detections, orientation):
            self.counters.stuck_scans += 1
            return
        if self._rig.turn_variance(number, orientation) > UNMEASURED**2:
            self._identities.turn_unmeasured()
        scan = make_scan(detections, t, camera, tracker)
        self.camera_clocks[number].see(detections.t, scan, camera)
        self._watch_mounting(number, scan, orientation)
        is_known = number not in self._picture_turns.wrong
        self._events += self._rig.update(number, scan, orientation) or []
        self._orientation = orientation
        before = self._pictures.get(number)
        if before is None or not _is_same(before.detections, detections):
            self._pictures[number] = _Picture(detections, orientation)
            if is_known:
                self._changed_t[number] = t
        self.counters.scans += 1
        self.counters.detections += len(detections)
        tracks = self._rig.tracks(orientation)
        observer = self._ego.steady(t) if is_known else None
        wanted: tuple[int, ...] = ()
        if observer is not None:
            vouched, astray, wanted = self._identities.observe(self._placeable(tracks), observer, number)
            self._events += astray
            for track_id in vouched:
                self._rig.vouch(track_id)
            self._watch_doubt(t)
            # A picture that has been the same for long tells nobody where anybody is now.
            is_live = t - self._changed_t[number] < STUCK_S
            seen = self._identities.sightings(observer.t) if is_live else []
            own = self._as_sure_as_it_is(observer)
            self._view = OwnView.of(own, mounting.body_from_camera, seen)
            self._consensus.remember(self._view)
        labelled = self._labelled(tracks)
        if observer is not None:
            labelled = self._in_metres(labelled, scan, observer, number)
        self._events.append(ScanReport(detections.sequence, TrackList(t, t, labelled), number))
        self._events += map(PoseWanted, wanted)

    def _is_stuck(self, detections: Detections, orientation: Orientation) -> bool:
        """Whether a camera shows what it did although it has turned since: then this is no picture of now."""
        before = self._pictures.get(detections.camera)
        if before is None or not _is_same(before.detections, detections):
            return False
        turned = rotation.log(rotation_between(before.orientation, orientation).matrix)
        return bool(np.linalg.norm(turned) > STUCK_TURN)

    def _watch_mounting(self, number: int, scan: Scan, orientation: Orientation) -> None:
        """Does a camera sit as it was told? One that does not shows nobody where it seems to."""
        news = self._picture_turns.see(number, scan, self._cameras[number].camera, orientation)
        if news is not None:
            self._rig.set_apart(self._picture_turns.wrong)
            # It may have been of this camera.
            self._view = None
            self._events.append(news)

    def _placeable(self, tracks: tuple[Track, ...]) -> tuple[Track, ...]:
        """Those that are where they seem to be."""
        wrong = self._picture_turns.wrong
        return tuple(track for track in tracks if track.camera not in wrong) if wrong else tracks

    def _labelled(self, tracks: tuple[Track, ...]) -> tuple[IdentifiedTrack, ...]:
        """The same tracks, and who they are; nobody knows of those that are not where they seem to be."""
        wrong = self._picture_turns.wrong
        labelled = self._identities.label(tracks)
        if not wrong:
            return labelled
        return tuple(
            IdentifiedTrack(entry.track, None, 0.0) if entry.track.camera in wrong else entry
            for entry in labelled
        )

    def _in_metres(
        self, tracks: tuple[IdentifiedTrack, ...], scan: Scan, observer: TeamPose, number: int
    ) -> tuple[IdentifiedTrack, ...]:
        """The same tracks, and where those are that are teammates, after a scan of a camera by its number."""
        lens, mounting, tracker = self._cameras[number]
        R = scan.R if scan.R is not None else tracker.measurement_noise(_sizes(scan), scan.score)
        camera = observer.pose @ mounting.body_from_camera
        velocity, velocity_cov = self._ego.velocity(observer.t)

        def looked(boxes: Sequence[NamedBox]) -> TeamLook:
            return TeamLook.of(observer.t, boxes, lens, camera, velocity, padding_px=self._padding_px)

        if self._anybody is not None:
            nameless = looked(named_boxes(_nameless(tracks), scan, R, number))
            self._anybody.observe(nameless)
            named = {entry.track.id for entry in tracks if isinstance(entry.identity, int)}
            self._far_off.observe(nameless.without(named))
        look = looked(named_boxes(tracks, scan, R, number))
        self._frames.see(look)
        self._relative.observe(look)
        first = observer.pose @ self._mounting.body_from_camera
        own = OwnMotion(first.position, velocity, velocity_cov, self._attitude_cov(observer))
        states = self._relative.at(observer.t, own)
        if self._anybody is not None:
            # Of interest where the drone flies by what it sees.
            self._height_sights = self._said_heights.sights(look, states)
        return _with_places(tracks, states)

    def _placed(self, tracks: tuple[IdentifiedTrack, ...], now: float) -> tuple[IdentifiedTrack, ...]:
        """The same tracks, and where those are by now that are teammates: the own camera has flown on, too."""
        observer = self._ego.at(now) if any(isinstance(entry.identity, int) for entry in tracks) else None
        if observer is None:
            return tracks
        return _with_places(tracks, self._relative.at(now, self._own_motion(observer, now)))

    def _own_motion(self, observer: TeamPose, now: float) -> OwnMotion:
        """Of the own camera by now, which has flown on since the newest pose."""
        camera = observer.position + observer.world_from_body @ self._mounting.body_from_camera.position
        way, velocity, velocity_cov = self._ego.flown_on(now)
        return OwnMotion(camera + way, velocity, velocity_cov, self._attitude_cov(observer))

    def _attitude_cov(self, observer: TeamPose) -> Array:
        """(3, 3) rad², for places in metres: the tilt is as good as the user says, and not as bad as names allow for.
        What came by the age of the pose stays."""
        cov = observer.attitude_cov.copy()
        for i in (0, 1):
            cov[i, i] = max(float(cov[i, i]) - ASSUMED_TILT**2, 0.0) + self._tilt_var
        return cov


def _with_places(
    tracks: tuple[IdentifiedTrack, ...], states: dict[int, RelativeState]
) -> tuple[IdentifiedTrack, ...]:
    """states: by track; a place ends with the name that it was found for."""
    return tuple(
        IdentifiedTrack(entry.track, entry.identity, entry.identity_probability, entry.proof, state)
        if (state := states.get(entry.track.id)) is not None and state.drone_id == entry.identity
        else entry
        for entry in tracks
    )


def _nameless(tracks: tuple[IdentifiedTrack, ...]) -> list[IdentifiedTrack]:
    """The same tracks, as if all that were confirmed were a drone 0, and the others nobody."""
    return [
        IdentifiedTrack(entry.track, None if entry.track.status is TrackStatus.TENTATIVE else 0, 0.0)
        for entry in tracks
    ]


def _is_same(before: Detections, now: Detections) -> bool:
    """Whether both show the same boxes to the last bit, and any."""
    pairs = ((before.centre, now.centre), (before.size, now.size), (before.score, now.score))
    return len(now) > 0 and all(np.array_equal(*pair) for pair in pairs)


def _sizes(scan: Scan) -> Array:
    return scan.size if scan.size is not None else np.full((len(scan.z), 2), np.nan)
