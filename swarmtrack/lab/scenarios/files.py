"""Scenarios as TOML files: read, checked, and turned into a `Scenario`. configs/scenarios holds those that are shipped.

A file describes a formation, which makes as many drones as requested, or drones one by one (`[[drone]]`), or both.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Annotated, Self

from pydantic import (
    BeforeValidator,
    Field,
    Strict,
    field_validator,
    model_validator,
)

from swarmtrack.config.drone import Intrinsics, Lens, Mount
from swarmtrack.config.team import TeamOrigin
from swarmtrack.config.toml.layers import Key, Layers, Problem, read_layers
from swarmtrack.config.toml.sections import (
    NotNegative,
    Number,
    ParameterSection,
    Place,
    Positive,
    Section,
    Switch,
    Text,
    Vector,
    found,
    one_of,
    parameter_problems,
    validated,
)
from swarmtrack.errors import ConfigError
from swarmtrack.formation.plan import FormationPlan, plan_faults
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.lab.scenarios.scenario import (
    BODY_FROM_CAMERA,
    CAMERA,
    DRIFT_M,
    HOVER_S,
    LOCKSTEP_SKEW,
    SCENARIO_ORIGIN,
    AnnouncedStart,
    AutopilotKind,
    DroneId,
    Ghosts,
    Lanes,
    Plan,
    Radio,
    Ring,
    Scenario,
    ScenarioCamera,
    ScenarioEvent,
    ScenarioFault,
    Sway,
    Swing,
    Weave,
    Wind,
    announced_starts,
    drawn_skews,
    fly,
    form_up,
    run_errands,
)
from swarmtrack.lab.score.swarm_verdict import Limits
from swarmtrack.lab.world.airframe import Airframe
from swarmtrack.lab.world.errands import Errand
from swarmtrack.lab.world.sensors import DetectorParameters
from swarmtrack.lab.world.star import Star, Stick, arc, fly_star
from swarmtrack.lab.world.trajectory import (
    Facing,
    Lissajous,
    MinimumSnap,
    SteadyYaw,
    SwingingYaw,
    YawProfile,
)
from swarmtrack.lab.world.trajectory import (
    Path as FlightPath,
)
from swarmtrack.lab.world.world import World

FOLDER = Path(str(resources.files("swarmtrack") / "configs" / "scenarios"))
# Each is a process with a camera of its own, and to find the places of more takes longer than anybody waits.
MAX_SCENARIO_DRONES = 100
MOST_ON_ERRANDS = 20  # each takes 0.2 s to prepare, in every process of the simulation
MAX_CAMERAS = 8  # of a drone
CLIMBS_S = 8.0  # s from a take-off to the height of a slot
FASTEST_LEADER_M_S = 5.0
FENCE_M = 200.0  # around where a follower was engaged: wider than any scenario, it is not what is shown
WALKING_SIGMA_M = 0.3  # m: what docs/rehearse.md lets a PX4 state
LEAST_STAR_HEIGHT_M = 2.0  # as an agent's config has it: nobody's slot is lower
VIEW_MARGIN = math.radians(4.0)  # at each side of the image, for drift and sway
VIEW = 2.0 * (math.atan(0.5 * CAMERA.width / CAMERA.fx) - VIEW_MARGIN)

ShareRate = Annotated[Number, Field(ge=2.0, le=10.0)]
DroneCount = Annotated[int, Strict(), Field(ge=1, le=MAX_SCENARIO_DRONES)]


class ScenarioCameraSection(Section):
    """[camera], or one of [[camera]]: a camera on every drone."""

    fps: Annotated[Positive, Field(le=1000.0)] = Field(default=15.0, description="frames per second")
    intrinsics: Intrinsics | None = Field(
        default=None,
        description="the intrinsics as numbers, px; the shipped camera of 73 degrees by default",
    )
    distortion: Lens | None = Field(default=None, description="the distortion that goes with intrinsics")
    body_from_camera: Mount | None = Field(
        default=None, description="the camera's mounting; 0.1 m ahead, looking along the nose, by default"
    )
    phase: Annotated[Number, Field(ge=0.0, lt=1.0)] | None = Field(
        default=None,
        description="delay of its exposure, as a share of the frame interval; evenly spread by default",
    )
    mounting_sigma_deg: Annotated[Number, Field(ge=0.0, le=10.0)] = Field(
        default=0.0, description="error of the angles in the configs, degrees per axis; the configs state it"
    )

    @model_validator(mode="after")
    def _one_lens(self) -> Self:
        if self.distortion is not None and self.intrinsics is None:
            raise ValueError("distortion without intrinsics, expected both")
        return self

    def camera(self, place: int, of: int) -> ScenarioCamera:
        """place: among the cameras of a drone, of which there are so many."""
        lens = CAMERA
        if self.intrinsics is not None:
            bent = None if self.distortion is None else self.distortion.distortion()
            lens = PinholeCamera(**self.intrinsics.model_dump(), distortion=bent)
        mount = BODY_FROM_CAMERA if self.body_from_camera is None else self.body_from_camera.pose()
        phase = place / of if self.phase is None else self.phase
        return ScenarioCamera(lens, mount, self.fps, phase, math.radians(self.mounting_sigma_deg))


def _listed(found: object) -> object:
    """One table [camera] as a list of one, with its own keys in what is wrong with it."""
    if not isinstance(found, list | tuple):
        return (ScenarioCameraSection.model_validate(found),)
    if not 1 <= len(found) <= MAX_CAMERAS:
        raise ValueError(f"{len(found)} cameras, expected 1 to {MAX_CAMERAS}")
    return found


Cameras = Annotated[tuple[ScenarioCameraSection, ...], BeforeValidator(_listed)]


class AgentsSection(Section):
    """[agents]: values for the configs of the agents."""

    imu_rate_hz: Annotated[Positive, Field(le=1000.0)] = Field(
        default=200.0, description="IMU rate requested from the autopilot"
    )
    tracks_hz: Annotated[Positive, Field(le=1000.0)] = Field(
        default=100.0, description="highest rate of published tracks"
    )
    position_sigma_m: Positive = Field(
        default=0.05, description="standard deviation of the measured starts, m per axis"
    )
    announce: Switch = Field(default=True, description="false: agents send each other nothing")
    share_hz: ShareRate | None = Field(
        default=None, description="rate at which they share their velocities; never without this key"
    )
    late: Annotated[int, Strict(), Field(ge=0)] = Field(
        default=0, description="how many agents start late: those with the highest IDs"
    )
    late_by_s: Positive = Field(default=8.0, description="how late they start, s")
    swapped: tuple[DroneId, ...] = Field(
        default=(),
        description="drones on each other's pads: each one's config has the next one's start",
    )


class ClocksSection(Section):
    """[clocks]: lists of values. The drones take them in turn, in the order of their IDs."""

    utc_offset_s: tuple[Number, ...] = Field(
        default=(), description="error of the companion computer's wall clock, s"
    )
    autopilot_skew_ppm: tuple[Annotated[Number, Field(ge=-1000.0, le=1000.0)], ...] = Field(
        default=(),
        description="rate error of the autopilot's clock, positive: fast; ±100 to ±200 by default",
    )
    camera_offset_s: tuple[Annotated[Number, Field(ge=-0.15, le=0.15)], ...] = Field(
        default=(), description="delay of the camera's stamps, s"
    )
    autopilot_boot_s: tuple[NotNegative, ...] = Field(
        default=(), description="reading of the autopilot's clock at world time 0, s"
    )


class StarSection(Section):
    """Followers on an arc behind a leader, whose agents fly them by sight; see `lab.world.star`. The first drone
    leads."""

    gap_m: Annotated[Number, Field(ge=3.0, le=30.0)] = Field(
        default=5.0, description="horizontal distance from the leader to its followers, m"
    )
    layer_m: Annotated[Number, Field(ge=0.0, le=5.0)] = Field(
        default=1.0, description="height of followers above or below the leader, m"
    )
    height_m: Annotated[Number, Field(ge=4.0, le=120.0)] = Field(
        default=6.0, description="height of the leader above the ground, m"
    )
    takes_off_s: NotNegative | None = Field(
        default=None,
        description="when all take off, world time, s; by default they hover from the beginning",
    )
    engages_s: Positive = Field(
        default=3.0, description="when the followers' pilots let their agents fly, world time, s"
    )
    judged_from_s: Positive = Field(description="when the verdict on slots begins, world time, s")
    leader_leaves_s: Positive | None = Field(
        default=None, description="when the leader leaves all views, world time, s"
    )
    sticks: Annotated[tuple[Stick, ...], Field(min_length=2)] = Field(
        description="velocities that the leader's pilot commands; the first and the last are 0"
    )

    @model_validator(mode="after")
    def _one_after_the_other(self) -> Self:
        if self.takes_off_s is not None and self.engages_s < self.takes_off_s + CLIMBS_S:
            raise ValueError(
                f"engages_s {self.engages_s:g}, expected takes_off_s + {CLIMBS_S:g} or later: they climb first"
            )
        times = [stick.at_s for stick in self.sticks]
        if times[0] < self.engages_s or any(b <= a for a, b in itertools.pairwise(times)):
            raise ValueError(
                f"sticks at_s {times}, expected each later than the one before, the first after engages_s"
            )
        speeds = [math.hypot(*stick.velocity_m_s) for stick in self.sticks]
        if speeds[0] or speeds[-1]:
            raise ValueError("sticks: the first and the last velocity, expected [0, 0, 0]")
        if max(speeds) > FASTEST_LEADER_M_S:
            raise ValueError(f"sticks: {max(speeds):g} m/s, expected {FASTEST_LEADER_M_S:g} m/s or less")
        return self

    def star(self, ids: Sequence[int]) -> Star:
        """The lowest ID leads."""
        return Star(
            leader=ids[0],
            slots=arc(ids, self.gap_m, layer_m=self.layer_m),
            height_m=self.height_m,
            takes_off_s=-math.inf if self.takes_off_s is None else self.takes_off_s,
            engages_s=self.engages_s,
            judged_from_s=self.judged_from_s,
            sticks=self.sticks,
            leader_leaves_s=math.inf if self.leader_leaves_s is None else self.leader_leaves_s,
            settings={"limits": {"fence_radius_m": FENCE_M}},
        )


class FormationSection(Section):
    """[formation]: a shape for any number of drones, and how they move after the hover."""

    drones: DroneCount = Field(description="number of drones, unless --drones is given")
    autopilots: tuple[AutopilotKind, ...] = Field(
        default=(), description="kinds of their autopilots, taken in turn; ArduPilot by default"
    )
    ring: Ring | None = Field(default=None, description="shape: a circle of drones that face its centre")
    lanes: Lanes | None = Field(default=None, description="shape: lanes on two sides that face each other")
    errand: Errand | None = Field(
        default=None, description="shape and flight: a circle on the ground, take-offs, go-tos"
    )
    star: StarSection | None = Field(
        default=None, description="shape and flight: followers behind a leader, flown by their agents"
    )
    sway: Sway | None = Field(default=None, description="flight: each drone oscillates about its station")
    weave: Weave | None = Field(
        default=None, description="flight, with lanes: neighbouring lanes swing in opposite directions"
    )
    swing: Swing | None = Field(default=None, description="in addition: each drone yaws to and fro")

    @model_validator(mode="after")
    def _one_shape_and_one_flight(self) -> FormationSection:
        shapes = sum(shape is not None for shape in (self.ring, self.lanes, self.errand, self.star))
        if shapes != 1:
            raise ValueError(f"{shapes} of ring, lanes, errand and star, expected one of them")
        moves = [name for name in ("sway", "weave", "swing") if getattr(self, name) is not None]
        for name in ("errand", "star"):
            if getattr(self, name) is not None and moves:
                raise ValueError(
                    f"{name} with {moves[0]}, expected one or the other: {name}s are flights already"
                )
        if self.star is not None and set(self.autopilots) - {AutopilotKind.ARDUPILOT}:
            raise ValueError('star with autopilots, expected "ardupilot", whose response is known')
        if self.sway is not None and self.weave is not None:
            raise ValueError("both sway and weave, expected one of them")
        if self.weave is not None and self.lanes is None:
            raise ValueError(
                "weave with ring, expected sway, or lanes, whose drones can swing sideways together"
            )
        return self


class OscillationSection(Section):
    """centre + amplitude sin(2π frequency t + phase), each [north, east, down]."""

    centre_m: Place = Field(description="[north, east, down], m")
    amplitude_m: Place = Field(description="[north, east, down], m")
    frequency_hz: Vector = Field(description="frequency of each axis")
    phase_rad: Vector = Field(default=(0.0, 0.0, 0.0), description="phase of each axis at world time 0")


class WaypointSection(Section):
    at_s: Number = Field(description="world time, s; later than the previous one")
    position_m: Place = Field(description="[north, east, down], m")


class OwnSwingSection(Section):
    peak_rad_s: Positive = Field(description="highest yaw rate")
    period_s: Positive = Field(description="period of one swing to and fro, s")


class PlannedFlight(Section):
    """Where one drone hovers, how it then flies, and which way it looks."""

    id: DroneId = Field(description="1 … 65535, unique")
    position_m: Place = Field(description="where it hovers first, [north, east, down], m; up is negative")
    looks_at_m: Place | None = Field(default=None, description="a point that it always faces")
    heading_deg: Number | None = Field(
        default=None, description="heading, clockwise from north, instead of looks_at_m"
    )
    swing: OwnSwingSection | None = Field(default=None, description="yaw to and fro about its heading")
    flight: OscillationSection | None = Field(default=None, description="endless oscillation after the hover")
    waypoints: tuple[WaypointSection, ...] = Field(
        default=(), description="instead of flight: from rest at the first to rest at the last"
    )

    @model_validator(mode="after")
    def _one_way_to_fly_and_to_look(self) -> Self:
        if self.looks_at_m is not None and (self.heading_deg is not None or self.swing is not None):
            raise ValueError("looks_at_m with heading_deg or swing, expected one or the other")
        if self.flight is not None and self.waypoints:
            raise ValueError("both flight and waypoints, expected one of them")
        return self

    @field_validator("waypoints")
    @classmethod
    def _later_and_later(cls, waypoints: tuple[WaypointSection, ...]) -> tuple[WaypointSection, ...]:
        if len(waypoints) == 1:
            raise ValueError("one waypoint, expected two or more")
        if any(after.at_s <= before.at_s for before, after in itertools.pairwise(waypoints)):
            raise ValueError(
                f"at_s {[point.at_s for point in waypoints]}, expected each later than the one before"
            )
        return waypoints

    def plan(self, hover_s: float) -> Plan:
        return Plan(self.position_m, self._view(hover_s), self._flight(), hover_s)

    def _view(self, hover_s: float) -> YawProfile:
        heading = math.radians(self.heading_deg or 0.0)
        if self.looks_at_m is not None:
            return Facing(self.looks_at_m)
        if self.swing is not None:
            return SwingingYaw(heading, self.swing.peak_rad_s, self.swing.period_s, hover_s)
        return SteadyYaw(heading)

    def _flight(self) -> FlightPath | None:
        if self.flight is not None:
            f = self.flight
            return Lissajous(f.centre_m, f.amplitude_m, f.frequency_hz, f.phase_rad)
        if self.waypoints:
            return MinimumSnap(
                [point.at_s for point in self.waypoints], [point.position_m for point in self.waypoints]
            )
        return None


class DroneSection(PlannedFlight):
    """[[drone]]: one drone by itself, with or without a formation."""

    stranger: Switch = Field(
        default=False, description="true: it has no agent and does not belong to the team"
    )
    guided: Switch = Field(
        default=False, description="true: it stands on the ground there until a program flies it by MAVLink"
    )
    autopilot: AutopilotKind = Field(default=AutopilotKind.ARDUPILOT, description="kind of its autopilot")

    @model_validator(mode="after")
    def _guided_or_by_plan(self) -> Self:
        planned = [name for name in ("flight", "waypoints", "swing") if getattr(self, name)]
        if self.guided and planned:
            raise ValueError(f"guided with {planned[0]}, expected one of them: who is guided has no plan")
        if self.guided and self.stranger:
            raise ValueError("guided stranger, expected one of them: a stranger has no autopilot to command")
        return self

    def plan(self, hover_s: float) -> Plan:
        plan = super().plan(hover_s)
        return dataclasses.replace(plan, guided=self.autopilot.response) if self.guided else plan


class ScenarioFile(Section):
    """A whole file."""

    about: Text = Field(description="what the scenario shows, for --list")
    seconds: Positive = Field(description="length of the flight without --seconds, s")
    hover_s: NotNegative = Field(default=HOVER_S, description="how long all drones hover before they fly, s")
    drift_m: Annotated[Number, Field(ge=0.0, le=0.1)] = Field(
        default=DRIFT_M, description="error with which a drone holds its position, RMS per axis, m"
    )
    wind: Wind | None = None
    origin: TeamOrigin | None = Field(
        default=None, description="{ lat_deg, lon_deg, alt_m } of the world's origin"
    )
    codes_s: tuple[NotNegative, ...] = Field(
        default=(), description="when all drones sway by their codes, world time, s"
    )
    camera: Cameras = (ScenarioCameraSection(),)
    agents: AgentsSection = AgentsSection()
    clocks: ClocksSection = ClocksSection()
    detector: ParameterSection = ParameterSection()
    radio: Radio = Radio()
    ghosts: Ghosts = Ghosts(count=0)
    formation: FormationSection | None = None
    drone: tuple[DroneSection, ...] = Field(default=(), max_length=2 * MAX_SCENARIO_DRONES)
    fault: tuple[ScenarioFault, ...] = ()
    expected: ParameterSection = ParameterSection()

    @property
    def sway_m(self) -> float:
        """RMS per axis of a drone that holds its place, m."""
        return self.drift_m if self.wind is None else max(self.drift_m, self.wind.gusts_m)


def scenario_names() -> list[str]:
    """The shipped scenarios."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def load_scenario(name_or_path: str | Path, *, seed: int = 1, drones: int | None = None) -> Scenario:
    """The scenario of a TOML file, or the shipped scenario of that bare name.

    seed ≥ 0 decides all that is random. drones: how many of the team fly; None: as many as the file says.
    Raises ConfigError with every problem that was found.
    """
    path = _path(name_or_path)
    return scenario_of(read_scenario(name_or_path), path.stem, seed=seed, drones=drones)


