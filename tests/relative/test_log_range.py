"""The filter of log ranges against what it must be in metres, where motion is linear, and against brute force."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmtrack.geometry import rotation
from swarmtrack.relative.log_range import (
    STATE_SIZE,
    Beliefs,
    Drift,
    OwnWay,
    SizeErrors,
    VelocityPrior,
    across,
    cartesian,
    corrected,
    corrected_late,
    decay,
    predicted,
)

seeds = st.integers(0, 2**32 - 1)
STEADY, APART = SizeErrors(0.0, 1.0), Drift(0.0, 0.0)


def some(rng, n):
    """Beliefs of n teammates, with covariances that mix everything."""
    d = rng.normal(size=(n, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    L = 0.05 * rng.normal(size=(n, STATE_SIZE, STATE_SIZE))
    return Beliefs(
        d, across(d), rng.uniform(0.0, 4.0, n), 0.3 * rng.normal(size=(n, 3)), rng.normal(size=(n, 2)),
        rng.normal(size=(n, 3)), rng.normal(size=n), L @ L.swapaxes(1, 2) + 1e-4 * np.eye(STATE_SIZE),
    )  # fmt: skip


def wander(n, speed=0.7, forget=3.0):
    return VelocityPrior(np.full(n, speed), forget)


def step(now, u, dt=0.14, speed=0.7, walked=0.0):
    law = decay(dt, wander(now.n, speed))
    return law, *predicted(now, law, OwnWay(u, walked, 0.0, 0.0), dt=dt, errors=STEADY, drift=APART)


@given(seeds, st.integers(0, 5))
@settings(max_examples=50, deadline=None)
def test_a_step_is_the_cartesian_one_in_mean_and_covariance(seed, n):
    """r' = r + φ v − u and v' = e v are linear in metres, and so must be what they do to a covariance."""
    rng = np.random.default_rng(seed)
    now, u = some(rng, n), 0.3 * rng.normal(size=3)
    before = cartesian(now)
    law, later, _ = step(now, u)
    after = cartesian(later)
    assert after.r == pytest.approx(before.r + law.phi * before.v - u, rel=1e-9)
    assert after.v == pytest.approx(law.left * before.v, rel=1e-9, abs=1e-12)
    phi = np.eye(6)
    phi[:3, 3:], phi[3:, 3:] = law.phi * np.eye(3), law.left * np.eye(3)
    q = np.array([[[pp, pv], [pv, vv]] for pp, pv, vv in zip(law.pp, law.pv, law.vv, strict=True)])
    Q = np.array([np.kron(one, np.eye(3)) for one in q]).reshape(n, 6, 6)
    np.testing.assert_allclose(after.cov, phi @ before.cov @ phi.T + Q, rtol=1e-6, atol=1e-9)


def test_the_decay_is_the_integral_of_its_process():
    """Against sums over a thousand small steps."""
    law, h, tau, sigma = decay(0.5, wander(1, 1.3, 2.0)), 0.5 / 20000, 2.0, 1.3
    F, A, Q = np.eye(2), np.array([[1.0, h], [0.0, 1.0 - h / tau]]), np.zeros((2, 2))
    for _ in range(20000):
        F, Q = A @ F, A @ Q @ A.T + h * np.diag([0.0, 2.0 * sigma**2 / tau])
    assert (law.phi, law.left) == pytest.approx((F[0, 1], F[1, 1]), rel=1e-4)
    assert (law.pp[0], law.pv[0], law.vv[0]) == pytest.approx((Q[0, 0], Q[0, 1], Q[1, 1]), rel=1e-3)


def test_an_own_way_that_is_mostly_noise_tells_nothing_of_the_range():
    rng = np.random.default_rng(1)
    now, u = some(rng, 3), np.array([0.01, 0.0, 0.0])
    _, later, F = step(now, u, walked=0.02**2)
    assert F[:, 0:2, 2] == pytest.approx(0.0)
    _, sure, F = step(now, u, walked=0.0)
    assert np.abs(F[:, 0:2, 2]).max() > 1e-4
    np.testing.assert_allclose(later.d, sure.d)


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_an_update_adds_the_information_of_its_measurement(seed):
    rng = np.random.default_rng(seed)
    prior, H, nu = some(rng, 4), rng.normal(size=(4, 3, STATE_SIZE)), 0.01 * rng.normal(size=(4, 3))
    R = np.tile(np.diag([0.01, 0.02, 0.03]), (4, 1, 1))
    found, A = corrected(prior, H, nu, R)
    information = np.linalg.inv(prior.P) + H.swapaxes(1, 2) @ np.linalg.solve(R, H)
    # In the axes across the new direction.
    T = np.zeros((4, STATE_SIZE, STATE_SIZE)) + np.eye(STATE_SIZE)
    T[:, :2, :2] = found.E.swapaxes(1, 2) @ prior.E
    np.testing.assert_allclose(
        found.P, T @ np.linalg.inv(information) @ T.swapaxes(1, 2), rtol=1e-5, atol=1e-8
    )
    np.testing.assert_allclose(
        A, T @ np.linalg.inv(information) @ np.linalg.inv(prior.P), rtol=1e-4, atol=1e-6
    )
    gain = np.linalg.solve(information, H.swapaxes(1, 2) @ np.linalg.solve(R, nu[:, :, None]))[:, :, 0]
    np.testing.assert_allclose(found.log_range - prior.log_range, gain[:, 2], atol=1e-9)


def test_what_was_measured_before_the_last_scan_is_worth_what_the_joint_gaussian_says():
    """Two instants of one state, jointly normal: the conditional by hand, and by what the two share."""
    rng = np.random.default_rng(3)
    then = some(rng, 1)
    _, now, F = step(then, np.zeros(3))
    H, R, nu = rng.normal(size=(2, STATE_SIZE)), np.diag([0.02, 0.01]), np.array([0.01, -0.02])
    P_then, P_now = then.P[0], now.P[0]
    joint = np.block([[P_now, F[0] @ P_then], [P_then @ F[0].T, P_then]])
    both = np.concatenate([np.zeros((2, STATE_SIZE)), H], axis=1)
    K = joint @ both.T @ np.linalg.inv(both @ joint @ both.T + R)
    want, dx = (joint - K @ both @ joint)[:STATE_SIZE, :STATE_SIZE], (K @ nu)[:STATE_SIZE]
    found = corrected_late(now, F[0] @ P_then @ H.T, nu, H @ P_then @ H.T + R)
    T = np.eye(STATE_SIZE)
    T[:2, :2] = found.E[0].T @ now.E[0]
    np.testing.assert_allclose(found.P[0], T @ want @ T.T, rtol=1e-8, atol=1e-12)
    assert found.log_range[0] - now.log_range[0] == pytest.approx(dx[2])
    assert found.s[0] - now.s[0] == pytest.approx(dx[3:6])


@pytest.mark.parametrize("guess", [1e-3, 1e5])
def test_no_range_leaves_0_3_to_300_m(guess):
    rng = np.random.default_rng(4)
    now = some(rng, 1)
    H, R = np.zeros((1, 1, STATE_SIZE)), np.full((1, 1, 1), 1e-8)
    H[0, 0, 2] = 1.0
    found, _ = corrected(now, H, np.array([[np.log(guess) - now.log_range[0]]]), R)
    assert 0.3 - 1e-9 <= np.exp(found.log_range[0]) <= 300.0 + 1e-9


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_turning_the_team_s_axes_turns_what_is_believed_and_nothing_else(seed):
    rng = np.random.default_rng(seed)
    now, u = some(rng, 3), 0.2 * rng.normal(size=3)
    R = rotation.exp(rng.normal(size=3))
    d = now.d @ R.T
    turned = Beliefs(
        d, R @ now.E, now.log_range, now.s @ R.T, now.size, now.place, now.turn, _with_speed_turned(now.P, R)
    )
    _, here, _ = step(now, u)
    _, there, _ = step(turned, R @ u)
    a, b = cartesian(here), cartesian(there)
    assert b.r == pytest.approx(a.r @ R.T)
    both = np.kron(np.eye(2), R)
    np.testing.assert_allclose(b.cov, both @ a.cov @ both.T, rtol=1e-6, atol=1e-9)


def _with_speed_turned(P, R):
    T = np.eye(STATE_SIZE)
    T[3:6, 3:6] = R
    return T @ P @ T.T
