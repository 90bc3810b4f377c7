"""The mix of a calm and an agile model: its mathematics against closed forms, other ways to compute it, and chance."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.tracking import gaussian, manoeuvre
from swarmtrack.tracking.manoeuvre import (
    AGILE,
    CALM,
    AgileLevel,
    Manoeuvres,
    ModeMixture,
    begun,
    joined,
    merged,
    predict,
    update,
)
from swarmtrack.tracking.motion_model import propagate

CAMERA = PinholeCamera(430.0, 430.0, 320.0, 240.0, 640, 480)
SWAYING = Manoeuvres(agile_psd=9000.0, calm_psd=10.0, lasting_s=2.0, calm_s=4.0, agile_s=2.0)
NEVER_CHANGING = Manoeuvres(agile_psd=9000.0, calm_psd=10.0, lasting_s=2.0, calm_s=1e15, agile_s=1e15)
U = np.ix_((0, 1, 4), (0, 1, 4))  # position, velocity and acceleration of one axis
V = np.ix_((2, 3, 5), (2, 3, 5))
KNOWN = np.diag([1.0, 400.0, 1.0, 400.0])
seeds = st.integers(0, 2**32 - 1)


def mixture_of(rng, n):
    """Anything: n targets near the middle of the image, in each mode with its own mean and covariance."""
    A = rng.normal(0.0, 1.0, (n, 2, 6, 6)) * np.array([3.0, 20.0, 3.0, 20.0, 40.0, 40.0])[:, None]
    mean = rng.normal(0.0, 1.0, (n, 2, 6)) * [5.0, 30.0, 5.0, 30.0, 40.0, 40.0] + [
        320.0,
        0.0,
        240.0,
        0.0,
        0.0,
        0.0,
    ]
    agile = rng.uniform(0.02, 0.98, n)
    return ModeMixture(mean, A @ A.swapaxes(2, 3), np.stack([1.0 - agile, agile], axis=1))


def assert_same(one, other, rel=1e-9):
    for a, b in zip(one, other, strict=True):
        scale = np.abs(b).max(initial=1e-300)
        assert np.abs(a - b).max(initial=0.0) <= rel * scale


def assert_positive(cov):
    """Symmetric, and positive once its sides are scaled to one: a pixel and a px/s² have little in common."""
    side = np.sqrt(np.einsum("...ii->...i", cov))
    assert (side > 0.0).all()
    correlation = cov / side[..., :, None] / side[..., None, :]
    assert np.abs(correlation - correlation.swapaxes(-1, -2)).max() < 1e-9
    assert np.linalg.eigvalsh(correlation).min() > -1e-12


# Drift and noise


@given(seed=seeds, dt=st.floats(1e-6, 30.0), share=st.floats(0.0, 1.0))
@settings(max_examples=60, deadline=None)
def test_two_short_steps_are_one_long_one_for_who_keeps_the_mode(seed, dt, share):
    mixture = mixture_of(np.random.default_rng(seed), 3)
    once = predict(mixture, dt, NEVER_CHANGING, camera=CAMERA)
    halfway = predict(mixture, share * dt, NEVER_CHANGING, camera=CAMERA)
    twice = predict(halfway, (1.0 - share) * dt, NEVER_CHANGING, camera=CAMERA)
    kinematic = manoeuvre.KINEMATIC
    assert_same(twice.mean[:, :, kinematic], once.mean[:, :, kinematic])
    assert_same(twice.cov[:, :, kinematic, kinematic], once.cov[:, :, kinematic, kinematic])
    assert_same(twice.mean[:, AGILE], once.mean[:, AGILE])
    assert_same(twice.cov[:, AGILE], once.cov[:, AGILE])
    assert_same(twice.mode, once.mode)


@given(seed=seeds, dt=st.floats(0.0, 100.0), share=st.floats(0.0, 1.0))
@settings(max_examples=60, deadline=None)
def test_the_modes_change_as_often_in_two_short_steps_as_in_one_long_one(seed, dt, share):
    mixture = mixture_of(np.random.default_rng(seed), 3)
    once = predict(mixture, dt, SWAYING, camera=CAMERA).mode
    halfway = predict(mixture, share * dt, SWAYING, camera=CAMERA)
    assert predict(halfway, (1.0 - share) * dt, SWAYING, camera=CAMERA).mode == pytest.approx(once, rel=1e-12)
    assert once.sum(axis=1) == pytest.approx(np.ones(3))


def test_a_target_stays_calm_as_long_as_told_and_in_the_end_is_so_as_often():
    calm = ModeMixture(np.zeros((1, 2, 6)), np.tile(np.eye(6), (1, 2, 1, 1)), np.array([[1.0, 0.0]]))
    short = predict(calm, 1e-5, SWAYING, camera=CAMERA)
    assert short.mode[0, AGILE] == pytest.approx(1e-5 / 4.0, rel=1e-4)
    assert predict(calm, 1e3, SWAYING, camera=CAMERA).mode[0] == pytest.approx([4.0 / 6.0, 2.0 / 6.0])
    assert SWAYING.usual == pytest.approx([4.0 / 6.0, 2.0 / 6.0])


def matrix_exponential(dt, told):
    """F and Q (3, 3) of Singer's model by Van Loan (1978) over a short step, put together again by doubling it."""
    rate = 1.0 / told.lasting_s
    halvings = max(0, math.ceil(math.log2(dt * rate))) if dt > 0.0 else 0
    A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -rate]])
    block = np.zeros((6, 6))
    block[:3, :3], block[3:, 3:] = -A, A.T
    block[2, 5] = 2.0 * rate * told.acceleration_variance
    exponential = expm(block * dt / 2**halvings)
    F = exponential[3:, 3:].T
    Q = F @ exponential[:3, 3:]
    for _ in range(halvings):
        F, Q = F @ F, F @ Q @ F.T + Q
    return F, Q