def read_scenario(name_or_path: str | Path) -> Layers:
    """The layers of a scenario's files, not yet checked. Raises ConfigError."""
    return read_layers(_path(name_or_path), lambda table, folder: None)


def scenario_of(layers: Layers, name: str, *, seed: int, drones: int | None) -> Scenario:
    """As `load_scenario`, from layers that were read before."""
    problems = parameter_problems(layers, "detector", DetectorParameters)
    problems += parameter_problems(layers, "expected", Limits)
    file = validated(ScenarioFile, layers, problems, lambda file: _drone_problems(layers, file, drones))
    return _scenario(name, file, seed, drones)


def load_limits(name_or_path: str | Path) -> Limits:
    """What a scenario expects of a flight, from [expected] of a file that `load_scenario` has accepted."""
    return limits_of(read_scenario(name_or_path))


def limits_of(layers: Layers) -> Limits:
    """As `load_limits`, from layers that were read before."""
    return Limits(**layers.table.get("expected", {}))


def _path(name_or_path: str | Path) -> Path:
    name = str(name_or_path)
    if isinstance(name_or_path, Path) or "/" in name or name.endswith(".toml"):
        return Path(name_or_path)
    known = scenario_names()
    if name not in known:
        raise ConfigError([f"scenario {found(name)}, {one_of(name, known)}"])
    return FOLDER / f"{name}.toml"


