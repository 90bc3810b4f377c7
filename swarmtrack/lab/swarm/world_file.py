"""A world from outside as a TOML file: who flies it, where the truth about each drone is told, and what it looks like.

    [world]
    origin = { lat_deg = -35.363262, lon_deg = 149.165237, alt_m = 584.0 }    # on the ground

    [[drone]]
    id = 1
    link = "tcp:127.0.0.1:5762"       # for the agent
    truth = "tcp:127.0.0.1:5763"      # for us

Everything else is as in a scenario, or has a default. docs/rehearse.md tells how it is used.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, Strict, field_validator, model_validator

from swarmtrack.autopilot.address import parse_address
from swarmtrack.config.drone import CameraSection, Intrinsics, Lens, Mount, Start, mount_camera
from swarmtrack.config.formation import TeamFormation, fields_of_view, plan_problem
from swarmtrack.config.team import TeamOrigin
from swarmtrack.config.toml.layers import Layers, Problem, Table, read_layers
from swarmtrack.config.toml.sections import (
    Number,
    ParameterSection,
    Positive,
    Section,
    Switch,
    Text,
    parameter_problems,
    validated,
)
from swarmtrack.errors import SourceError, SwarmtrackError
from swarmtrack.formation.plan import FormationPlan, PlanFault, plan_faults, view_faults
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.lab.scenarios.files import PlannedFlight, ShareRate
from swarmtrack.lab.scenarios.scenario import (
    BODY_FROM_CAMERA,
    CAMERA,
    HOVER_S,
    DroneId,
    Scenario,
    ScenarioCamera,
    fly,
)
from swarmtrack.lab.score.swarm_verdict import Limits
from swarmtrack.lab.swarm.truth_link import TruthAddress
from swarmtrack.lab.world.airframe import Airframe
from swarmtrack.lab.world.followed import FOLLOWED_KEPT_S, FollowedDrone
from swarmtrack.lab.world.sensors import DetectorParameters
from swarmtrack.lab.world.star import TeamSlots
from swarmtrack.lab.world.world import World

LINKS = ("link", "truth")
TRUTH_SCHEMES = ("tcp", "udpin", "udpout")
FORMATION_SHARE_HZ = 5.0  # without each other's velocities nothing holds


class WorldSection(Section):
    """[world]"""

    origin: TeamOrigin = Field(
        description="{ lat_deg, lon_deg, alt_m } of the world's origin, on the ground where the drones start"
    )
    about: Text = Field(default="flown from outside", description="one sentence: what it shows")
    seed: Annotated[int, Strict(), Field(ge=0)] = Field(
        default=1, description="seed of scenery, paint and noise"
    )
    seconds: Positive = Field(default=60.0, description="length of the flight that is judged, s")
    counts_from: Literal["start", "take-off"] = Field(
        default="start",
        description='beginning of seconds and judged_from_s: "start" of the agents, or the first drone\'s "take-off"',
    )


class WorldCameraSection(Section):
    """[camera]: of every drone."""

    fps: Annotated[Positive, Field(le=1000.0)] = 15.0
    calibration: Path | None = Field(default=None, description="calibration file, instead of intrinsics")
    calibration_camera: Text | None = Field(
        default=None, description="which camera, where the file holds several"
    )
    intrinsics: Intrinsics | None = Field(default=None, description="the intrinsics as numbers, px")
    distortion: Lens | None = Field(default=None, description="the distortion that goes with intrinsics")
    body_from_camera: Mount | None = Field(default=None, description="where the camera sits on the drone")

    @model_validator(mode="after")
    def _one_calibration(self) -> WorldCameraSection:
        if self.calibration is not None and self.intrinsics is not None:
            raise ValueError("both calibration and intrinsics, expected one of them, or neither")
        if self.distortion is not None and self.intrinsics is None:
            raise ValueError("distortion without intrinsics, expected both")
        return self

    def mounted(self) -> tuple[PinholeCamera, Pose]:
        """Camera and body_from_camera. Raises CalibrationError."""
        mount = BODY_FROM_CAMERA if self.body_from_camera is None else self.body_from_camera.pose()
        if self.calibration is None and self.intrinsics is None:
            return CAMERA, mount
        given = {name: getattr(self, name) for name in self.model_fields_set - {"fps", "body_from_camera"}}
        mounted = mount_camera(CameraSection(source="http://", **given))
        has_mount = self.body_from_camera is None and self.calibration is not None
        return mounted.camera, mounted.body_from_camera if has_mount else mount


class WorldAgentsSection(Section):
    """[agents]: values for the configs of the agents."""

    imu_rate_hz: Annotated[Positive, Field(le=1000.0)] = 200.0
    tracks_hz: Annotated[Positive, Field(le=1000.0)] = 100.0
    share_hz: ShareRate | None = Field(
        default=None,
        description="rate of motion reports; by default 5 Hz in formation, else none",
    )
    feed: Literal["none", "odometry"] = Field(
        default="none", description="autopilot.feed of the agents' configs (docs/feeding.md)"
    )


class WorldFormationSection(TeamFormation):
    """[formation]: as in the agents' configs. Their pilots engage them in the air, whoever those are."""

    enabled: Switch = Field(default=True, description="false: the agents of followers only watch")
    judged_from_s: Positive = Field(
        default=30.0, description="beginning of the judgement of slots, s; counts as world.seconds"
    )

    def team_slots(self) -> TeamSlots | None:
        plan = self.plan()
        if plan is None:
            return None
        told_beside = {"leader", "slots", "height_m", "judged_from_s"}
        return TeamSlots(
            leader=plan.leader,
            slots=plan.slots,
            height_m=plan.height,
            judged_from_s=self.judged_from_s,
            settings=self.model_dump(exclude=told_beside, exclude_unset=True),
        )