@pytest.mark.parametrize("dt", [1e-9, 1e-4, 0.01, 1 / 15, 0.4, 0.9, 1.0, 1.1, 3.0, 10.0, 100.0])
def test_drift_and_noise_while_agile_are_those_of_the_matrix_exponential(dt):
    F, Q = manoeuvre.transitions(dt, SWAYING)
    expected_F, expected_Q = matrix_exponential(dt, SWAYING)
    for axis in (U, V):
        assert F[AGILE][axis] == pytest.approx(expected_F, rel=1e-9, abs=1e-12)
        assert Q[AGILE][axis] == pytest.approx(expected_Q, rel=1e-6, abs=0.0)
    assert np.count_nonzero(Q[AGILE]) == 18  # the axes have nothing to do with each other


@pytest.mark.parametrize("share", [0.05, 0.2, 0.49, 0.51, 1.0, 4.0])
def test_noise_while_agile_is_singer_s(share):
    """Bar-Shalom, Li & Kirubarajan (2001), (8.2.3-8) ff., as printed."""
    T, alpha, sigma2 = share * SWAYING.lasting_s, 1.0 / SWAYING.lasting_s, SWAYING.acceleration_variance
    aT, e, e2 = alpha * T, math.exp(-alpha * T), math.exp(-2.0 * alpha * T)
    q11 = (1.0 - e2 + 2.0 * aT + 2.0 / 3.0 * aT**3 - 2.0 * aT**2 - 4.0 * aT * e) / (2.0 * alpha**5)
    q12 = (e2 + 1.0 - 2.0 * e + 2.0 * aT * e - 2.0 * aT + aT**2) / (2.0 * alpha**4)
    q13 = (1.0 - e2 - 2.0 * aT * e) / (2.0 * alpha**3)
    q22 = (4.0 * e - 3.0 - e2 + 2.0 * aT) / (2.0 * alpha**3)
    q23 = (e2 + 1.0 - 2.0 * e) / (2.0 * alpha**2)
    q33 = (1.0 - e2) / (2.0 * alpha)
    expected = 2.0 * alpha * sigma2 * np.array([[q11, q12, q13], [q12, q22, q23], [q13, q23, q33]])
    _, Q = manoeuvre.transitions(T, SWAYING)
    assert Q[AGILE][U] == pytest.approx(expected, rel=1e-8)


def test_an_agile_target_wanders_as_the_density_says_over_long_times():
    """Velocity's variance grows by agile_psd a second."""
    _, Q = manoeuvre.transitions(1e4, SWAYING)
    assert Q[AGILE][1, 1] == pytest.approx(9000.0 * 1e4, rel=1e-3)


