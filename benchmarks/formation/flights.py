"""Drones that fly in formation by what they see: the loop closed, in one process, as fast as it computes.

Every follower's real `Onboard` (tracker, names, places in metres), the real `Follower` and its barrier, and an
autopilot's measured response (`lab/world/response.py`); oracle detections with misses, noise and clutter. The leader
hovers, flies a square to be known, then off, turns a quarter and stops.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from swarmtrack.benchmarks.formation.faults import FailingSwarm, Failure, Fault
from swarmtrack.benchmarks.virtual_swarm import Exposure, Eyes, oracle_eyes
from swarmtrack.follower import Engagement, Follower
from swarmtrack.formation.parameters import FlightLimits, FormationParameters, Place
from swarmtrack.formation.setpoint import Why
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.lab.scenarios.scenario import (
    BODY_FROM_CAMERA,
    DRIFT_M,
    AnnouncedStart,
    Ghost,
    Scenario,
    ScenarioCamera,
    Wind,
    announced_starts,
)
from swarmtrack.lab.world.airframe import Airframe
from swarmtrack.lab.world.guided import GuidedDrone
from swarmtrack.lab.world.response import ARDUPILOT_RESPONSE, SetPoint, Triple
from swarmtrack.lab.world.sensors import DetectorParameters, visible
from swarmtrack.lab.world.star import arc
from swarmtrack.lab.world.trajectory import wander
from swarmtrack.lab.world.world import World
from swarmtrack.messages import Array, Detections, EgoPose
from swarmtrack.relative.box_width import BoxWidth
from swarmtrack.relative.parameters import RelativeParameters

LEADER, INTRUDER = 1, 99
HEIGHT_M = 8.0
COMMAND_HZ = 10.0
# Poses, of which one comes with what the range finder measures.
GROUND_EVERY = 5
FPS, LATENCY_S, IMU_HZ = 20.0 / 3.0, 0.15, 50.0
START_SIGMA_M = 0.3
# m, level and vertical: what an ordinary receiver claims to be off, and is.
RECEIVER_SIGMA_M, RECEIVER_VERTICAL_SIGMA_M = 0.9, 1.78
# s, world time: engaged, and off they fly.
ENGAGED_S, DEPARTS_S, TURNS_S, TURN_S, STOPS_S, ENDS_S = 3.0, 14.0, 26.0, 5.0, 40.0, 50.0
# s: before that the leader flies a square, by which it is known: so long each side; and m/s.
SHOWS_S, SHOW_S, SHOW_M_S = 4.0, 2.0, 0.8
# s, world time: the intruder sets out, so far from the slot that it flies through [m]; and a leader that homes in.
INTRUDES_S, INTRUDER_FROM_M = 16.0, 14.0
SPAN_M = 0.5
WIND = Wind(speed_m_s=6.0)
# Ghosts: m from a follower, in front of it give or take rad; m, how near a drone would be that looks as large; m above
# the ground; how often the detector fires on each, and with which scores: from … to.
GHOST_FROM_M, GHOST_BESIDE = (15.0, 50.0), 0.5
GHOST_LOOKS_M, GHOST_HEIGHT_M = (3.0, 7.0), (0.5, 9.0)
GHOST_FIRES, GHOST_SCORES = (0.5, 0.95), (0.47, 0.64)
# 90° by 74°.
CAMERA = PinholeCamera(320.0, 320.0, 319.5, 239.5, 640, 480)


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightPlan:
    """n drones, gap_m from the leader, which flies at speed_m_s. share_hz: how often they tell how they move, 0: never.

    size_drone, size_white: how far boxes are off, from drone to drone and from frame to frame, as shares. gone_s: when
    the leader vanishes from everybody's sight, world time; intruder_m_s: as fast a drone that is nobody's flies through
    the slot of the first follower, 0: there is none, while the leader hovers; homes: it steers at that follower,
    wherever it goes; leader_homes_m_s: so does the leader; sure: of names, see the law's parameters.
    ghosts: in front of each follower, parts of houses that look like drones at 3 to 7 m; failure: what breaks;
    range_finders: all have one that looks down; turn_s: in which the leader turns a quarter; wind: drones lean into a
    steady wind, from anywhere, and sway in its gusts; receivers: how many drones, the leader first, start where an
    ordinary receiver has them.
    """

    name: str
    drones: int = 3
    gap_m: float = 5.0
    layer_m: float = 1.0
    speed_m_s: float = 1.5
    share_hz: float = 5.0
    size_drone: float = 0.19
    size_white: float = 0.11
    p_detection: float = 0.9
    latency_s: float = LATENCY_S
    gone_s: float = math.inf
    intruder_m_s: float = 0.0
    homes: bool = False
    leader_homes_m_s: float = 0.0
    sure: float = 0.99
    ends_s: float = ENDS_S
    ghosts: int = 0
    failure: Failure | None = None
    range_finders: bool = False
    turn_s: float = TURN_S
    wind: bool = False
    receivers: int = 0

    def has_receiver(self, drone: int) -> bool:
        return LEADER <= drone < LEADER + self.receivers


class FlightSample(NamedTuple):
    """positions (n, 3) m and speeds (n,) m/s, leader first, intruder last; whys: of the followers' last setpoints.

    intruder_seen: whether the first follower's camera could see it."""

    t: float
    positions: Array
    speeds: Array
    whys: tuple[Why, ...]
    intruder_seen: bool = False