class AirframeSection(Section):
    """What a drone looks like."""

    span_m: Annotated[Number, Field(gt=0.05, le=10.0)] = Field(
        description="from the outer rim of one rotor to that of its neighbour, m; all else is in proportion"
    )


class OutsideDroneSection(Section):
    """[[drone]]: a drone that others fly, and that has an agent of ours."""

    id: DroneId = Field(description="1 … 65535, unique")
    link: Text = Field(
        description="the MAVLink link for its agent, as in autopilot.link: udpin:, udpout:, tcp:, serial:"
    )
    truth: Text = Field(
        description="another MAVLink link to the same simulator, for the truth: tcp:HOST:PORT, udpin: or udpout:"
    )
    system_id: Annotated[int, Strict(), Field(ge=1, le=255)] | None = Field(
        default=None, description="its autopilot's system ID; by default the one on each link"
    )
    airframe: AirframeSection | None = Field(default=None, description="{ span_m } of the rendered drone")
    start: Start | None = Field(
        default=None, description='drone.start of the agent\'s config; { from = "gps" } by default'
    )

    @field_validator(*LINKS)
    @classmethod
    def _address(cls, text: str) -> str:
        try:
            return str(parse_address(text))
        except SwarmtrackError as error:
            raise ValueError(str(error).removeprefix("autopilot link ")) from None

    @field_validator("truth")
    @classmethod
    def _two_ways(cls, text: str) -> str:
        if text.partition(":")[0] not in TRUTH_SCHEMES:
            raise ValueError(f'"{text}", expected a link of a simulator: tcp:HOST:PORT, udpin: or udpout:')
        return text


class WorldFile(Section):
    """A whole file."""

    world: WorldSection = Field(description="a table [world] with origin")
    camera: WorldCameraSection = WorldCameraSection()
    agents: WorldAgentsSection = WorldAgentsSection()
    formation: WorldFormationSection = WorldFormationSection()
    detector: ParameterSection = ParameterSection()
    drone: tuple[OutsideDroneSection, ...] = Field(min_length=1, description="tables [[drone]], one each")
    intruder: tuple[PlannedFlight, ...] = ()
    expected: ParameterSection = ParameterSection()


@dataclass(frozen=True, slots=True)
class Outsider:
    """What is known of one drone that others fly. start: drone.start of its agent's config."""

    drone: FollowedDrone
    truth: TruthAddress
    link: str
    start: Table


@dataclass(frozen=True, slots=True)
class OutsideWorld:
    """scenario: with the followed drones in its world. origin: of the world. table: of the file, as it was read."""

    scenario: Scenario
    origin: TeamOrigin
    outsiders: dict[int, Outsider]
    limits: Limits
    table: Table


def check_alone(path: Path, *, scenario: str | None, drones: int | None, detail: str) -> None:
    """Raises SourceError where a world file is asked for together with what it decides itself."""
    less = None if detail in ("auto", "full") else detail
    for name, value in (("--scenario", scenario), ("--drones", drones), ("--detail", less)):
        if value is not None:
            raise SourceError(
                f"{name} {value} with --world {path}, expected one of them: the file sets the drones and their flight"
            )


def load_world(path: Path, *, seed: int | None = None, keep_s: float = FOLLOWED_KEPT_S) -> OutsideWorld:
    """seed: other than the file's; keep_s: how much of the truth is kept. Raises ConfigError with every problem."""
    layers = read_layers(path, _resolve_calibration)
    return world_of(layers, path.stem, seed=seed, keep_s=keep_s)


def world_of(layers: Layers, name: str, *, seed: int | None, keep_s: float) -> OutsideWorld:
    """As `load_world`, from layers that were read before."""
    problems = parameter_problems(layers, "detector", DetectorParameters)
    problems += parameter_problems(layers, "expected", Limits)
    file = validated(WorldFile, layers, problems, partial(_shared, layers))
    outsiders = {drone.id: _outsider(drone, keep_s) for drone in file.drone}
    return OutsideWorld(
        _scenario(name, file, seed, outsiders),
        file.world.origin,
        outsiders,
        Limits(**layers.table.get("expected", {})),
        layers.table,
    )


