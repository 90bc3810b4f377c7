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

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import assert_never

from swarmtrack.cameras.picture_turn import MountingNews, PictureTurns
from swarmtrack.cameras.rig import NOTHING_EXPECTED, ExpectedTracks, Rig, RigCamera
from swarmtrack.cameras.seams import SeamNews
from swarmtrack.cameras.stuck import StuckCameras
from swarmtrack.carried.own_place import CarriedNews, OwnPlace
from swarmtrack.formation.own_flight import OwnFlightRecord
from swarmtrack.formation.setpoint import OwnFlight
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.identity.consensus import Consensus, Disagreement, OwnView
from swarmtrack.identity.neighbours import Neighbours
from swarmtrack.identity.news import Astray
from swarmtrack.identity.paper import PaperIdentities
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.messages import (
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
    LeapNews,
    MotionReport,
    PeerArrived,
    PeerDeparted,
    PeerExpelled,
    PoseWanted,
    RangeReport,
    RelativeState,
    RemoteIdClaim,
    Scan,
    ScanReport,
    SightingReport,
    StrangerReport,
    TeamEvent,
    Track,
    TrackList,
    VisualTurn,
)
from swarmtrack.motion.carried_place import CarriedPlace
from swarmtrack.motion.ego import AutopilotPlace, EgoHistory, TeamPose
from swarmtrack.motion.exposures import WaitingScans
from swarmtrack.motion.ground_heights import GroundHeightNews, GroundHeights
from swarmtrack.motion.gyro import GyroHistory, Orientation
from swarmtrack.motion.gyro_bias import GyroBias, KnownGyroBias
from swarmtrack.motion.heading import HeadingBulletin, HeadingSteps
from swarmtrack.motion.heading_at_rest import HeadingAtRest
from swarmtrack.motion.mounting import Mounting
from swarmtrack.motion.time_offset import CameraClock
from swarmtrack.perceived import Counters
from swarmtrack.relative.frames import FrameNews
from swarmtrack.relative.metres import MeasuringCamera, Metres
from swarmtrack.relative.parameters import RelativeParameters
from swarmtrack.relative.range_watch import RangeNews
from swarmtrack.strangers.claims import RemoteIdNews
from swarmtrack.strangers.located import Strangers
from swarmtrack.strangers.sights import ScannedTracks
from swarmtrack.team.identities import Identities
from swarmtrack.tracking.base import Tracker
from swarmtrack.tracking.scan import make_scan

# s that a scan may stay away beyond the history: by then a target may be anywhere.
MAX_SCAN_SILENCE_S = 1.0
# m: how well a drone knows its place that doubts its start or heading. For whoever hears it, that is nowhere.
DOUBTED_M = 1000.0
# rad: of a turn between two scans that is known no better, tracks may have taken up each other's detections.
UNMEASURED_TURN_RAD = 0.35


Output = (
    ScanReport
    | Disagreement
    | PoseWanted
    | HeadingNews
    | LeapNews
    | GroundHeightNews
    | DoubtNews
    | Astray
    | FrameNews
    | RangeNews
    | SeamNews
    | MountingNews
    | RemoteIdNews
    | CarriedNews
)


