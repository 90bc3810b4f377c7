"""Who flies where, which camera everyone carries, and what goes wrong when: one simulated flight of a swarm.

A scenario is a value. `lab.scenarios.files` reads one from TOML with the builders below. Where a table of a file is a
part of a scenario as it stands (a fault, the radio, a ring), that part's class is here, with its limits.

All drones hover until world time `HOVER_S`, and at every negative time: however slowly processes start, the announced
poses fit what is seen. Then they move, without end. In errands and stars they stand on the ground first.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydantic import (
    AfterValidator,
    Field,
    Strict,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    field_validator,
)

from swarmtrack.config.toml.sections import Count, NotNegative, Number, Place, Positive, Section
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.geodesy import Geodetic
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import BODY_FROM_FORWARD_CAMERA
from swarmtrack.lab.world.errands import Errand, Heights, fly_errands
from swarmtrack.lab.world.followed import FollowedDrone
from swarmtrack.lab.world.guided import GuidedDrone
from swarmtrack.lab.world.response import ARDUPILOT_RESPONSE, PX4_RESPONSE, Response
from swarmtrack.lab.world.sensors import ARDUPILOT_EGO, PX4_EGO, DetectorParameters, Ego, EgoParameters
from swarmtrack.lab.world.star import Star, TeamSlots
from swarmtrack.lab.world.trajectory import (
    Coded,
    Facing,
    Handover,
    Hover,
    Lissajous,
    Path,
    SteadyYaw,
    SwingingYaw,
    Together,
    Trajectory,
    YawProfile,
    wander,
)
from swarmtrack.lab.world.world import Drawn, World
from swarmtrack.messages import Array

HOVER_S = 4.5  # s: an agent needs one to start, and one to see and name everyone
DEPARTURE_S = 5.0  # s: from hover into the flight proper
SKEWS = (1e-4, 2e-4)  # s/s
LOCKSTEP_SKEW = -0.011  # s/s, as measured: a simulator that cannot quite follow
GHOST_BEARING_SIGMA_RAD = 0.15  # rad: from a drone to a ghost behind it, one sigma
WIND_DRAG_PER_S = 1.7 / 6.0  # m/s² per m/s: against 6 m/s a drone leans by 10°, as measured
GUSTS_M = 0.25
DRIFT_M = 0.03  # m RMS an axis: how well a drone holds its position
SCENARIO_ORIGIN = Geodetic.from_degrees(47.397742, 8.545594, 488.0)  # where PX4's simulators fly
CAMERA = PinholeCamera(fx=430.0, fy=430.0, cx=319.5, cy=239.5, width=640, height=480)
BODY_FROM_CAMERA = Pose(BODY_FROM_FORWARD_CAMERA, np.array([0.1, 0.0, 0.0]))


class AutopilotKind(StrEnum):
    """Whose manners a drone's autopilot has."""

    ARDUPILOT = "ardupilot"
    PX4 = "px4"
    PX4_LOCKSTEP = "px4-lockstep"  # as in PX4's own simulators by default: time moves in steps, and 1 % slow

    @property
    def response(self) -> Response:
        """How it flies what it is told."""
        return ARDUPILOT_RESPONSE if self is AutopilotKind.ARDUPILOT else PX4_RESPONSE

    @property
    def ego(self) -> EgoParameters:
        """How it errs about its own pose."""
        return ARDUPILOT_EGO if self is AutopilotKind.ARDUPILOT else PX4_EGO


class FaultKind(StrEnum):
    CAMERA_STALL = "camera-stall"
    IMU_GAP = "imu-gap"
    AUTOPILOT_REBOOT = "autopilot-reboot"
    POSITION_LOSS = "position-loss"  # no place is told; who is guided lands
    LOW_BATTERY = "low-battery"  # who is guided returns to its start, and lands
    KILL = "kill"  # kill -9 of the agent, started again after `seconds`; 0: it stays dead
    PARTITION = "partition"  # `drones` hear each other, and so does everybody else; nobody hears across
    LOSS = "loss"
    LATENCY = "latency"
    CLUTTER = "clutter"


