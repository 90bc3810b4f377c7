"""A whole swarm in one process, as fast as it computes: every drone's real `Onboard`, fed by a scenario's sensors.

What processes, sockets and clocks add is left out, so a Monte Carlo run of twenty seconds takes a few. Messages
arrive at the instants a good radio would bring them: announcements when they are made, `RADIO_S` after they were
asked for; sightings once a second and when they change.
"""

from __future__ import annotations

import dataclasses
import heapq
import math
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import BODY_FROM_FORWARD_CAMERA
from swarmtrack.identity.neighbours import is_far
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.lab.scenarios.oracle import OracleDetector
from swarmtrack.lab.scenarios.scenario import Scenario
from swarmtrack.lab.world.sensors import Ego, EgoParameters, Imu, ImuParameters
from swarmtrack.messages import (
    Announcement,
    Array,
    Detections,
    DoubtNews,
    EgoPose,
    HeadingNews,
    LocatedStranger,
    MotionReport,
    PeerArrived,
    PoseWanted,
    ScanReport,
    SightingReport,
    StrangerReport,
    TrackList,
)
from swarmtrack.motion.ego import EgoHistory
from swarmtrack.motion.gyro import GyroHistory
from swarmtrack.motion.mounting import Mounting
from swarmtrack.onboard import Onboard, OnboardCamera
from swarmtrack.outputs.periods import NEIGHBOURS
from swarmtrack.perceived import Perceived
from swarmtrack.relative.parameters import RelativeParameters
from swarmtrack.runtime.filed import coded_motion, filed_announcement
from swarmtrack.strangers.claims import RemoteIdNews
from swarmtrack.tracking import AGENT_PARAMETERS, DEFAULT_TRACKER, create_trackers
from swarmtrack.tracking.base import Tracker

RADIO_S = 0.05  # s from a question to the announcement it asked for
REPORT_S, SOONEST_REPORT_S = 1.0, 0.1  # s between two reports of sightings, of the same and of others
STRANGERS_S = 0.4  # s between two reports of strangers, while one is in view
CLOCK_SIGMA = 0.01  # s: what a drone knows of its teammates' clocks
LATENCY_S = 0.08  # s from exposure to detections
LEAD_S = 1.0  # s that the sensors run before world time 0
LOOKS_AHEAD = Pose(BODY_FROM_FORWARD_CAMERA, np.zeros(3))


class Exposure(NamedTuple):
    """A drone's frame number `sequence`, exposed at t and stamped `stamp` [s, world time]; what the drone perceives
    when its detector looks; and which of its cameras it was."""

    drone_id: int
    sequence: int
    t: float
    stamp: float
    perceived: Perceived
    camera: int = 0


Said = Announcement | MotionReport | SightingReport | StrangerReport
"""What drones tell each other."""

Eyes = Callable[[Exposure], Detections]
"""What is detected in a frame, with the frame's stamp."""


def oracle_eyes(scenario: Scenario) -> Eyes:
    """The scenario's own detector, which knows where everybody is."""
    oracle = OracleDetector(scenario)

    def eyes(seen: Exposure) -> Detections:
        found = oracle.detections(seen.drone_id, seen.sequence, seen.t, seen.camera)
        return dataclasses.replace(found, t=seen.stamp)

    return eyes


class ObservedScan(NamedTuple):
    """What `observer` tracked in the scan exposed at t [s, world time, by its own belief].

    centres (m, 2) px: what its detector had found there; exposed_t [s, world time]: when it was exposed in truth;
    camera: in which of its cameras; strangers: where it finds them by then.
    """

    observer: int
    t: float
    tracks: TrackList
    centres: Array
    exposed_t: float
    camera: int = 0
    strangers: tuple[LocatedStranger, ...] = ()


@dataclasses.dataclass(frozen=True, slots=True)
class Mistake:
    """What is wrong with one drone for the whole flight, rad, turns about the vertical clockwise seen from above; its
    start is the scenario's."""

    compass: float = 0.0
    """The autopilot's heading less the true one."""
    mounting: float = 0.0
    """The yaw of the cameras in the config less the true one."""
    tilt: tuple[float, float] = (0.0, 0.0)
    """By how much the autopilot's attitude is turned about north and east."""
    place_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The autopilot's position less the true one."""


