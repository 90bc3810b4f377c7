"""The own flight at a time: the pose carried on, the ages, the ground below, and the sway of the own code."""

import math

import numpy as np
import pytest

from swarmtrack.formation.own_flight import GROUND_STALE_S, OwnFlightRecord
from swarmtrack.formation.setpoint import NO_SWAY
from swarmtrack.geometry.rotation import BODY_FROM_FORWARD_CAMERA
from swarmtrack.messages import EgoPose
from swarmtrack.motion.ego import EgoHistory
from swarmtrack.motion.gyro import GyroHistory
from swarmtrack.motion.sway import sway
from swarmtrack.runtime.filed import coded_motion


class Flying:
    """Climbs at 1 m/s from 3 m; poses every 20 ms for one second."""

    def __init__(self, ground=None):
        self.ego, self.gyro = EgoHistory(origin=np.zeros(3)), GyroHistory()
        self.record = OwnFlightRecord(self.ego, self.gyro, BODY_FROM_FORWARD_CAMERA)
        for k in range(51):
            t = 0.02 * k
            pose = EgoPose(t, np.array([0.0, 0.0, -3.0 - t]), np.eye(3), ground=ground if k == 0 else None)
            self.ego.append(pose)
            self.record.add_pose(pose)

    def at(self, t, **stated):
        told = {"scan_ages": (0.1,), "clash": False, "doubted": False, "height_sights": ()} | stated
        return self.record.at(self.ego.at(t), **told)


def test_position_is_carried_on_from_the_newest_pose():
    own = Flying().at(1.2)
    assert own.position == pytest.approx((0.0, 0.0, -4.2), abs=1e-6)
    assert own.velocity == pytest.approx((0.0, 0.0, -1.0), abs=1e-6)
    assert own.heading == pytest.approx(0.0)
    assert own.pose_age == pytest.approx(0.2)
    assert own.gyro_age == own.heading_step_age == own.leap_age == math.inf


def test_what_others_found_is_passed_on():
    own = Flying().at(1.0, scan_ages=(0.3, math.inf), clash=True, doubted=True)
    assert (own.scan_ages, own.clash, own.doubted) == ((0.3, math.inf), True, True)


def test_the_ground_is_where_the_range_finder_found_it_for_a_second():
    flying = Flying(ground=3.2)
    assert flying.at(0.5).ground == pytest.approx(3.7, abs=1e-6)
    assert flying.at(GROUND_STALE_S + 0.1).ground is None
    assert Flying().at(0.5).ground is None


def test_a_heading_step_ages():
    flying = Flying()
    flying.record.step_heading(0.4)
    assert flying.at(1.0).heading_step_age == pytest.approx(0.6)


def test_the_drone_sways_by_its_code_while_that_lasts():
    flying = Flying()
    flying.record.agree(coded_motion(2, (1, 2, 3), begin=-2.0))
    down, speed = sway(2, (1, 2, 3), 3.0)[:2, 2].tolist()
    assert flying.at(1.0).sways.down == pytest.approx(down, abs=5e-3)
    assert flying.at(1.0).sways.speed == pytest.approx(speed, abs=0.05)
    assert flying.at(9.0).sways == NO_SWAY