@given(seed=seeds, dt=st.floats(0.0, 3.0), turned=st.booleans())
@settings(max_examples=40, deadline=None)
def test_who_is_calm_moves_as_every_other_tracker_s_targets(seed, dt, turned):
    rng = np.random.default_rng(seed)
    mixture = mixture_of(rng, 3)
    R = rotation.exp(rng.normal(0.0, 0.1, 3)) if turned else None
    after = predict(mixture, dt, NEVER_CHANGING, camera=CAMERA, rotation=R, rotation_variance=1e-5)
    mean, cov = propagate(
        mixture.mean[:, CALM, :4],
        mixture.cov[:, CALM, :4, :4],
        dt,
        psd=NEVER_CHANGING.calm_psd,
        camera=CAMERA,
        rotation=R,
        rotation_variance=1e-5,
    )
    assert_same([after.mean[:, CALM, :4], after.cov[:, CALM, :4, :4]], [mean, cov])


def test_a_calm_target_s_acceleration_is_what_it_would_begin_to_manoeuvre_with():
    after = predict(mixture_of(np.random.default_rng(0), 2), 0.1, NEVER_CHANGING, camera=CAMERA)
    assert after.mean[:, CALM, 4:] == pytest.approx(np.zeros((2, 2)), abs=1e-12)
    assert after.cov[:, CALM, 4:, 4:] == pytest.approx(np.tile(2250.0 * np.eye(2), (2, 1, 1)))
    assert after.cov[:, CALM, :4, 4:] == pytest.approx(np.zeros((2, 4, 2)), abs=1e-9)


def test_an_acceleration_turns_with_the_camera():
    """Two targets a moment apart, on the way of a third: what turns both turns their difference, too."""
    R = rotation.exp(np.array([0.05, -0.1, 0.3]))
    mixture = begun(np.array([[400.0, 30.0, 200.0, -20.0]]), np.eye(4)[None], NEVER_CHANGING)
    mixture.mean[:, :, 4:] = [50.0, -80.0]
    after = predict(mixture, 0.0, NEVER_CHANGING, camera=CAMERA, rotation=R)
    step = 1e-4
    nudged = begun(
        np.array([[400.0 + 50.0 * step, 30.0, 200.0 - 80.0 * step, -20.0]]), np.eye(4)[None], SWAYING
    )
    there = predict(nudged, 0.0, NEVER_CHANGING, camera=CAMERA, rotation=R).mean[0, AGILE, 0:4:2]
    assert after.mean[0, AGILE, 4:] == pytest.approx((there - after.mean[0, AGILE, 0:4:2]) / step, rel=1e-4)


@given(seed=seeds)
@settings(max_examples=20, deadline=None)
def test_no_time_and_no_turn_change_nothing(seed):
    mixture = mixture_of(np.random.default_rng(seed), 3)
    after = predict(mixture, 0.0, SWAYING, camera=CAMERA, rotation=np.eye(3))
    assert_same(after.mean[:, :, :4], mixture.mean[:, :, :4], rel=1e-12)
    assert_same(after.cov[:, AGILE], mixture.cov[:, AGILE], rel=1e-12)
    assert after.mode == pytest.approx(mixture.mode)


def test_how_far_an_acceleration_reaches_is_how_far_it_moves_a_target():
    mixture = begun(np.zeros((1, 4)), np.eye(4)[None], NEVER_CHANGING)
    mixture.mean[:, :, 4] = 1.0
    after = predict(mixture, 0.7, NEVER_CHANGING, camera=CAMERA).mean[0, AGILE]
    assert manoeuvre.acceleration_reach(0.7, NEVER_CHANGING) == pytest.approx([after[0], after[1]])
    assert manoeuvre.acceleration_reach(1e-3, NEVER_CHANGING) == pytest.approx([0.5e-6, 1e-3], rel=1e-3)


# The mix


@given(seed=seeds)
@settings(max_examples=20, deadline=None)
def test_merged_is_the_mean_and_the_covariance_of_what_is_drawn_from_the_mix(seed):
    """By definition: E[x], and E[x xᵀ] − E[x] E[x]ᵀ."""
    mixture = mixture_of(np.random.default_rng(seed), 3)
    mean, cov = merged(mixture)
    for i in range(3):
        first = sum(mixture.mode[i, j] * mixture.mean[i, j, :4] for j in (CALM, AGILE))
        second = sum(
            mixture.mode[i, j]
            * (mixture.cov[i, j, :4, :4] + np.outer(mixture.mean[i, j, :4], mixture.mean[i, j, :4]))
            for j in (CALM, AGILE)
        )
        assert mean[i] == pytest.approx(first)
        assert cov[i] == pytest.approx(second - np.outer(first, first), rel=1e-8, abs=1e-6)


