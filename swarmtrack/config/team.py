"""[team] of a config: what the drones of a team share, and what each knows of the others before the flight."""

from __future__ import annotations

import contextlib
import math
import os
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, Strict, field_validator, model_validator

from swarmtrack.config.toml.layers import Layers, Problem, Table
from swarmtrack.config.toml.sections import Number, Place, Positive, Section, Switch, check_drone_ids, found
from swarmtrack.geometry.geodesy import Geodetic

# Of what the file says: further off, a drone's own start contradicts it.
SAME_START_SIGMAS, SAME_CONFIGURED_START_M = 3.0, 0.1


class TeamOrigin(Section):
    """Where on the Earth the team frame begins."""

    lat_deg: Annotated[Number, Field(ge=-90.0, le=90.0)] = Field(
        description="latitude, WGS-84 degrees; north is positive"
    )
    lon_deg: Annotated[Number, Field(ge=-180.0, le=180.0)] = Field(
        description="longitude, WGS-84 degrees; east is positive"
    )
    alt_m: Annotated[Number, Field(ge=-500.0, le=9000.0)] = Field(
        description="height above mean sea level, m, as autopilots report it"
    )

    def place(self) -> Geodetic:
        return Geodetic.from_degrees(self.lat_deg, self.lon_deg, self.alt_m)


class FiledDrone(Section):
    """What the team's file says of one drone."""

    position_m: Place | None = Field(
        default=None,
        description="start, [north, east, down] in the team frame, m; unknown by default",
    )
    yaw_deg: Number = Field(default=0.0, description="heading of its nose, clockwise from the frame's north")
    position_sigma_m: Positive | None = Field(
        default=None,
        description="standard deviation of position_m, m per axis: 0.3 for a marked pad, 1 paced out",
    )

    @model_validator(mode="after")
    def _place_with_its_error(self) -> FiledDrone:
        if (self.position_m is None) != (self.position_sigma_m is None):
            has, lacks = ("position_m", "position_sigma_m")[:: 1 if self.position_m else -1]
            raise ValueError(f"{has} without {lacks}, expected both: a position needs its standard deviation")
        return self


def _time_of_text(value: Any) -> Any:
    """JSON has no times: a recording keeps the config's as text."""
    if isinstance(value, str):
        with contextlib.suppress(ValueError):
            return datetime.fromisoformat(value)
    return value


Utc = Annotated[datetime, Field(strict=True), BeforeValidator(_time_of_text)]


class SwitchSection(Section):
    """A switch of the pilot's transmitter, by its channel."""

    channel: Annotated[int, Strict(), Field(ge=1, le=18)] = Field(
        description="channel of the radio control, as numbered in RC_CHANNELS"
    )
    above_us: Annotated[Number, Field(ge=1000.0, le=2000.0)] = Field(
        default=1700.0, description="pulse width above which the switch is on, µs"
    )


class CodeSection(Section):
    """When the drones of the team sway by their codes (`swarmtrack mission sway`)."""

    begins: tuple[Utc, ...] = Field(
        default=(), description="UTC, such as 2026-05-01T10:00:00Z; several for more than once"
    )
    switch: SwitchSection | None = Field(
        default=None,
        description="{ channel, above_us }: the channel of the radio control by which the pilot starts them, at the "
        "next full 10 s of UTC",
    )

    @model_validator(mode="after")
    def _begins_some_time(self) -> CodeSection:
        if not self.begins and self.switch is None:
            raise ValueError(
                "neither begins nor switch, expected begins = [UTC, …] or switch = { channel = 8 }"
            )
        return self

    @field_validator("begins")
    @classmethod
    def _with_a_zone(cls, begins: tuple[datetime, ...]) -> tuple[datetime, ...]:
        return tuple(map(_zoned, begins))


class PlanSection(Section):
    """Trajectories that all drones have."""

    file: Path = Field(description="CSV with the columns id, t_s, north_m, east_m, down_m")
    begins: Utc = Field(description="UTC at t_s = 0, such as 2026-05-01T10:00:00Z")

    @field_validator("begins")
    @classmethod
    def _with_a_zone(cls, begins: datetime) -> datetime:
        return _zoned(begins)


def _zoned(begin: datetime) -> datetime:
    if begin.tzinfo is None:
        raise ValueError(f"{begin.isoformat()}, expected UTC with its Z: {begin.isoformat()}Z")
    return begin


