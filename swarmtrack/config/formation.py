"""[formation] of a config: slots, leader, limits. Refused where a formation could not be flown as it is written."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, Strict, field_validator, model_validator

from swarmtrack.cameras.field_of_view import half_angles
from swarmtrack.config.team import SwitchSection
from swarmtrack.config.toml.layers import Layers, Problem
from swarmtrack.config.toml.sections import Number, Section, Switch, Vector, check_drone_ids, found
from swarmtrack.formation.margins import LIMIT_BOUNDS
from swarmtrack.formation.parameters import FlightLimits, FormationParameters
from swarmtrack.formation.plan import FormationPlan, HalfView, PlanFault, plan_faults
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import BODY_FROM_FORWARD_CAMERA, to_euler

DroneId = Annotated[int, Strict(), Field(ge=1, le=65535)]
# m: a slot farther from the leader cannot be held by sight.
FARTHEST_SLOT_M = 60.0
USUAL = FlightLimits()
# Links to autopilots that fly.
FLYABLE = ("udpin", "udpout", "udp", "tcp", "tcpin", "serial")


def _within(name: str, scale: float = 1.0) -> object:
    low, high = LIMIT_BOUNDS[name]
    return Field(ge=round(low * scale, 1), le=round(high * scale, 1))


class FormationLimits(Section):
    """What no setpoint exceeds, whatever the law says."""

    speed_m_s: Annotated[Number, _within("speed")] = Field(default=USUAL.speed, description="largest speed")
    climb_m_s: Annotated[Number, _within("climb")] = Field(
        default=USUAL.climb, description="largest rate of climb and descent"
    )
    acceleration_m_s2: Annotated[Number, _within("acceleration")] = Field(
        default=USUAL.acceleration,
        description="largest change of a set point per second, evasions aside",
    )
    evasion_m_s2: Annotated[Number, _within("evasion")] = Field(
        default=USUAL.evasion,
        description="the same in an evasion; no set point changes faster",
    )
    yaw_rate_deg_s: Annotated[Number, _within("yaw_rate", 180.0 / math.pi)] = Field(
        default=45.0, description="largest yaw rate"
    )
    least_height_m: Annotated[Number, _within("least_height")] = Field(
        default=USUAL.least_height, description="lowest height above the team frame's origin"
    )
    fence_radius_m: Annotated[Number, _within("fence_radius")] = Field(
        default=USUAL.fence_radius, description="horizontal radius, around the position of engagement"
    )
    fence_height_m: Annotated[Number, _within("fence_height")] = Field(
        default=USUAL.fence_height, description="height above and below the position of engagement"
    )

    def in_si(self) -> FlightLimits:
        return FlightLimits(
            speed=self.speed_m_s,
            climb=self.climb_m_s,
            acceleration=self.acceleration_m_s2,
            evasion=self.evasion_m_s2,
            yaw_rate=math.radians(self.yaw_rate_deg_s),
            least_height=self.least_height_m,
            fence_radius=self.fence_radius_m,
            fence_height=self.fence_height_m,
        )


class TeamFormation(Section):
    """[formation]: the leader, and every drone's slot (docs/formation.md). The same for all of a team, but for
    `enabled`.

    Without `leader` there is no formation.
    """

    enabled: Switch = Field(
        default=False,
        description="true: a follower's agent flies it while its pilot has the agent engaged (docs/formation.md)",
    )
    leader: DroneId | None = Field(
        default=None, description="the drone that a pilot flies, and that others follow"
    )
    slots: dict[str, Vector] = Field(
        default={},
        description="ID = [north, east, down] of each follower's slot from the leader, m, in the team frame's axes",
    )
    height_m: Annotated[Number, Field(gt=0.0, le=500.0)] = Field(
        default=5.0,
        description="the leader's height above the team frame's origin; the heights of the slots count from there",
    )
    references: dict[str, tuple[DroneId, ...]] = Field(
        default={},
        description="ID = [ID, …]: the references from which a drone computes its slot; by default the "
        "leader",
    )
    ranging: Switch = Field(
        default=False,
        description="true: the drones have ranging radios and receive their ranges (docs/client.md)",
    )
    sure: Annotated[Number, Field(ge=0.9, lt=1.0)] = Field(
        default=0.998,
        description="confidence that a reference's name needs for a second before it is used; with several teammates, "
        "only motion confirms a name above 0.997, with [team] share",
    )
    consent: Literal["mode", "mode and switch"] = Field(
        default="mode",
        description="what engages the agent: the flight mode, or the mode and a switch of the pilot's transmitter, so "
        "that a mode change by a ground station engages no drone",
    )
    switch: SwitchSection | None = Field(
        default=None, description='{ channel, above_us }: which switch, with consent = "mode and switch"'
    )
    limits: FormationLimits = Field(default=FormationLimits(), description="limits of every set point")

    @field_validator("slots", "references")
    @classmethod
    def _by_id(cls, said: dict[str, object]) -> dict[str, object]:
        check_drone_ids(said, "2 = […]")
        return said

    @model_validator(mode="after")
    def _whole(self) -> TeamFormation:
        if self.leader is None:
            fields = type(self).model_fields
            given = sorted(
                name for name in self.model_fields_set if getattr(self, name) != fields[name].default
            )
            if given:
                raise ValueError(f"{given[0]} without leader, expected leader = ID as well")
            return self
        if str(self.leader) in self.slots:
            raise ValueError(
                f"found a slot of the leader {self.leader}, expected none: slots are counted from the leader"
            )
        if not self.slots:
            raise ValueError("leader without slots, expected 2 = [north, east, down] in [formation.slots]")
        for drone, place in self.slots.items():
            if math.hypot(*place) > FARTHEST_SLOT_M:
                raise ValueError(
                    f"slots.{drone}: {math.hypot(*place):.0f} m from the leader, expected {FARTHEST_SLOT_M:g} or less"
                )
        self._known_references()
        asks = self.consent == "mode and switch"
        if asks and self.switch is None:
            raise ValueError('consent = "mode and switch" without switch, expected switch = { channel = 7 }')
        if self.switch is not None and not asks:
            raise ValueError('switch without consent, expected consent = "mode and switch" as well')
        return self

    def _known_references(self) -> None:
        for drone, others in self.references.items():
            if drone not in self.slots:
                raise ValueError(f"references.{drone}: no follower, expected one of {', '.join(self.slots)}")
            wrong = [other for other in others if str(other) not in self.slots and other != self.leader]
            wrong += [other for other in others if str(other) == drone]
            if wrong or not others or len(set(others)) < len(others):
                raise ValueError(
                    f"references.{drone}: found {found(list(others))}, expected other drones of the formation"
                )

    def plan(self) -> FormationPlan | None:
        """None without a leader."""
        if self.leader is None:
            return None
        slots = {self.leader: (0.0, 0.0, 0.0)} | {int(drone): place for drone, place in self.slots.items()}
        references = {int(drone): self.references.get(drone, (self.leader,)) for drone in self.slots}
        return FormationPlan(
            leader=self.leader,
            slots=slots,
            references=references,
            height=self.height_m,
            least_height=self.limits.least_height_m,
        )

    def parameters(self, drone_id: int) -> FormationParameters | None:
        """Parameters of a follower; None for a drone without a reference."""
        plan = self.plan()
        if plan is None or drone_id not in plan.references:
            return None
        return FormationParameters(
            drone_id=drone_id,
            leader=plan.leader,
            slots=plan.slots,
            references=plan.references[drone_id],
            height=plan.height,
            limits=self.limits.in_si(),
            sure=self.sure,
        )


def formation_problems(
    section: TeamFormation, drone_id: int, span: float | None, link: str, layers: Layers
) -> Iterable[Problem]:
    """What a formation has against the rest of a config, and against itself. span [m]: of the team's drones; link: to
    the autopilot."""
    plan = section.plan()
    if plan is None:
        return []
    if span is None:
        text = "found none, expected the drones' span: collision avoidance needs it"
        return [
            layers.problem(("team", "airframe_span_m"), f"team.airframe_span_m: {text}, as [formation] does")
        ]
    if drone_id not in plan.slots:
        text = f"no slot of drone {drone_id}, expected one in [formation.slots], or that it is the leader"
        return [layers.problem(("formation", "slots"), f"formation.slots: {text}")]
    if section.enabled and drone_id != plan.leader and link.partition(":")[0] not in FLYABLE:
        text = f"{found(link)}, expected a MAVLink link, over which [formation] enabled = true could fly the drone"
        return [layers.problem(("autopilot", "link"), f"autopilot.link: {text}")]
    return [plan_problem(layers, fault) for fault in plan_faults(plan, span)]


def plan_problem(layers: Layers, fault: PlanFault) -> Problem:
    """A fault, where it stands in [formation]."""
    key = ("formation", *fault.key)
    return layers.problem(key, f"{'.'.join(key)}: {fault.text}")


def fields_of_view(mounted: Iterable[tuple[PinholeCamera, Pose]]) -> list[HalfView]:
    """What the cameras of a level drone see. mounted: of each its lens and body_from_camera; it is the first that a
    follower turns towards its references."""
    views: list[HalfView] = []
    first = 0.0
    for camera, body_from_camera in mounted:
        # As a drone that is turned like that camera would have it if it looked straight ahead.
        turned = np.asarray(body_from_camera.rotation) @ BODY_FROM_FORWARD_CAMERA.T
        roll, pitch, yaw = to_euler(turned).tolist()
        first = first if views else yaw
        views.append(HalfView(*half_angles(camera), pitch, math.remainder(yaw - first, 2.0 * math.pi), roll))
    return views