def _drone_problems(layers: Layers, file: ScenarioFile, drones: int | None) -> list[Problem]:
    """What is wrong with the number of drones, and with the IDs that are used."""
    problems: list[Problem] = []

    def wrong(key: Key, text: str) -> None:
        place = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in key)
        problems.append(layers.problem(key, f"{place.removeprefix('.')}: {text}"))

    ids = [drone.id for drone in file.drone]
    for k, drone_id in enumerate(ids):
        if drone_id in ids[:k]:
            wrong(("drone", k, "id"), f"{drone_id}, expected an ID that no other drone has")
    wanted = _team_size(file, drones)
    for key, text in _size_faults(file, wanted):
        wrong(key, text)
    by_others = [drone.id for drone in file.drone if drone.guided]
    shape = file.formation
    if file.codes_s and (by_others or (shape is not None and (shape.errand or shape.star) is not None)):
        wrong(
            ("codes_s",), "with guided drones, errands or a star, expected drones that hover or fly by plan"
        )
    if problems:
        return problems
    flying = {*ids, *_formation_ids(file, wanted)}
    for k, drone_id in enumerate(file.agents.swapped):
        if drone_id not in flying or drone_id in file.agents.swapped[:k]:
            wrong(("agents", "swapped"), f"drone {drone_id}, expected some of {sorted(flying)}, each once")
    if shape is not None and shape.star is not None:
        if _drones_one_by_one(file):
            wrong(
                ("drone",),
                "of the team beside a star, expected strangers only: a star has a slot for all others",
            )
        for text in _star_faults(shape.star, _formation_ids(file, wanted)):
            wrong(("formation", "star"), text)
    for k, fault in enumerate(file.fault):
        absent = sorted(set(fault.drones) - flying)
        if absent:
            wrong(
                ("fault", k, "drones"),
                f"drone {absent[0]}, which does not fly, expected some of {sorted(flying)}",
            )
    return problems