class TeamSection(Section):
    """[team]: the team frame, and the starts. The same for every drone: keep it in the file that all extend."""

    origin: TeamOrigin | None = Field(
        default=None,
        description="{ lat_deg, lon_deg, alt_m } of the team frame's origin; needed for starts by GPS",
    )
    announce: Switch = Field(
        default=True,
        description="false: the agent sends its team nothing and requests nothing; identities come from `drones` "
        "(docs/silent.md)",
    )
    airframe_span_m: Annotated[Number, Field(ge=0.05, le=10.0)] | None = Field(
        default=None,
        description="width of the team's drones, from the outer rim of one rotor disc to that of its neighbour; with "
        "it the size of a box gives a range (docs/metres.md)",
    )
    share: Literal["nothing", "velocity"] = Field(
        default="nothing",
        description='"velocity": this drone reports its motion to its team, so that names are confirmed by motion '
        "(docs/swarm.md)",
    )
    share_hz: Annotated[Number, Field(ge=2.0, le=10.0)] = Field(
        default=5.0, description="rate of these reports"
    )
    drones: dict[str, FiledDrone] = Field(
        default={},
        description="ID = { position_m, yaw_deg, position_sigma_m } for every drone of the team: their starts, "
        "without announcements",
    )

    code: CodeSection | None = Field(
        default=None,
        description="when all drones fly their codes, which identify them (docs/silent.md)",
    )
    plan: PlanSection | None = Field(
        default=None, description="trajectories that identify the drones (docs/silent.md)"
    )

    @field_validator("drones")
    @classmethod
    def _drones_by_id(cls, drones: dict[str, FiledDrone]) -> dict[str, FiledDrone]:
        check_drone_ids(drones, "1 = { position_m = … }")
        return drones

    @model_validator(mode="after")
    def _somebody_is_known(self) -> TeamSection:
        if not self.announce and self.share != "nothing":
            raise ValueError(
                f'announce = false with share = "{self.share}", expected one or the other: sharing sends messages'
            )
        for needs, name in (
            (not self.announce, "announce = false"),
            (self.code, "code"),
            (self.plan, "plan"),
        ):
            if needs and not self.drones:
                raise ValueError(f"{name} without drones, expected 1 = {{ position_m = … }} in [team.drones]")
        return self


def resolve_plan(table: Table, folder: Path) -> None:
    """Make the path of a plan absolute, from the folder of the file that names it."""
    plan = _table(_table(table.get("team")).get("plan"))
    if isinstance(plan.get("file"), str):
        plan["file"] = str(folder / os.path.expanduser(plan["file"]))


def take_own_start(layers: Layers) -> None:
    """Where its config says nothing of a drone's start, it is what the team's file tells of it."""
    drone, filed = _own_entries(layers)
    start = drone.get("start", {})
    if "position_m" not in filed or not isinstance(start, dict):
        return
    if "from" not in start and "position_m" not in start:
        names = ("position_m", "yaw_deg", "position_sigma_m")
        drone["start"] = {name: filed[name] for name in names if name in filed} | start
    elif start.get("from") == "local" and "offset_m" not in start:
        drone["start"] = {"offset_m": filed["position_m"]} | start


def roster_problems(layers: Layers) -> list[Problem]:
    """In a team whose file lists its drones, this must be one of them, and start at the listed place."""
    team = layers.table.get("team", {})
    drones = team.get("drones") if isinstance(team, dict) else None
    drone, filed = _own_entries(layers)
    if not isinstance(drones, dict) or not drones or "id" not in drone:
        return []
    if str(drone["id"]) not in drones:
        text = f"drone.id: {found(drone['id'])}, expected one of [team.drones]: {', '.join(drones)}"
        return [layers.problem(("drone", "id"), text)]
    start = drone.get("start", {})
    if not isinstance(start, dict):
        return []
    key = "position_m" if "from" not in start else "offset_m"
    here, there = start.get(key), filed.get("position_m")
    try:
        apart = math.dist(here, there) if here is not None and there is not None else 0.0
        allowed = SAME_START_SIGMAS * math.hypot(*3 * (filed.get("position_sigma_m", 0.0),))
        differs = apart > max(allowed, SAME_CONFIGURED_START_M)
    except (TypeError, ValueError):
        return []  # pydantic says so
    if not differs:
        return []
    text = f"{found(here)}, expected [team.drones] of drone {drone['id']}: {found(there)}"
    return [layers.problem(("drone", "start", key), f"drone.start.{key}: {text}")]


def switch_problems(layers: Layers) -> list[Problem]:
    """Reading the pilot's switch needs an autopilot that reports it."""
    code = _table(_table(layers.table.get("team")).get("code"))
    link = _table(layers.table.get("autopilot")).get("link", "none")
    if "switch" not in code or link not in ("none", "sim"):
        return []
    text = f"{found(link)}, expected a MAVLink link, which reports the channel of team.code.switch"
    return [layers.problem(("autopilot", "link"), f"autopilot.link: {text}")]


def _own_entries(layers: Layers) -> tuple[dict[str, Any], dict[str, Any]]:
    """[drone], and what [team.drones] says of that drone; empty where they are no tables."""
    drone, team = (_table(layers.table.get(name)) for name in ("drone", "team"))
    return drone, _table(_table(team.get("drones")).get(str(drone.get("id"))))


def _table(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}
