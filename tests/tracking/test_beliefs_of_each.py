"""Beliefs of wide matchings beside exact sums (`test_marginals.py` has those written out)."""

import numpy as np
import pytest

from swarmtrack.tracking.beliefs_of_each import believed
from swarmtrack.tracking.marginals import matched
from swarmtrack.tracking.marginals_of_each import matched_of_each
from swarmtrack.tracking.priors import MARGINALS_OF_EACH_MOST_ROWS

WIDE = MARGINALS_OF_EACH_MOST_ROWS + 2
SURE = 0.9


def compared(log_ratio):
    """How far p and log weights are off, at most, and how much too sure the surest of each row is."""
    found, part = believed(log_ratio)
    exact = [matched(each) for each in log_ratio]
    off = found.probability - np.array([one.probability for one in exact])
    surest = found.probability.argmax(axis=2)[:, :, None]
    too_sure = np.take_along_axis(off, surest, 2)[np.take_along_axis(found.probability, surest, 2) > SURE]
    assert part.sum(axis=1) == pytest.approx(found.log_total, abs=1e-9)
    log_off = found.log_total - [one.log_total for one in exact]
    return np.abs(off).max(), np.abs(log_off).max(), too_sure.max(initial=0.0)


def seen(seed, ratio, swaps):
    """Eleven tracks that are teammates by `ratio`, in a team of twenty, of which some fit each other's as well."""
    rng = np.random.default_rng(seed)
    log_ratio = rng.normal(-4.0, 2.0, (20, 11, 20))
    for each in log_ratio:
        right = rng.permutation(20)[:11]
        each[np.arange(11), right] = rng.normal(ratio, 2.0, 11)
        for i, j in rng.integers(11, size=(swaps, 2)):
            each[i, right[j]], each[j, right[i]] = rng.normal(ratio, 2.0, 2)
    return log_ratio


@pytest.mark.parametrize("ratio", [3.0, 6.0, 10.0, 20.0, 40.0])
@pytest.mark.parametrize("swaps", [0, 1, 6])
def test_names_are_no_surer_than_exact_ones(ratio, swaps):
    off, log_off, too_sure = compared(seen(int(ratio), ratio, swaps))
    assert off < 0.02
    assert log_off < 0.03
    assert too_sure < 0.005


@pytest.mark.parametrize("ratio", [3.0, 10.0, 30.0, 60.0])
@pytest.mark.parametrize("around", ["in pairs", "in threes", "in a ring"])
def test_what_goes_around_a_loop_is_summed_exactly(ratio, around):
    """Two ways around, one a little better: beliefs alone would take it for sure."""
    log_ratio = np.full((12, 12), -5.0)
    for i in range(12):
        others = {"in pairs": [i ^ 1], "in threes": [i // 3 * 3 + (i + 1) % 3], "in a ring": [(i + 1) % 12]}
        log_ratio[i, others[around]] = ratio
        log_ratio[i, i] = ratio + 0.2
    off, log_off, _ = compared(log_ratio[None])
    assert off < 1e-3
    assert log_off < 0.01


@pytest.mark.parametrize("ratio", [-30.0, -3.0, 0.0, 3.0, 20.0, 60.0])
def test_of_equals_nobody_is_likelier(ratio):
    log_ratio = np.full((1, WIDE, WIDE + 1), ratio)
    found, part = believed(log_ratio)
    assert np.ptp(found.probability) < 1e-9
    assert np.ptp(part) < 1e-9
    assert compared(log_ratio)[0] < 0.005


@pytest.mark.parametrize("shape", [(WIDE, WIDE), (WIDE, WIDE + 4), (WIDE + 4, WIDE)])
def test_where_pairs_make_no_loop_beliefs_are_exact(shape):
    """A chain: each row wants two columns, each column two rows; some rows and columns nobody wants."""
    rng = np.random.default_rng(1)
    log_ratio = np.full((5, *shape), -np.inf)
    for i in range(WIDE - 2):
        log_ratio[:, i, i], log_ratio[:, i, i + 1] = rng.normal(0.0, 20.0, (2, 5))
    off, log_off, _ = compared(log_ratio)
    assert off < 1e-5
    assert log_off < 1e-4


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("spread", [1.0, 4.0, 15.0])
def test_forbidden_pairs_and_ratios_of_any_size(seed, spread):
    rng = np.random.default_rng(seed)
    log_ratio = np.minimum(rng.normal(-1.0, spread, (10, 10, 13)), 60.0)
    log_ratio[rng.random(log_ratio.shape) < 0.4] = -np.inf
    found = matched_of_each(log_ratio)
    assert np.all(found.probability[log_ratio == -np.inf] == 0.0)
    assert found.probability.sum(axis=1).max() < 1.0 + 1e-9
    assert found.probability.sum(axis=2).max() < 1.0 + 1e-9
    off, log_off, _ = compared(log_ratio)
    assert off < 0.05
    assert log_off < 0.25


def test_hypotheses_do_not_know_of_each_other():
    log_ratio = np.concatenate([seen(1, 6.0, 3)[:3], np.zeros((1, 11, 20)), seen(2, 30.0, 6)[:3]])
    together, alone = believed(log_ratio)[0], [believed(each[None])[0] for each in log_ratio]
    for k, one in enumerate(alone):
        assert together.probability[k] == pytest.approx(one.probability[0], abs=1e-12)
        assert together.log_total[k] == pytest.approx(one.log_total[0], abs=1e-9)


def test_loops_of_what_is_not_worth_it_are_believed():
    log_ratio = seen(3, 10.0, 6)
    worth = np.arange(len(log_ratio)) % 2 == 0
    found, all_worth = believed(log_ratio, worth)[0], believed(log_ratio)[0]
    assert np.array_equal(found.probability[worth], all_worth.probability[worth])
    assert np.all(found.log_total[~worth] <= all_worth.log_total[~worth] + 1e-9)