RADIO_FAULTS = frozenset({FaultKind.PARTITION, FaultKind.LOSS, FaultKind.LATENCY})
# The value of a fault: the largest one, and what it is; kinds that are not listed have none.
FAULT_VALUES: dict[FaultKind, tuple[float, str]] = {
    FaultKind.LOSS: (1.0, "the share of frames that are lost, 0 to 1"),
    FaultKind.LATENCY: (60.0, "a delay of 0 to 60 s"),
    FaultKind.CLUTTER: (1000.0, "0 to 1000 false detections per frame"),
}


def _ascending(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] > ends[1]:
        raise ValueError(f"{list(ends)}, expected [shortest, longest]")
    return ends


Share = Annotated[Number, Field(ge=0.0, le=1.0)]
Range = Annotated[tuple[Positive, Positive], AfterValidator(_ascending)]
DroneId = Annotated[int, Strict(), Field(ge=1, le=65535)]


class ScenarioFault(Section):
    """[[fault]]: a failure of `drones` from world time `at_s` on, for `seconds`."""

    kind: FaultKind = Field(description="what fails; loss, latency and clutter need a value")
    at_s: NotNegative = Field(description="when it starts, world time, s")
    seconds: NotNegative = Field(
        default=0.0,
        description="how long it lasts, s; for a kill: until the agent is restarted",
        validate_default=True,
    )
    drones: tuple[DroneId, ...] = Field(
        default=(),
        description="the drones affected, all by default; for a partition: one side of it",
        validate_default=True,
    )
    value: Number = Field(
        default=None, description="strength of loss, latency or clutter", validate_default=True
    )

    @field_validator("seconds")
    @classmethod
    def _lasting(cls, seconds: float, info: ValidationInfo) -> float:
        momentary = (FaultKind.KILL, FaultKind.AUTOPILOT_REBOOT, FaultKind.LOW_BATTERY)
        if seconds == 0.0 and "kind" in info.data and info.data["kind"] not in momentary:
            raise ValueError(f"{seconds:g}, expected how long the {info.data['kind']} lasts, more than 0 s")
        return seconds

    @field_validator("drones")
    @classmethod
    def _with_a_side(cls, drones: tuple[int, ...], info: ValidationInfo) -> tuple[int, ...]:
        if not drones and info.data.get("kind") is FaultKind.PARTITION:
            raise ValueError("none, expected the drones on one side of the partition")
        return drones

    @field_validator("value", mode="wrap")
    @classmethod
    def _of_its_kind(cls, given: object, number: ValidatorFunctionWrapHandler, info: ValidationInfo) -> float:
        """0 where the kind has no strength."""
        kind, value = info.data.get("kind"), None if given is None else float(number(given))
        if kind in FAULT_VALUES:
            most, meaning = FAULT_VALUES[kind]
            if value is None or not 0.0 <= value <= most:
                raise ValueError(f"{'missing' if value is None else format(value, 'g')}, expected {meaning}")
        elif kind is not None and value is not None:
            raise ValueError(f"{value:g}, expected none: {kind} has no strength")
        return value or 0.0

    def concerns(self, drone_id: int, t: float) -> bool:
        """Whether it holds for this drone at world time t."""
        return (not self.drones or drone_id in self.drones) and self.at_s <= t < self.at_s + self.seconds


class Radio(Section):
    """[radio]: every link of the team's radio, all the time."""

    loss: Share = Field(default=0.0, description="share of the frames that are lost")
    latency_s: NotNegative = Field(default=0.0, description="delay of every frame, s")
    jitter_s: NotNegative = Field(default=0.0, description="variation of the latency, ±, s")
    kbit_s: Annotated[Number, Field(ge=1.0, le=1e6)] | None = Field(
        default=None, description="data rate of each drone's radio, at most, kbit/s"
    )


PERFECT_RADIO = Radio()