def _size_faults(file: ScenarioFile, wanted: int) -> Iterator[tuple[Key, str]]:
    """What is wrong with the number of drones."""
    one_by_one = _drones_one_by_one(file)
    if file.formation is None:
        if not one_by_one:
            yield ("formation",), "missing, expected a table [formation], or drones one by one in [[drone]]"
        elif wanted != one_by_one:
            text = f"expected {one_by_one}: it has no [formation] that makes others"
            yield ("drone",), f"{wanted} drones wanted, {text}"
        return
    key, least = ("formation", "drones"), max(1, one_by_one)
    if not least <= wanted <= MAX_SCENARIO_DRONES:
        yield key, f"{wanted} drones wanted, expected {least} to {MAX_SCENARIO_DRONES}"
    if file.formation.errand is not None and wanted > MOST_ON_ERRANDS:
        text = f"expected {MOST_ON_ERRANDS} at most: each errand is flown before the scenario"
        yield key, f"{wanted} drones wanted, {text}"


def _drones_one_by_one(file: ScenarioFile) -> int:
    """How many of the team have a table of their own."""
    return sum(not drone.stranger for drone in file.drone)


def _star_faults(section: StarSection, ids: Sequence[int]) -> list[str]:
    """What its agents would refuse."""
    if len(ids) < 2:
        return ["one drone, expected a leader and a follower or more"]
    star = section.star(ids)
    plan = FormationPlan(
        leader=star.leader,
        slots=star.slots,
        references=dict.fromkeys(star.followers, (star.leader,)),
        height=star.height_m,
        least_height=LEAST_STAR_HEIGHT_M,
    )
    faults = plan_faults(plan, Airframe().span)
    return [f"{len(ids)} drones, {'.'.join(fault.key)}: {fault.text}" for fault in faults[:1]]