class FormationFlight(FailingSwarm):
    """One flight; `samples` holds what truly happened."""

    def __init__(self, plan: FlightPlan, seed: int) -> None:
        self.plan = plan
        self.slots = arc(range(LEADER, LEADER + plan.drones), plan.gap_m, layer_m=plan.layer_m)
        scenario = _scenario(plan, self.slots, seed)
        box_width = BoxWidth(
            drone_sigma=plan.size_drone, wander_sigma=0.02, white_sigma=max(plan.size_white, 0.01)
        )
        super().__init__(
            scenario,
            plan.failure,
            share_hz=plan.share_hz,
            camera_clocks_told=True,
            relative=RelativeParameters(airframe_span_m=SPAN_M, box_width=box_width),
            places_anybody=True,
            latency_s=plan.latency_s,
            eyes=_eyes(scenario, plan.gone_s),
        )
        self._followers = {drone: Follower(self._of(drone)) for drone in self.slots if drone != LEADER}
        self._whys = dict.fromkeys(self._followers, Why.NOT_ENGAGED)
        self._judged = -1
        self._is_engaged = False
        """Whether the pilot of a follower on its link has engaged it."""
        self.samples: list[FlightSample] = []

    def run(self) -> list[FlightSample]:
        """Fly it to its end."""
        for _ in self.fly(self.plan.ends_s):
            pass
        return self.samples

    def _of(self, drone: int) -> FormationParameters:
        return FormationParameters(
            drone_id=drone,
            leader=LEADER,
            slots=self.slots,
            references=(LEADER,),
            height=HEIGHT_M,
            limits=FlightLimits(fence_radius=100.0),
            sure=self.plan.sure,
        )

    def _rates(self) -> dict[str, float]:
        return {**super()._rates(), "command": COMMAND_HZ}

    def _also(self, drone_id: int, now: float) -> None:
        drone = self.scenario.world.drones[drone_id]
        assert isinstance(drone, GuidedDrone)
        self._judge(now)
        if now < 0.0:
            return
        self.fail(now)
        if drone_id == LEADER:
            velocity = leader_velocity(now, self.plan.speed_m_s, self.plan.turn_s)
            if self.plan.leader_homes_m_s and now >= INTRUDES_S:
                velocity = self._pursuit(LEADER, self.plan.leader_homes_m_s, now)
            drone.command(now, SetPoint(now, velocity=velocity, yaw_rate=0.0))
            self._intrude(now)
            return
        if not self._runs(drone_id, now):
            self._whys[drone_id] = Why.NOT_ENGAGED
            return
        onboard = self.onboard(drone_id)
        engagement = Engagement(self.engagement_of(drone_id, ENGAGED_S, now))
        told = self._followers[drone_id].command(onboard, onboard.tracks(now), engagement)
        self._whys[drone_id] = told.setpoint.why
        if not engagement.number:
            # It stays where its pilot has it, or its failsafe takes it home.
            drone.command(now, SetPoint(now, position=self.way_home(drone_id, now)))
            return
        if self.fed is not None and self.failure is not None and drone_id == self.failure.victim:
            if not self._is_engaged:
                self.fed.engage(now)
            self._is_engaged = True
            self.fed.command(told.velocity, told.yaw_rate)
            return
        flown = self.flown_as_told(drone_id, told.velocity, now)
        drone.command(now, SetPoint(now, velocity=flown, yaw_rate=told.yaw_rate))

    def _intrude(self, now: float) -> None:
        intruder = self.scenario.world.drones.get(INTRUDER)
        if isinstance(intruder, GuidedDrone) and now >= INTRUDES_S:
            way = _intruder_way(self.slots[LEADER + 1], self.scenario.seed)
            speed = self.plan.intruder_m_s
            velocity = speed * math.cos(way), speed * math.sin(way), 0.0
            if self.plan.homes:
                velocity = self._pursuit(INTRUDER, speed, now)
            intruder.command(now, SetPoint(now, velocity=velocity, yaw_rate=0.0))

    def _pursuit(self, pursuer: int, speed: float, now: float) -> Triple:
        """m/s: straight at the first follower, where it truly is."""
        here, there = (
            self.scenario.world.flown(drone).motion(now).position for drone in (pursuer, LEADER + 1)
        )
        north, east, down = (speed * (there - here) / max(float(np.linalg.norm(there - here)), 1e-3)).tolist()
        return north, east, down

    def _judge(self, now: float) -> None:
        """Once per instant."""
        number = round(now * COMMAND_HZ)
        if number <= self._judged or now < 0.0:
            return
        self._judged = number
        states = [self.scenario.world.flown(drone).motion(now) for drone in self.scenario.world.drones]
        self.samples.append(
            FlightSample(
                now,
                np.array([state.position for state in states]),
                np.array([math.hypot(*state.velocity) for state in states]),
                tuple(self._whys.values()),
                self._sees_intruder(now),
            )
        )

    def _sees_intruder(self, now: float) -> bool:
        scenario = self.scenario
        if INTRUDER not in scenario.world.drones:
            return False
        seen = visible(scenario.world, LEADER + 1, scenario.camera, scenario.body_from_camera, now)
        return INTRUDER in seen

    def _pose(self, drone_id: int, index: int) -> EgoPose:
        pose = super()._pose(drone_id, index)
        if self.plan.has_receiver(drone_id):
            pose = replace(pose, position_sigma=RECEIVER_SIGMA_M, vertical_sigma=RECEIVER_VERTICAL_SIGMA_M)
        if not self.plan.range_finders or index % GROUND_EVERY:
            return pose
        return replace(pose, ground=-float(self.scenario.world.flown(drone_id).position(pose.t)[2]))

    def _scan(self, drone_id: int, camera: int, index: int) -> None:
        if drone_id != LEADER and self._runs(drone_id, self.scenario.cameras[camera].exposure(index)):
            super()._scan(drone_id, camera, index)