def test_merged_is_what_many_draws_come_to():
    rng = np.random.default_rng(0)
    mixture = mixture_of(rng, 1)
    mean, cov = merged(mixture)
    n = 200_000
    agile = rng.random(n) < mixture.mode[0, AGILE]
    draws = [
        rng.multivariate_normal(mixture.mean[0, j, :4], mixture.cov[0, j, :4, :4], n) for j in (CALM, AGILE)
    ]
    x = np.where(agile[:, None], draws[AGILE], draws[CALM])
    sigma = np.sqrt(cov[0].diagonal())
    assert (x.mean(axis=0) - mean[0]) / sigma == pytest.approx(np.zeros(4), abs=5.0 / math.sqrt(n))
    assert np.cov(x.T) / np.outer(sigma, sigma) == pytest.approx(cov[0] / np.outer(sigma, sigma), abs=0.03)


def mixed_by_hand(mean, cov, mode, change):
    """Interaction of Blom & Bar-Shalom (1988) for one target: (11.6.6-7) to (11.6.6-10), with plain loops."""
    later = [sum(change[i][j] * mode[i] for i in range(2)) for j in range(2)]
    means, covs = [], []
    for j in range(2):
        share = [change[i][j] * mode[i] / later[j] for i in range(2)]
        x = sum(share[i] * mean[i] for i in range(2))
        means.append(x)
        covs.append(sum(share[i] * (cov[i] + np.outer(mean[i] - x, mean[i] - x)) for i in range(2)))
    return means, covs, later


@given(seed=seeds, dt=st.floats(1e-3, 3.0))
@settings(max_examples=30, deadline=None)
def test_predict_mixes_and_moves_as_the_book_does(seed, dt):
    mixture = mixture_of(np.random.default_rng(seed), 2)
    after = predict(mixture, dt, SWAYING, camera=CAMERA)
    leave_calm = (1.0 - math.exp(-dt * (1 / 4.0 + 1 / 2.0))) * 2.0 / 6.0
    leave_agile = (1.0 - math.exp(-dt * (1 / 4.0 + 1 / 2.0))) * 4.0 / 6.0
    change = [[1.0 - leave_calm, leave_calm], [leave_agile, 1.0 - leave_agile]]
    F, Q = manoeuvre.transitions(dt, SWAYING)
    for n in range(2):
        means, covs, later = mixed_by_hand(mixture.mean[n], mixture.cov[n], mixture.mode[n], change)
        assert after.mode[n] == pytest.approx(later)
        for j in range(2):
            assert_same(after.mean[n, j], F[j] @ means[j])
            assert_same(after.cov[n, j], F[j] @ covs[j] @ F[j].T + Q[j])


@given(seed=seeds, sigma=st.floats(0.05, 20.0))
@settings(max_examples=40, deadline=None)
def test_update_is_a_kalman_filter_for_each_mode_and_bayes_for_their_probabilities(seed, sigma):
    rng = np.random.default_rng(seed)
    mixture = mixture_of(rng, 3)
    z = rng.normal([320.0, 240.0], 8.0, (3, 2))
    B = rng.normal(0.0, 1.0, (3, 2, 2))
    R = sigma**2 * (B @ B.swapaxes(1, 2) + 0.1 * np.eye(2))
    after, fit = update(mixture, z, R)
    H = np.zeros((2, 6))
    H[0, 0] = H[1, 2] = 1.0
    for n in range(3):
        weight, distance = [], []
        for j in range(2):
            x, P = mixture.mean[n, j], mixture.cov[n, j]
            S = H @ P @ H.T + R[n]
            y = z[n] - H @ x
            K = np.linalg.solve(S, H @ P).T
            assert_same(after.mean[n, j], x + K @ y)
            assert_same(after.cov[n, j], P - K @ S @ K.T, rel=1e-8)
            density = math.exp(-0.5 * y @ np.linalg.solve(S, y)) / math.sqrt(np.linalg.det(2.0 * np.pi * S))
            weight.append(mixture.mode[n, j] * density)
            distance.append(y @ np.linalg.solve(S, y))
        if sum(weight) > 1e-290:
            assert after.mode[n] == pytest.approx(np.array(weight) / sum(weight), rel=1e-8, abs=1e-11)
        assert fit.nis[n] == pytest.approx(after.mode[n] @ distance)
        assert (fit.calm[n] ** 2).sum() == pytest.approx(distance[0])
        assert fit.weight[n] == after.mode[n, 0]