def _team_size(file: ScenarioFile, drones: int | None) -> int:
    if drones is not None:
        return drones
    return file.formation.drones if file.formation is not None else _drones_one_by_one(file)


def _formation_ids(file: ScenarioFile, team: int) -> list[int]:
    """The lowest free IDs, for all team members that are not described one by one."""
    taken = {drone.id for drone in file.drone}
    free = (drone_id for drone_id in itertools.count(1) if drone_id not in taken)
    return list(itertools.islice(free, team - _drones_one_by_one(file)))


def _autopilots(file: ScenarioFile, members: Sequence[int], ids: Sequence[int]) -> dict[int, AutopilotKind]:
    """By drone. ids: of those that the formation makes."""
    autopilots = dict.fromkeys(members, AutopilotKind.ARDUPILOT)
    autopilots |= {drone.id: drone.autopilot for drone in file.drone}
    if file.formation is not None and file.formation.autopilots:
        autopilots |= zip(ids, itertools.cycle(file.formation.autopilots), strict=False)
    return autopilots


def _with_errands(
    world: World, file: ScenarioFile, ids: Sequence[int], autopilots: Mapping[int, AutopilotKind]
) -> tuple[World, tuple[ScenarioEvent, ...]]:
    """The same world, in which the drones of the formation run their errands, where there are any; and what happens."""
    shape = file.formation
    if shape is None or shape.errand is None:
        return world, ()
    responses = {drone_id: autopilots[drone_id].response for drone_id in ids}
    return run_errands(world, ids, shape.errand, file.sway_m, responses)


