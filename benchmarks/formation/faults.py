"""What goes wrong in a flight in formation, in virtual time: a team in which one drone's parts fail as they do in life.

Each is as it reaches `Onboard`: what a fault does to cameras, autopilots, radios and clocks is told there.
"""

from __future__ import annotations

import dataclasses
import enum
import math
from collections import defaultdict
from typing import Any, assert_never

import numpy as np

from swarmtrack.benchmarks.formation.fed import FedAutopilot
from swarmtrack.benchmarks.virtual_swarm import Exposure, Eyes, Said, VirtualSwarm
from swarmtrack.lab.scenarios.scenario import Scenario
from swarmtrack.lab.world.guided import GuidedDrone
from swarmtrack.lab.world.response import Triple
from swarmtrack.lab.world.sensors import EgoParameters
from swarmtrack.messages import (
    Announcement,
    AutopilotRebooted,
    Detections,
    EgoPose,
    MotionReport,
    PeerArrived,
    PeerDeparted,
    SightingReport,
    StrangerReport,
)
from swarmtrack.transport.limits import ANNOUNCED_CLOCKS_AGREE_S, REPORTED_CLOCKS_AGREE_S
from swarmtrack.transport.sender_clock import SenderClock
from swarmtrack.wire.announcement import AnnouncementMessage, announcement_from, announcement_message
from swarmtrack.wire.motion import MotionMessage, motion_from, motion_message
from swarmtrack.wire.sightings import SightingsMessage, report_from, sightings_message
from swarmtrack.wire.strangers import StrangersMessage, strangers_from, strangers_message

# s of silence after which a teammate is gone.
LEASE_S = 2.0
# s: so long an autopilot boots, and then its pilot waits before engaging it again.
BOOTS_S, PILOT_WAITS_S = 8.0, 6.0
CLOCK_OFF_S, GLITCH_M = 7200.0, 10.0
# s: so long an autopilot's filter resists a glitch of its receiver, and its end; then the position leaps.
GLITCH_RESISTED_S = 10.0
# m above the team frame's origin, at which a drone returns; and so near to its start it is back.
RETURN_HEIGHT_M, RETURNED_M = 15.0, 0.5
# m below itself to which a drone goes that lands: at half a metre per second.
LANDS_M = 0.5
# s on the way, from … to.
ON_THE_WAY_S = (0.005, 0.06)


class Fault(enum.Enum):
    SWAPPED = "the leader and the victim say each other's start"
    STUCK_CAMERA = "the same picture again and again, with new stamps"
    KILLED = "its agent is gone for good"
    PARTITION = "nobody hears anybody"
    REBOOT = "its autopilot is silent, and comes back with a new frame; its pilot engages it again"
    CLOCK = "its wall clock is two hours off, from the beginning"
    GLITCH = "its receiver's position leaps by ten metres, and back"
    RETURNS = "its autopilot returns to the start by a failsafe, and its pilot lets it"
    LANDS = "its autopilot has no position, tells none, and lands where it is"
    DENIED = "its autopilot has no position, tells none, and its pilot flies on by hand"
    FED = "its autopilot has no position, and is fed ours over its link"
    HEIGHT_DRIFT = "its autopilot believes that it climbs, and flies by that"
    PUSHED = "it flies otherwise than its autopilot is told, level"


GOING_DOWN = (Fault.RETURNS, Fault.LANDS)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Failure:
    """A fault, of the drone `victim`, from begins_s to ends_s, world time. speed_m_s: of a drift, or of a push; feeds:
    whether an autopilot without a position is fed."""

    fault: Fault
    victim: int
    begins_s: float = 20.0
    ends_s: float = math.inf
    speed_m_s: float = 0.0
    feeds: bool = True

    def lasts(self, now: float) -> bool:
        return self.begins_s <= now < self.ends_s

    def is_believed(self, now: float) -> bool:
        """Whether an autopilot's filter follows a glitch. One that is shorter than it resists is never followed."""
        is_short = self.ends_s - self.begins_s < GLITCH_RESISTED_S
        return not is_short and self.lasts(now - GLITCH_RESISTED_S)