def _resolve_calibration(table: Table, folder: Path) -> None:
    camera = table.get("camera")
    if isinstance(camera, dict) and isinstance(camera.get("calibration"), str):
        camera["calibration"] = str(folder / os.path.expanduser(camera["calibration"]))


def _shared(layers: Layers, file: WorldFile) -> Iterator[Problem]:
    """What two drones have in common and must not."""
    ids: set[int] = set()
    listed = {"drone": [drone.id for drone in file.drone], "intruder": [drone.id for drone in file.intruder]}
    for kind, drone_ids in listed.items():
        for k, drone_id in enumerate(drone_ids):
            if drone_id in ids:
                text = f"{kind}[{k}].id: {drone_id}, expected an ID that no other drone has"
                yield layers.problem((kind, k, "id"), text)
            ids.add(drone_id)
    yield from _formation_problems(layers, file)
    used: dict[str, str] = {}
    for k, drone in enumerate(file.drone):
        for name in LINKS:
            address = getattr(drone, name)
            if address in used:
                yield layers.problem(
                    ("drone", k, name),
                    f'drone[{k}].{name}: "{address}" is {used[address]} too, expected a port of its own: a simulator '
                    "answers one client on each",
                )
            used.setdefault(address, f"{name} of drone {drone.id}")


def _formation_problems(layers: Layers, file: WorldFile) -> Iterator[Problem]:
    """What the agents would refuse, and what could not be judged."""
    plan = file.formation.plan()
    if plan is not None:
        for fault in _formation_faults(file, plan):
            yield plan_problem(layers, fault)


def _formation_faults(file: WorldFile, plan: FormationPlan) -> Iterator[PlanFault]:
    flying = {drone.id for drone in file.drone}
    if set(plan.slots) != flying:
        yield PlanFault(
            ("slots",),
            f"leader and slots of the drones {sorted(plan.slots)}, expected of {sorted(flying)}: each [[drone]] leads "
            "or follows",
        )
        return
    spans = {_span(drone) for drone in file.drone}
    if len(spans) > 1:
        yield PlanFault((), f"drones with spans of {sorted(spans)} m, expected one span of all")
    yield from plan_faults(plan, max(spans))
    views, acceleration = fields_of_view([file.camera.mounted()]), file.formation.limits.acceleration_m_s2
    for drone_id in plan.followers:
        yield from view_faults(plan, drone_id, views, acceleration)
    begins, ends = file.formation.judged_from_s, file.world.seconds
    if begins >= ends:
        yield PlanFault(("judged_from_s",), f"{begins:g} s, expected less than world.seconds, {ends:g} s")


def _span(section: OutsideDroneSection) -> float:
    return Airframe().span if section.airframe is None else section.airframe.span_m


def _outsider(section: OutsideDroneSection, keep_s: float) -> Outsider:
    start = section.start or Start.model_validate({"from": "gps"})
    return Outsider(
        FollowedDrone(keep_s),
        TruthAddress(section.id, section.truth, section.system_id),
        section.link,
        start.model_dump(exclude_unset=True, by_alias=True),
    )


def _scenario(name: str, file: WorldFile, seed: int | None, outsiders: dict[int, Outsider]) -> Scenario:
    seed = file.world.seed if seed is None else seed
    intruders = fly(seed, {drone.id: drone.plan(HOVER_S) for drone in file.intruder})
    followed = {drone_id: outsider.drone for drone_id, outsider in outsiders.items()}
    spans = {drone.id: drone.airframe.span_m for drone in file.drone if drone.airframe is not None}
    camera, body_from_camera = file.camera.mounted()
    formation = file.formation.team_slots()
    share_hz = file.agents.share_hz
    if share_hz is None and formation is not None and not file.formation.ranging:
        share_hz = FORMATION_SHARE_HZ
    return Scenario(
        world=World(
            seed,
            dict(sorted([*followed.items(), *intruders.drones.items()])),
            {drone_id: Airframe().scaled(span) for drone_id, span in spans.items()},
        ),
        origin=file.world.origin.place(),
        name=name,
        about=file.world.about,
        seconds=file.world.seconds,
        cameras=(ScenarioCamera(camera, body_from_camera, file.camera.fps),),
        imu_rate_hz=file.agents.imu_rate_hz,
        tracks_hz=file.agents.tracks_hz,
        share_hz=share_hz,
        feed=file.agents.feed,
        detector=DetectorParameters(**file.detector.parameters),
        strangers=frozenset(drone.id for drone in file.intruder),
        formation=formation,
        from_take_off=file.world.counts_from == "take-off",
    )