def _announced(
    world: World, agents: AgentsSection, autopilots: Mapping[int, AutopilotKind]
) -> dict[int, AnnouncedStart]:
    """Starts by drone; of those whose position walks as vague as the manual has it."""
    starts = announced_starts(world, agents.position_sigma_m, agents.swapped)
    walking = {n for n in starts if n in autopilots and autopilots[n].ego.walks_m[1] > 0.0}
    return starts | {
        n: dataclasses.replace(starts[n], position_sigma_m=max(starts[n].position_sigma_m, WALKING_SIGMA_M))
        for n in walking
    }


def _scenario(name: str, file: ScenarioFile, seed: int, drones: int | None) -> Scenario:
    ids = _formation_ids(file, _team_size(file, drones)) if file.formation is not None else []
    members = sorted([*ids, *(drone.id for drone in file.drone if not drone.stranger)])
    agents = file.agents
    starts = dict.fromkeys(members[len(members) - agents.late :], agents.late_by_s) if agents.late else {}
    autopilots = _autopilots(file, members, ids)
    plans = {drone.id: drone.plan(file.hover_s + starts.get(drone.id, 0.0)) for drone in file.drone}
    shape = file.formation
    if shape is not None and (layout := shape.ring or shape.lanes) is not None:
        plans |= form_up(
            seed,
            dict(zip(ids, layout.stations(len(ids)), strict=True)),
            flight=shape.sway or shape.weave,
            swing=shape.swing,
            departs_s={drone_id: file.hover_s + starts.get(drone_id, 0.0) for drone_id in ids},
            view=VIEW,
        )
    world = fly(seed, dict(sorted(plans.items())), file.sway_m, codes_s=file.codes_s, team=tuple(members))
    world, events = _with_errands(world, file, ids, autopilots)
    star = shape.star.star(ids) if shape is not None and shape.star is not None else None
    if star is not None:
        world = fly_star(world, star, file.sway_m)
    if file.wind is not None:
        world = file.wind.blows(world)
    strangers = frozenset(drone.id for drone in file.drone if drone.stranger)
    starts_at = _announced(world, agents, autopilots)

    def in_turn(values: Sequence[float], factor: float = 1.0) -> dict[int, float]:
        return dict(zip(members, itertools.cycle([factor * value for value in values]), strict=False))

    return Scenario(
        world=world,
        origin=file.origin.place() if file.origin else SCENARIO_ORIGIN,
        name=name,
        about=file.about,
        seconds=file.seconds,
        cameras=tuple(camera.camera(place, len(file.camera)) for place, camera in enumerate(file.camera)),
        imu_rate_hz=agents.imu_rate_hz,
        tracks_hz=agents.tracks_hz,
        detector=DetectorParameters(**file.detector.parameters),
        announced={drone_id: starts_at[drone_id] for drone_id in starts_at if drone_id not in strangers},
        announces=agents.announce,
        share_hz=agents.share_hz,
        codes_s=file.codes_s,
        strangers=strangers,
        starts_s=starts,
        utc_offset_s=in_turn(file.clocks.utc_offset_s),
        autopilot_skew=(in_turn(file.clocks.autopilot_skew_ppm, 1e-6) or drawn_skews(world, members))
        | {n: LOCKSTEP_SKEW for n in members if autopilots[n] is AutopilotKind.PX4_LOCKSTEP},
        autopilot_boot_s=in_turn(file.clocks.autopilot_boot_s),
        autopilots=autopilots,
        camera_offset_s=in_turn(file.clocks.camera_offset_s),
        ghosts=file.ghosts.drawn(world),
        events=events,
        radio=file.radio,
        faults=file.fault,
        formation=star,
    )