@dataclass(slots=True, eq=False)
class OnboardCamera:
    """One of a drone's cameras: its lens, how it sits, its clock, and the tracker of what it sees."""

    lens: PinholeCamera
    mounting: Mounting
    tracker: Tracker
    clock: CameraClock = field(init=False)

    def __post_init__(self) -> None:
        mounting = self.mounting
        self.clock = CameraClock(mounting.time_offset_s, estimates=mounting.estimate_time_offset)

    @property
    def body_from_camera(self) -> Pose:
        return self.mounting.body_from_camera


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
        uses_gyro: bool = True,
    ) -> None:
        """cameras: in the order of the config, as `Detections.camera` counts them; the gyro's axes are the first one's.
        start_sigma_m: how well the drone knows where it starts, m per axis, beside what its autopilot says.
        estimate_gyro_bias: from the autopilot's attitudes; that of `gyro` is where it begins. places_anybody: find
        where confirmed tracks are by their size also while they have no name, for who has to keep clear of them.
        uses_gyro: false where the camera's rotation is not the gyro's, as on a gimbal."""
        self.counters = Counters()
        self.cameras = tuple(cameras)
        self.gyro = gyro
        self.self_doubt = False
        """Whether what this drone sees shows that its own start or heading is wrong."""
        self._drone_id = drone_id
        self._uses_gyro = uses_gyro
        self._first = first = cameras[0].mounting
        self._bias = GyroBias(gyro, estimates=estimate_gyro_bias)
        self._heading_steps = HeadingSteps(gyro, first.body_from_camera.rotation)
        self._heading_at_rest = HeadingAtRest()
        self._heading_bulletin = HeadingBulletin()
        self._ground_heights = GroundHeights()
        self._ego = ego
        self._flight = OwnFlightRecord(ego, gyro, first.body_from_camera.rotation)
        self._waiting = WaitingScans([each.clock for each in cameras], gyro)
        self._rig = Rig(
            [
                RigCamera(each.lens, each.body_from_camera, each.tracker, each.mounting.sigma)
                for each in cameras
            ]
        )
        self._picture_turns = PictureTurns(self._rig.from_first)
        self._stuck = StuckCameras(len(cameras))
        lenses = [(each.lens, each.body_from_camera) for each in cameras]
        self._identities: Identities | PaperIdentities = (
            PaperIdentities(drone_id, cameras=lenses)
            if identity.profile == "paper"
            else Identities(drone_id, cameras=lenses, parameters=identity, start_sigma_m=start_sigma_m)
        )
        self._consensus = Consensus()
        self._view: OwnView | None = None
        measuring = [MeasuringCamera(each.lens, each.body_from_camera, each.tracker) for each in cameras]
        relative = relative or RelativeParameters()
        self._neighbours = Neighbours([max(each.lens.fx, each.lens.fy) for each in cameras], relative.width_m)
        self._metres = Metres(drone_id, relative, cameras=measuring, ego=ego, places_anybody=places_anybody)
        self._strangers = Strangers(drone_id, relative, cameras=measuring)
        self._own_place = OwnPlace(
            drone_id,
            relative,
            cameras=[each.body_from_camera.position for each in cameras],
            start_sigma_m=start_sigma_m,
        )
        self._events: list[Output] = []

    def tell(self, event: Input) -> None:
        """Something happened: the one way in."""
        match event:
            case ImuSample():
                if self._uses_gyro:
                    x, y, z = (self._first.camera_from_body @ event.gyro).tolist()
                    self.gyro.append(event.t, (x, y, z))
                    if self._ego.heading.is_on_ground:
                        self._heading_at_rest.add_gyro(event)
                    self._bias.settle()
                    self._settle()
            case VisualTurn():
                self.gyro.add_visual_turn(event)
                self._settle()
            case EgoPose():
                leap = self._ego.append(event)
                self._flight.add_pose(event)
                if self.self_doubt:
                    # Where its place goes on from it is not, it seems: what is left is its autopilot's word.
                    self._ego.believe_leaps()
                elif leap is not None:
                    self._events.append(leap)
                attitude = event.world_from_body @ self._first.body_from_camera.rotation
                self._bias.add_attitude(event.t, attitude, event.attitude_sigma)
                self._watch_heading(event)
                self._compare_heights(event)
            case FlightState():
                self._ego.fly(event)
            case Detections():
                self._waiting.append(event)
                self._settle()
            case RemoteIdClaim():
                self._strangers.hear_claim(event)
            case AutopilotRebooted():
                self._ego.restart()
                self._bias.restart()
                self._heading_steps.restart()
                self._identities.autopilot_rebooted()
            case _:
                self._hear(event)

    def _hear(self, event: TeamEvent) -> None:
        """What the team says, or has agreed."""
        match event:
            case SightingReport():
                self._identities.on_report(event)
                self._compare(event)
                if self._identities.teammates.is_heard(event.observer):
                    self._strangers.hear_sightings(event)
            case MotionReport():
                self._identities.on_motion(event)
                self._metres.hear_motion(event)
            case RangeReport():
                range_news = self._metres.hear_range(event)
                self._events += [] if range_news is None else [range_news]
            case StrangerReport():
                if self._identities.teammates.is_heard(event.observer):
                    self._strangers.hear(event, self.gyro.newest)
            case AgreedMotion():
                if event.drone_id == self._drone_id:
                    self._flight.agree(event)
                else:
                    self._identities.agree(event)
            case Announcement():
                if self._identities.announce(event):
                    self._metres.announce(event)
                    self._own_place.announce(event)
                    self._ground_heights.hear(event)
                else:
                    self.counters.announcements_refused += 1
            case PeerArrived() | PeerDeparted() | IdClash() | PeerExpelled():
                self._identities.on_membership(event)
                if isinstance(event, IdClash | PeerExpelled):
                    self._metres.forget(event.drone_id)
                    self._strangers.forget(event.drone_id)
                    self._own_place.forget(event.drone_id)
            case _:
                assert_never(event)

    def events(self) -> Sequence[Output]:
        """What came of it since the last call: the one way out."""
        events, self._events = tuple(self._events), []
        return events

    def sighting_report(self, boot: str, sequence: int) -> SightingReport | None:
        """Whom this drone saw in its last scan; None where it does not know where it stands."""
        view, known = self._view, self._identities.teammates.announced
        return None if view is None else view.report(self._drone_id, boot, sequence, known)

    def neighbours(self, t: float, needed: Collection[int]) -> frozenset[int] | None:
        """The teammates whose reports are to be received, `needed` among them; None: all."""
        own = self._ego.at(t)
        return self._neighbours.of(
            None if own is None else own.position,
            self._identities.directions(),
            self._identities.teammates,
            needed,
        )

    def motion_report(self, boot: str, sequence: int) -> MotionReport | None:
        """How this drone itself moves; None where it does not know."""
        return self._ego.moved(self._drone_id, boot, sequence)

    def stranger_report(self, boot: str, sequence: int) -> StrangerReport | None:
        """On which rays this drone saw strangers in its last scan; None where it saw none."""
        return self._strangers.report(boot, sequence)

    @property
    def stranger_numbers(self) -> dict[int, int]:
        """By track, the number of the stranger that it is."""
        return self._strangers.by_track

    def tracks(self, now: float) -> TrackList:
        """Everything tracked, carried on to now; nothing once the scans have stayed away for too long."""
        self._settle(now)
        if self._rig.t is None:
            return TrackList(now, now, ())
        if now - self._rig.t > self.gyro.history_s + MAX_SCAN_SILENCE_S:
            return TrackList(now, self._rig.t, ())
        labelled = self._labelled(self._rig.at(now, self.gyro.orientation(now)))
        return TrackList(now, self._rig.t, self._metres.at(labelled, now))

    def expected(self, t: float, camera: int) -> ExpectedTracks:
        """Where one of the cameras should see the tracks at t, that of its last scan at the earliest."""
        if self._rig.t is None:
            return NOTHING_EXPECTED
        own = self.cameras[camera].tracker.t
        t = t if own is None else max(t, own)
        return self._rig.expected(camera, t, self.gyro.orientation(t))

    def ego_pose(self, t: float) -> TeamPose | None:
        """Where this drone itself was at t, in the team frame, as it states it."""
        pose = self._ego.at(t)
        return None if pose is None else self._stated(pose)

    def announced_pose(self, t: float) -> TeamPose | None:
        """`ego_pose`, as far off as the start that the team knows this drone by."""
        pose = self._ego.at(t)
        return None if pose is None else self._stated(self._ego.from_start(pose))

    def camera_pose(self, t: float, camera: int = 0) -> Pose | None:
        """world_from_camera at t of one of the cameras, in the team frame; None where the drone does not know."""
        ego = self._ego.at(t)
        return None if ego is None else ego.pose @ self.cameras[camera].body_from_camera

    def anybody(self, now: float) -> dict[int, RelativeState]:
        """`Metres.anybody`, and strangers that the team has located (`Strangers.obstacles`)."""
        states, here = self._metres.anybody(now), self.camera_pose(now) if self._strangers else None
        if here is not None:
            states |= self._strangers.obstacles(now, here.position, self._ego.velocity(now)[0])
        return states

    def own_flight(self, now: float) -> OwnFlight | None:
        """How this drone flies now, and how old its measurements of that are; None where it knows no place."""
        pose = self.ego_pose(now)
        if pose is None:
            return None
        return self._flight.at(
            pose,
            scan_ages=self._stuck.ages(now),
            clash=bool(self._identities.teammates.own_clash),
            doubted=self.self_doubt or self._ego.heading.doubt > 0.0,
            height_sights=self._metres.height_sights,
        )

    @property
    def carried(self) -> CarriedPlace | None:
        """Where this drone is by its teammates; None where its autopilot's position counts."""
        return self._ego.carried

    @property
    def place_for_autopilot(self) -> AutopilotPlace | None:
        """`EgoHistory.for_autopilot`."""
        return self._ego.for_autopilot

    @property
    def team_from_local(self) -> Array:
        """(3, 3): from the axes of the autopilot's local frame to the team's."""
        return self._ego.team_from_local

    @property
    def has_waiting(self) -> bool:
        """Whether a scan waits for the gyro; only then does asking for tracks change anything."""
        return bool(self._waiting)

    @property
    def gyro_bias(self) -> KnownGyroBias:
        """In body axes."""
        return self._bias.known_in(self._first.body_from_camera.rotation)

    @property
    def teammates(self) -> dict[int, Announcement]:
        """The latest announcement of every teammate."""
        return dict(self._identities.teammates.announced)

    def by_fault(self) -> dict[str, float]:
        """The probability that all is as configured, and of each kind of fault of this drone or its team."""
        return self._identities.by_fault()

    @property
    def part_counters(self) -> dict[str, int]:
        """What its parts refused or had to mend."""
        parts = (
            self._rig, self.gyro, self._ego, self._bias, self._heading_steps, self._heading_at_rest, self._consensus,
            self._metres, self._strangers, self._own_place,
        )  # fmt: skip
        return {name: count for part in parts for name, count in part.counters.items()}

    def _settle(self, now: float | None = None) -> None:
        """Track every scan that need not wait for the gyro any longer."""
        while (scan := self._waiting.pop(now)) is not None:
            self._track(*scan)

    def _watch_heading(self, pose: EgoPose) -> None:
        """Has the autopilot's heading jumped, or has it been aligned in flight? Then the team should hear of it."""
        heading, steps = self._ego.heading, self._heading_steps.add_pose(pose)
        at_rest = self._heading_at_rest.add_pose(pose, is_on_ground=heading.is_on_ground)
        # Of a drone at rest every change counts, those that are steps too.
        for step in steps if at_rest is None else at_rest:
            turned = self._ego.step_heading(pose.t, step)
            self._identities.step_heading(pose.t, turned)
            self._flight.step_heading(pose.t)
        aligned = heading.is_aligned(pose.t)
        news = self._heading_bulletin.news(pose.t, steps, is_aligned=aligned, doubt=heading.doubt)
        if news is not None:
            self._events.append(news)

    def _compare_heights(self, pose: EgoPose) -> None:
        """On the ground, and by GPS: is each teammate's announced height one of the same field?"""
        here = self._ego.standing_at(pose) if self._ground_heights.has_waiting else None
        if here is not None:
            self._events += self._ground_heights.stand(pose.t, here.position, here.position_cov)

    def _stated(self, pose: TeamPose) -> TeamPose:
        """As well known as the drone states it to others: not at all while it suspects itself."""
        return pose.vaguer(DOUBTED_M if self.self_doubt else 0.0)

    def _compare(self, report: SightingReport) -> None:
        """Whom a teammate sees, and where it stands: do we see the same, and in which frame is that?"""
        self._events += self._consensus.compare(report)
        self._own_place.hear(report)
        news = self._metres.hear_sightings(report, self._identities.frame)
        self._events += [] if news is None else [news]

    def _track(self, detections: Detections, t: float) -> None:
        """A scan exposed at t: into the tracker, its tracks to identity, and what has a name to metres."""
        number = detections.camera
        orientation = self._accepted(detections, t)
        if orientation is None:
            return
        scan = make_scan(detections, t, self.cameras[number].lens, self.cameras[number].tracker)
        tracks = self._update_tracks(detections, scan, orientation)
        own = None if number in self._picture_turns.wrong else self._ego.steady(t)
        wanted = () if own is None else self._identify(tracks, own, number)
        labelled = self._labelled(tracks)
        if own is not None:
            labelled = self._metres.observe(labelled, scan, own, number)
            self._locate(t, number)
            if self._stuck.is_live(number, t):
                scanned = ScannedTracks(labelled, scan, number, self._identities.p_none())
                self._events += self._strangers.observe(scanned, self._stated(own), self._view)
        found = TrackList(t, t, labelled)
        self._events.append(ScanReport(detections.sequence, found, number, self._strangers.located(t)))
        self._events += map(PoseWanted, wanted)

    def _accepted(self, detections: Detections, t: float) -> Orientation | None:
        """How the first camera was turned at t; None for a scan that is refused, and counted."""
        newest = self.gyro.newest
        too_old = newest is not None and t < newest - self.gyro.history_s
        if too_old or self.cameras[detections.camera].tracker.refuses(t):
            self.counters.late_scans += 1
            return None
        self.counters.scans_ahead_of_gyro += newest is not None and newest < t
        orientation = self.gyro.orientation(t)
        if self._stuck.is_stuck(detections, orientation):
            self.counters.stuck_scans += 1
            return None
        return orientation

    def _update_tracks(
        self, detections: Detections, scan: Scan, orientation: Orientation
    ) -> tuple[Track, ...]:
        """All tracks after a scan; on the way it corrects its camera's clock and is compared with its mounting."""
        number = detections.camera
        if self._rig.turn_variance(number, orientation) > UNMEASURED_TURN_RAD**2:
            self._identities.turn_unmeasured()
        self.cameras[number].clock.add_scan(detections.t, scan, self.cameras[number].lens)
        self._watch_mounting(number, scan, orientation)
        self._events += self._rig.update(number, scan, orientation) or []
        is_mounted = number not in self._picture_turns.wrong
        self._stuck.add_scan(detections, scan.t, orientation, is_mounted=is_mounted)
        self.counters.scans += 1
        self.counters.detections += len(detections)
        return self._rig.tracks(orientation)

    def _identify(self, tracks: tuple[Track, ...], own: TeamPose, number: int) -> tuple[int, ...]:
        """Names for the tracks after a scan of a camera, and what the team hears of them. Returns the drones that
        should announce their pose again."""
        placeable = self._picture_turns.placeable(tracks)
        # The team knows this drone by the start that it announced, and by how far off that was: both lasts.
        own = self._ego.from_start(own)
        vouched, astray, wanted = self._identities.observe(placeable, own, number)
        self._events += astray
        for track_id in vouched:
            self._rig.vouch(track_id)
        if self._identities.self_doubt != self.self_doubt:
            self.self_doubt = self._identities.self_doubt
            self._events.append(DoubtNews(own.t, self.self_doubt, self._identities.fault))
        # A picture that has been the same for long does not show where anybody is now.
        seen = self._identities.sightings(own.t) if self._stuck.is_live(number, own.t) else []
        leans_on = self.carried.leans_on if self.carried else ()
        self._view = OwnView.of(self._stated(own), self.cameras[number].body_from_camera, seen, leans_on)
        self._consensus.remember(self._view)
        return wanted

    def _locate(self, t: float, number: int) -> None:
        """Where this drone is by its teammates, after a look of a camera at t."""
        stated, look = self._ego.stated(t), self._metres.look
        if not isinstance(self._identities, Identities) or stated is None or look is None:
            return
        if not self._ego.may_be_carried:
            return
        was_suspect = self._own_place.is_suspect
        self._own_place.observe(look, number, stated, self._ego.stated_t, self._identities)
        if self._own_place.is_suspect and not was_suspect:
            self._identities.doubt_origin(self._own_place.off_m)
        self._ego.carried = self._own_place.carried(t)
        news = self._own_place.news(t)
        self._events += [] if news is None else [news]

    def _watch_mounting(self, number: int, scan: Scan, orientation: Orientation) -> None:
        """Is a camera mounted as configured? A target in one that is not is elsewhere than it seems."""
        news = self._picture_turns.add_scan(number, scan, self.cameras[number].lens, orientation)
        if news is not None:
            self._rig.set_apart(self._picture_turns.wrong)
            # It may have been of this camera, and so may what it seemed to show of where this drone is.
            self._view = None
            self._identities.lose_place()
            self._events.append(news)

    def _labelled(self, tracks: tuple[Track, ...]) -> tuple[IdentifiedTrack, ...]:
        """The same tracks, with their identities."""
        return self._picture_turns.without_names(self._identities.label(tracks))