class Wind(Section):
    """[wind]: steady, with gusts; drones lean into it. The seed sets its direction."""

    speed_m_s: Annotated[Number, Field(ge=0.0, le=12.0)] = Field(description="mean speed, m/s")
    gusts_m: Annotated[Number, Field(ge=0.0, le=0.5)] = Field(
        default=GUSTS_M, description="displacement of a drone by gusts, RMS per axis, m"
    )

    def blows(self, world: World) -> World:
        """The world in this wind: its drones lean."""
        away = world.chance("wind").uniform(-math.pi, math.pi)
        push = WIND_DRAG_PER_S * self.speed_m_s
        against = (push * math.cos(away), push * math.sin(away), 0.0)
        drones = dict(world.drones)
        for drone_id, drone in drones.items():
            if isinstance(drone, Trajectory):
                drones[drone_id] = replace(drone, against_wind=against)
            elif isinstance(drone, GuidedDrone):
                drone.against_wind = against
        return replace(world, drones=drones)


@dataclass(frozen=True, slots=True, eq=False)
class Ghost:
    """A fixed point of the world, (3,) m, on which the detector fires with a probability per frame: part of a house, a
    pole, a tree. size_m: of the box, at the ghost's distance; score: from … to.
    """

    position_m: Array
    size_m: float
    p_detection: float
    score: tuple[float, float]


class Ghosts(Section):
    """[ghosts]: fixed points that the detector repeatedly takes for drones."""

    count: Annotated[int, Strict(), Field(ge=0, le=1000)] = Field(
        default=4, description="number of ghosts; 0 without this table"
    )
    p_detection: tuple[Share, Share] = Field(default=(0.3, 0.9), description="per frame, [least, most]")
    score: tuple[Share, Share] = Field(default=(0.47, 0.64), description="[least, most]")
    distance_m: Range = Field(default=(12.0, 40.0), description="[nearest, farthest], m")
    height_m: Range = Field(default=(0.5, 6.0), description="above the ground, [lowest, highest], m")
    size_m: Range = Field(default=(0.5, 1.5), description="size of the boxes, [least, most], m")

    def drawn(self, world: World) -> tuple[Ghost, ...]:
        """Ghosts in the directions in which drones look for each other: each behind one as another one sees it, give or
        take `GHOST_BEARING_SIGMA_RAD`, with a probability of its own. All of them have scores from the range."""
        ghosts = []
        drones = list(world.drones)
        for k in range(self.count if len(drones) > 1 else 0):
            chance = world.chance("ghost", k)
            observer, other = (
                world.flown(d).position(0.0) for d in chance.choice(drones, 2, replace=False).tolist()
            )
            north, east, _ = other - observer
            bearing = math.atan2(east, north) + chance.normal(0.0, GHOST_BEARING_SIGMA_RAD)
            distance = chance.uniform(*self.distance_m)
            place = observer + distance * np.array([math.cos(bearing), math.sin(bearing), 0.0])
            place[2] = -chance.uniform(*self.height_m)
            ghosts.append(
                Ghost(place, chance.uniform(*self.size_m), chance.uniform(*self.p_detection), self.score)
            )
        return tuple(ghosts)


class ScenarioEvent(NamedTuple):
    """What a drone is told, at world time t [s]."""

    t: float
    drone_id: int
    words: str


@dataclass(frozen=True, slots=True, eq=False)
class AnnouncedStart:
    """Where a drone's config says that it starts: measured, hence off by about `position_sigma_m` per axis.

    position_m (3,) m in the team frame; yaw in rad from north.
    """

    position_m: Array
    yaw: float
    position_sigma_m: float


