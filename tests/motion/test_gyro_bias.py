"""The gyro's bias: found by the attitude's side, told apart from everything that only looks like one."""

import math

import numpy as np
import pytest

from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.messages import AutopilotRebooted, EgoPose, ImuSample
from swarmtrack.motion.ego import EgoHistory
from swarmtrack.motion.gyro import GyroHistory
from swarmtrack.motion.gyro_bias import GyroBias
from swarmtrack.motion.mounting import Mounting
from swarmtrack.motion.priors import BIAS_USED_SIGMA_RAD_S
from swarmtrack.onboard import Onboard, OnboardCamera
from swarmtrack.tracking import create_tracker

HZ, ATTITUDES_HZ = 200, 10
BIAS = np.array([0.012, -0.02, 0.007])


def rates(t):
    """(n, 3) rad/s of a drone that looks about, at times (n,)."""
    return np.stack([0.3 * np.sin(1.1 * t), 0.2 * np.cos(0.7 * t), 0.6 * np.sin(0.9 * t)], axis=1)


def attitudes(seconds):
    """World from body at every gyro sample, by fine integration."""
    t = (np.arange(seconds * HZ) + 0.5) / HZ
    R, found = np.eye(3), [np.eye(3)]
    for turn in rotation.exp(rates(t) / HZ):
        R = R @ turn
        found.append(R)
    return found


TRUTH = attitudes(40)


