"""Which seconds of a flight were late, by what agents tell and by when all was known."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from swarmtrack.geometry.pose import Pose
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.scenario import as_told
from swarmtrack.lab.score.swarm_verdict import Limits
from swarmtrack.lab.swarm.watch import HeldClock, Watch
from swarmtrack.wire.health import RateHealth


def told(tracks_hz: float, imu_hz: float, uptime_s: float = 20.0) -> Any:
    rates = {"tracks": RateHealth(100.0, tracks_hz), "imu": RateHealth(200.0, imu_hz)}
    return SimpleNamespace(rates=rates, uptime_s=uptime_s)


def test_where_a_flight_counts_from_take_off_it_ends_so_long_after_it() -> None:
    scenario, followed = as_told(load_scenario("guided"))
    clock = HeldClock()
    watch = Watch(replace(scenario, from_take_off=True), clock, clock, epoch=0.0, seconds=10.0)
    first, second = followed.values()
    for k in range(100):
        first.add_pose(0.1 * k, Pose(np.eye(3), np.zeros(3)))
        second.add_pose(0.1 * k, Pose(np.eye(3), np.array([0.0, 0.0, -0.2 * max(k - 50, 0)])))
        if k < 50:
            assert math.isinf(watch.ends_at)
    assert watch.ends_at == pytest.approx(5.6 + 10.0)


async def test_a_flight_in_which_nobody_takes_off_ends_with_what_was_told() -> None:
    scenario, followed = as_told(load_scenario("guided"))
    clock = HeldClock()
    watch = Watch(replace(scenario, from_take_off=True), clock, clock, epoch=0.0, seconds=10.0)
    for drone in followed.values():
        for k in range(100):
            drone.add_pose(0.1 * k, Pose(np.eye(3), np.zeros(3)))
    await watch.judge_the_rest()
    assert watch.ends_at == pytest.approx(9.9)


def test_late_are_the_seconds_with_too_low_a_rate_and_the_time_until_all_was_known() -> None:
    scenario = replace(load_scenario("hover-triangle"), tracks_hz=100.0, imu_rate_hz=200.0)
    clock = HeldClock()
    watch = Watch(scenario, clock, clock, epoch=0.0, seconds=10.0)
    first, second, _ = watch.agents.values()
    first.health = [(2.0, told(100.0, 200.0)), (3.0, told(93.0, 200.0)), (4.0, told(96.0, 195.0))]
    second.health = [(5.5, told(100.0, 150.0)), (6.5, told(20.0, 200.0, uptime_s=1.0)), (0.5, told(1.0, 1.0))]
    for drone_id in scenario.members:  # everybody is known after 4 s
        watch.started(drone_id)
        watch._known[drone_id] = dict.fromkeys(scenario.members, 4.0)
    assert watch.late(Limits()) == [(2.0, 3.0), (4.5, 5.5)]
    watch._known[2].clear()
    assert watch.late(Limits()) == [(2.0, 3.0), (4.5, 5.5), (0.0, 10.0)]