@dataclass(frozen=True, slots=True, eq=False)
class ScenarioCamera:
    """One of the cameras that every drone carries.

    phase: the share of a frame, 0 to 1, by which its exposures are later than those of a camera at phase 0.
    mounting_sigma: by how much a drone's config is wrong about its rotation, rad per axis, and says that it may be.
    """

    lens: PinholeCamera = CAMERA
    body_from_camera: Pose = BODY_FROM_CAMERA
    fps: float = 15.0
    phase: float = 0.0
    mounting_sigma: float = 0.0

    def exposure(self, index: int) -> float:
        """World time of frame number `index`, s."""
        return (index + self.phase) / self.fps


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Scenario:
    """A world, the cameras that every drone in it carries, and what its agents and their machines are like.

    origin: where the world's origin lies on the Earth, its height above mean sea level. seconds is its natural
    length. starts_s: when a drone's agent is started, in world time; 0: before the flight begins. utc_offset_s: how
    wrong its companion's wall clock is. autopilot_skew: how much faster than true time its autopilot's clock runs
    (5e-5: 50 ppm), and autopilot_boot_s what that clock shows at world time 0: one on the ground wakes from its boot
    on, arms 40 s later, and its heading swings meanwhile. camera_offset_s: by how much its camera's stamps are late.
    Drones that a mapping leaves out start at 0, with right clocks and an ArduPilot whose clock shows 0 then, and which
    woke before. All cameras of a drone stamp alike. announces: whether the drones tell each other anything; where they
    do not, all know `announced` from a file, and codes_s is when all sway by their codes [s].
    share_hz: how often they tell how they move; None: never. formation: who follows whom by sight; None: nobody.
    feed: `autopilot.feed` of their configs.
    from_take_off: whether `seconds`, and the formation's times, count from when the first drone left the ground.
    ghosts are for detectors that are not shown pictures; the pictures have houses, poles and trees.
    """

    world: World
    origin: Geodetic = SCENARIO_ORIGIN
    name: str = "unnamed"
    about: str = ""
    seconds: float = 30.0
    cameras: tuple[ScenarioCamera, ...] = (ScenarioCamera(),)
    imu_rate_hz: float = 200.0
    tracks_hz: float = 100.0
    detector: DetectorParameters = field(default_factory=DetectorParameters)
    announced: Mapping[int, AnnouncedStart] = field(default_factory=dict)
    announces: bool = True
    share_hz: float | None = None
    feed: Literal["none", "odometry"] = "none"
    codes_s: tuple[float, ...] = ()
    strangers: frozenset[int] = frozenset()
    starts_s: Mapping[int, float] = field(default_factory=dict)
    utc_offset_s: Mapping[int, float] = field(default_factory=dict)
    autopilot_skew: Mapping[int, float] = field(default_factory=dict)
    autopilot_boot_s: Mapping[int, float] = field(default_factory=dict)
    autopilots: Mapping[int, AutopilotKind] = field(default_factory=dict)
    camera_offset_s: Mapping[int, float] = field(default_factory=dict)
    ghosts: tuple[Ghost, ...] = ()
    events: tuple[ScenarioEvent, ...] = ()
    radio: Radio = PERFECT_RADIO
    faults: tuple[ScenarioFault, ...] = ()
    formation: TeamSlots | None = None
    from_take_off: bool = False

    @property
    def seed(self) -> int:
        return self.world.seed

    @property
    def star(self) -> Star | None:
        """The formation, where its leader is one of ours; None: nobody leads, or whom others fly."""
        return self.formation if isinstance(self.formation, Star) else None

    @property
    def camera(self) -> PinholeCamera:
        """The lens of the first camera."""
        return self.cameras[0].lens

    @property
    def body_from_camera(self) -> Pose:
        """Where the first camera sits."""
        return self.cameras[0].body_from_camera

    @property
    def fps(self) -> float:
        """Of the first camera."""
        return self.cameras[0].fps

    def told_mounting(self, drone_id: int, camera: int) -> Pose:
        """body_from_camera as the drone's config has it, of a camera by its number: as well as it was measured."""
        mounted = self.cameras[camera]
        if mounted.mounting_sigma == 0.0:
            return mounted.body_from_camera
        error = mounted.mounting_sigma * self.world.chance("mounting", drone_id, camera).standard_normal(3)
        true = mounted.body_from_camera
        return Pose(true.rotation @ rotation.exp(error), true.position)

    @property
    def members(self) -> tuple[int, ...]:
        """The drones that have an agent."""
        return tuple(drone_id for drone_id in self.world.drones if drone_id not in self.strangers)

    @property
    def initial_poses(self) -> Mapping[int, Pose]:
        """world_from_body at world time 0, by drone."""
        return {drone_id: self.world.pose(drone_id, 0.0) for drone_id in self.world.drones}

    def autopilot(self, drone_id: int) -> AutopilotKind:
        """Whose manners the drone's autopilot has."""
        return self.autopilots.get(drone_id, AutopilotKind.ARDUPILOT)

    def ego(self, drone_id: int) -> Ego:
        """What the drone's autopilot believes of its pose. One whose boot the scenario does not tell woke long ago."""
        on_since = -self.autopilot_boot_s.get(drone_id, math.inf)
        return Ego(self.world, drone_id, self.autopilot(drone_id).ego, on_since=on_since)

    def extra_clutter(self, drone_id: int, t: float) -> float:
        """False detections to expect in a frame exposed at world time t, beyond the detector's own."""
        return sum(f.value for f in self.faults if f.kind is FaultKind.CLUTTER and f.concerns(drone_id, t))

    @property
    def needs_radio(self) -> bool:
        """Whether its links lose, delay or part: it then needs a network of its own."""
        return self.radio != PERFECT_RADIO or any(fault.kind in RADIO_FAULTS for fault in self.faults)


