"""Clusters of tracks in dispute: what joining, sifting and settling does to the probability of what they say."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components

from swarmtrack.tracking.clusters import Cluster, components, faded, in_dispute, merged, normalised, product

seeds = st.integers(0, 2**32 - 1)


def cluster_of(tracks, leaf, weight):
    """Best first, as clusters are."""
    order = np.argsort(-np.asarray(weight), kind="stable")
    log_weight = normalised(np.log(np.asarray(weight, dtype=float)))
    return Cluster(np.array(tracks), np.array(leaf)[order], log_weight[order])


def random_cluster(rng, tracks, h, leaves_each=3):
    """Track i has the leaves 10 i … 10 i + 2; some hypotheses may come twice."""
    own = rng.integers(0, leaves_each, (h, len(tracks)))
    return cluster_of(tracks, 10 * np.array(tracks) + own, rng.random(h) + 0.01)


def told(cluster):
    """What it says: the probability of each choice of leaves, in order of the tracks."""
    order = np.argsort(cluster.tracks)
    said = {}
    for leaves, weight in zip(cluster.leaf[:, order].tolist(), cluster.weight.tolist(), strict=True):
        said[tuple(leaves)] = said.get(tuple(leaves), 0.0) + weight
    return said


@given(a=st.integers(1, 5), b=st.integers(1, 5), seed=seeds)
def test_two_that_had_nothing_to_do_with_each_other_are_as_likely_as_both(a, b, seed):
    rng = np.random.default_rng(seed)
    first, second = random_cluster(rng, [4, 1], a), random_cluster(rng, [2], b)
    both = product(first, second, 100)
    assert both.tracks.tolist() == [4, 1, 2]
    expected = {}
    for (one, four), p in told(first).items():
        for (two,), q in told(second).items():
            expected[one, two, four] = p * q
    assert told(both) == pytest.approx(expected)


def test_of_too_many_pairs_the_likeliest_are_kept_and_share_the_whole():
    first = cluster_of([0], [[0], [1], [2]], [0.5, 0.3, 0.2])
    second = cluster_of([1], [[10], [11]], [0.9, 0.1])
    both = product(first, second, 3)
    assert both.leaf.tolist() == [[0, 10], [1, 10], [2, 10]]
    assert both.weight == pytest.approx(np.array([0.45, 0.27, 0.18]) / 0.9)


@given(a=st.integers(1, 6), b=st.integers(1, 6), count=st.integers(1, 40), seed=seeds)
def test_what_was_dropped_was_no_better_than_what_was_kept(a, b, count, seed):
    rng = np.random.default_rng(seed)
    first, second = random_cluster(rng, [0], a), random_cluster(rng, [1], b)
    every = np.sort(np.outer(first.weight, second.weight).ravel())[::-1][:count]
    both = product(first, second, count)
    assert both.weight == pytest.approx(every / every.sum())
    assert (np.diff(both.log_weight) <= 0.0).all()


def test_a_single_hypothesis_multiplies_nothing():
    first = cluster_of([3], [[30]], [1.0])
    second = cluster_of([5, 6], [[50, 60], [51, 61]], [0.8, 0.2])
    both = product(first, second, 20)
    assert both.leaf.tolist() == [[30, 50, 60], [30, 51, 61]]
    assert both.log_weight == pytest.approx(second.log_weight, abs=1e-15)


@given(k=st.integers(1, 3), h=st.integers(1, 30), seed=seeds)
def test_doubles_become_one_and_nothing_else_changes(k, h, seed):
    cluster = random_cluster(np.random.default_rng(seed), list(range(k)), h)
    single = merged(cluster)
    assert told(single) == pytest.approx(told(cluster))
    assert len(np.unique(single.leaf, axis=0)) == len(single.leaf)
    assert (np.diff(single.log_weight) <= 0.0).all()
    assert single.tracks.tolist() == cluster.tracks.tolist()


def test_two_halves_of_one_story_may_outweigh_another():
    cluster = cluster_of([0, 1], [[0, 10], [1, 11], [1, 11]], [0.4, 0.3, 0.3])
    assert merged(cluster).leaf.tolist() == [[1, 11], [0, 10]]
    assert merged(cluster).weight == pytest.approx([0.6, 0.4])


def test_without_doubles_there_is_nothing_to_do():
    cluster = cluster_of([0, 1], [[0, 10], [1, 10]], [0.7, 0.3])
    assert merged(cluster) is cluster


def test_a_double_of_no_weight_to_speak_of_does_no_harm():
    leaf = np.array([[0], [1], [1]])
    single = merged(Cluster(np.array([0]), leaf, normalised(np.array([0.0, -900.0, -2000.0]))))
    assert single.leaf[0].tolist() == [0]
    assert single.log_weight[0] == pytest.approx(0.0)
    assert not np.isnan(single.log_weight).any()


def test_who_is_the_same_in_all_hypotheses_is_settled():
    cluster = cluster_of([7, 8, 9], [[70, 80, 90], [71, 80, 91]], [0.6, 0.4])
    left = in_dispute(cluster)
    assert left.tracks.tolist() == [7, 9]
    assert left.leaf.tolist() == [[70, 90], [71, 91]]
    assert left.log_weight == pytest.approx(cluster.log_weight)


@pytest.mark.parametrize("leaf", [[[1, 2]], [[1, 2], [1, 2]]])
def test_where_all_agree_nothing_is_left_in_dispute(leaf):
    assert in_dispute(cluster_of([0, 1], leaf, np.ones(len(leaf)))) is None


@given(k=st.integers(1, 4), h=st.integers(1, 8), seed=seeds)
def test_what_is_left_in_dispute_says_the_same_of_those_who_are(k, h, seed):
    cluster = merged(random_cluster(np.random.default_rng(seed), list(range(k)), h, leaves_each=2))
    left = in_dispute(cluster)
    disputed = [i for i in range(k) if len(set(cluster.leaf[:, i].tolist())) > 1]
    if left is None:
        assert disputed == []
        return
    assert left.tracks.tolist() == disputed
    assert len(np.unique(left.leaf, axis=0)) == len(left.leaf)
    assert told(left) == pytest.approx(
        told(cluster._replace(tracks=left.tracks, leaf=cluster.leaf[:, disputed]))
    )


def shown(cluster):
    """The leaf of each track that is published."""
    return dict(zip(cluster.tracks.tolist(), cluster.leaf[cluster.shown].tolist(), strict=True))


@given(
    a=st.integers(1, 5),
    b=st.integers(1, 5),
    which=st.tuples(st.integers(0, 4), st.integers(0, 4)),
    seed=seeds,
)
def test_who_is_published_stays_so_when_clusters_join_are_sifted_and_settle(a, b, which, seed):
    rng = np.random.default_rng(seed)
    first, second = random_cluster(rng, [4, 1], a, leaves_each=2), random_cluster(rng, [2], b, leaves_each=2)
    first = first._replace(shown=min(which[0], a - 1))
    second = second._replace(shown=min(which[1], b - 1))
    both = product(first, second, 100)
    assert shown(both) == shown(first) | shown(second)
    single = merged(both)
    assert shown(single) == shown(both)
    left = in_dispute(single)
    if left is not None:
        assert shown(left).items() <= shown(single).items()


def test_if_what_was_published_is_dropped_the_best_is():
    first = cluster_of([0], [[0], [1]], [0.999, 0.001])._replace(shown=1)
    assert shown(product(first, cluster_of([1], [[10], [11]], [0.6, 0.4]), 2)) == {0: 0, 1: 10}


@given(h=st.integers(1, 6), shown=st.integers(0, 5), by=st.floats(0.0, 20.0), seed=seeds)
def test_doubts_fade_beside_what_is_published(h, shown, by, seed):
    cluster = random_cluster(np.random.default_rng(seed), [1, 2], h)._replace(shown=shown % h)
    after = faded(cluster, by)
    published = after.leaf[after.shown].tolist()
    assert published == cluster.leaf[cluster.shown].tolist()
    assert (np.diff(after.log_weight) <= 0.0).all()
    assert after.weight.sum() == pytest.approx(1.0)
    odds = (1.0 - cluster.weight[cluster.shown]) / cluster.weight[cluster.shown] * math.exp(-by)
    assert after.weight[after.shown] == pytest.approx(1.0 / (1.0 + odds))


def test_a_doubt_that_no_detection_settles_does_not_last():
    cluster = cluster_of([0, 1], [[0, 10], [1, 11]], [0.999, 0.001])
    for _ in range(300):
        cluster = faded(cluster, 0.033 / 10.0)
    assert cluster.weight[1] == pytest.approx(0.001 / 0.999 * math.exp(-0.99), rel=1e-3)


@given(st.lists(st.floats(-800.0, 800.0), min_size=1, max_size=10))
def test_weights_of_any_size_come_to_add_up_to_one(log_weight):
    result = normalised(np.array(log_weight))
    assert math.fsum(np.exp(result)) == pytest.approx(1.0, rel=1e-12)
    assert np.diff(result) == pytest.approx(np.diff(log_weight), abs=1e-9)


@given(n=st.integers(0, 12), share=st.floats(0.0, 0.4), seed=seeds)
def test_components_are_those_of_a_well_known_library(n, share, seed):
    related = np.random.default_rng(seed).random((n, n)) < share
    related |= related.T | np.eye(n, dtype=bool)
    label = components(related)
    assert label.shape == (n,)
    if n == 0:
        return
    _, expected = connected_components(related, directed=False)
    assert (label[:, None] == label[None]).tolist() == (expected[:, None] == expected[None]).tolist()
    firsts = [int(np.flatnonzero(expected == one)[0]) for one in expected]
    assert label.tolist() == firsts


def test_a_long_chain_is_one_component():
    n = 50
    order = np.random.default_rng(0).permutation(n)
    related = np.eye(n, dtype=bool)
    related[order[:-1], order[1:]] = related[order[1:], order[:-1]] = True
    assert components(related).tolist() == [0] * n
