"""Rotations and poses: closed forms, SciPy as the independent witness, and round trips."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from swarmtrack.geometry import rotation
from swarmtrack.geometry.pose import Pose

component = st.floats(-3.0, 3.0, allow_nan=False)
vectors = st.tuples(component, component, component).map(np.array)
angle = st.floats(-np.pi, np.pi)


@given(vectors)
def test_exp_is_the_matrix_exponential(phi):
    assert np.allclose(rotation.exp(phi), expm(rotation.hat(phi)), atol=1e-13)


@pytest.mark.parametrize("length", [0.0, 1e-300, 1e-12, 1e-7, 1e-3, 1.0, np.pi - 1e-3, np.pi - 1e-9])
def test_log_undoes_exp_from_nothing_to_half_a_turn(length):
    axis = np.array([0.48, -0.6, 0.64])
    phi = length * axis
    assert np.allclose(rotation.log(rotation.exp(phi)), phi, rtol=1e-9, atol=1e-15)


@given(vectors)
def test_the_angle_is_that_of_scipy_for_one_and_for_many(phi):
    R = rotation.exp(np.stack((phi, 0.0 * phi)))
    expected = Rotation.from_matrix(R).magnitude()
    assert np.allclose(rotation.angle(R), expected, atol=1e-12)
    assert rotation.angle(R[0]) == pytest.approx(expected[0], abs=1e-12)


@given(vectors)
def test_log_at_half_a_turn_is_one_of_the_two_answers(v):
    if np.linalg.norm(v) < 1e-3:
        return
    phi = np.pi * v / np.linalg.norm(v)
    found = rotation.log(rotation.exp(phi))
    assert min(np.abs(found - phi).max(), np.abs(found + phi).max()) < 1e-7


@given(vectors)
def test_quaternions_agree_with_scipy_and_come_back(phi):
    R = rotation.exp(phi)
    q = rotation.to_quaternion(R)
    x, y, z, w = Rotation.from_rotvec(phi).as_quat()
    assert q[0] >= 0.0
    assert abs(abs(q @ [w, x, y, z]) - 1.0) < 1e-12
    assert np.allclose(rotation.from_quaternion(-2.0 * q), R, atol=1e-12)


@given(angle, st.floats(-1.57, 1.57), angle)
def test_euler_angles_are_the_aerospace_ones_and_come_back(roll, pitch, yaw):
    R = rotation.from_euler(roll, pitch, yaw)
    assert np.allclose(R, Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix(), atol=1e-12)
    assert np.allclose(rotation.from_euler(*rotation.to_euler(R)), R, atol=1e-12)


def test_euler_angles_come_back_as_a_rotation_with_the_nose_straight_up():
    R = rotation.from_euler(0.3, np.pi / 2, 1.1)
    assert np.allclose(rotation.from_euler(*rotation.to_euler(R)), R, atol=1e-12)


def test_yaw_turns_the_nose_from_north_to_east_and_pitch_lifts_it():
    nose = np.array([1.0, 0.0, 0.0])
    assert np.allclose(rotation.from_euler(0, 0, np.pi / 2) @ nose, [0, 1, 0])
    assert (rotation.from_euler(0, 0.1, 0) @ nose)[2] < 0.0  # NED: up is negative


def test_a_forward_camera_looks_along_the_nose_with_the_world_upright():
    R = rotation.BODY_FROM_FORWARD_CAMERA
    assert rotation.is_rotation(R, 0.0)
    assert np.array_equal(R @ [0, 0, 1], [1, 0, 0])  # optical axis: forward
    assert np.array_equal(R @ [0, 1, 0], [0, 0, 1])  # image down: body down


def test_batches_are_the_single_answers_stacked():
    """To the last digits: a single one goes by plain numbers."""
    rng = np.random.default_rng(0)
    phi = rng.normal(size=(4, 5, 3))
    phi *= np.array([0.0, 1e-9, 1e-4, 1.0, 1.0])[:, None]
    phi[:3, 4] = np.pi * np.eye(3)
    R = rotation.exp(phi)
    for f, x in ((rotation.exp, phi), (rotation.log, R), (rotation.to_quaternion, R), (rotation.to_euler, R)):
        for i, k in np.ndindex(4, 5):
            assert np.allclose(f(x)[i, k], f(x[i, k]), rtol=1e-14, atol=1e-14)
    assert np.isnan(rotation.exp([np.inf, 0.0, 0.0])).all()
    assert rotation.exp(np.empty((0, 3))).shape == (0, 3, 3)
    assert rotation.log(np.empty((0, 3, 3))).shape == (0, 3)


def test_reflections_shears_and_nan_are_not_rotations():
    assert rotation.is_rotation(np.eye(3))
    for bad in (-np.eye(3), np.diag([1, 1, -1.0]), 1.01 * np.eye(3), np.full((3, 3), np.nan), np.eye(4)):
        assert not rotation.is_rotation(bad)
    with pytest.raises(ValueError, match=r"Pose\.rotation"):
        Pose(np.diag([1, 1, -1.0]), np.zeros(3))
    with pytest.raises(ValueError, match=r"Pose\.position"):
        Pose(np.eye(3), np.array([0.0, np.nan, 0.0]))


@given(vectors, vectors, vectors, vectors)
def test_composing_poses_is_transforming_twice_and_the_inverse_undoes_it(phi, psi, p, point):
    a_from_b = Pose(rotation.exp(phi), p)
    b_from_c = Pose(rotation.exp(psi), -2 * p + 1)
    once = (a_from_b @ b_from_c).transform(point[None])
    assert np.allclose(once, a_from_b.transform(b_from_c.transform(point[None])), atol=1e-12)
    assert np.allclose(a_from_b.inverse().transform(a_from_b.transform(point[None])), point, atol=1e-12)
