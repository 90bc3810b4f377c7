"""A drone that stands does not turn, whatever its autopilot's heading does."""

import math

import numpy as np
import pytest

from swarmtrack.geometry import rotation
from swarmtrack.messages import EgoPose, ImuSample
from swarmtrack.motion.heading_at_rest import HeadingAtRest
from swarmtrack.motion.priors import REST_HEADING_STEP_RAD

NOISE_RAD = 0.005


def flown(heading, rate, *, seconds=40.0, is_on_ground=True, scatter=0.003, gyro_until=math.inf):
    """Sum of the steps, and how many there were; heading(t) [rad] by the autopilot, rate(t) [rad/s] by the gyro."""
    chance, at_rest, steps = np.random.default_rng(1), HeadingAtRest(), []
    for k in range(round(200 * seconds)):
        t = k / 200.0
        gyro = np.array([0.0, 0.0, rate(t)]) + scatter * chance.standard_normal(3)
        if t < gyro_until:
            at_rest.add_gyro(ImuSample(t, gyro, np.full(3, math.nan)))
        if k % 4 == 0:
            turned = rotation.from_euler(0.0, 0.0, heading(t) + NOISE_RAD * chance.standard_normal())
            pose = EgoPose(t, np.zeros(3), turned, 0.02, NOISE_RAD)
            steps += at_rest.add_pose(pose, is_on_ground=is_on_ground) or []
    return sum(steps), at_rest.counters["heading_steps_at_rest"]


def swing(t):
    return math.radians(4.0) * math.sin(2.0 * math.pi * t / 12.0)


def still(t):
    return 0.004


@pytest.mark.parametrize("seconds", [2.0, 9.0, 15.0, 40.0])
def test_rays_are_taken_along_with_a_heading_that_swings(seconds):
    total, steps = flown(swing, still, seconds=seconds)
    assert total == pytest.approx(swing(seconds), abs=REST_HEADING_STEP_RAD + math.radians(1.0))
    assert steps > 1


def test_a_heading_that_stands_makes_no_steps():
    assert flown(lambda t: 1.0, still) == (0.0, 0)


def test_a_drone_that_is_turned_turns():
    def turn(t):
        return math.radians(10.0) * t

    assert flown(turn, lambda t: math.radians(10.0)) == (0.0, 0)


@pytest.mark.parametrize("degrees", [3.0, 20.0, 90.0])
def test_a_drone_that_stood_before_it_is_turned_turns(degrees):
    rate = math.radians(degrees)
    assert flown(lambda t: rate * max(t - 20.0, 0.0), lambda t: rate * (t > 20.0)) == (0.0, 0)


def test_without_a_gyro_nobody_knows_that_it_stands():
    assert flown(lambda t: 0.1 * (t > 20.0), still, gyro_until=19.0) == (0.0, 0)


def test_vibrating_motors_are_no_rest():
    assert flown(swing, still, scatter=0.05) == (0.0, 0)


def test_in_the_air_a_heading_may_change_by_turning():
    assert flown(swing, still, is_on_ground=False) == (0.0, 0)


def test_a_heading_that_jumps_has_turned_the_rays_once():
    total, _ = flown(lambda t: 0.5 * (t > 20.0), still)
    assert total == pytest.approx(0.5, abs=REST_HEADING_STEP_RAD)
