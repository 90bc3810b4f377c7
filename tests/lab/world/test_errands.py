"""Errands: still on the ground, never still in the air, noses to the way points, and ghosts that haunt the detector."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest

from support.patience import soon
from swarmtrack.errors import ConfigError
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.oracle import OracleDetector
from swarmtrack.lab.scenarios.scenario import Scenario
from swarmtrack.lab.world.scenery import Scenery
from swarmtrack.lab.world.sensors import Instant
from swarmtrack.lab.world.trajectory import wander
from swarmtrack.messages import Array

SHORT = [(0, 2), (1, 3), (2, 4)]
TEAMS = SHORT + [
    pytest.param(seed, drones, marks=pytest.mark.long("other seeds for teams of each size"))
    for seed in range(3)
    for drones in (2, 3, 4)
    if (seed, drones) not in SHORT
]


@functools.cache  # three drones cost a second
def errand(seed: int = 1, drones: int = 3) -> Scenario:
    return load_scenario("errand", seed=seed, drones=drones)


def in_view(scenario: Scenario, observer: int, times: Array) -> list[set[int]]:
    return [
        set(Instant(scenario.world, t).visible(observer, scenario.camera, scenario.body_from_camera))
        for t in times.tolist()
    ]


@pytest.mark.parametrize(("seed", "drones"), TEAMS)
def test_drones_keep_apart_and_above_the_ground(seed, drones):
    world = errand(seed, drones).world
    for t in np.arange(-5.0, 80.0, 0.25):
        points = np.stack([world.pose(drone_id, t).position for drone_id in world.drones])
        apart = np.linalg.norm(points[:, None] - points, axis=2) + 99.0 * np.eye(drones)
        assert apart.min() > 1.5
        assert points[:, 2].max() < 0.0


def test_a_drone_stands_perfectly_still_until_it_takes_off_and_never_in_the_air():
    world = errand().world
    takes_off = [world.flown(drone_id).takes_off_s for drone_id in world.drones]
    assert np.diff(takes_off) == pytest.approx(1.0, abs=0.6), "one after the other"
    for drone_id, begins in zip(world.drones, takes_off, strict=True):
        drone = world.flown(drone_id)
        for t in (-60.0, 0.0, begins - 0.01):
            motion = drone.motion(t)
            np.testing.assert_array_equal(motion.position, drone.position(0.0))
            np.testing.assert_array_equal(motion.body_rate, np.zeros(3))
        hovering = np.arange(begins + 6.0, begins + 9.0, 0.05)
        speeds = [np.linalg.norm(drone.motion(t).velocity) for t in hovering.tolist()]
        rates = [np.linalg.norm(drone.motion(t).body_rate) for t in hovering.tolist()]
        assert min(speeds) > 1e-4
        assert 0.003 < float(np.mean(rates)) < 0.2


@pytest.mark.parametrize(("seed", "drones"), TEAMS)
def test_teammates_leave_the_view_and_come_back(seed, drones):
    scenario = errand(seed, drones)
    times = np.arange(0.0, scenario.seconds, 0.25)
    for observer in scenario.members:
        seen = np.array([bool(others) for others in in_view(scenario, observer, times)])
        assert seen[times < 7.0].all(), "on the ground they look at each other"
        changes = np.flatnonzero(np.diff(seen.astype(int)))
        assert len(changes) >= 2
        assert seen[-1] or seen[changes[-1]]
        assert 0.4 < seen.mean() < 0.95


def test_more_drones_than_can_be_prepared_soon_are_refused():
    with (
        soon(),
        pytest.raises(ConfigError, match=r"errand\.toml:\d+: formation\.drones: 21 drones .* 20 at most"),
    ):
        errand(drones=21)


def test_the_nose_turns_to_the_way_point():
    scenario = errand()
    going = [event for event in scenario.events if event.words.startswith("goes to")]
    assert len(going) >= 3 * len(scenario.members)
    turned = []
    for event in going:
        drone = scenario.world.flown(event.drone_id)
        before, there = drone.position(event.t), drone.position(event.t + 3.6)
        bearing = math.atan2(*(there - before)[[1, 0]])
        turned.append(abs(math.remainder(drone.yaw(event.t + 3.6) - bearing, 2.0 * math.pi)))
    assert np.median(turned) < 0.3


def test_body_rates_have_no_jumps():
    drone = errand().world.flown(1)
    times = np.arange(5.0, 30.0, 0.001)
    rates = np.array([drone.motion(t).body_rate for t in times.tolist()])
    # Angular accelerations of a few rad/s², for a millisecond.
    assert np.abs(np.diff(rates, axis=0)).max() < 0.02


def test_the_motion_is_the_derivative_of_the_place():
    drone, h = errand().world.flown(2), 1e-4
    for t in np.arange(5.0, 50.0, 0.37):
        slope = (drone.position(t + h) - drone.position(t - h)) / (2.0 * h)
        np.testing.assert_allclose(drone.motion(t).velocity, slope, atol=1e-5)


def test_what_each_is_told_is_listed_in_order():
    scenario = errand()
    assert [event.t for event in scenario.events] == sorted(event.t for event in scenario.events)
    for drone_id in scenario.members:
        first = next(event for event in scenario.events if event.drone_id == drone_id)
        assert first.words == "takes off"
        assert first.t == scenario.world.flown(drone_id).takes_off_s


def test_sway_is_of_the_size_that_is_asked_for_and_slow():
    sway = wander(np.random.default_rng(3), 0.05)
    flat = np.array([sway.derivatives(t) for t in np.arange(0.0, 200.0, 0.05)])
    np.testing.assert_allclose(flat[:, 0].std(axis=0), 0.05, rtol=0.1)
    tilt = np.degrees(np.hypot(flat[:, 2, 0], flat[:, 2, 1]) / 9.81)
    assert 0.1 < tilt.mean() < 3.0


def test_frames_show_the_same_in_whatever_order_they_are_asked_for():
    scenario = errand()
    backwards = OracleDetector(scenario)
    later = [backwards.detections(1, k, 0.1 * k).centre for k in reversed(range(20))][::-1]
    for k in range(20):
        np.testing.assert_array_equal(OracleDetector(scenario).detections(1, k, 0.1 * k).centre, later[k])


def test_a_ghost_fires_as_often_as_its_probability_says_and_always_at_its_place():
    times, judged = np.arange(0.0, 6.5, 0.04), 0
    for seed in (1, 2):
        scenario = errand(seed)
        oracle = OracleDetector(scenario)
        eye = (scenario.world.pose(1, 0.0) @ scenario.body_from_camera).inverse()
        pixels, _, valid = scenario.camera.project(
            eye.transform(np.array([g.position_m for g in scenario.ghosts]))
        )
        well_inside = valid & (pixels > 20.0).all(axis=1) & (pixels < (620.0, 460.0)).all(axis=1)
        frames = [oracle.detections(1, k, t) for k, t in enumerate(times.tolist())]
        for k in np.flatnonzero(well_inside):
            near = [np.linalg.norm(found.centre - pixels[k], axis=1) < 5.0 for found in frames]
            fired = np.mean([hits.any() for hits in near])
            scores = np.concatenate([found.score[hits] for found, hits in zip(frames, near, strict=True)])
            assert fired == pytest.approx(scenario.ghosts[k].p_detection, abs=0.1)
            assert 0.47 <= np.median(scores) <= 0.64
            judged += 1
    assert judged, "a ghost in view of a drone on the ground"


def test_other_scenarios_have_no_ghosts():
    assert load_scenario("crossing").ghosts == ()


def test_a_house_a_pole_and_trees_stand_in_every_background():
    for seed in range(2):
        places = Scenery(errand(seed).world, 500.0).places
        for kind, least in (("house", 1), ("pole", 2), ("tree", 15)):
            azimuth = np.arctan2(*places[kind].T[::-1])
            for heading in np.arange(-math.pi, math.pi, 0.1):
                ahead = np.abs(np.angle(np.exp(1j * (azimuth - heading)))) < math.radians(36.0)
                assert ahead.sum() >= least
