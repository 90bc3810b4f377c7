"""The best ways to explain a scan, against all ways written out; and the prices that say where to stop looking."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from swarmtrack.tracking import hypotheses
from swarmtrack.tracking.hypotheses import UNDETECTED, best_matchings

NEVER = -np.inf
EVERYTHING = 1e-300  # least: leaves nothing out that has any weight
seeds = st.integers(0, 2**32 - 1)


def ways(k, m):
    """(w, k): each of k tracks made one of m detections or none, no two the same."""
    options = itertools.product(range(UNDETECTED, m), repeat=k)
    allowed = [way for way in options if len(made := [j for j in way if j >= 0]) == len(set(made))]
    return np.array(allowed, np.intp).reshape(-1, k)


def written_out(log_weight, gain):
    """(h, w) log-weight of every way under every earlier hypothesis, and the ways (w, k)."""
    h, k, m = gain.shape
    every = ways(k, m)
    padded = np.concatenate([gain, np.zeros((h, k, 1))], axis=2)
    return log_weight[:, None] + padded[:, np.arange(k), every].sum(axis=2), every


def expected_weights(log_weight, gain, count, least):
    """Best first: the log-weights that `best_matchings` should return."""
    weight = np.sort(written_out(log_weight, gain)[0].ravel())[::-1]
    return weight[weight >= weight[0] + math.log(least)][:count]


def best_of_all(log_weight, gain):
    cost = np.minimum(-gain, 0.0)
    return max(w - c[linear_sum_assignment(c)].sum() for w, c in zip(log_weight, cost, strict=True))


def assert_sound(found, log_weight, gain):
    """Each says what it weighs, gives no detection to two and forbidden pairs to nobody, and comes once."""
    for prior, column, weight in zip(found.prior, found.column, found.log_weight, strict=True):
        made = column[column >= 0]
        assert len(set(made.tolist())) == len(made)
        pairs = gain[prior, np.flatnonzero(column >= 0), made]
        assert (pairs > NEVER).all()
        assert weight == pytest.approx(log_weight[prior] + pairs.sum(), rel=1e-9, abs=1e-9)
    assert len({(p, *c) for p, c in zip(found.prior.tolist(), found.column.tolist(), strict=True)}) == len(
        found.prior
    )
    assert (np.diff(found.log_weight) <= 0.0).all()


def scan_of(rng, h, k, m, *, size=4.0, forbidden=0.3, levels=None):
    """Random (log_weight, gain); levels: round to so few values that many matchings weigh the same."""
    gain = rng.normal(0.0, size, (h, k, m))
    log_weight = rng.normal(0.0, 0.5 * size, h)
    if levels:
        gain, log_weight = np.round(gain / size * levels) * size, np.round(log_weight / size) * size
    gain[rng.random(gain.shape) < forbidden] = NEVER
    return log_weight, gain


@given(
    h=st.integers(1, 4),
    k=st.integers(1, 4),
    m=st.integers(0, 5),
    count=st.integers(1, 50),
    least=st.sampled_from([EVERYTHING, 1e-9, 1e-4, 0.1, 1.0]),
    size=st.sampled_from([0.1, 4.0, 1000.0]),
    forbidden=st.sampled_from([0.0, 0.3, 0.8]),
    levels=st.sampled_from([None, 1, 0.5]),
    seed=seeds,
)
@settings(max_examples=250, deadline=None)
def test_they_are_the_best_of_all_ways_written_out(h, k, m, count, least, size, forbidden, levels, seed):
    log_weight, gain = scan_of(
        np.random.default_rng(seed), h, k, m, size=size, forbidden=forbidden, levels=levels
    )
    found = best_matchings(log_weight, gain, count, least)
    assert_sound(found, log_weight, gain)
    assert len(found.prior) <= count
    expected = expected_weights(log_weight, gain, count, least)
    assert found.log_weight[0] == pytest.approx(expected[0], rel=1e-9, abs=1e-9)
    if found.complete and least < 1.0:  # at 1 only ties are left, and how many ties is rounding
        assert found.log_weight == pytest.approx(expected, rel=1e-9, abs=1e-9)


@given(k=st.integers(1, 4), m=st.integers(0, 4), seed=seeds)
@settings(max_examples=60, deadline=None)
def test_small_ones_are_always_complete(k, m, seed):
    """One earlier hypothesis has at most 209 ways, two 418, of which no more than `breadth` are asked for at once."""
    log_weight, gain = scan_of(np.random.default_rng(seed), 2, k, m, forbidden=0.0)
    found = best_matchings(log_weight, gain, 60, 1e-9)
    assert found.complete
    assert found.log_weight == pytest.approx(expected_weights(log_weight, gain, 60, 1e-9))


@given(size=st.sampled_from([0.01, 0.3, 2.0]), count=st.integers(1, 20), seed=seeds)
@settings(max_examples=12, deadline=None)
def test_it_says_complete_only_where_it_is(size, count, seed):
    """Five tracks, six detections, 4051 ways and next to nothing to tell them by: more than are kept at once."""
    log_weight, gain = scan_of(np.random.default_rng(seed), 3, 5, 6, size=size, forbidden=0.0)
    found = best_matchings(log_weight, gain, count, 1e-4)
    assert_sound(found, log_weight, gain)
    expected = expected_weights(log_weight, gain, count, 1e-4)
    missing = len(found.log_weight) < len(expected) or not np.allclose(found.log_weight, expected, atol=1e-9)
    assert not (missing and found.complete)


def test_where_too_many_are_alike_it_says_that_it_is_not_complete(monkeypatch):
    monkeypatch.setattr(hypotheses, "MATCHINGS_BREADTH", 1)
    monkeypatch.setattr(hypotheses, "MATCHINGS_LEAST_BREADTH", 3)
    log_weight, gain = scan_of(np.random.default_rng(0), 1, 5, 6, size=0.3, forbidden=0.0)
    found = best_matchings(log_weight, gain, 3, 1e-4)
    assert not found.complete
    assert best_matchings(log_weight[:1], gain[:, :1], 3, 1e-4).complete


def test_a_list_that_could_be_longer_is_not_complete(monkeypatch):
    """Three of seven asked for ten: two tracks and two detections, but room for three partial ones only."""
    monkeypatch.setattr(hypotheses, "MATCHINGS_BREADTH", 0)
    monkeypatch.setattr(hypotheses, "MATCHINGS_LEAST_BREADTH", 3)
    found = best_matchings(np.zeros(1), np.full((1, 2, 2), 0.1), 10, 1e-4)
    assert len(found.prior) < 7
    assert not found.complete


def crowd(rng, h, k, m, spread):
    """k tracks within a few sigmas of each other, seen by m detections; two change places in each hypothesis."""
    gain = np.empty((h, k, m))
    position = rng.normal(0.0, spread, (k, 2))
    own = position[: min(k, m)]
    z = np.concatenate([own, rng.normal(0.0, spread + 2.0, (m - len(own), 2))]) + rng.normal(0.0, 1.0, (m, 2))
    for i in range(h):
        swapped = position.copy()
        a, b = rng.integers(0, k, 2)
        swapped[[a, b]] = swapped[[b, a]]
        gain[i] = 12.0 - 0.5 * ((swapped[:, None] - z[None]) ** 2).sum(axis=2)
    gain[gain < math.log(1e-4)] = NEVER
    return -np.sort(rng.exponential(2.0, h)), gain


@pytest.mark.parametrize("h", [1, 20])
@pytest.mark.parametrize(("k", "m", "spread"), [(8, 7, 1.0), (8, 18, 2.0), (16, 14, 3.0), (30, 40, 10.0)])
def test_in_a_crowd_the_best_is_not_missed(h, k, m, spread):
    """Where far more are alike than can be listed, the first of the list is still that of a well-known solver."""
    for seed in range(10):
        log_weight, gain = crowd(np.random.default_rng(seed), h, k, m, spread)
        found = best_matchings(log_weight, gain, 20, 1e-4)
        assert_sound(found, log_weight, gain)
        assert found.log_weight[0] == pytest.approx(best_of_all(log_weight, gain), abs=1e-7)


def test_what_nobody_made_changes_nothing():
    """Without detections the earlier hypotheses stay as they were, in their order, within `least`."""
    found = best_matchings(np.array([-3.0, -1.0, -20.0]), np.empty((3, 2, 0)), 10, 1e-4)
    assert found.prior.tolist() == [1, 0]
    assert found.log_weight.tolist() == [-1.0, -3.0]
    assert (found.column == UNDETECTED).all()
    assert found.complete


def test_an_earlier_hypothesis_that_explains_the_scan_overtakes_the_likelier_one():
    gain = np.full((2, 1, 1), NEVER)
    gain[1] = 5.0
    found = best_matchings(np.array([0.0, -2.0]), gain, 10, 1e-4)
    assert found.prior.tolist() == [1, 0, 1]
    assert found.column.ravel().tolist() == [0, UNDETECTED, UNDETECTED]
    assert found.log_weight == pytest.approx([3.0, 0.0, -2.0])


@given(seed=seeds, size=st.sampled_from([0.5, 5.0, 1e3]))
@settings(max_examples=60, deadline=None)
def test_the_order_of_tracks_and_detections_is_nobody_s_business(seed, size):
    rng = np.random.default_rng(seed)
    log_weight, gain = scan_of(rng, 2, 4, 4, size=size)
    tracks, detections = rng.permutation(4), rng.permutation(4)
    found = best_matchings(log_weight, gain, 20, 1e-6)
    shuffled = best_matchings(log_weight, gain[:, tracks][:, :, detections], 20, 1e-6)
    assert shuffled.log_weight == pytest.approx(found.log_weight)


@given(k=st.integers(1, 12), m=st.integers(0, 12), size=st.sampled_from([0.1, 4.0, 1e3]), seed=seeds)
@settings(max_examples=150, deadline=None)
def test_at_fair_prices_the_bound_is_the_best_matching(k, m, size, seed):
    """Weak duality holds for any prices ≥ 0; these reach it."""
    _, gain = scan_of(np.random.default_rng(seed), 1, k, m, size=size)
    price, reached = hypotheses.fair_prices(gain[0])
    assert price.shape == (m,)
    assert (price >= 0.0).all()
    bound = (gain[0] - price).max(axis=1, initial=0.0).sum() + price.sum()
    best = best_of_all(np.zeros(1), gain)
    assert reached == pytest.approx(best, rel=1e-12, abs=1e-12)
    assert bound == pytest.approx(best, rel=1e-12, abs=1e-9)


@given(h=st.integers(1, 6), k=st.integers(1, 5), m=st.integers(0, 5), seed=seeds)
@settings(max_examples=80, deadline=None)
def test_nobody_is_promised_more_than_the_best_is_worth_and_no_less_than_their_own(h, k, m, seed):
    log_weight, gain = scan_of(np.random.default_rng(seed), h, k, m)
    price, reached = hypotheses.tightest_prices(log_weight, gain)
    promised = log_weight + (gain - price[:, None]).max(axis=2, initial=0.0).sum(axis=1) + price.sum(axis=1)
    own = [best_of_all(log_weight[i : i + 1], gain[i : i + 1]) for i in range(h)]
    assert (price >= 0.0).all()
    assert reached == pytest.approx(max(own))
    assert (promised >= np.array(own) - 1e-9).all()
    assert (promised <= reached + 1e-9).all()


@pytest.mark.parametrize("value", [0.0, 1e-12, 0.1, 12.0, 1e3, 1e9])
@pytest.mark.parametrize(("k", "m"), [(1, 1), (3, 2), (8, 7), (7, 8), (12, 12)])
def test_where_all_gains_are_equal_it_ends_and_as_many_as_can_have_one(k, m, value):
    price, reached = hypotheses.fair_prices(np.full((k, m), value))
    assert reached == pytest.approx(min(k, m) * value)
    assert price == pytest.approx(np.full(m, value if k > m else 0.0))
    found = best_matchings(np.zeros(1), np.full((1, k, m), value), 5, 1e-4)
    assert found.log_weight[0] == pytest.approx(min(k, m) * value)


def test_one_forbidden_track_does_not_forbid_the_others():
    gain = np.array([[[NEVER, NEVER], [3.0, NEVER]]])
    found = best_matchings(np.zeros(1), gain, 10, EVERYTHING)
    assert found.column.tolist() == [[UNDETECTED, 0], [UNDETECTED, UNDETECTED]]
