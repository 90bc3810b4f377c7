"""The marginals of one-to-one matchings, against all matchings written out."""

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from swarmtrack.tracking import marginals
from swarmtrack.tracking.listed_matchings import listed
from swarmtrack.tracking.marginals import matched, matching_marginals, sweep_width
from swarmtrack.tracking.priors import MARGINALS_MOST_OPEN_ROWS, MARGINALS_SMALL

NEVER = -np.inf
UNHURRIED = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])


def written_out(log_ratio):
    """The same by definition: every matching, its weight, and the weight of those that have the pair."""
    weights, pairs = matchings(log_ratio)
    share = np.exp(np.array(weights) - max(weights))
    probability = np.zeros(log_ratio.shape)
    for part, matching in zip(share / share.sum(), pairs, strict=True):
        for pair in matching:
            probability[pair] += part
    return probability


def matchings(log_ratio):
    """All of them: the logarithm of the weight and the pairs of each."""
    n, m = log_ratio.shape
    weights, pairs = [], []

    def extend(row, free, weight, matching):
        if row == n:
            weights.append(weight)
            pairs.append(matching)
            return
        extend(row + 1, free, weight, matching)  # none of them
        for j in free:
            if log_ratio[row, j] > NEVER:
                extend(row + 1, free - {j}, weight + log_ratio[row, j], [*matching, (row, j)])

    extend(0, frozenset(range(m)), 0.0, [])
    return weights, pairs


@st.composite
def ratios(draw, largest=6, size=5, columns=None, forbidden=True):
    """log r (n, m) with up to 5 rows and columns; about a third of the pairs may be forbidden."""
    n, m = draw(st.integers(1, size)), draw(st.integers(1, columns or size))
    entries = st.floats(-largest, largest)
    if forbidden:
        entries = st.one_of(entries, entries, st.just(NEVER))
    return np.array(draw(st.lists(st.lists(entries, min_size=m, max_size=m), min_size=n, max_size=n)))