def test_begun_is_in_either_mode_as_often_as_usual_and_known_as_told():
    mean, cov = np.array([[10.0, 1.0, 20.0, 2.0]]), np.diag([4.0, 100.0, 4.0, 100.0])[None]
    mixture = begun(mean, cov, SWAYING)
    assert mixture.mode[0] == pytest.approx([2 / 3, 1 / 3])
    assert merged(mixture)[0] == pytest.approx(mean)
    assert merged(mixture)[1] == pytest.approx(cov)
    assert mixture.cov[0, :, [4, 5], [4, 5]] == pytest.approx(np.full((2, 2), 2250.0))
    assert manoeuvre.mean_acceleration(mixture) == pytest.approx(np.zeros((1, 1, 2)))


LEVELS = replace(SWAYING, levels=(AgileLevel(0.04, 0.75), AgileLevel(1.0, 0.25)))


def test_of_two_levels_the_gentle_is_slower_and_the_calm_are_of_either():
    mixture = begun(np.zeros((1, 4)), np.diag([4.0, 100.0, 4.0, 100.0])[None], LEVELS)
    assert mixture.mode[0] == pytest.approx([2 / 3, 1 / 4, 1 / 12])
    assert mixture.cov[0, :, 1, 1] == pytest.approx([100.0 * (0.75 * 0.04 + 0.25), 4.0, 100.0])
    assert mixture.cov[0, :, 0, 0] == pytest.approx(np.full(3, 4.0))
    assert mixture.cov[0, :, 4, 4] == pytest.approx([90.0, 90.0, 2250.0])


def test_two_levels_alike_are_one():
    """However one splits them, and whatever came before: same Gaussian, same innovations."""
    alike = replace(SWAYING, levels=(AgileLevel(1.0, 0.75), AgileLevel(1.0, 0.25)))
    one, two = (begun(np.zeros((1, 4)), KNOWN[None], m) for m in (SWAYING, alike))
    R = np.eye(2)[None]
    for k in range(1, 8):
        z = np.array([[0.3 * k**2, -1.0 * k]])
        one, fit = update(
            predict(one, 0.1, SWAYING, camera=CAMERA, rotation=rotation.exp([0, 0.01, 0])), z, R
        )
        two, same = update(predict(two, 0.1, alike, camera=CAMERA, rotation=rotation.exp([0, 0.01, 0])), z, R)
        assert_same(merged(two), merged(one), rel=1e-9)
        assert two.mode[0, AGILE:].sum() == pytest.approx(one.mode[0, AGILE])
        in_all = manoeuvre.mean_acceleration(two).sum(axis=0)
        assert in_all == pytest.approx(manoeuvre.mean_acceleration(one)[0])
        assert same.nis == pytest.approx(fit.nis)


def test_a_level_with_briefer_accelerations_is_a_model_of_its_own():
    """Of the same density: as strong a disturbance over seconds, by stronger accelerations that fade sooner."""
    brief = replace(NEVER_CHANGING, levels=(AgileLevel(0.04, 0.75), AgileLevel(1.0, 0.25, 0.25)))
    alone = replace(NEVER_CHANGING, lasting_s=0.25 * NEVER_CHANGING.lasting_s)
    assert brief.variances == pytest.approx([90.0, 90.0, 4.0 * 2250.0])
    for of_both, of_one in zip(
        manoeuvre.transitions(0.3, brief), manoeuvre.transitions(0.3, alone), strict=True
    ):
        assert of_both[2] == pytest.approx(of_one[AGILE])
    assert manoeuvre.acceleration_reach(0.3, brief)[2:] == manoeuvre.acceleration_reach(0.3, alone)


def test_who_begins_a_hard_manoeuvre_has_a_hard_acceleration_at_once():
    gentle = begun(np.zeros((1, 4)), KNOWN[None], LEVELS)._replace(mode=np.array([[0.5, 0.5, 1e-12]]))
    after = predict(gentle, 1e-3, LEVELS, camera=CAMERA)
    assert after.cov[0, :, 4, 4] == pytest.approx([90.0, 90.0, 2250.0], rel=1e-2)


