"""The image-plane motion model against numeric derivatives and projected three-dimensional truth."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.tracking.motion_model import drift, optical_flow, propagate, turn_by_flow, turn_exactly

CAMERA = PinholeCamera(430.0, 470.0, 315.0, 242.0, 640, 480)
angles = st.tuples(*[st.floats(-0.3, 0.3)] * 3).map(np.array)
states = st.tuples(
    st.floats(0, 640), st.floats(-300, 300), st.floats(0, 480), st.floats(-300, 300)
).map(np.array)  # fmt: skip


def differentiated(turn, x, R, step=1e-4):
    ahead, behind = x + step * np.eye(4), x - step * np.eye(4)
    return ((turn(ahead, R, CAMERA)[0] - turn(behind, R, CAMERA)[0]) / (2 * step)).T


@pytest.mark.parametrize("turn", [turn_exactly, turn_by_flow])
@given(x=states, angle=angles)
@settings(max_examples=60, deadline=None)
def test_the_covariance_is_carried_by_the_jacobian_of_the_mean(turn, x, angle):
    P = np.diag([4.0, 90.0, 9.0, 50.0])
    R = rotation.exp(angle)
    F = differentiated(turn, x, R)
    assert turn(x[None], R, CAMERA)[1][0] == pytest.approx(F, rel=1e-5, abs=1e-5)
    _, carried = propagate(x[None], P[None], 0.0, psd=1.0, camera=CAMERA, rotation=R, turn=turn)
    assert carried[0] == pytest.approx(F @ P @ F.T, rel=1e-4, abs=1e-4)


@given(x=states, angle=angles)
@settings(max_examples=60, deadline=None)
def test_a_turned_target_stands_where_its_bearing_is_seen(x, angle):
    R = rotation.exp(angle)
    bearing = np.array([(x[0] - 315.0) / 430.0, (x[2] - 242.0) / 470.0, 1.0])
    seen = R @ bearing
    turned, _ = turn_exactly(x[None], R, CAMERA)
    assert turned[0, [0, 2]] == pytest.approx(
        [430.0 * seen[0] / seen[2] + 315.0, 470.0 * seen[1] / seen[2] + 242.0], abs=1e-8
    )


def test_the_paper_s_flow_is_the_derivative_of_the_exact_turn():
    points = np.array([[100.0, 50.0], [600.0, 400.0], [315.0, 242.0]])
    states = np.zeros((3, 4))
    states[:, ::2] = points
    for axis in range(3):
        angle = np.zeros(3)
        angle[axis] = 1e-6
        turned, _ = turn_exactly(states, rotation.exp(-angle), CAMERA)
        flow = (turned[:, ::2] - points) / 1e-6
        assert flow == pytest.approx(optical_flow(points, CAMERA)[:, :, axis], rel=1e-3, abs=1e-2)


def test_a_roll_turns_the_velocity_and_keeps_its_length():
    square = PinholeCamera(400.0, 400.0, 320.0, 240.0, 640, 480)
    x = np.array([[420.0, 50.0, 240.0, 0.0]])
    turned, _ = turn_exactly(x, rotation.exp(np.array([0.0, 0.0, np.pi / 2])), square)
    assert turned[0] == pytest.approx([320.0, 0.0, 340.0, 50.0], abs=1e-9)


@pytest.mark.parametrize("rate_hz", [50, 100, 400])
def test_uncertainty_grows_the_same_per_second_at_any_rate(rate_hz):
    mean, cov = np.zeros((1, 4)), np.diag([4.0, 100.0, 4.0, 100.0])[None]
    once = drift(mean, cov, 1.0, 900.0)[1]
    for _ in range(rate_hz):
        mean, cov = drift(mean, cov, 1.0 / rate_hz, 900.0)
    assert cov == pytest.approx(once, rel=1e-9)


def test_an_unsure_rotation_costs_what_it_would_move():
    mean, cov = np.array([[315.0, 0.0, 242.0, 0.0]]), np.zeros((1, 4, 4))
    _, paid = propagate(mean, cov, 0.0, psd=1.0, camera=CAMERA, rotation=np.eye(3), rotation_variance=1e-4)
    assert paid[0, 0, 0] == pytest.approx((430.0 * 0.01) ** 2)
    assert paid[0, 2, 2] == pytest.approx((470.0 * 0.01) ** 2)


def test_a_target_turned_behind_the_camera_stays_finite():
    mean = np.array([[320.0, 10.0, 240.0, 10.0]])
    turned, F = turn_exactly(mean, rotation.exp(np.array([0.0, 3.0, 0.0])), CAMERA)
    assert np.isfinite(turned).all()
    assert np.isfinite(F).all()


@given(x=states)
@settings(max_examples=30, deadline=None)
def test_what_an_unsure_rotation_costs_is_the_flow_times_its_transpose(x):
    flow = optical_flow(x[None, ::2], CAMERA)[0]
    _, paid = propagate(
        x[None], np.zeros((1, 4, 4)), 0.0, psd=1.0, camera=CAMERA, rotation=np.eye(3), rotation_variance=1e-4
    )
    assert paid[0, ::2, ::2] == pytest.approx(1e-4 * flow @ flow.T, rel=1e-9)