def swept_in_order(log_ratio):
    """As of a large cluster: column by column, opening and closing rows."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(marginals, "MARGINALS_SMALL", 0)
        patch.setattr(marginals, "MARGINALS_UNORDERED", 0)
        return matching_marginals(log_ratio)


both_sweeps = pytest.mark.parametrize("solve", [matching_marginals, swept_in_order])


@both_sweeps
@UNHURRIED
@given(log_ratio=ratios(columns=7))
def test_a_pair_is_as_likely_as_the_matchings_that_have_it(solve, log_ratio):
    assert solve(log_ratio) == pytest.approx(written_out(log_ratio), abs=1e-12)


@pytest.mark.parametrize("small", [MARGINALS_SMALL, 0])
@settings(UNHURRIED, max_examples=50)
@given(log_ratio=ratios(largest=300, columns=7))
def test_the_weight_of_all_matchings_is_the_sum_of_theirs(small, log_ratio):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(marginals, "MARGINALS_SMALL", small)
        patch.setattr(marginals, "MARGINALS_UNORDERED", small)
        found = matched(log_ratio).log_total
    assert found == pytest.approx(np.logaddexp.reduce(matchings(log_ratio)[0]), abs=1e-9)


@both_sweeps
@settings(UNHURRIED, max_examples=50)
@given(log_ratio=ratios(largest=300, columns=7))
def test_ratios_of_any_size_are_taken_as_they_are(solve, log_ratio):
    assert solve(log_ratio) == pytest.approx(written_out(log_ratio), abs=1e-12)


@both_sweeps
def test_who_is_a_little_more_certain_wins_what_all_are_sure_of(solve):
    """Ratios beyond what a double holds: only their ratios to each other are left to decide."""
    log_ratio = np.array([[5000.0, 4000.0], [5001.0, 4000.0], [4999.0, NEVER]])
    assert solve(log_ratio) == pytest.approx(written_out(log_ratio), abs=1e-12)
    other_three = math.exp(-1.0) + 2.0 * math.exp(-2.0)
    assert solve(log_ratio)[1, 0] == pytest.approx(1.0 / (1.0 + other_three), abs=1e-12)


@pytest.mark.parametrize("size", [6, 7, 8, 9, 10, 12])
def test_all_rows_at_once_or_one_after_the_other_is_the_same(size):
    rng = np.random.default_rng(size)
    for m in (size, size + 3):
        log_ratio = rng.normal(0.0, 4.0, (size, m))
        assert matching_marginals(log_ratio) == pytest.approx(swept_in_order(log_ratio), abs=1e-12)


@settings(UNHURRIED, max_examples=50)
@given(ratios(largest=1e4, size=9))
def test_nothing_overflows_however_certain_it_is(log_ratio):
    found = matching_marginals(log_ratio)
    assert np.isfinite(found).all()
    assert found.sum(axis=0).max() <= 1.0 + 1e-9
    assert found.sum(axis=1).max() <= 1.0 + 1e-9


@UNHURRIED
@given(ratios(size=8), st.integers(1, 3))
def test_a_row_and_a_column_have_one_partner_at_most_also_where_pairs_are_left_out(log_ratio, widest):
    for found in (matching_marginals(log_ratio), matching_marginals(log_ratio, widest)):
        assert found.min() >= 0.0
        assert found.sum(axis=0).max() <= 1.0 + 1e-9
        assert found.sum(axis=1).max() <= 1.0 + 1e-9
        assert not found[log_ratio == NEVER].any()


@UNHURRIED
@given(ratios(size=7))
def test_tracks_are_matched_to_drones_as_drones_are_to_tracks(log_ratio):
    assert matching_marginals(log_ratio.T) == pytest.approx(matching_marginals(log_ratio).T, abs=1e-12)


@UNHURRIED
@given(ratios(size=7), st.randoms(use_true_random=False))
def test_the_order_of_rows_and_columns_does_not_matter(log_ratio, random):
    rows, columns = list(range(len(log_ratio))), list(range(log_ratio.shape[1]))
    random.shuffle(rows)
    random.shuffle(columns)
    shuffled = matching_marginals(log_ratio[np.ix_(rows, columns)])
    assert shuffled == pytest.approx(matching_marginals(log_ratio)[np.ix_(rows, columns)], abs=1e-12)


def test_no_rows_no_columns_and_nothing_allowed_are_ordinary():
    assert matching_marginals(np.zeros((0, 3))).shape == (0, 3)
    assert matching_marginals(np.zeros((3, 0))).shape == (3, 0)
    assert not matching_marginals(np.full((2, 3), NEVER)).any()


def test_one_pair_is_its_odds():
    assert matching_marginals(np.array([[math.log(9.0)]])) == pytest.approx(np.array([[0.9]]))


def test_a_hundred_pairs_in_a_chain_are_exact():
    """Long, but never more than two rows open: the recursion for a chain says the same."""
    n = 100
    log_ratio = np.full((n, n), NEVER)
    for i in range(n):
        log_ratio[i, i] = 1.0 + math.sin(i)
        if i + 1 < n:
            log_ratio[i, i + 1] = math.cos(i)
    # Edges 0-0, 0-1, 1-1, 1-2, … of which neighbours exclude each other.
    edges = [(i, j) for i in range(n) for j in (i, i + 1) if j < n]
    weight = [math.exp(log_ratio[edge]) for edge in edges]
    up_to, from_there = _chain(weight), _chain(weight[::-1])[::-1]
    expected = [
        weight[k] * up_to[max(k - 1, 0)] * from_there[min(k + 2, len(edges))] / up_to[-1]
        for k in range(len(edges))
    ]
    found = matching_marginals(log_ratio)
    assert [found[edge] for edge in edges] == pytest.approx(expected, rel=1e-9)


def _chain(weight):
    """The total weight of all choices among the first k edges of a chain, neighbours excluding each other."""
    total = [1.0, 1.0 + weight[0]]
    for k in range(1, len(weight)):
        total.append(total[-1] + weight[k] * total[-2])
    return total


def crowded(rng, n, spread=3.0, sigma=1.0):
    """n drones uniformly in a square of that many sigma per √n, and their tracks: many pairs compete."""
    true = rng.uniform(0.0, spread * math.sqrt(n), (n, 2))
    projected, seen = (true + rng.normal(0.0, sigma, (n, 2)) for _ in range(2))
    distance = ((seen[:, None] - projected) ** 2).sum(axis=2) / (2.0 * sigma**2)
    return np.where(distance > 18.4, NEVER, math.log(200.0) - 0.5 * distance)


def test_leaving_pairs_out_stays_near_the_exact_marginals():
    """Stated: within 0.03 at 12 of 14 open rows, where belief propagation alone is off by more than 0.05."""
    rng = np.random.default_rng(1)
    thinned, beliefs = [], []
    while len(thinned) < 10:
        log_ratio = crowded(rng, 20)
        if not 13 <= sweep_width(log_ratio) <= 15:
            continue
        exact = matching_marginals(log_ratio, 15)
        thinned.append(np.abs(matching_marginals(log_ratio, 12) - exact).max())
        beliefs.append(np.abs(marginals.beliefs(log_ratio) - exact).max())
    assert max(thinned) < 0.03
    assert np.median(beliefs) > 0.05


def test_where_everything_may_be_everything_nothing_is_likely():
    """Thirty drones that nobody can tell apart: leaving pairs out must not make the rest look certain."""
    found = matching_marginals(np.full((30, 30), 10.0))
    assert sweep_width(np.full((30, 30), 10.0)) > MARGINALS_MOST_OPEN_ROWS
    assert found == pytest.approx(np.full((30, 30), 1.0 / 30.0), abs=0.01)


def test_a_cluster_that_is_too_wide_is_left_to_whom_the_caller_says():
    """Two clusters: three rows that want everything are too wide, two are not."""
    log_ratio = np.full((5, 6), NEVER)
    log_ratio[:3, :4] = log_ratio[3:, 4:] = 1.0
    asked = []

    def beyond(block, widest):
        asked.append((block.shape, widest))
        return marginals.beliefs(block)

    found = matching_marginals(log_ratio, 2, beyond)
    assert asked == [((3, 4), 2)]
    assert found[3:] == pytest.approx(written_out(log_ratio[3:]), abs=1e-12)
    assert found[:3, :4] == pytest.approx(marginals.beliefs(log_ratio[:3, :4]))


@pytest.mark.parametrize("small", [MARGINALS_SMALL, 0])
@UNHURRIED
@given(log_ratio=ratios(largest=50, size=4))
def test_the_few_matchings_of_a_small_cluster_are_listed_whatever_sweeps_larger_ones(small, log_ratio):
    """0: as an order of the columns sweeps it, of which the listing is independent."""
    every = listed(*log_ratio.shape)
    assert every is not None
    assert len(every.has) == len(matchings(np.zeros(log_ratio.shape))[0])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(marginals, "MARGINALS_SMALL", small)
        patch.setattr(marginals, "MARGINALS_UNORDERED", small)
        found, reference = every.matched(log_ratio[None]), matched(log_ratio)
    assert found.probability[0] == pytest.approx(reference.probability, abs=1e-12)
    assert found.log_total[0] == pytest.approx(reference.log_total, rel=1e-12, abs=1e-12)


def test_more_matchings_than_a_sweep_is_worth_are_not_listed():
    assert listed(4, 5) is not None
    assert listed(5, 4) is not None
    assert listed(5, 5) is None