def test_levels_manoeuvre_as_hard_as_they_say():
    """Each by itself moves as the only level of a target that is told its density."""
    _, Q = manoeuvre.transitions(0.3, LEVELS)
    for mode, scale in ((1, 0.04), (2, 1.0)):
        _, alone = manoeuvre.transitions(0.3, replace(SWAYING, agile_psd=scale * SWAYING.agile_psd))
        assert_same(Q[mode], alone[AGILE])
    assert LEVELS.psd == pytest.approx([SWAYING.calm_psd, 0.04 * SWAYING.agile_psd, SWAYING.agile_psd])


def test_nobody_flows_through():
    nobody = manoeuvre.ModeMixture(np.empty((0, 2, 6)), np.empty((0, 2, 6, 6)), np.empty((0, 2)))
    assert (
        len(predict(nobody, 0.1, SWAYING, camera=CAMERA, rotation=np.eye(3), rotation_variance=1e-4).mean)
        == 0
    )
    after, fit = update(nobody, np.empty((0, 2)), np.empty((0, 2, 2)))
    assert after.mode.shape == (0, 2)
    assert fit.nis.shape == (0,)
    one = mixture_of(np.random.default_rng(0), 1)
    assert_same(joined(nobody, one), one)
    assert merged(nobody)[1].shape == (0, 4, 4)


# What it does in flight


def follow(path, dt, sigma=1.0, seeds=20):
    """After each scan of path (k, 2) px, under as many noises: mode probabilities (k, n) and positions (k, n, 2)."""
    rng = np.random.default_rng(0)
    start = np.array([[path[0, 0], 0.0, path[0, 1], 0.0]])
    mixture = begun(np.tile(start, (seeds, 1)), np.tile(KNOWN, (seeds, 1, 1)), SWAYING)
    R = np.tile(sigma**2 * np.eye(2), (seeds, 1, 1))
    agile, position = [], []
    for point in path[1:]:
        mixture = predict(mixture, dt, SWAYING, camera=CAMERA)
        mixture, _ = update(mixture, point + rng.normal(0.0, sigma, (seeds, 2)), R)
        agile.append(mixture.mode[:, AGILE])
        position.append(merged(mixture)[0][:, ::2])
    return np.array(agile), np.array(position)


def follow_by_one_model(path, dt, sigma=1.0, seeds=20):
    """The same scans by white acceleration of the mix's density over time: a third of the agile one. (k, n, 2)."""
    rng = np.random.default_rng(0)
    mean = np.tile([path[0, 0], 0.0, path[0, 1], 0.0], (seeds, 1))
    cov = np.tile(KNOWN, (seeds, 1, 1))
    R = np.tile(sigma**2 * np.eye(2), (seeds, 1, 1))
    position = []
    for point in path[1:]:
        mean, cov = propagate(mean, cov, dt, psd=3000.0, camera=CAMERA)
        mean, cov = gaussian.update(mean, cov, point + rng.normal(0.0, sigma, (seeds, 2)), R)
        position.append(mean[:, ::2])
    return np.array(position)


def test_a_manoeuvre_is_noticed_in_some_scans_and_over_soon():
    """Three seconds straight on, two seconds of 100 px/s², four seconds straight on, at 15 Hz."""
    now = np.arange(0.0, 9.0, 1 / 15)
    v = 50.0 * np.clip(now - 3.0, 0.0, 2.0) ** 2 + 200.0 * np.maximum(now - 5.0, 0.0)
    agile, _ = follow(np.stack([100.0 + 20.0 * now, v], axis=1), 1 / 15)
    usually, now = agile.mean(axis=1), now[1:]
    assert usually[(now > 2.0) & (now < 3.0)].max() < 0.3
    assert usually[(now > 3.7) & (now < 5.0)].min() > 0.85
    assert usually[now > 7.0].max() < 0.35


@pytest.mark.parametrize(("sway_px", "factor"), [(0.0, 0.75), (60.0, 1.05)])
def test_the_mix_follows_a_calm_target_closer_and_an_agile_one_no_worse_than_one_model(sway_px, factor):
    t = np.arange(0.0, 9.0, 1 / 15)
    path = np.stack([100.0 + 20.0 * t, 200.0 + sway_px * np.sin(2.0 * np.pi * 0.25 * t)], axis=1)
    error = [found - path[1:, None] for found in (follow(path, 1 / 15)[1], follow_by_one_model(path, 1 / 15))]
    mixed, single = (math.sqrt(np.square(e).mean()) for e in error)
    assert mixed < factor * single


