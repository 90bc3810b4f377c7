"""The manners of a real autopilot's senses: a filtered gyro, a heading that aligns in flight, a biased height."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import common
from scipy.signal import butter, lfilter

from swarmtrack.geometry.geodesy import Geodetic
from swarmtrack.geometry.rotation import from_quaternion
from swarmtrack.lab.autopilots.autopilot import SimulatedArduPilot
from swarmtrack.lab.autopilots.senses import FINDS_ITSELF_S, DroneSenses
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.world.guided import GuidedDrone
from swarmtrack.lab.world.response import PX4_RESPONSE, SetPoint
from swarmtrack.lab.world.sensors import PX4_EGO, Ego, EgoParameters, Imu, ImuParameters
from swarmtrack.lab.world.trajectory import Hover
from swarmtrack.lab.world.world import World
from swarmtrack.messages import Array

SEEDS = range(8)
NO_NOISE = ImuParameters(
    gyro_noise_density=0.0, gyro_bias_sigma=0.0, accel_noise_density=0.0, accel_bias_sigma=0.0
)
HOME = Geodetic(math.radians(47.4), math.radians(8.5), 488.0)


@functools.cache
@functools.cache  # two drones cost a second
def errand(seed: int = 1) -> World:
    return load_scenario("errand", seed=seed, drones=2).world


def yaw_error(world: World, t: float) -> float:
    """Degrees, without the white part."""
    _, attitude = Ego(world, 1).estimate(world.flown(1).motion(t), t, np.zeros((2, 3)))
    turned = attitude @ world.pose(1, t).rotation.T
    return math.degrees(math.atan2(turned[1, 0], turned[0, 0]))


def test_a_range_finder_measures_along_its_beam_as_far_as_it_sees_and_who_has_none_says_nothing():
    world = errand()
    flying = [t for t in np.arange(0.0, 30.0, 0.5) if world.flown(1).position(t)[2] < -1.0]
    assert flying
    for t in flying:
        motion = world.flown(1).motion(t)
        height = -motion.position[2]
        sensed = DroneSenses(world, 1, 0.0, range_finder_m=100.0).at(t)
        assert sensed.ground * motion.attitude[2, 2] == pytest.approx(height)
        assert DroneSenses(world, 1, 0.0, range_finder_m=0.5 * height).at(t).ground is None
        assert DroneSenses(world, 1, 0.0).at(t).ground is None


def test_the_gyro_is_that_of_a_two_pole_low_pass_of_20_hz():
    world = errand()
    imu, rate = Imu(world, 1, NO_NOISE), 2000.0
    # Take-off, two go-tos, turns: sway and kicks included.
    times = np.arange(18.0, 32.0, 1.0 / rate)
    true = np.array([world.body_rate(1, t) for t in times])
    filtered = lfilter(*butter(2, 20.0, fs=rate), true, axis=0)
    every = slice(2000, None, 10)
    ours = np.array([imu.measure(t, np.zeros((2, 3)))[0] for t in times[every].tolist()])
    late = true[every] - filtered[every]
    assert np.abs(late).max() > 0.02, "the delay is seen"
    assert np.abs(ours - filtered[every]).max() < 0.15 * np.abs(late).max()
    assert imu.parameters.delay_s == pytest.approx(0.01125, abs=1e-5)


def test_a_gyro_without_filter_is_not_late_and_a_mean_over_an_interval_by_half_of_it():
    assert ImuParameters(filter_hz=0.0).delay_s == 0.0
    assert ImuParameters(filter_hz=0.0, window_s=0.005).delay_s == 0.0025


def test_whoever_knows_the_delay_has_right_stamps():
    world = errand()
    sample = Imu(world, 1, NO_NOISE).sample(20 * 200)
    np.testing.assert_allclose(sample.gyro, world.body_rate(1, sample.t), atol=1e-12)


def test_heading_is_two_to_three_degrees_off_on_the_ground_and_steps_to_a_small_error_in_flight():
    on_the_ground, in_flight, steps = [], [], []
    for seed in SEEDS:
        world = errand(seed)
        takes_off = world.flown(1).takes_off_s
        errors = [yaw_error(world, t) for t in (-100.0, 0.0, takes_off + 9.9)]
        assert errors == pytest.approx([errors[0]] * 3)
        on_the_ground.append(errors[0])
        in_flight.append(yaw_error(world, takes_off + 25.1))
        over = [yaw_error(world, takes_off + s) for s in np.arange(10.0, 25.0, 0.5)]
        steps.append(int(np.count_nonzero(np.abs(np.diff(over)) > 1e-6)))
    assert np.abs(on_the_ground).min() >= 1.5
    assert np.abs(on_the_ground).max() <= 3.0
    assert min(on_the_ground) < 0.0 < max(on_the_ground)
    assert np.abs(in_flight).max() <= 1.0
    assert set(steps) <= {0, 1}, "once; 0: just when one begins to look"
    assert sum(steps) > 0.8 * len(steps)


def test_the_heading_swings_by_up_to_four_degrees_while_the_autopilot_wakes():
    swings = []
    for seed in SEEDS:
        world = errand(seed)
        awake, waking = Ego(world, 1), Ego(world, 1, on_since=-30.0)
        off = [
            math.degrees(waking.heading_error(t) - awake.heading_error(t)) for t in np.arange(-30.0, 5.0, 0.5)
        ]
        swings.append(np.ptp(off))
        assert max(np.abs(off)) <= 4.0
        assert waking.heading_error(11.0) == awake.heading_error(11.0)
        assert (waking.is_awake(9.9), waking.is_awake(10.1)) == (False, True)
    assert min(swings) > 1.5
    assert max(swings) > 4.0


def hovers_then_flies(seed: int, departs_s: float = 40.0) -> World:
    """A PX4 that takes off at 5 s, hovers at 5 m, and flies 20 m to the north."""
    drone = GuidedDrone((0.0, 0.0, -0.09), 0.0, PX4_RESPONSE, Hover((0.0, 0.0, 0.0)))
    drone.take_off(5.0, SetPoint(math.inf, position=(0.0, 0.0, -5.0), yaw_rate=0.0))
    drone.command(departs_s, SetPoint(math.inf, position=(20.0, 0.0, -5.0), yaw=0.0))
    return World(seed, {1: drone})


def test_a_px4s_heading_drifts_in_hover_and_is_back_after_ten_metres_of_flight():
    drifted = []
    for seed in SEEDS:
        world = hovers_then_flies(seed)
        ego = Ego(world, 1, PX4_EGO)
        errors = [math.degrees(ego.heading_error(t)) for t in (0.0, 4.9, 20.0, 40.0)]
        assert errors[0] == errors[1]
        assert abs(errors[0]) <= 3.6
        drifted.append(errors[3])
        assert abs(errors[3] - errors[0]) >= abs(errors[2] - errors[0])
        world.pose(1, 55.0)
        flown_from = world.flown(1).flown_from(10.0)
        assert world.flown(1).position(flown_from)[0] == pytest.approx(10.0, abs=0.5)
        assert math.degrees(ego.heading_error(flown_from)) == pytest.approx(errors[3], abs=1.0)
        assert abs(math.degrees(ego.heading_error(flown_from + 5.0))) <= 1.0
        # Continuous: a filter's estimate does not leap there.
        each = [ego.heading_error(t) for t in np.arange(5.0, 55.0, 0.02)]
        assert np.abs(np.diff(each)).max() < math.radians(0.2)
    assert 2.5 < np.abs(drifted).min() < np.abs(drifted).max() <= 9.0
    assert min(drifted) < 0.0 < max(drifted)


def test_a_flight_that_is_known_ahead_has_flown_ten_metres_at_the_same_time_whenever_it_is_asked():
    flight = errand().drones[1]
    when = flight.flown_from(10.0)
    way = np.array([flight.position(t)[:2] for t in np.arange(flight.takes_off_s, when, 0.02)])
    assert np.linalg.norm(np.diff(way, axis=0), axis=1).sum() == pytest.approx(10.0, rel=0.05)
    assert load_scenario("hover-triangle", seed=1).world.flown(1).flown_from(10.0) == -math.inf


def test_a_px4s_position_walks_by_a_decimetre_and_an_ardupilots_does_not():
    walks = []
    for seed in SEEDS:
        world = load_scenario("mixed", seed=seed).world
        scenario = load_scenario("mixed", seed=seed)
        assert not scenario.ego(1).walk(30.0).any()
        ego, t = scenario.ego(2), np.arange(0.0, 600.0, 1.0)
        walk = np.array([ego.walk(each) for each in t.tolist()])
        walks.append(walk[:, 0].std())
        np.testing.assert_allclose(np.diff(walk[:, 0], axis=0), walk[:-1, 1], atol=0.03)
        position, _ = ego.estimate(world.flown(2).motion(30.0), 30.0, np.zeros((2, 3)))
        truth = world.pose(2, 30.0).position - world.pose(2, 0.0).position
        np.testing.assert_allclose((position - truth)[:2], walk[30, 0, :2], atol=1e-9)
        sensed = DroneSenses(world, 2, 0.0, earth=HOME, ego=ego).at(30.0)
        np.testing.assert_allclose(sensed.velocity, world.flown(2).motion(30.0).velocity + walk[30, 1])
    assert 0.03 < min(walks) < max(walks) < 0.2


def test_an_autopilot_that_was_just_switched_on_knows_its_place_late_and_arms_later_still():
    senses = DroneSenses(errand(), 1, epoch=100.0, earth=HOME, ego=Ego(errand(), 1, on_since=-4.0))
    assert [senses.at(t).position is None for t in (103.9, 104.1)] == [True, False]
    assert [senses.is_ready(t) for t in (103.0, 135.9, 136.1)] == [False, False, True]
    senses.rebooted(102.0)
    assert [senses.is_ready(t) for t in (141.9, 142.1)] == [False, True]


def test_drones_that_hover_from_the_start_are_aligned():
    for seed in SEEDS:
        world = load_scenario("hover-triangle", seed=seed).world
        assert abs(yaw_error(world, 0.0)) <= 1.0
        assert yaw_error(world, 0.0) == pytest.approx(yaw_error(world, 60.0))


def test_height_is_off_by_a_decimetre_for_the_whole_flight():
    errors = []
    for seed in SEEDS:
        world = errand(seed)
        ego = Ego(world, 1, EgoParameters(position_sigma=0.0))
        for t in (0.0, 30.0):
            position, _ = ego.estimate(world.flown(1).motion(t), t, np.zeros((2, 3)))
            truth = world.pose(1, t).position - world.pose(1, 0.0).position
            np.testing.assert_allclose((position - truth)[:2], 0.0, atol=1e-12)
            errors.append(position[2] - truth[2])
    assert 0.05 <= np.abs(errors).min() <= np.abs(errors).max() <= 0.12
    assert min(errors) < 0.0 < max(errors)


def test_the_autopilot_and_the_simulation_address_have_the_same_lasting_errors():
    world = errand(3)
    senses = DroneSenses(world, 1, epoch=100.0)
    t = 20.0
    position, attitude = Ego(world, 1).estimate(world.flown(1).motion(t), t, np.zeros((2, 3)))
    sensed = senses.at(100.0 + t)
    assert np.linalg.norm(sensed.position - position) < 0.15
    turn = from_quaternion(sensed.q).T @ attitude
    assert math.degrees(math.acos(min((np.trace(turn) - 1.0) / 2.0, 1.0))) < 1.5


def messages(autopilot: SimulatedArduPilot, begin: float, seconds: float) -> list[tuple[float, str, Array]]:
    found = []
    for now in np.arange(begin, begin + seconds, 0.1).tolist():
        for datagram in autopilot.step(now):
            told = common.MAVLink(None).parse_buffer(datagram)
            found += [(now, message.get_type(), message) for message in told]
    return found


def test_after_a_reboot_a_position_is_known_eight_seconds_later():
    autopilot = SimulatedArduPilot(DroneSenses(errand(), 1, epoch=0.0, earth=HOME))
    asked = (
        common.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        common.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
        common.MAVLINK_MSG_ID_GPS_RAW_INT,
    )
    autopilot.reboot(20.0)
    for message_id in asked:
        autopilot.set_interval(message_id, 200_000, 20.0)
    heard = messages(autopilot, 20.0, 10.0)
    first = {name: min(t for t, kind, _ in heard if kind == name) for name in {kind for _, kind, _ in heard}}
    assert first["ATTITUDE_QUATERNION"] < 21.0
    assert first["LOCAL_POSITION_NED"] == pytest.approx(20.0 + FINDS_ITSELF_S, abs=0.4)
    fixes = [(t, m.fix_type) for t, kind, m in heard if kind == "GPS_RAW_INT"]
    assert {fix for t, fix in fixes if t < 27.9} == {common.GPS_FIX_TYPE_NO_FIX}
    assert {fix for t, fix in fixes if t > 28.3} == {common.GPS_FIX_TYPE_3D_FIX}