def as_told(scenario: Scenario) -> tuple[Scenario, dict[int, FollowedDrone]]:
    """The scenario for who does not fly it: where a guided drone is cannot be computed there, it must be told."""
    followed = {
        drone_id: FollowedDrone(keep_s=math.inf)
        for drone_id, drone in scenario.world.drones.items()
        if isinstance(drone, GuidedDrone)
    }
    world = replace(scenario.world, drones={**scenario.world.drones, **followed})
    return replace(scenario, world=world), followed


# --- who flies where -------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """Hover at `start` (3,) m; at `departs_s`, unless `flight` is None, go over into it.

    guided: instead, stand there on the ground until somebody flies it by MAVLink, and respond as this autopilot does.
    """

    start: ArrayLike
    view: YawProfile
    flight: Path | None = None
    departs_s: float = HOVER_S
    guided: Response | None = None


def fly(
    seed: int,
    plans: Mapping[int, Plan],
    drift_m: float = DRIFT_M,
    *,
    codes_s: tuple[float, ...] = (),
    team: tuple[int, ...] = (),
) -> World:
    """The world in which each drone follows its plan, give or take the drift of a drone that holds its position, and
    those of the team sway by their codes from each of codes_s [s] on."""
    chance = World(seed, {}).chance
    drones: dict[int, Drawn] = {}
    for drone_id, plan in plans.items():
        path: Path = Hover(plan.start)
        drift = wander(chance("wander", drone_id), drift_m)
        if plan.guided is not None:
            north, east, down = np.asarray(plan.start, dtype=float).tolist()
            yaw, _ = plan.view.yaw(0.0, path.derivatives(0.0))
            drones[drone_id] = GuidedDrone((north, east, down), yaw, plan.guided, drift)
            continue
        if plan.flight is not None:
            path = Handover(path, plan.flight, plan.departs_s, DEPARTURE_S)
        code = Coded(drone_id, team, codes_s if drone_id in team else ())
        drones[drone_id] = Trajectory(Together((path, drift, code)), plan.view)
    return World(seed, drones)


def run_errands(
    world: World, ids: Sequence[int], errand: Errand, sway_m: float, responses: Mapping[int, Response]
) -> tuple[World, tuple[ScenarioEvent, ...]]:
    """The world with these drones on errands, and what they are told when."""
    flights, orders = fly_errands(world, ids, errand, responses, sway_m)
    events = (
        ScenarioEvent(order.t, drone_id, order.words) for drone_id, told in orders.items() for order in told
    )
    drones = dict(sorted({**world.drones, **flights}.items()))
    return replace(world, drones=drones), tuple(sorted(events))


def drawn_skews(world: World, ids: Sequence[int]) -> dict[int, float]:
    """Of the autopilots' clocks, s/s: 100 to 200 ppm, either way, as measured."""
    skews = {}
    for drone_id in ids:
        chance = world.chance("autopilot skew", drone_id)
        skews[drone_id] = float(chance.choice((-1.0, 1.0)) * chance.uniform(*SKEWS))
    return skews