def of_its_own_model(n, steps, dt, sigma, rng):
    """n targets that do what the model says. Yields (state (n, 6), agile (n,), mixture, nis (n,)) after each
    scan."""
    F, Q = manoeuvre.transitions(dt, SWAYING)
    change, root = manoeuvre.mode_changes(dt, SWAYING), np.linalg.cholesky(Q)
    start, P = np.tile([320.0, 0.0, 240.0, 0.0], (n, 1)), np.diag([4.0, 100.0, 4.0, 100.0])
    mixture = begun(start, np.tile(P, (n, 1, 1)), SWAYING)
    mode = (rng.random(n) < SWAYING.usual[AGILE]).astype(int)
    x = np.concatenate([start, np.zeros((n, 2))], axis=1)
    x += rng.normal(0.0, 1.0, (n, 6)) * np.sqrt([4.0, 100.0, 4.0, 100.0, 2250.0, 2250.0])
    R = np.tile(sigma**2 * np.eye(2), (n, 1, 1))
    for _ in range(steps):
        mode = (rng.random(n) < change[mode, AGILE]).astype(int)
        x = ((F[mode] @ x[:, :, None]) + root[mode] @ rng.normal(0.0, 1.0, (n, 6, 1)))[:, :, 0]
        mixture = predict(mixture, dt, SWAYING, camera=CAMERA)
        mixture, fit = update(mixture, x[:, [0, 2]] + rng.normal(0.0, sigma, (n, 2)), R)
        yield x, mode, mixture, fit.nis


@pytest.mark.parametrize(("dt", "sigma"), [(1 / 15, 1.5), (1 / 7, 2.0)])
def test_of_targets_that_fly_as_it_thinks_it_knows_how_wrong_it_is(dt, sigma):
    """400 of them, 60 scans: NEES 4, NIS 2 and the mode's probability that of the mode, each in its 99.9 % band.

    The mix is no exact filter: it is given 3 % beside. The band is from the spread between targets, whose scans hang
    together."""
    nees, nis, doubt = [], [], []
    for x, agile, mixture, squared in of_its_own_model(400, 60, dt, sigma, np.random.default_rng(1)):
        mean, cov = merged(mixture)
        e = x[:, :4] - mean
        nees.append((e * np.linalg.solve(cov, e[:, :, None])[:, :, 0]).sum(axis=1))
        nis.append(squared)
        doubt.append(mixture.mode[:, AGILE] - agile)
    for values, expected, slack in ((nees, 4.0, 0.12), (nis, 2.0, 0.06), (doubt, 0.0, 0.02)):
        per_target = np.mean(values, axis=0)
        band = 3.3 * per_target.std() / math.sqrt(len(per_target)) + slack
        assert band < 0.1 * max(expected, 1.0)
        assert per_target.mean() == pytest.approx(expected, abs=band)


def test_where_it_says_seven_in_ten_seven_in_ten_manoeuvre():
    said, were = [], []
    for _, agile, mixture, _ in of_its_own_model(400, 60, 1 / 15, 1.5, np.random.default_rng(2)):
        said.append(mixture.mode[:, AGILE])
        were.append(agile)
    said, were = np.concatenate(said), np.concatenate(were)
    for low in np.arange(0.0, 1.0, 0.2):
        chosen = (said >= low) & (said < low + 0.2)
        assert chosen.sum() > 500
        assert were[chosen].mean() == pytest.approx(said[chosen].mean(), abs=0.07)


# Numbers that could break it


def test_it_stays_sound_whatever_happens_for_twenty_thousand_steps():
    """Rotations, no time at all, hours, tiny and huge R, measurements far off; new targets take the place of those
    that left. Eight at once, 2500 scans."""
    rng = np.random.default_rng(0)
    n = 8

    def fresh(k):
        mean = rng.uniform([100.0, -50.0, 100.0, -50.0], [540.0, 50.0, 380.0, 50.0], (k, 4))
        return begun(mean, np.tile(np.diag([4.0, 1e4, 4.0, 1e4]), (k, 1, 1)), SWAYING)

    mixture = fresh(n)
    with np.errstate(all="raise", under="ignore"):
        for step in range(2500):
            dt = float(
                rng.choice([0.0, 1e-9, 1e-3, 1 / 15, 1.0, 1000.0], p=[0.1, 0.05, 0.1, 0.7, 0.04, 0.01])
            )
            turned = rotation.exp(rng.normal(0.0, 0.02, 3)) if rng.random() < 0.5 else None
            mixture = predict(mixture, dt, SWAYING, camera=CAMERA, rotation=turned, rotation_variance=1e-6)
            if rng.random() < 0.8:
                sigma = rng.choice([1e-3, 1.0, 1e3], p=[0.05, 0.9, 0.05])
                off = rng.choice([1.0, 1e4], p=[0.98, 0.02])
                z = merged(mixture)[0][:, ::2] + rng.normal(0.0, sigma * off, (n, 2))
                mixture, _ = update(mixture, z, np.tile(sigma**2 * np.eye(2), (n, 1, 1)))
            assert np.isfinite(mixture.mean).all()
            assert mixture.mode.min() > 0.0
            assert np.abs(mixture.mode.sum(axis=1) - 1.0).max() < 1e-9
            if step % 10 == 0:
                assert_positive(mixture.cov)
                assert_positive(merged(mixture)[1])
            gone = np.abs(mixture.mean[:, :, 0:4:2] - [320.0, 240.0]).max(axis=(1, 2)) > 500.0
            if gone.any():
                mixture = joined(mixture.select(np.flatnonzero(~gone)), fresh(int(gone.sum())))


