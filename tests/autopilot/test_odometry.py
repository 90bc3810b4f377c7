"""The place that an autopilot is fed, as it and others read it."""

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.odometry import no_odometry, odometry, quality_of
from swarmtrack.geometry.rotation import from_euler, from_quaternion
from swarmtrack.motion.ego import AutopilotPlace

ARDUPILOT, PX4 = common.MAV_AUTOPILOT_ARDUPILOTMEGA, common.MAV_AUTOPILOT_PX4
COV = np.array([[0.04, 0.01, 0.002], [0.01, 0.09, 0.003], [0.002, 0.003, 0.16]])
PLACE = AutopilotPlace(
    12.5,
    np.array([3.0, -2.0, -5.0]),
    COV,
    np.array([1.0, 0.0, 0.5]),
    np.diag([0.25, 0.01, 0.04]),
    from_euler(0.0, 0.0, math.pi / 2.0),
    np.diag([1e-4, 2e-4, 3e-4]),
    held_t=12.4,
    by=(1, 3),
)


def sent(kind, **more):
    """As the other end decodes it."""
    options = {"origin": np.array([10.0, 0.0, 0.0]), "quality": 80, "resets": 257} | more
    mav = common.MAVLink(None, 1, 191)
    return common.MAVLink(None).decode(bytearray(odometry(PLACE, kind=kind, **options).pack(mav)))


@pytest.mark.parametrize(
    ("kind", "frame"), [(ARDUPILOT, common.MAV_FRAME_LOCAL_FRD), (PX4, common.MAV_FRAME_LOCAL_NED)]
)
def test_each_autopilot_gets_the_frames_that_it_takes(kind, frame):
    m = sent(kind)
    assert (m.frame_id, m.child_frame_id) == (frame, common.MAV_FRAME_BODY_FRD)
    assert m.estimator_type == common.MAV_ESTIMATOR_TYPE_VISION


def test_place_attitude_and_velocity_are_in_the_autopilots_own_frame():
    m = sent(ARDUPILOT)
    assert m.time_usec == 12_500_000
    assert (m.x, m.y, m.z) == pytest.approx((13.0, -2.0, -5.0))
    np.testing.assert_allclose(from_quaternion(np.array(m.q)), PLACE.world_from_body, atol=1e-6)
    # It looks east: what moves north moves to its left.
    assert (m.vx, m.vy, m.vz) == pytest.approx((0.0, -1.0, 0.5), abs=1e-6)
    assert (m.quality, m.reset_counter) == (80, 1)


def test_covariances_are_upper_triangles_and_nan_where_nothing_is_known():
    m = sent(PX4)
    pose, velocity = np.full((6, 6), math.nan), np.full((6, 6), math.nan)
    pose[np.triu_indices(6)], velocity[np.triu_indices(6)] = m.pose_covariance, m.velocity_covariance
    np.testing.assert_allclose(pose[:3, :3][np.triu_indices(3)], COV[np.triu_indices(3)], rtol=1e-6)
    assert [pose[k, k] for k in (3, 4, 5)] == pytest.approx([1e-4, 2e-4, 3e-4])
    assert np.isnan(pose[:3, 3:]).all()
    assert velocity[0, 0] == pytest.approx(0.01)
    assert velocity[1, 1] == pytest.approx(0.25)
    assert np.isnan([m.rollspeed, m.pitchspeed, m.yawspeed]).all()
    assert np.isnan(velocity[3:, 3:]).all()


def test_that_there_is_no_place_can_be_used_by_nobody():
    m = no_odometry(7.0, resets=3)
    assert m.quality == -1
    assert np.isnan([m.x, m.y, m.z, m.vx, m.vy, m.vz, m.pose_covariance[0]]).all()
    assert m.reset_counter == 3


def test_quality_is_a_share_of_the_limit_and_never_that_of_a_failure():
    assert [quality_of(s, 2.0) for s in (0.0, 1.0, 2.0, 5.0)] == [100, 50, 1, 1]