def announced_starts(
    world: World, position_sigma_m: float, swapped: tuple[int, ...] = ()
) -> dict[int, AnnouncedStart]:
    """What the drones' configs say of their starts, measured with errors of that standard deviation per axis.

    swapped: drones that stand on each other's places: each says where the next of them stands.
    """
    starts = {}
    for drone_id in world.drones:
        trajectory = world.flown(drone_id)
        error = position_sigma_m * world.chance("start", drone_id).standard_normal(3)
        starts[drone_id] = AnnouncedStart(
            trajectory.position(0.0) + error, trajectory.yaw(0.0), position_sigma_m
        )
    told = dict(zip(swapped, (*swapped[1:], *swapped[:1]), strict=True))
    return starts | {drone_id: starts[other] for drone_id, other in told.items()}


# --- formations ------------------------------------------------------------------------------------


class Station(NamedTuple):
    """A drone's place in a formation: position (3,) m; which side of it; phase [rad] in what its side does together."""

    position: Array
    side: int = 0
    phase: float = 0.0


def _uneven(n: int, most_m: float) -> Array:
    """(n, 3) m: by how much stations are off their even places, north and east."""
    off = np.zeros((n, 3))
    off[:, :2] = np.random.default_rng(n).uniform(-most_m, most_m, (n, 2))
    return off


class Ring(Section):
    """Stations on a circle about the origin, looking at its middle."""

    radius_m: Positive = Field(description="smallest radius, m")
    spacing_m: Annotated[Number, Field(ge=1.5)] = Field(
        default=1.8, description="smallest distance along the circle, m"
    )
    heights_m: Heights = Field(default=(5.0,), description="heights above the ground, taken in turn, m")
    uneven_m: Annotated[Number, Field(ge=0.0)] = Field(
        default=0.0, description="each stands off its even place, north and east, by up to this, m"
    )

    def stations(self, n: int) -> list[Station]:
        """Four make a rhombus of two equilateral triangles. In a square, a camera of 73° would show each drone only
        its opposite and one neighbour, so 8 of the 12 pairs; here it is 10."""
        radius = max(self.radius_m, n * self.spacing_m / (2.0 * math.pi))
        along, across = (1.3 * radius, 0.75 * radius) if n == 4 else (radius, radius)
        angle = math.pi + 2.0 * math.pi * np.arange(n) / n  # the first in the south, which looks north
        heights, off = self.heights_m, _uneven(n, self.uneven_m)
        return [
            Station(off[k] + (along * math.cos(a), across * math.sin(a), -heights[k % len(heights)]))
            for k, a in enumerate(angle)
        ]


