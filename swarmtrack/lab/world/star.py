"""A star: followers around a leader, who fly by what they see. The leader is a scripted pilot with sticks.

All hover, or take off first. Then the followers' pilots let their agents fly, and the leader flies as its sticks say,
with its autopilot's measured response. That is computed ahead: nobody's answer changes it.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from swarmtrack.config.toml.sections import NotNegative, Section
from swarmtrack.config.toml.sections import Place as Velocity
from swarmtrack.formation.parameters import Place
from swarmtrack.lab.world.errands import ON_THE_GROUND_M, SWAYS_AFTER_S
from swarmtrack.lab.world.guided import GuidedDrone
from swarmtrack.lab.world.response import (
    ARDUPILOT_RESPONSE,
    NO_MOTION,
    RESPONSE_STEP_S,
    SetPoint,
    Triple,
    advance,
    at_rest,
)
from swarmtrack.lab.world.trajectory import (
    Handover,
    Hover,
    Path,
    Sampled,
    SampledPath,
    SteadyYaw,
    Together,
    Trajectory,
    wander,
)
from swarmtrack.lab.world.world import Drawn, World

STAR_STATE_STRIDE = 4  # steps of the response for each sample that is kept: 20 ms
STAR_SETTLES_S = 8.0  # after the sticks were let go
SLOT_OFFSET_SIGMA_M = 0.3  # level, one sigma: so well a drone is put below its slot


def arc(ids: Sequence[int], gap_m: float, *, layer_m: float = 1.0) -> dict[int, Place]:
    """Slots [north, east, down] m: of the first the middle, of the others on an arc of 120° behind it, in layers: above
    and below it in turn, and of more than five every third level with it."""
    leader, *others = ids
    n = len(ids)
    slots: dict[int, Place] = {leader: NO_MOTION}
    for k, drone in enumerate(others):
        angle = math.radians(-60.0 + 120.0 * k / (n - 2)) if n > 2 else 0.0
        radius = gap_m if n <= 5 or k % 2 == 0 else 1.6 * gap_m
        levels = (1, -1, 0)[k % 3] if n > 5 else (1, -1)[k % 2]
        slots[drone] = (-radius * math.cos(angle), radius * math.sin(angle), -layer_m * levels)
    return slots


class Stick(Section):
    """Where the leader's sticks are at a world time, as the velocity that they ask for."""

    at_s: NotNegative = Field(description="world time, s; later than the previous one")
    velocity_m_s: Velocity = Field(description="[north, east, down], m/s; linear in between")


@dataclass(frozen=True, slots=True, kw_only=True)
class TeamSlots:
    """Who leads, and where everybody is to be, whoever flies the leader.

    slots: by drone, [north, east, down] m from the leader, its own included; height_m: of the leader's slot above the
    ground. World times [s]: slots are judged from; and the leader leaves everybody's view from then on, inf: never.
    settings: what else [formation] of the agents' configs says.
    """

    leader: int
    slots: Mapping[int, Place]
    height_m: float
    judged_from_s: float
    leader_leaves_s: float = math.inf
    settings: Mapping[str, object]

    @property
    def followers(self) -> list[int]:
        return [drone_id for drone_id in self.slots if drone_id != self.leader]


@dataclass(frozen=True, slots=True, kw_only=True)
class Star(TeamSlots):
    """Followers around a leader with sticks, all simulated here. World times [s]: all take off, −inf: they hover from
    the beginning; followers are engaged. sticks: between two the velocity is linear."""

    takes_off_s: float = -math.inf
    engages_s: float
    sticks: tuple[Stick, ...]

    def height_of(self, drone_id: int) -> float:
        """m above the ground."""
        return self.height_m - self.slots[drone_id][2]

    def velocity(self, t: float) -> Triple:
        """What the leader's sticks ask for [m/s, NED]."""
        after = bisect_right(self.sticks, t, key=lambda stick: stick.at_s)
        if after in (0, len(self.sticks)):
            return NO_MOTION
        before, then = self.sticks[after - 1], self.sticks[after]
        share = (t - before.at_s) / (then.at_s - before.at_s)
        north, east, down = (
            a + share * (b - a) for a, b in zip(before.velocity_m_s, then.velocity_m_s, strict=True)
        )
        return north, east, down


def fly_star(world: World, star: Star, sway_m: float) -> World:
    """The world with these drones. sway_m: RMS per axis, of drones in the air."""
    drones: dict[int, Drawn] = {star.leader: _leader(world, star, sway_m)}
    hovers = star.takes_off_s == -math.inf
    for drone_id in star.followers:
        north, east, _ = star.slots[drone_id]
        off = SLOT_OFFSET_SIGMA_M * world.chance("beside its slot", drone_id).standard_normal(2)
        height = star.height_of(drone_id) if hovers else ON_THE_GROUND_M
        start = (north + float(off[0]), east + float(off[1]), -height)
        drift = wander(world.chance("wander", drone_id), sway_m)
        heading = math.atan2(-east, -north)
        drones[drone_id] = GuidedDrone(start, heading, ARDUPILOT_RESPONSE, drift, hovers=hovers)
    return World(world.seed, dict(sorted({**world.drones, **drones}.items())), world.airframes)


def _leader(world: World, star: Star, sway_m: float) -> Trajectory:
    """Up to its height, then wherever its sticks are."""
    hovers = star.takes_off_s == -math.inf
    begins, ends = star.sticks[0].at_s, star.sticks[-1].at_s + STAR_SETTLES_S
    departs = begins if hovers else star.takes_off_s
    height = star.height_m if hovers else ON_THE_GROUND_M
    state = at_rest(departs, (0.0, 0.0, -height), 0.0)
    above = SetPoint(math.inf, position=(0.0, 0.0, -star.height_m), yaw_rate=0.0)
    kept = [state]
    for step in range(
        1, round((ends - departs) / (STAR_STATE_STRIDE * RESPONSE_STEP_S)) * STAR_STATE_STRIDE + 1
    ):
        steered = SetPoint(state.t, velocity=star.velocity(state.t), yaw_rate=0.0)
        state = advance(state, above if state.t < begins else steered, ARDUPILOT_RESPONSE)
        if step % STAR_STATE_STRIDE == 0:
            kept.append(state)
    motion = np.array([[s.position, s.velocity, s.acceleration, s.jerk] for s in kept])
    drift: Path = wander(world.chance("wander", star.leader), sway_m)
    if not hovers:
        drift = Handover(Hover(NO_MOTION), drift, star.takes_off_s, SWAYS_AFTER_S)
    path = SampledPath(Sampled(departs, STAR_STATE_STRIDE * RESPONSE_STEP_S, motion))
    return Trajectory(Together((path, drift)), SteadyYaw(0.0), takes_off_s=star.takes_off_s)
