"""A camera that shows the same boxes to the last bit is stuck once it has turned, and not live once it lasts."""

import math

import numpy as np
import pytest

from swarmtrack.cameras.stuck import STUCK_AFTER_S, STUCK_LEAST_TURN_RAD, StuckCameras
from swarmtrack.messages import Detections
from swarmtrack.motion.gyro import Orientation


def scan(*centres, camera=0):
    n = len(centres)
    centre = np.array(centres, float).reshape(n, 2)
    return Detections(0.0, 0, centre, np.full((n, 2), 30.0), np.full(n, 0.9), camera=camera)


def turned(angle):
    return Orientation((math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0), 0.0)


AT_REST = turned(0.0)


@pytest.mark.parametrize(
    ("angle", "stuck"),
    [(0.0, False), (0.9 * STUCK_LEAST_TURN_RAD, False), (1.1 * STUCK_LEAST_TURN_RAD, True)],
)
def test_the_same_boxes_after_a_turn_are_no_picture_of_now(angle, stuck):
    cameras = StuckCameras(1)
    cameras.add_scan(scan((300.0, 240.0)), 0.0, AT_REST, is_mounted=True)
    assert cameras.is_stuck(scan((300.0, 240.0)), turned(angle)) is stuck
    assert not cameras.is_stuck(scan((300.001, 240.0)), turned(angle))


def test_no_boxes_again_are_never_stuck():
    cameras = StuckCameras(1)
    cameras.add_scan(scan(), 0.0, AT_REST, is_mounted=True)
    assert not cameras.is_stuck(scan(), turned(1.0))
    cameras.add_scan(scan(), 3.0, AT_REST, is_mounted=True)
    assert cameras.ages(3.5) == (0.5,)


def test_boxes_that_stay_the_same_are_not_live_for_long():
    cameras = StuckCameras(2)
    assert not cameras.is_live(0, 0.0)
    assert cameras.ages(0.0) == (math.inf, math.inf)
    for k in range(15):
        cameras.add_scan(scan((300.0, 240.0), camera=1), 0.1 * k, AT_REST, is_mounted=True)
        assert cameras.is_live(1, 0.1 * k) is (0.1 * k < STUCK_AFTER_S)
    assert cameras.ages(2.0) == (math.inf, 2.0)


def test_a_camera_that_is_mounted_otherwise_than_configured_shows_nothing_new():
    cameras = StuckCameras(1)
    cameras.add_scan(scan((300.0, 240.0)), 1.0, AT_REST, is_mounted=False)
    assert cameras.ages(1.0) == (math.inf,)
    assert cameras.is_stuck(scan((300.0, 240.0)), turned(1.0))