class Lanes(Section):
    """Two sides, south and north of the origin, of lanes one behind the other.

    The drones of a lane stand side by side; the next lane stands in its gaps, at the next height. The first n // 2
    drones are the southern side, from front to rear and again; the rest are the northern one.
    """

    gap_m: Positive = Field(description="distance between the two sides, m")
    lane_step_m: Annotated[Number, Field(ge=1.2)] = Field(
        default=1.6, description="distance from lane to lane, m"
    )
    lanes_a_side: Count = Field(default=2, description="lanes per side, one behind the other")
    spacing_m: Annotated[Number, Field(ge=1.5)] = Field(default=2.5, description="distance within a lane, m")
    heights_m: Heights = Field(
        default=(5.0,), description="heights of a side's lanes above the ground, taken in turn, m"
    )
    uneven_m: Annotated[Number, Field(ge=0.0)] = Field(
        default=0.0, description="each stands off its even place, north and east, by up to this, m"
    )

    def stations(self, n: int) -> list[Station]:
        stations: list[Station] = []
        off = _uneven(n, self.uneven_m)
        for side, size, direction in ((0, n // 2, -1.0), (1, n - n // 2, 1.0)):
            for k in range(size):
                lane, rank = k % self.lanes_a_side, k // self.lanes_a_side
                in_lane = math.ceil((size - lane) / self.lanes_a_side)
                used = min(size, self.lanes_a_side)
                shift = (lane - (used - 1) / 2.0) / self.lanes_a_side
                east = self.spacing_m * (rank - (in_lane - 1) / 2.0 + shift)
                north = direction * (self.gap_m / 2.0 + lane * self.lane_step_m)
                position = np.array([north, east, -self.heights_m[lane % len(self.heights_m)]])
                position += off[len(stations)]
                stations.append(Station(position, side, 2.0 * math.pi * lane / self.lanes_a_side))
        return stations


def best_view(eye: ArrayLike, others: Sequence[ArrayLike], width: float) -> Array:
    """The point (3,) m to look at from `eye` so that a view `width` rad wide shows as many of the others as it can.

    It lies as far away as the farthest of those in view. Among equally many, those farther away are preferred: they
    move less in the image.
    """
    offsets = np.array([np.asarray(other, float) - np.asarray(eye, float) for other in others]).reshape(-1, 3)
    if not len(offsets):
        return np.asarray(np.asarray(eye, float) + np.array([1.0, 0.0, 0.0]))
    bearing = np.arctan2(offsets[:, 1], offsets[:, 0])
    distance = np.hypot(offsets[:, 0], offsets[:, 1])
    groups = []
    for leftmost in bearing:
        turn = (bearing - leftmost) % (2.0 * math.pi)
        seen = turn <= width
        rank = (int(seen.sum()), round(float(distance[seen].mean()), 6))
        groups.append((rank, leftmost + turn[seen].max() / 2.0, distance[seen].max()))
    _, heading, reach = max(groups, key=lambda group: group[0])
    target: Array = np.asarray(eye, float) + reach * np.array([math.cos(heading), math.sin(heading), 0.0])
    return target


# --- flights ---------------------------------------------------------------------------------------


class Sway(Section):
    """Each drone by itself about its station."""

    amplitude_m: Place = Field(description="[north, east, down], m")
    period_s: Range = Field(description="[shortest, longest], s")

    def path(self, world: World, drone_id: int, station: Station) -> Path:
        chance = world.chance("sway", drone_id)
        frequencies = 1.0 / chance.uniform(*self.period_s, 3)
        return Lissajous(
            station.position, self.amplitude_m, frequencies, chance.uniform(0.0, 2.0 * math.pi, 3)
        )


class Weave(Section):
    """The drones of a lane swing east and west together, up to `reach_m`, and the lanes of a side against each other.

    Each side has its own period, drawn from a range of s. As its lanes share it, they meet where both are fast.
    """

    reach_m: Positive = Field(description="amplitude, to either side, m")
    period_s: Range = Field(description="[shortest, longest], s")

    def path(self, world: World, drone_id: int, station: Station) -> Path:
        chance = world.chance("weave", station.side)
        frequency = 1.0 / chance.uniform(*self.period_s)
        phase = chance.uniform(0.0, 2.0 * math.pi) + station.phase
        return Lissajous(station.position, (0.0, self.reach_m, 0.0), (0.0, frequency, 0.0), (0.0, phase, 0.0))


class Swing(Section):
    """Looking left and right, up to `peak_rad_s`; each drone in its own time, its period drawn from a range of s."""

    peak_rad_s: Positive = Field(description="highest yaw rate")
    period_s: Range = Field(description="[shortest, longest], s")

    def view(self, world: World, drone_id: int, heading: float, departs_s: float) -> YawProfile:
        chance = world.chance("swing", drone_id)
        period = chance.uniform(*self.period_s)
        return SwingingYaw(heading, self.peak_rad_s, period, departs_s + chance.uniform(0.0, period))


def form_up(
    seed: int,
    stations: Mapping[int, Station],
    *,
    flight: Sway | Weave | None,
    swing: Swing | None,
    departs_s: Mapping[int, float],
    view: float,
) -> dict[int, Plan]:
    """The plans of a formation whose drones each look where they see most of the others. view: rad, see `best_view`."""
    world = World(seed, {})
    plans = {}
    for drone_id, station in stations.items():
        others = [other.position for key, other in stations.items() if key != drone_id]
        target = best_view(station.position, others, view)
        north, east, _ = target - station.position
        heading = math.atan2(east, north)
        if swing is not None:
            profile = swing.view(world, drone_id, heading, departs_s[drone_id])
        else:
            # Who leaves its station by metres keeps the others in view by looking at a point among them.
            profile = Facing(target) if isinstance(flight, Weave) else SteadyYaw(heading)
        path = flight.path(world, drone_id, station) if flight is not None else None
        plans[drone_id] = Plan(station.position, profile, path, departs_s[drone_id])
    return plans
