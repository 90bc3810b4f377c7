"""Scans wait for the gyro, but not for ever, and each in its turn."""

import numpy as np
import pytest

from swarmtrack.messages import Detections
from swarmtrack.motion.exposures import WaitingScans
from swarmtrack.motion.gyro import GyroHistory
from swarmtrack.motion.priors import GYRO_WAIT_S
from swarmtrack.motion.time_offset import CameraClock

OFFSET = 0.02


@pytest.fixture
def gyro():
    return GyroHistory()


@pytest.fixture
def waiting(gyro):
    return WaitingScans([CameraClock(OFFSET, estimates=False)], gyro)


def scan(t):
    return Detections(t, 0, np.empty((0, 2)), np.empty((0, 2)), np.empty(0))


def reach(gyro, t):
    gyro.append(t, (0.0, 0.0, 0.0))


def test_a_scan_waits_for_the_sample_that_brackets_its_exposure(gyro, waiting):
    late = scan(1.0)
    reach(gyro, 1.0)
    waiting.append(late)
    assert waiting.pop() is None
    assert len(waiting) == 1
    reach(gyro, 1.0 + OFFSET)
    assert waiting.pop() == (late, 1.0 + OFFSET)
    assert waiting.pop() is None


def test_a_gyro_that_never_spoke_or_fell_silent_is_not_waited_for(gyro, waiting):
    waiting.append(scan(1.0))
    assert waiting.pop() is not None
    reach(gyro, 1.0 + OFFSET - GYRO_WAIT_S - 1e-3)
    waiting.append(scan(1.0))
    assert waiting.pop() is not None


def test_whoever_cannot_wait_any_longer_says_what_time_it_is(gyro, waiting):
    reach(gyro, 1.0)
    waiting.append(scan(1.0))
    assert waiting.pop(1.0 + OFFSET + GYRO_WAIT_S) is None
    assert waiting.pop(1.0 + OFFSET + GYRO_WAIT_S + 1e-6) is not None


def test_they_come_in_the_order_in_which_they_arrived(gyro, waiting):
    reach(gyro, 1.0)
    first, second = scan(1.0), scan(0.9)
    waiting.append(first)
    waiting.append(second)
    assert waiting.pop() is None  # the second need not wait, but its turn has not come
    reach(gyro, 1.1)
    assert [waiting.pop()[0] for _ in range(2)] == [first, second]