def leader_velocity(t: float, speed: float, turn_s: float = TURN_S) -> Triple:
    """A square; then north, a quarter turn to the right within turn_s, and stop."""
    side = math.floor((t - SHOWS_S) / SHOW_S)
    if 0 <= side < 4:
        return SHOW_M_S * (1.0, 0.0, -1.0, 0.0)[side], SHOW_M_S * (0.0, 1.0, 0.0, -1.0)[side], 0.0
    share = min(max((t - DEPARTS_S) / 2.0, 0.0), 1.0) - min(max((t - STOPS_S) / 2.0, 0.0), 1.0)
    heading = 0.5 * math.pi * min(max((t - TURNS_S) / turn_s, 0.0), 1.0)
    return speed * share * math.cos(heading), speed * share * math.sin(heading), 0.0


def _scenario(plan: FlightPlan, slots: Mapping[int, Place], seed: int) -> Scenario:
    chance = World(seed, {}).chance
    drones, airframes = {}, {}
    for drone, slot in slots.items():
        off = chance("beside its slot", drone).standard_normal(3) * (1.0, 1.0, 0.4)
        if drone == LEADER:
            off = np.zeros(3)
        north, east, down = (np.array(slot) + off - (0.0, 0.0, HEIGHT_M)).tolist()
        yaw = math.atan2(-slot[1], -slot[0]) if drone != LEADER else 0.0
        drift = wander(chance("wander", drone), WIND.gusts_m if plan.wind else DRIFT_M)
        drones[drone] = GuidedDrone((north, east, down), yaw, ARDUPILOT_RESPONSE, drift, hovers=True)
        airframes[drone] = Airframe().scaled(
            SPAN_M * math.exp(plan.size_drone * chance("size", drone).standard_normal())
        )
    if plan.intruder_m_s:
        way = _intruder_way(slots[LEADER + 1], seed)
        north, east, down = slots[LEADER + 1]
        start = (
            north - INTRUDER_FROM_M * math.cos(way),
            east - INTRUDER_FROM_M * math.sin(way),
            down - HEIGHT_M,
        )
        drift = wander(chance("wander", INTRUDER), DRIFT_M)
        drones[INTRUDER] = GuidedDrone(start, 0.0, ARDUPILOT_RESPONSE, drift, hovers=True)
        airframes[INTRUDER] = Airframe()
    world = World(seed, drones, airframes)
    if plan.wind:
        world = WIND.blows(world)
    failure = plan.failure
    swapped = (LEADER, failure.victim) if failure is not None and failure.fault is Fault.SWAPPED else ()
    return Scenario(
        strangers=frozenset(drones) - frozenset(slots),
        world=world,
        cameras=(ScenarioCamera(CAMERA, BODY_FROM_CAMERA, FPS),),
        imu_rate_hz=IMU_HZ,
        detector=DetectorParameters(
            p_detection=plan.p_detection, centre_sigma=2.6, size_sigma=plan.size_white, clutter_per_frame=0.1
        ),
        announced=announced_starts(world, START_SIGMA_M, swapped)
        | {drone: _by_receiver(world, drone) for drone in slots if plan.has_receiver(drone)},
        ghosts=tuple(ghost for drone in slots if drone != LEADER for ghost in _ghosts(plan, world, drone)),
    )