def fly(bias=BIAS, seconds=30, *, seed=0, sigma=0.01, told=(0.0, 0.0, 0.0), seen=lambda t, R: R, late=0):
    """Yields (t, gyro history, estimator) after each attitude. seen(t, R): what the autopilot says instead of R.

    late: how many gyro samples are still to come when an attitude is there.
    """
    rng = np.random.default_rng(seed)
    gyro = GyroHistory(bias=told)
    estimator = GyroBias(gyro)
    t = np.arange(seconds * HZ) / HZ
    samples = rates(t) + bias + 2.8e-3 * rng.standard_normal((len(t), 3))
    fed = 0
    for k in range(0, len(t), HZ // ATTITUDES_HZ):
        while fed <= min(k - late, len(t) - 1):
            gyro.append(float(t[fed]), tuple(samples[fed]))
            estimator.settle()
            fed += 1
        attitude = seen(t[k], TRUTH[k] @ rotation.exp(sigma * rng.standard_normal(3)))
        if attitude is not None:
            estimator.add_attitude(float(t[k]), attitude, sigma)
        yield t[k], gyro, estimator


def end_of(flight):
    *_, last = flight
    return last


def test_the_bias_is_found_within_its_sigma_and_taken_off():
    errors = []
    for seed in range(10):
        _, gyro, estimator = end_of(fly(seed=seed))
        errors.append(estimator.found.bias - BIAS)
        assert estimator.found.sigma < BIAS_USED_SIGMA_RAD_S
        assert gyro.bias == pytest.approx(BIAS, abs=2e-3)
    assert np.sqrt(np.mean(np.square(errors))) < estimator.found.sigma


def test_it_claims_nothing_before_it_knows_and_is_used_only_when_it_is_sure():
    sigmas = []
    for t, gyro, estimator in fly():
        if t < 0.5:
            assert estimator.found is None
        if estimator.found is None or estimator.found.sigma > BIAS_USED_SIGMA_RAD_S:
            assert gyro.bias == (0.0, 0.0, 0.0)
        sigmas.append(estimator.found.sigma if estimator.found else math.inf)
    assert sigmas[100] < 2 * BIAS_USED_SIGMA_RAD_S  # ten seconds


def test_a_gyro_that_is_corrected_already_has_none():
    _, gyro, estimator = end_of(fly(bias=np.zeros(3)))
    assert np.abs(estimator.found.bias).max() < 1e-3
    assert np.abs(gyro.bias).max() < 1e-3


def test_what_the_config_says_is_where_it_begins():
    _, gyro, estimator = end_of(fly(told=(0.05, 0.0, -0.03)))
    assert estimator.found.bias == pytest.approx(BIAS, abs=2e-3)
    for t, gyro, _ in fly(told=(0.05, 0.0, -0.03)):
        if t < 0.5:
            assert gyro.bias == (0.05, 0.0, -0.03)


def test_without_an_attitude_nothing_is_found():
    _, gyro, estimator = end_of(fly(seen=lambda t, R: None))
    assert (estimator.found, gyro.bias) == (None, (0.0, 0.0, 0.0))


def test_a_heading_that_jumps_is_no_bias():
    turned = rotation.exp([0.0, 0.0, 0.8])
    for t, _, estimator in fly(seen=lambda t, R: turned @ R if t > 15.0 else R):
        if t > 12.0:
            assert estimator.found.bias == pytest.approx(BIAS, abs=2e-3)
    assert estimator.refused == 5


def test_single_attitudes_that_are_wild_are_left_out():
    rng = np.random.default_rng(1)
    wild = rotation.exp([1.0, 0.5, 0.0])
    _, _, estimator = end_of(fly(seen=lambda t, R: wild if t > 5.0 and rng.random() < 0.1 else R))
    assert estimator.refused > 3
    assert estimator.found.bias == pytest.approx(BIAS, abs=2e-3)


def test_attitudes_that_come_before_their_gyro_samples_wait_for_them():
    _, _, estimator = end_of(fly(late=4))
    assert estimator.found.bias == pytest.approx(BIAS, abs=2e-3)


def test_late_and_repeated_attitudes_change_nothing():
    plain, _ = end_of(fly())[2], None
    again = None
    for t, _, estimator in fly():
        estimator.add_attitude(float(t), np.eye(3), 0.01)
        estimator.add_attitude(float(t) - 0.3, np.eye(3), 0.01)
        again = estimator
    assert np.array_equal(plain.found.bias, again.found.bias)


def test_a_gap_in_the_gyro_s_samples_is_no_bias():
    gyro = GyroHistory()
    estimator = GyroBias(gyro)
    t = np.arange(30 * HZ) / HZ
    samples = rates(t) + BIAS
    for k in range(len(t)):
        if not 10 * HZ < k < 13 * HZ:
            gyro.append(float(t[k]), tuple(samples[k]))
            estimator.settle()
        if k % 20 == 0:
            estimator.add_attitude(float(t[k]), TRUTH[k], 0.01)
    assert estimator.found.bias == pytest.approx(BIAS, abs=2e-3)


def test_a_gyro_whose_stamps_jump_back_is_followed():
    gyro = GyroHistory()
    estimator = GyroBias(gyro)
    t = np.arange(20 * HZ) / HZ
    samples = rates(t) + BIAS
    for start in (100.0, 3.0):
        for k in range(len(t)):
            gyro.append(start + float(t[k]), tuple(samples[k]))
            estimator.settle()
            if k % 20 == 0:
                estimator.add_attitude(start + float(t[k]), TRUTH[k], 0.01)
        assert estimator.found.bias == pytest.approx(BIAS, abs=2e-3)


def test_turns_across_the_moment_at_which_the_bias_is_taken_off_are_whole():
    for t, gyro, _ in fly():
        if t > 2.0:  # until the bias is off, and as long again, it is in the turn: 25 mrad/s
            turn = gyro.rotation(t - 1.5, t - 0.1).matrix
            a, b = round((t - 1.5) * HZ), round((t - 0.1) * HZ)
            left = rotation.log(TRUTH[b].T @ TRUTH[a] @ turn.T)
            assert np.linalg.norm(left) < (0.006 if t > 16.0 else 0.045)


# --- in Onboard -----------------------------------------------------------------------------------

CAMERA = PinholeCamera(430.0, 430.0, 320.0, 240.0, 640, 480)


def onboard(**how):
    return Onboard(
        1,
        cameras=[
            OnboardCamera(
                CAMERA,
                Mounting(Pose(rotation.BODY_FROM_FORWARD_CAMERA, np.zeros(3))),
                create_tracker("kalman", camera=CAMERA),
            )
        ],
        gyro=GyroHistory(),
        ego=EgoHistory(),
        identity=IdentityParameters(),
        **how,
    )


def on_the_pad(drone, seconds, start=0.0):
    for k in range(seconds * HZ):
        t = start + k / HZ
        drone.tell(ImuSample(t, BIAS, np.full(3, np.nan)))
        if k % 4 == 0:
            drone.tell(EgoPose(t, None, np.eye(3), attitude_sigma=0.005))


def test_onboard_tells_it_in_body_axes_and_says_what_it_uses():
    drone = onboard()
    assert drone.gyro_bias.found is None
    on_the_pad(drone, 15)
    assert drone.gyro_bias.found.bias == pytest.approx(BIAS, abs=1e-3)
    assert drone.gyro_bias.used == pytest.approx(BIAS, abs=1e-3)
    turn = drone.gyro.rotation(13.2, 14.9).matrix
    assert np.linalg.norm(rotation.log(turn)) < 2e-3


def test_a_rebooted_autopilot_may_have_calibrated_its_gyro_so_all_begins_anew():
    drone = onboard()
    on_the_pad(drone, 15)
    drone.tell(AutopilotRebooted())
    assert drone.gyro_bias.found is None
    assert drone.gyro_bias.used == pytest.approx(np.zeros(3))
    on_the_pad(drone, 15, start=20.0)
    assert drone.gyro_bias.found.bias == pytest.approx(BIAS, abs=1e-3)


def test_who_does_not_want_it_estimated_keeps_the_one_that_was_told():
    drone = onboard(estimate_gyro_bias=False)
    on_the_pad(drone, 15)
    assert drone.gyro_bias.found is None
    assert drone.gyro_bias.used == pytest.approx(np.zeros(3))