@dataclasses.dataclass(slots=True)
class _Drone:
    onboard: Onboard
    imu: Imu
    ego: Ego
    announced: int = 0
    announce_at: float = np.inf
    reports: int = 0
    reported_t: float = -np.inf
    reported: frozenset[int] = frozenset()
    compared: int = 0
    """How many scans it had tracked when it last looked whether there is something new to report."""
    shared: int = 0
    strangers_t: float = -np.inf
    """When it last reported strangers, and of which scan."""
    strangers_of: float = -np.inf
    wanted: list[int] = dataclasses.field(default_factory=list)
    """Whose pose it wants and has not asked for yet."""
    neighbours: frozenset[int] | None = None
    """The teammates whose reports it receives; None: all. When it chose them, and how many reports came."""
    chose_t: float = -np.inf
    received: int = 0
    announced_place: Array | None = None
    found: dict[int, tuple[Array, float, int]] = dataclasses.field(default_factory=dict)
    """By number, of the frames that are not tracked yet: centres (m, 2) px, when it was exposed [s, world time], and by
    which camera."""


class VirtualSwarm:
    """`fly` yields every scan of every drone, in the order of their exposure.

    share_hz: how often each tells how it moves; None: as the scenario says.

    eyes: what finds drones in frames, `oracle_eyes` by default. camera_clocks_told: every drone knows by
    how much its camera's stamps are late, and does not estimate it. observers: the members that perceive, all by
    default; of a team that tells each other nothing the rest need not be computed. mistakes: by drone. relative: what
    all know of airframes and more. places_anybody: as `Onboard` has it. latency_s: from exposure to detections.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        tracker: str = DEFAULT_TRACKER,
        identity: IdentityParameters | None = None,
        eyes: Eyes | None = None,
        camera_clocks_told: bool = False,
        share_hz: float | None = None,
        observers: Collection[int] | None = None,
        mistakes: Mapping[int, Mistake] | None = None,
        relative: RelativeParameters | None = None,
        places_anybody: bool = False,
        latency_s: float = LATENCY_S,
    ) -> None:
        self.scenario = scenario
        self._latency_s = latency_s
        self._places_anybody = places_anybody
        self.announcements = 0
        self.remote_ids: list[tuple[int, RemoteIdNews]] = []
        """Which drone has found what of claims by Remote ID."""
        self.announced_at: dict[int, float] = {}
        """World time of each drone's first announcement [s]."""
        self._identity = identity or IdentityParameters()
        self._tracker = tracker
        self._eyes = eyes or oracle_eyes(scenario)
        self._camera_clocks_told = camera_clocks_told
        self._share_hz = share_hz or scenario.share_hz or 0.0
        # What happens to a drone when a camera exposes, and which of its cameras that is.
        self._scans = {f"scan {k}" if k else "scan": k for k in range(len(scenario.cameras))}
        self._mistakes = mistakes or {}
        self._relative = relative
        self._drones = {drone_id: self._make(drone_id) for drone_id in observers or scenario.members}

    def _make(self, drone_id: int) -> _Drone:
        scenario = self.scenario
        # The autopilot's frame begins where its drone hovers: there, as well as its config was measured.
        start = scenario.announced[drone_id]
        lenses = [camera.lens for camera in scenario.cameras]
        trackers = create_trackers(self._tracker, cameras=lenses, **AGENT_PARAMETERS)
        onboard = Onboard(
            drone_id,
            cameras=[
                OnboardCamera(camera.lens, self._mounting(drone_id, number), tracker)
                for number, (camera, tracker) in enumerate(zip(scenario.cameras, trackers, strict=True))
            ],
            gyro=GyroHistory(),
            ego=EgoHistory(origin=start.position_m),
            identity=self._identity,
            relative=self._relative,
            start_sigma_m=start.position_sigma_m,
            places_anybody=self._places_anybody,
        )
        imu = Imu(scenario.world, drone_id, ImuParameters(rate_hz=scenario.imu_rate_hz))
        ego = scenario.ego(drone_id)
        if not scenario.announces:
            self._file(onboard, drone_id)
            return _Drone(onboard, imu, ego)
        return _Drone(onboard, imu, ego, announce_at=max(scenario.starts_s.get(drone_id, 0.0) - 0.5, -0.5))

    def _mounting(self, drone_id: int, number: int) -> Mounting:
        """Of one of its cameras, as its config has it."""
        told = self.scenario.told_mounting(drone_id, number)
        turned = _yaw(self._mistake(drone_id).mounting) @ told.rotation
        return Mounting(
            Pose(turned, told.position),
            time_offset_s=-self.stamps_late(drone_id) if self._camera_clocks_told else 0.0,
            estimate_time_offset=not self._camera_clocks_told,
            sigma=self.scenario.cameras[number].mounting_sigma,
        )

    def _file(self, onboard: Onboard, drone_id: int) -> None:
        """Tell it what the team's file says of its teammates: their starts, and the codes that they will sway."""
        scenario = self.scenario
        for other, start in scenario.announced.items():
            if other == drone_id:
                continue
            place, sigma = start.position_m, start.position_sigma_m
            onboard.tell(filed_announcement(other, -LEAD_S, position=place, yaw=start.yaw, sigma=sigma))
            for begin in scenario.codes_s:
                onboard.tell(coded_motion(other, scenario.members, begin))

    def _mistake(self, drone_id: int) -> Mistake:
        return self._mistakes.get(drone_id, Mistake())

    def stamps_late(self, drone_id: int) -> float:
        """By how much the stamps of its camera are late, s."""
        return self.scenario.camera_offset_s.get(drone_id, 0.0)

    def onboard(self, drone_id: int) -> Onboard:
        return self._drones[drone_id].onboard

    def fly(self, seconds: float) -> Iterator[ObservedScan]:
        """From world time −LEAD_S to `seconds`."""
        scenario, rates = self.scenario, self._rates()
        queue: list[tuple[float, int, str, int]] = []
        for drone_id in self._drones:
            begin = max(scenario.starts_s.get(drone_id, 0.0) - LEAD_S, -LEAD_S)
            for what, rate in rates.items():
                index = int(np.ceil(begin * rate))
                queue.append((self._due(what, index, rate), drone_id, what, index))
        heapq.heapify(queue)
        while queue:
            now, drone_id, what, index = heapq.heappop(queue)
            if now >= seconds + self._latency_s:
                return
            drone = self._drones[drone_id]
            if what == "pose":
                self._say(now)
            if what in ("imu", "pose"):
                self._hear_autopilot(drone_id, what, index)
            elif what in self._scans:
                self._scan(drone_id, self._scans[what], index)
            else:
                self._also(drone_id, now)
            for event in drone.onboard.events():
                if isinstance(event, ScanReport):
                    centres, exposed_t, camera = drone.found.pop(event.sequence)
                    yield ObservedScan(
                        drone_id, event.tracks.t, event.tracks, centres, exposed_t, camera, event.strangers
                    )
                elif isinstance(event, PoseWanted):
                    drone.wanted.append(event.drone_id)
                elif isinstance(event, RemoteIdNews):
                    self.remote_ids.append((drone_id, event))
                elif isinstance(event, HeadingNews | DoubtNews) and drone.announced:
                    drone.announce_at = min(drone.announce_at, now)
            rate = rates[what]
            heapq.heappush(queue, (self._due(what, index + 1, rate), drone_id, what, index + 1))

    def _rates(self) -> dict[str, float]:
        """What happens how often to each drone, Hz; overridden where more does."""
        return {
            "imu": self.scenario.imu_rate_hz,
            "pose": EgoParameters().rate_hz,
            **{what: self.scenario.cameras[number].fps for what, number in self._scans.items()},
        }

    def _also(self, drone_id: int, now: float) -> None:
        """What happens beside what every drone has; overridden where something does."""

    def _runs(self, drone_id: int, now: float) -> bool:
        """Whether its agent runs; overridden where one does not."""
        return True

    def _hear_autopilot(self, drone_id: int, what: str, index: int) -> None:
        """A sample of its gyro, or a pose; overridden where an autopilot is silent."""
        drone, rate = self._drones[drone_id], EgoParameters().rate_hz
        if what == "imu":
            drone.onboard.tell(drone.imu.sample(index))
            return
        if index % int(rate) == 0:
            drone.onboard.tell(drone.ego.flight_state(index / rate))
        drone.onboard.tell(self._pose(drone_id, index))

    def _deliver(self, sender: int, receiver: int, said: PeerArrived | Said, now: float) -> None:
        """One drone's word to another; overridden where it does not arrive as it was said."""
        self._drones[receiver].onboard.tell(said)

    def _deliver_to_all(self, sender: int, now: float, *said: PeerArrived | Said) -> None:
        for receiver, drone in self._drones.items():
            for one in said if receiver != sender else ():
                is_report = not isinstance(one, PeerArrived | Announcement)
                if is_report and drone.neighbours is not None and sender not in drone.neighbours:
                    continue
                drone.received += is_report
                self._deliver(sender, receiver, one, now)

    def _due(self, what: str, index: int, rate: float) -> float:
        if what not in self._scans:
            return index / rate
        return self.scenario.cameras[self._scans[what]].exposure(index) + self._latency_s

    def _pose(self, drone_id: int, index: int) -> EgoPose:
        pose = self._drones[drone_id].ego.pose(index)
        wrong = self._mistakes.get(drone_id)
        if wrong is None:
            return pose
        assert pose.position is not None, "simulated autopilots know where they are"
        turned = _yaw(wrong.compass) @ pose.world_from_body
        if any(wrong.tilt):
            turned = rotation.exp(np.array([*wrong.tilt, 0.0])) @ turned
        return dataclasses.replace(pose, world_from_body=turned, position=pose.position + wrong.place_m)

    def _scan(self, drone_id: int, camera: int, index: int) -> None:
        drone, t = self._drones[drone_id], self.scenario.cameras[camera].exposure(index)
        exposure = Exposure(drone_id, index, t, t + self.stamps_late(drone_id), drone.onboard, camera)
        found = self._eyes(exposure)
        # A number that no frame of the drone's other cameras has.
        sequence = index * len(self.scenario.cameras) + camera
        drone.found[sequence] = found.centre, t, camera
        drone.onboard.tell(dataclasses.replace(found, sequence=sequence, camera=camera))

    def _say(self, now: float) -> None:
        if not self.scenario.announces:
            return
        for drone_id, drone in self._drones.items():
            if not self._runs(drone_id, now):
                continue
            self._choose_neighbours(drone, now)
            if now >= drone.announce_at:
                self._announce(drone_id, drone, now)
            self._report(drone_id, drone, now)
            self._share(drone_id, drone, now)
            self._report_strangers(drone_id, drone, now)
            events = drone.onboard.events()
            drone.wanted += [event.drone_id for event in events if isinstance(event, PoseWanted)]
            self.remote_ids += [(drone_id, event) for event in events if isinstance(event, RemoteIdNews)]
            for wanted in drone.wanted:
                other = self._drones[wanted]
                if other.announced:
                    other.announce_at = min(other.announce_at, now + RADIO_S)
            drone.wanted.clear()

    def _choose_neighbours(self, drone: _Drone, now: float) -> None:
        """As `Teamwork.receive`; overridden where all reports are received."""
        if now - drone.chose_t < NEIGHBOURS:
            return
        drone.chose_t, drone.neighbours = now, drone.onboard.neighbours(now, ())
        own = None if drone.neighbours is None else drone.onboard.ego_pose(now)
        if own is not None and is_far(own.position, drone.announced_place):
            drone.announce_at = min(drone.announce_at, now)

    def received(self, drone_id: int) -> int:
        """How many reports of teammates it has received."""
        return self._drones[drone_id].received

    def _announce(self, drone_id: int, drone: _Drone, now: float) -> None:
        drone.announce_at = np.inf
        pose = drone.onboard.announced_pose(now)
        if pose is None:
            drone.announce_at = now + 0.1
            return
        start_sigma = self.scenario.announced[drone_id].position_sigma_m
        drone.announced += 1
        drone.announced_place = pose.position
        self.announcements += 1
        self.announced_at.setdefault(drone_id, now)
        announcement = Announcement(
            drone_id=drone_id,
            boot=f"{drone_id:08x}",
            sequence=drone.announced,
            t=pose.t,
            t_sigma=0.05,
            position=pose.position,
            world_from_body=pose.world_from_body,
            position_cov=start_sigma**2 * np.eye(3) + pose.position_cov,
        )
        self._deliver_to_all(drone_id, now, PeerArrived(drone_id, announcement.boot), announcement)
        for other_id, other in self._drones.items():  # a late joiner hears those who were there before
            if other_id != drone_id and drone.announced == 1:
                for earlier in list(other.onboard.teammates.values()):
                    self._deliver(other_id, drone_id, earlier, now)

    def _report(self, drone_id: int, drone: _Drone, now: float) -> None:
        if now - drone.reported_t < SOONEST_REPORT_S:
            return
        scans, drone.compared = drone.compared, drone.onboard.counters.scans
        if scans == drone.compared and now - drone.reported_t < REPORT_S:
            return
        report = drone.onboard.sighting_report(f"{drone_id:08x}", drone.reports)
        if report is None:
            return
        seen = frozenset(sighting.drone_id for sighting in report.sightings)
        if seen == drone.reported and now - drone.reported_t < REPORT_S:
            return
        drone.reported_t, drone.reported = now, seen
        drone.reports += 1
        self._deliver_to_all(drone_id, now, dataclasses.replace(report, t_sigma=CLOCK_SIGMA))

    def _share(self, drone_id: int, drone: _Drone, now: float) -> None:
        if self._share_hz == 0.0 or now * self._share_hz < drone.shared:
            return
        drone.shared = math.floor(now * self._share_hz) + 1
        report = drone.onboard.motion_report(f"{drone_id:08x}", drone.shared)
        if report is None:
            return
        self._deliver_to_all(drone_id, now, dataclasses.replace(self._said(report), t_sigma=CLOCK_SIGMA))

    def _report_strangers(self, drone_id: int, drone: _Drone, now: float) -> None:
        if now - drone.strangers_t < STRANGERS_S:
            return
        report = drone.onboard.stranger_report(f"{drone_id:08x}", drone.reports)
        if report is None or report.t <= drone.strangers_of:
            return
        drone.strangers_t, drone.strangers_of = now, report.t
        self._deliver_to_all(drone_id, now, dataclasses.replace(report, t_sigma=CLOCK_SIGMA))

    def _said(self, report: MotionReport) -> MotionReport:
        """What a drone says of its motion; overridden where it lies."""
        return report


class AllReports(VirtualSwarm):
    """Every drone receives the reports of the whole team, however large."""

    def _choose_neighbours(self, drone: _Drone, now: float) -> None: ...


def _yaw(angle: float) -> Array:
    """(3, 3): a turn about the vertical axis, rad."""
    return rotation.from_euler(0.0, 0.0, angle)


def lone_onboard(
    camera: PinholeCamera,
    tracker: Tracker,
    body_from_camera: Pose = LOOKS_AHEAD,
    *,
    drone_id: int = 1,
    ego: EgoHistory | None = None,
    relative: RelativeParameters | None = None,
) -> Onboard:
    """The `Onboard` of a drone with one camera and nobody to talk to, with an agent's parameters where nothing else is
    said."""
    return Onboard(
        drone_id,
        cameras=[OnboardCamera(camera, Mounting(body_from_camera), tracker)],
        gyro=GyroHistory(),
        ego=ego or EgoHistory(),
        identity=IdentityParameters(),
        relative=relative,
    )