def _by_receiver(world: World, drone: int) -> AnnouncedStart:
    """Where an ordinary receiver has it; what it claims comes with each pose."""
    flown = world.flown(drone)
    sigmas = (RECEIVER_SIGMA_M, RECEIVER_SIGMA_M, RECEIVER_VERTICAL_SIGMA_M)
    off = world.chance("receiver", drone).standard_normal(3) * sigmas
    return AnnouncedStart(flown.position(0.0) + off, flown.yaw(0.0), 0.0)


def _ghosts(plan: FlightPlan, world: World, drone: int) -> Iterator[Ghost]:
    """In front of a follower."""
    here, ahead = world.flown(drone).position(0.0), world.flown(LEADER).position(0.0)
    course = math.atan2(ahead[1] - here[1], ahead[0] - here[0])
    for k in range(plan.ghosts):
        chance = world.chance("ghost", drone, k)
        way, far = course + chance.uniform(-GHOST_BESIDE, GHOST_BESIDE), chance.uniform(*GHOST_FROM_M)
        place = here + far * np.array([math.cos(way), math.sin(way), 0.0])
        place[2] = -chance.uniform(*GHOST_HEIGHT_M)
        size = SPAN_M * far / chance.uniform(*GHOST_LOOKS_M)
        yield Ghost(place, size, chance.uniform(*GHOST_FIRES), GHOST_SCORES)


def _intruder_way(slot: Place, seed: int) -> float:
    """Rad, clockwise from north: towards a follower, from about where its camera looks."""
    chance = World(seed, {}).chance("intruder")
    return math.atan2(-slot[1], -slot[0]) + math.pi + float(chance.uniform(-0.5, 0.5))


def _eyes(scenario: Scenario, gone_s: float) -> Eyes:
    """The scenario's own detector, which from then on does not see the leader any more."""
    others = {drone: flown for drone, flown in scenario.world.drones.items() if drone != LEADER}
    before = oracle_eyes(scenario)
    after = oracle_eyes(replace(scenario, world=replace(scenario.world, drones=others)))

    def eyes(seen: Exposure) -> Detections:
        return before(seen) if seen.t < gone_s else after(seen)

    return eyes
