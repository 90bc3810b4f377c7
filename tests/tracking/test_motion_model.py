"""The image-plane motion model against numeric derivatives and projected three-dimensional truth."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.tracking.gaussian import update
from swarmtrack.tracking.motion_model import (
    Course,
    FadingAcceleration,
    optical_flow,
    propagate,
    turn_by_flow,
    turn_exactly,
)

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
    once = propagate(mean, cov, 1.0, psd=900.0, camera=CAMERA)[1]
    for _ in range(rate_hz):
        mean, cov = propagate(mean, cov, 1.0 / rate_hz, psd=900.0, camera=CAMERA)
    assert cov == pytest.approx(once, rel=1e-9)


@pytest.mark.parametrize("turn", [turn_exactly, turn_by_flow])
@given(seed=st.integers(0, 2**32 - 1), angle=angles, dt=st.floats(-0.1, 2.0))
@settings(max_examples=60, deadline=None)
def test_one_product_is_the_drift_and_then_the_turn(turn, seed, angle, dt):
    rng = np.random.default_rng(seed)
    mean = rng.uniform([0, -300, 0, -300], [640, 300, 480, 300], (5, 4))
    L = rng.normal(size=(5, 4, 4)) * [[2.0], [50.0], [2.0], [50.0]]
    P, psd, R = L @ L.swapaxes(1, 2), rng.uniform(1.0, 1e5, 5), rotation.exp(angle)
    A = np.kron(np.eye(2), [[1.0, dt], [0.0, 1.0]])
    ahead = max(dt, 0.0)  # no noise on the way back
    Q = np.kron(np.eye(2), [[ahead**3 / 3, ahead**2 / 2], [ahead**2 / 2, ahead]])
    drifted = A @ P @ A.T + psd[:, None, None] * Q
    turned, F = turn(mean @ A.T, R, CAMERA)
    expected = F @ drifted @ F.swapaxes(1, 2)
    carried, cov = propagate(mean, P, dt, psd=psd, camera=CAMERA, rotation=R, turn=turn)
    sigma = np.sqrt(np.abs(np.einsum("nii->ni", expected)))
    np.testing.assert_allclose(carried, turned, rtol=1e-12)
    assert (np.abs(cov - expected) <= 1e-9 * sigma[:, :, None] * sigma[:, None]).all()
    alone = propagate(mean, P, dt, psd=psd[0], camera=CAMERA, rotation=R, turn=turn)[1]
    np.testing.assert_array_equal(alone[0], cov[0])  # an array of densities is one for each target


@pytest.mark.parametrize(
    "steps", [2000, pytest.param(10_000, marks=pytest.mark.long("ten thousand steps, not two"))]
)
def test_covariances_stay_symmetric_and_positive_through_thousands_of_random_steps(steps):
    rng = np.random.default_rng(11)
    home = rng.uniform([100, 0, 100, 0], [540, 1e-9, 380, 1e-9], (3, 4))
    mean, cov, attitude = home, np.tile(np.diag([4.0, 1e4, 4.0, 1e4]), (3, 1, 1)), np.eye(3)
    for _ in range(steps):
        before, attitude = attitude, rotation.exp(rng.normal(0.0, 0.1, 3))
        mean, cov = propagate(
            mean,
            cov,
            rng.choice([0.0, 0.001, 0.05]),
            psd=rng.choice([1.0, 1e5]),
            camera=CAMERA,
            rotation=attitude @ before.T,
            rotation_variance=rng.choice([0.0, 1e-6]),
        )
        seen = rng.random(3) < 0.7
        z = turn_exactly(home[seen], attitude, CAMERA)[0][:, ::2] + rng.normal(0.0, 2.0, (seen.sum(), 2))
        R = np.tile(rng.choice([0.01, 1.0, 100.0]) * np.eye(2), (len(z), 1, 1))
        mean[seen], cov[seen] = update(mean[seen], cov[seen], z, R)
        sigma = np.sqrt(np.einsum("nii->ni", cov))
        correlation = cov / (sigma[:, :, None] * sigma[:, None])
        assert np.abs(correlation - correlation.swapaxes(1, 2)).max() < 1e-9
        assert np.linalg.eigvalsh(correlation).min() > 0.0


def test_nobody_is_carried_to_nobody():
    mean, cov = propagate(
        np.empty((0, 4)),
        np.empty((0, 4, 4)),
        0.1,
        psd=np.empty(0),
        camera=CAMERA,
        rotation=rotation.exp(np.array([0.1, 0.2, 0.3])),
        rotation_variance=1e-6,
    )
    assert mean.shape == (0, 4)
    assert cov.shape == (0, 4, 4)


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
    assert turned[0, 0] > 50 * 430.0 or turned[0, 0] < -50 * 430.0  # no lens shows it


@given(x=states)
@settings(max_examples=30, deadline=None)
def test_what_an_unsure_rotation_costs_is_the_flow_times_its_transpose(x):
    flow = optical_flow(x[None, ::2], CAMERA)[0]
    _, paid = propagate(
        x[None], np.zeros((1, 4, 4)), 0.0, psd=1.0, camera=CAMERA, rotation=np.eye(3), rotation_variance=1e-4
    )
    assert paid[0, ::2, ::2] == pytest.approx(1e-4 * flow @ flow.T, rel=1e-9)


@pytest.mark.parametrize("turn", [turn_exactly, turn_by_flow])
@pytest.mark.parametrize("dt", [0.0, 0.05, 0.7, -0.04])
@pytest.mark.parametrize("angle", [None, (0.1, -0.2, 0.15)])
def test_a_course_says_what_propagate_says(dt, angle, turn):
    rng = np.random.default_rng(6)
    mean = rng.uniform((50.0, -200.0, 50.0, -200.0), (600.0, 200.0, 400.0, 200.0), (7, 4))
    root = rng.normal(0.0, 3.0, (7, 4, 4))
    cov, psd = root @ root.swapaxes(1, 2), rng.uniform(100.0, 3000.0, 7)
    R = None if angle is None else rotation.exp(np.array(angle))
    drift = FadingAcceleration(
        rng.normal(0.0, 500.0, (2, 7, 2)), lambda dt: (0.4 * dt**2, 0.8 * dt, 0.2 * dt**2, 0.4 * dt)
    )
    course = Course(
        mean, cov, psd=psd, camera=CAMERA, turn=turn, drift=drift, gyro_error=lambda told: 2.0 * told
    )
    found = course.at(dt, R, 1e-5)

    drifted = mean.copy()
    for acceleration, k in zip(drift.acceleration, (0, 2), strict=True):
        position, velocity = drift.reach(dt)[k : k + 2]
        drifted[:, 1::2] += velocity * acceleration
        drifted[:, ::2] += (position - dt * velocity) * acceleration
    said = propagate(drifted, cov, dt, psd=psd, camera=CAMERA, rotation=R, rotation_variance=2e-5, turn=turn)
    for ours, theirs in zip(found, said, strict=True):
        assert ours == pytest.approx(theirs, rel=1e-9, abs=1e-9)
    assert (np.linalg.eigvalsh(found[1]) > 0.0).all()


def test_a_course_may_be_asked_again():
    mean, cov = np.array([[300.0, 20.0, 200.0, -10.0]]), np.diag([4.0, 90.0, 9.0, 50.0])[None]
    course = Course(mean, cov, psd=900.0, camera=CAMERA, turn=turn_exactly)
    first = course.at(0.1, None, 1e-4)
    course.at(0.3, rotation.exp(np.array([0.1, 0.0, 0.0])), 1e-4)
    for once, again in zip(first, course.at(0.1, None, 1e-4), strict=True):
        assert np.array_equal(once, again)


def test_a_course_of_nobody_leads_nowhere():
    course = Course(np.empty((0, 4)), np.empty((0, 4, 4)), psd=np.empty(0), camera=CAMERA, turn=turn_exactly)
    mean, cov = course.at(0.1, rotation.exp(np.array([0.1, 0.0, 0.0])), 1e-4)
    assert mean.shape == (0, 4)
    assert cov.shape == (0, 4, 4)
