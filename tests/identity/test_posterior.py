"""Which track is which drone, by one look: closed forms, and what a thousand simulated looks say."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.identity.posterior import IN_VIEW, PRIOR, Prior, log_ratios, nearest, posterior, residuals
from swarmtrack.identity.reprojection import Predictions

CAMERA = PinholeCamera(430.0, 430.0, 320.0, 240.0, 640, 480)
AREA = 640.0 * 480.0
TRACK_SIGMA = 2.0


def tracks(*pixels):
    """mean (n, 4), cov (n, 4, 4) of standing tracks."""
    mean = np.zeros((len(pixels), 4))
    mean[:, ::2] = np.reshape(pixels, (-1, 2))
    return mean, np.broadcast_to(TRACK_SIGMA**2 * np.eye(4), (len(pixels), 4, 4))


def drones(*pixels, sigmas=(10.0,), shares=(1.0,)):
    """Drones 1, 2, … projected to these pixels; in all, tracks are off by `sigmas` with the probabilities `shares`."""
    k = len(pixels)
    spread = [(sigma**2 - TRACK_SIGMA**2) * np.eye(2) for sigma in sigmas]
    return Predictions(
        [(column,) for column in range(k)],
        [column + 1 for column in range(k)],
        np.reshape(pixels, (-1, 2)).astype(float),
        np.repeat(np.reshape(shares, (-1, 1)), k, axis=1),
        np.repeat(np.reshape(spread, (-1, 1, 2, 2)), k, axis=1),
        np.full((k, 2), np.nan),
        np.zeros((k, 2)),
    )


def density(distance, sigma):
    return math.exp(-0.5 * (distance / sigma) ** 2) / (2.0 * math.pi * sigma**2)


def test_a_lone_pair_is_as_likely_as_bayes_has_it():
    """One track, one drone: it is the drone, or a stranger where the drone was not seen."""
    mean, cov = tracks((320, 240))
    for distance in (0.0, 12.0, 30.0):
        drone = PRIOR.p_seen * density(distance, 10.0)
        stranger = (1.0 - PRIOR.p_seen) * PRIOR.strangers / AREA
        found = posterior(mean, cov, drones((320 + distance, 240)), CAMERA)
        assert found == pytest.approx(np.array([[drone / (drone + stranger)]]))


def test_outside_the_gate_nobody_is_anybody():
    mean, cov = tracks((320, 240))
    gate = math.sqrt(-2.0 * math.log(1e-4))  # sigma
    assert posterior(mean, cov, drones((320 + 9.99 * gate, 240)), CAMERA) > 0.0
    assert posterior(mean, cov, drones((320 + 10.01 * gate, 240)), CAMERA) == 0.0


def test_a_covariance_like_a_needle_is_no_nonsense():
    """As a hostile drone may announce: valid, and so long that rounding leaves nothing of its determinant."""
    exact = log_ratios(residuals(*tracks((300, 230)), drones((300, 230), sigmas=(2.1,))), CAMERA)
    for angle in np.linspace(0.0, math.pi, 200):
        along = np.array([math.cos(angle), math.sin(angle)])
        needle = drones((300, 230))._replace(cov=1e19 * np.outer(along, along)[None, None])
        ratios = log_ratios(residuals(*tracks((320, 240), (100, 100)), needle), CAMERA)
        assert not np.isnan(ratios).any()
        assert ratios.max() < exact


def test_two_drones_that_cross_may_be_either():
    found = posterior(*tracks((315, 240), (325, 240)), drones((320, 235), (320, 245)), CAMERA)
    assert found == pytest.approx(np.full((2, 2), 0.5), abs=0.01)


def test_one_clear_pair_settles_the_ambiguous_one():
    """Both tracks fit drone 1; only the first also fits drone 2, and that is all drone 2 has."""
    found = posterior(*tracks((325, 240), (305, 240)), drones((315, 240), (345, 240)), CAMERA)
    assert found.argmax(axis=1).tolist() == [1, 0]
    alone = posterior(*tracks((325, 240), (305, 240)), drones((315, 240)), CAMERA)
    assert found[1, 0] > 0.95
    assert alone[1, 0] < 0.6


def test_a_stranger_is_none_of_them():
    found = posterior(*tracks((100, 100), (500, 400)), drones((103, 100)), CAMERA)
    assert found[0, 0] > 0.99
    assert found[1].tolist() == [0.0]


def test_the_more_strangers_the_less_is_a_track_near_a_projection_the_drone():
    mean, cov = tracks((320, 240))
    likely = [
        posterior(mean, cov, drones((350, 240)), CAMERA, Prior(0.9, strangers)).item()
        for strangers in (0.1, 1.0, 100.0)
    ]
    assert likely == sorted(likely, reverse=True)
    assert likely[0] > 0.95
    assert likely[2] < 0.5


def test_what_is_known_of_a_stale_pose_is_a_mixture():
    """Half of them still where they said, half up to ten times as far off."""
    mean, cov = tracks((320, 240))
    for distance in (5.0, 60.0, 200.0):
        inside = distance < 10.0 * math.sqrt(-2.0 * math.log(1e-4))
        near = 0.5 * density(distance, 10.0) if inside else 0.0
        drone = PRIOR.p_seen * (near + 0.5 * density(distance, 100.0))
        stranger = (1.0 - PRIOR.p_seen) * PRIOR.strangers / AREA
        stale = drones((320 + distance, 240), sigmas=(10.0, 100.0), shares=(0.5, 0.5))
        found = posterior(mean, cov, stale, CAMERA).item()
        assert found == pytest.approx(drone / (drone + stranger))


def test_a_share_of_zero_is_no_hypothesis():
    mean, cov = tracks((320, 240))
    fresh = drones((330, 240), sigmas=(10.0, 100.0), shares=(1.0, 0.0))
    assert posterior(mean, cov, fresh, CAMERA) == posterior(mean, cov, drones((330, 240)), CAMERA)


def test_a_drone_that_may_be_anywhere_is_no_less_likely_than_one_in_view_by_chance():
    mean, cov = tracks((320, 240))
    found = posterior(mean, cov, drones((320, 240), sigmas=(1e5,)), CAMERA).item()
    ratio = math.exp(PRIOR.log_ratio) * IN_VIEW
    assert found == pytest.approx(ratio / (1.0 + ratio), rel=1e-6)


PIXELS = st.tuples(st.floats(280.0, 360.0), st.floats(200.0, 280.0))


@settings(max_examples=60)
@given(st.lists(PIXELS, min_size=2, max_size=6), st.lists(PIXELS, min_size=1, max_size=4))
def test_two_tracks_are_never_both_one_drone(seen, projected):
    found = posterior(*tracks(*seen), drones(*projected), CAMERA)
    assert ((found > 0.5).sum(axis=0) <= 1).all()
    assert ((found > 0.5).sum(axis=1) <= 1).all()
    assert found.sum(axis=0).max() <= 1.0 + 1e-9


def test_no_tracks_and_no_drones_are_ordinary():
    assert posterior(*tracks(), drones((1, 1)), CAMERA).shape == (0, 1)
    assert posterior(*tracks((1, 1)), drones(), CAMERA).shape == (1, 0)
    assert nearest(tracks((1, 1))[0], drones()) == {}


def test_algorithm_1_gives_one_id_twice():
    mean, _ = tracks((315, 240), (330, 240))
    assert nearest(mean, drones((320, 240), (500, 100))) == {0: 1, 1: 1}


def test_of_what_is_stated_with_probability_p_a_share_p_is_right():
    """Eight drones of which one in ten is missed, strangers as Poisson has it: the prior's own world."""
    rng = np.random.default_rng(3)
    sigma, n = 30.0, 8
    stated, right = [], []
    for _ in range(700):
        true = rng.uniform(0.0, 1.0, (n, 2)) * [640.0, 480.0]
        seen = np.flatnonzero(rng.random(n) < PRIOR.p_seen)
        strangers = rng.uniform(0.0, 1.0, (rng.poisson(PRIOR.strangers), 2)) * [640.0, 480.0]
        places = np.concatenate([true[seen] + rng.normal(0.0, sigma, (len(seen), 2)), strangers])
        truth = np.concatenate([seen, np.full(len(strangers), -1)])
        found = posterior(*tracks(*places), drones(*true, sigmas=(sigma,)), CAMERA)
        rows, columns = np.nonzero(found > 0.05)
        stated.append(found[rows, columns])
        right.append(truth[rows] == columns)
    p, was_so = np.concatenate(stated), np.concatenate(right)
    for low, high in ((0.05, 0.2), (0.2, 0.5), (0.5, 0.8), (0.8, 0.95), (0.95, 1.0)):
        chosen = (p >= low) & (p < high)
        mean = p[chosen].mean()
        four_sigma = 4.0 * math.sqrt(2.0 * mean * (1.0 - mean) / chosen.sum())  # 2: they come in pairs
        assert was_so[chosen].mean() == pytest.approx(mean, abs=four_sigma)
        assert four_sigma < 0.1
