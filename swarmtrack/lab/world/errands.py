"""Errands: from the ground into the air, on go-tos that turn the nose away from the team and back, and look round.

Each drone follows the orders of a pilot, as its autopilot was measured to follow them (`lab/world/response.py`). That
is computed once, ahead: a flight is a function of time like every other.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from swarmtrack.config.toml.sections import NotNegative, Number, Positive, Section
from swarmtrack.lab.world.response import RESPONSE_STEP_S, Flown, Response, SetPoint, Triple, advance, at_rest
from swarmtrack.lab.world.trajectory import (
    Handover,
    Hover,
    Sampled,
    SampledPath,
    SampledYaw,
    Together,
    Trajectory,
    wander,
)
from swarmtrack.lab.world.world import World
from swarmtrack.messages import Array

ON_THE_GROUND_M = 0.09  # of a drone's centre above it
TO_SPARE_M = 2.5  # between two drones' ways
ERRAND_STATE_STRIDE = 4  # steps of the response for each sample that is kept: 20 ms
SWAYS_AFTER_S = 3.0  # from take-off: in the ground's wake the wind is no matter
ERRAND_SETTLES_S = 8.0  # after the last order

Heights = Annotated[tuple[Positive, ...], Field(min_length=1)]


class Order(NamedTuple):
    """What a pilot tells a drone at `t` [s], in words and as a set point."""

    t: float
    words: str
    told: SetPoint


class Errand(Section):
    """On the ground, into the air, on errands: drones on a circle look at its middle. Each waits ground_s and its turn,
    and climbs. After hover_s its go-tos begin; they lead reach_m away from its station at most."""

    spacing_m: Annotated[Number, Field(ge=4.0)] = Field(default=8.0, description="neighbour distance, m")
    ground_s: NotNegative = Field(default=7.0, description="how long they stand on the ground, s")
    hover_s: NotNegative = Field(default=6.0, description="hover between the climb and the first go-to, s")
    heights_m: Heights = Field(default=(5.8, 6.5), description="heights above the ground, taken in turn, m")
    reach_m: Positive = Field(default=2.5, description="maximum distance of go-tos from the station, m")


def fly_errands(
    world: World, ids: Sequence[int], errand: Errand, response: Mapping[int, Response], sway_m: float
) -> tuple[dict[int, Trajectory], dict[int, list[Order]]]:
    """The flights of these drones, and what they were told. sway_m: RMS per axis, of drones in the air."""
    flights, orders = {}, {}
    radius = errand.spacing_m / (2.0 * math.sin(math.pi / max(len(ids), 2)))
    for k, drone_id in enumerate(ids):
        angle = math.pi + 2.0 * math.pi * k / len(ids)  # the first in the south, which looks north
        north, east = radius * math.cos(angle), radius * math.sin(angle)
        chance = world.chance("errand", drone_id)
        told = list(_orders(errand, (north, east), k, len(ids), chance))
        start = at_rest(told[0].t, (north, east, -ON_THE_GROUND_M), math.atan2(-east, -north))
        flown = _follow(start, told, response[drone_id])
        every = ERRAND_STATE_STRIDE * RESPONSE_STEP_S
        motion = np.array([[s.position, s.velocity, s.acceleration, s.jerk] for s in flown])
        yaw = np.array([[[s.yaw], [s.yaw_rate], [s.yaw_acceleration]] for s in flown])
        calm = Handover(
            Hover((0.0, 0.0, 0.0)), wander(world.chance("wander", drone_id), sway_m), start.t, SWAYS_AFTER_S
        )
        flights[drone_id] = Trajectory(
            Together((SampledPath(Sampled(start.t, every, motion)), calm)),
            SampledYaw(Sampled(start.t, every, yaw)),
            takes_off_s=start.t,
        )
        orders[drone_id] = told
    return flights, orders


def _follow(start: Flown, orders: Sequence[Order], response: Response) -> list[Flown]:
    """Every `ERRAND_STATE_STRIDE`th state of a flight by these orders."""
    state, kept, pending = start, [start], list(orders)
    told = pending.pop(0).told
    steps = (
        round((orders[-1].t + ERRAND_SETTLES_S - start.t) / (ERRAND_STATE_STRIDE * RESPONSE_STEP_S))
        * ERRAND_STATE_STRIDE
    )
    for step in range(1, steps + 1):
        while pending and pending[0].t <= state.t:
            told = pending.pop(0).told
        state = advance(state, told, response)
        if step % ERRAND_STATE_STRIDE == 0:
            kept.append(state)
    return kept


def _orders(
    errand: Errand, station: tuple[float, float], k: int, n: int, chance: np.random.Generator
) -> Iterator[Order]:
    """Take off, wait, two go-tos, look back at the team and round it, one more go-to, home, look back."""
    north, east = station
    height = errand.heights_m[k % len(errand.heights_m)] + 0.7 * (k // len(errand.heights_m))
    height += chance.uniform(-0.2, 0.2)
    centre = math.atan2(-east, -north)
    t = errand.ground_s + k + chance.uniform(0.0, 0.5)

    def goes(to: tuple[float, float], words: str, yaw: float | None = None) -> Order:
        place: Triple = (to[0], to[1], -height)
        return Order(t, words, SetPoint(t, position=place, yaw=yaw))

    yield goes(station, "takes off", yaw=centre)
    # A climb by 6 m takes five seconds.
    t += 5.0 + errand.hover_s + chance.uniform(0.0, 3.0)
    reach = min(errand.reach_m, 0.5 * (errand.spacing_m - TO_SPARE_M))
    for part in range(2):
        there = station
        for _ in range(2 - part):
            there = _nearby(station, there, reach, chance)
            yield goes(there, f"goes to {there[0]:.1f} N {there[1]:.1f} E")
            t += chance.uniform(3.7, 4.5)
        if part == 1:
            there = station
            yield goes(there, "goes home")
            t += chance.uniform(3.7, 4.5)
        yield goes(there, "looks at the team", yaw=centre)
        t += chance.uniform(3.0, 4.5)
        for side in chance.permutation((-1.0, 1.0)):
            look = centre + side * chance.uniform(0.2, 0.5)
            yield goes(there, f"turns to {math.degrees(look) % 360.0:.0f} degrees", yaw=look)
            t += chance.uniform(2.5, 3.5)


def _nearby(
    station: tuple[float, float], now: tuple[float, float], reach: float, chance: np.random.Generator
) -> tuple[float, float]:
    """A place within reach of the station that is worth the way from `now`."""
    while True:
        there: Array = chance.uniform(-reach, reach, 2)
        north, east = station[0] + float(there[0]), station[1] + float(there[1])
        if math.hypot(*there) <= reach and math.hypot(north - now[0], east - now[1]) >= 0.6 * reach:
            return north, east