@pytest.mark.parametrize("scale", [1e2, 1e4, 1e6])
@pytest.mark.parametrize("variance", [1e-2, 1e-6])
def test_a_detection_of_next_to_no_noise_leaves_a_positive_covariance(scale, variance):
    """Where P − K S Kᵀ is rounding alone: as sure as the detection, and no surer."""
    rng = np.random.default_rng(0)
    A = rng.normal(0.0, scale, (50, 2, 6, 6))
    known_to_little = ModeMixture(np.zeros((50, 2, 6)), A @ A.swapaxes(2, 3), np.full((50, 2), 0.5))
    R = np.tile(variance * np.eye(2), (50, 1, 1))
    after, _ = update(known_to_little, rng.normal(0.0, scale, (50, 2)), R)
    assert_positive(after.cov)
    assert after.cov[:, :, 0:4:2, 0:4:2] == pytest.approx(
        np.tile(R[:, None], (1, 2, 1, 1)), rel=1e-2, abs=1e-3 * variance
    )


def test_a_mode_that_was_ruled_out_can_come_back():
    """A second unseen, then 300 px off: the calm model's probability is e⁻¹⁰⁰⁰⁰. No time passes until the next."""
    told = Manoeuvres(agile_psd=150_000.0, calm_psd=10.0, lasting_s=2.0, calm_s=4.0, agile_s=2.0)
    mixture = begun(np.array([[320.0, 0.0, 240.0, 0.0]]), np.diag([1.0, 1.0, 1.0, 1.0])[None], told)
    mixture = predict(mixture, 1.0, told, camera=CAMERA)
    mixture, _ = update(mixture, np.array([[620.0, 240.0]]), np.eye(2)[None])
    assert mixture.mode[0, AGILE] == pytest.approx(1.0)
    for dt in (0.0, 0.0, 0.1):
        mixture = predict(mixture, dt, told, camera=CAMERA)
        assert np.isfinite(mixture.mean).all()
        assert np.isfinite(mixture.cov).all()
    assert mixture.mode[0, CALM] == pytest.approx(0.1 / 2.0, rel=0.1)


def test_what_is_handed_in_is_not_written_into():
    mixture = mixture_of(np.random.default_rng(0), 2)
    before = [a.copy() for a in mixture]
    predict(
        mixture,
        0.1,
        SWAYING,
        camera=CAMERA,
        rotation=rotation.exp(np.array([0.0, 0.1, 0.0])),
        rotation_variance=1e-4,
    )
    update(mixture, np.zeros((2, 2)), np.tile(np.eye(2), (2, 1, 1)))
    for was, now in itertools.zip_longest(before, mixture):
        assert (was == now).all()


def test_modes_that_are_far_apart_keep_their_covariances_where_they_hardly_mix():
    """As of a track that coasted for long in a turning camera: the squares of their distance must not cancel."""
    rng = np.random.default_rng(0)
    mixture = mixture_of(rng, 5)
    away = np.array([[0.0], [1e6]]) * rng.normal(0.0, 1.0, (5, 1, 6))
    apart = mixture._replace(mean=mixture.mean + away, cov=1e-3 * mixture.cov)
    mixed = manoeuvre._interact(apart, 1e-3, NEVER_CHANGING)
    assert mixed.cov == pytest.approx(apart.cov, rel=1e-4, abs=1e-5)
    assert mixed.mean == pytest.approx(apart.mean)
