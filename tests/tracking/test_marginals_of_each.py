"""Many hypotheses at once are what each of them is alone (`test_marginals.py` has those written out)."""

import numpy as np
import pytest

from swarmtrack.tracking.marginals import matched
from swarmtrack.tracking.marginals_of_each import matched_of_each
from swarmtrack.tracking.priors import MARGINALS_OF_EACH_MOST_ROWS


def ratios(seed, shape, forbidden=0.3, spread=4.0):
    rng = np.random.default_rng(seed)
    log_ratio = rng.normal(0.0, spread, shape)
    log_ratio[rng.random(shape) < forbidden] = -np.inf
    return log_ratio


@pytest.mark.parametrize("n", range(1, MARGINALS_OF_EACH_MOST_ROWS + 3))
@pytest.mark.parametrize("m", [1, 3, MARGINALS_OF_EACH_MOST_ROWS, MARGINALS_OF_EACH_MOST_ROWS + 3])
@pytest.mark.parametrize("spread", [4.0, 200.0])
def test_each_is_what_it_is_alone(n, m, spread):
    """Of more rows, and columns, only where beliefs cannot be worked out; `test_beliefs_of_each.py` has the others."""
    log_ratio = ratios(n * m, (7, n, m), spread=spread)
    if min(n, m) > MARGINALS_OF_EACH_MOST_ROWS:
        log_ratio[0, 0, 0] = 400.0
    found = matched_of_each(log_ratio)
    alone = [matched(each) for each in log_ratio]
    for c, each in enumerate(alone):
        assert found.probability[c] == pytest.approx(each.probability, abs=1e-12)
        assert found.log_total[c] == pytest.approx(each.log_total, abs=1e-9)


def test_what_is_forbidden_by_one_is_not_by_another():
    log_ratio = np.array([[[2.0, -np.inf]], [[-np.inf, 1.0]], [[-np.inf, -np.inf]]])
    found = matched_of_each(log_ratio)
    expected = [
        [[1.0 / (1.0 + np.exp(-2.0)), 0.0]],
        [[0.0, 1.0 / (1.0 + np.exp(-1.0))]],
        [[0.0, 0.0]],
    ]
    assert found.probability == pytest.approx(np.array(expected))
    assert found.log_total == pytest.approx([np.log1p(np.exp(2.0)), np.log1p(np.exp(1.0)), 0.0])


@pytest.mark.parametrize("shape", [(0, 2, 2), (3, 0, 2), (3, 2, 0)])
def test_no_hypotheses_no_rows_and_no_columns_are_ordinary(shape):
    found = matched_of_each(np.zeros(shape))
    assert found.probability.shape == shape
    assert found.log_total == pytest.approx(np.zeros(shape[0]))