class FailingSwarm(VirtualSwarm):
    """A virtual swarm with a failure, or none. Call `fail` now and then with the time. options: see `VirtualSwarm`."""

    def __init__(self, scenario: Scenario, failure: Failure | None, **options: Any) -> None:
        super().__init__(scenario, **options)
        self.failure = failure
        self._told_gone = self._told_back = self._rebooted = self._is_high = False
        self._clocks: dict[tuple[int, int], SenderClock] = defaultdict(SenderClock)
        self._picture: Detections | None = None
        if failure is not None and failure.fault is Fault.STUCK_CAMERA:
            self._eyes = self._stuck(self._eyes)
        self.fed: FedAutopilot | None = None
        """The victim's, where it is flown over its link."""
        if failure is not None and failure.fault is Fault.FED:
            self.fed = FedAutopilot(
                scenario,
                failure.victim,
                self.onboard(failure.victim),
                is_fed=failure.feeds,
                lost=failure.lasts,
            )

    def _is(self, fault: Fault, now: float, *drones: int) -> bool:
        """Whether that fault is there, and of one of these drones."""
        failure = self.failure
        return (
            failure is not None and failure.fault is fault and failure.lasts(now) and failure.victim in drones
        )

    def fail(self, now: float) -> None:
        """What the others and the victim are told of it, once each."""
        failure = self.failure
        if failure is None:
            return
        if failure.fault is Fault.REBOOT and now >= failure.begins_s and not self._rebooted:
            self._rebooted = True
            self._drones[failure.victim].onboard.tell(AutopilotRebooted())
            # Its frame begins where it is once it has booted.
            ego = self._drones[failure.victim].ego
            ego.origin = self.scenario.world.flown(failure.victim).position(now)
        silent = [
            (sender, receiver)
            for sender in self._drones
            for receiver in self._drones
            if sender != receiver and failure.fault in (Fault.KILLED, Fault.PARTITION)
            if failure.fault is Fault.PARTITION or sender == failure.victim
        ]
        if now >= failure.begins_s + LEASE_S and not self._told_gone:
            self._told_gone = True
            for sender, receiver in silent:
                self.onboard(receiver).tell(PeerDeparted(sender, f"{sender:08x}"))
        if now >= failure.ends_s and not self._told_back:
            self._told_back = True
            for sender, receiver in silent:
                self.onboard(receiver).tell(PeerArrived(sender, f"{sender:08x}"))

    def flown_as_told(self, drone_id: int, told: Triple, now: float) -> Triple:
        """What an autopilot makes of a velocity [m/s], NED, that it is told."""
        north, east, down = told
        failure = self.failure
        if failure is None:
            return told
        if self._is(Fault.HEIGHT_DRIFT, now, drone_id):
            # It holds the height that it believes in, and sinks.
            return north, east, down + failure.speed_m_s
        if self._is(Fault.PUSHED, now, drone_id):
            way = self.scenario.world.chance("push", drone_id).uniform(-math.pi, math.pi)
            return north + failure.speed_m_s * math.cos(way), east + failure.speed_m_s * math.sin(way), down
        return told

    def height_drift(self, drone_id: int, now: float) -> float:
        """m: by how much its autopilot believes to be higher than it is."""
        failure = self.failure
        if failure is None or failure.fault is not Fault.HEIGHT_DRIFT or failure.victim != drone_id:
            return 0.0
        return failure.speed_m_s * max(min(now, failure.ends_s) - failure.begins_s, 0.0)

    def engagement_of(self, drone_id: int, engaged_s: float, now: float) -> int:
        """How often its pilot has engaged it by now; 0: it is not."""
        failure = self.failure
        if self.goes_down(drone_id, now):
            return 0
        if failure is None or failure.fault is not Fault.REBOOT or failure.victim != drone_id:
            return int(now >= engaged_s)
        if now < failure.begins_s:
            return int(now >= engaged_s)
        return 2 * int(now >= failure.begins_s + BOOTS_S + PILOT_WAITS_S)

    def goes_down(self, drone_id: int, now: float) -> bool:
        """Whether a failsafe has the drone."""
        return any(self._is(fault, now, drone_id) for fault in GOING_DOWN)

    def way_home(self, drone_id: int, now: float) -> Triple | None:
        """Where a failsafe steers a drone now [m], NED: up, to above its start, and down; or down where it is. None: it
        does not."""
        if not self.goes_down(drone_id, now):
            return None
        drone = self.scenario.world.drones[drone_id]
        assert isinstance(drone, GuidedDrone)
        north, east, down = drone.position(now).tolist()
        if self._is(Fault.LANDS, now, drone_id):
            return north, east, down + LANDS_M
        start_north, start_east, _ = drone.start
        self._is_high = self._is_high or -down > RETURN_HEIGHT_M - RETURNED_M
        if not self._is_high:
            return north, east, -RETURN_HEIGHT_M
        is_above_start = math.hypot(north - start_north, east - start_east) < RETURNED_M
        return start_north, start_east, 0.0 if is_above_start else -RETURN_HEIGHT_M

    # ── as the swarm asks ────────────────────────────────────────────────────────────────────────────────────────────

    def _runs(self, drone_id: int, now: float) -> bool:
        return not self._is(Fault.KILLED, now, drone_id)

    def _hear_autopilot(self, drone_id: int, what: str, index: int) -> None:
        rate = self.scenario.imu_rate_hz if what == "imu" else EgoParameters().rate_hz
        now = index / rate
        failure = self.failure
        if self.fed is not None and failure is not None and failure.victim == drone_id:
            self.fed.fly(now)
            return
        boots = (
            self._is(Fault.REBOOT, now, drone_id) and failure is not None and now < failure.begins_s + BOOTS_S
        )
        if not boots and self._runs(drone_id, now):
            super()._hear_autopilot(drone_id, what, index)

    def _pose(self, drone_id: int, index: int) -> EgoPose:
        pose = super()._pose(drone_id, index)
        drift = self.height_drift(drone_id, pose.t)
        if drift and pose.position is not None:
            pose = dataclasses.replace(pose, position=pose.position - (0.0, 0.0, drift))
        if self._is(Fault.LANDS, pose.t, drone_id) or self._is(Fault.DENIED, pose.t, drone_id):
            return dataclasses.replace(pose, position=None)
        failure = self.failure
        if failure is None or failure.fault is not Fault.GLITCH or failure.victim != drone_id:
            return pose
        if not failure.is_believed(pose.t):
            return pose
        way = self.scenario.world.chance("glitch", drone_id).uniform(-math.pi, math.pi)
        assert pose.position is not None
        leap = GLITCH_M * np.array([math.cos(way), math.sin(way), 0.0])
        return dataclasses.replace(pose, position=pose.position + leap)

    def _stuck(self, eyes: Eyes) -> Eyes:
        def stuck(seen: Exposure) -> Detections:
            found = eyes(seen)
            if not self._is(Fault.STUCK_CAMERA, seen.t, seen.drone_id):
                if self.failure is not None and seen.drone_id == self.failure.victim:
                    self._picture = found
                return found
            assert self._picture is not None, "it has seen something first"
            return dataclasses.replace(self._picture, t=found.t, sequence=found.sequence)

        return stuck

    def _deliver(self, sender: int, receiver: int, said: PeerArrived | Said, now: float) -> None:
        if not self._runs(receiver, now) or not self._runs(sender, now):
            return
        failure = self.failure
        if failure is not None and failure.fault is Fault.PARTITION and failure.lasts(now):
            return
        if isinstance(said, PeerArrived) or not self._is(Fault.CLOCK, now, sender, receiver):
            super()._deliver(sender, receiver, said, now)
            return
        super()._deliver(sender, receiver, self._by_clocks(sender, receiver, said, now), now)

    def _by_clocks(self, sender: int, receiver: int, said: Said, now: float) -> Said:
        """What the receiver makes of it, by both wall clocks, as it came over the air."""
        assert self.failure is not None
        off = {drone: CLOCK_OFF_S if drone == self.failure.victim else 0.0 for drone in (sender, receiver)}
        chance = self.scenario.world.chance("on the way", sender, receiver, round(1e3 * now))
        made = now - float(chance.uniform(*ON_THE_WAY_S))
        clock = self._clocks[sender, receiver]

        def stamped(
            message: AnnouncementMessage | MotionMessage | SightingsMessage | StrangersMessage,
            tolerance: float,
        ) -> tuple[float, float]:
            return clock.time_of(message, arrived=now, utc_offset=off[receiver], tolerance=tolerance)

        match said:
            case Announcement():
                pose = announcement_message(said, off[sender], made)
                return announcement_from(pose, *stamped(pose, ANNOUNCED_CLOCKS_AGREE_S))
            case MotionReport():
                motion = motion_message(said, off[sender], made)
                return motion_from(motion, *stamped(motion, REPORTED_CLOCKS_AGREE_S))
            case SightingReport():
                sightings = sightings_message(said, off[sender], made)
                return report_from(sightings, *stamped(sightings, REPORTED_CLOCKS_AGREE_S))
            case StrangerReport():
                strangers = strangers_message(said, off[sender], made)
                return strangers_from(strangers, *stamped(strangers, REPORTED_CLOCKS_AGREE_S))
            case _:
                assert_never(said)
