"""All matchings of few rows and columns, listed once for each shape: their marginals are then one sum and one product.

A 2 x 2 has seven matchings, a 4 x 4 has 209. The logarithm of a matching's weight is the sum over its pairs, so ratios
of any size are weighed as they are; and as weights only add, nothing cancels.
"""

from __future__ import annotations

from functools import cache
from itertools import product
from math import comb, perm
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.tracking.priors import MARGINALS_LARGEST_LOG_RATIO, MARGINALS_MOST_LISTED


class MatchedOfEach(NamedTuple):
    """probability (c, n, m) of each pair, and the logarithm (c,) of the weight of all matchings."""

    probability: Array
    log_total: Array


class ListedMatchings(NamedTuple):
    """The K matchings of n rows and m columns. choice (n, K): where each row's choice stands in an (n, m + 1), the last
    column of which is "none", laid flat; has (K, n m): 1 where the matching has the pair."""

    choice: NDArray[np.intp]
    has: Array

    def matched(self, log_ratio: Array) -> MatchedOfEach:
        """log_ratio (c, n, m): log r by each of c hypotheses; −inf forbids a pair."""
        c, n, m = log_ratio.shape
        or_none = np.zeros((c, n, m + 1))
        np.minimum(log_ratio, MARGINALS_LARGEST_LOG_RATIO, out=or_none[:, :, :m])
        log_weight = or_none.reshape(c, -1).take(self.choice, axis=1).sum(axis=1)
        top = log_weight.max(axis=1, keepdims=True)
        weight = np.exp(log_weight - top)
        total = weight.sum(axis=1, keepdims=True)
        probability = (weight @ self.has) / total
        return MatchedOfEach(probability.reshape(c, n, m), (top + np.log(total))[:, 0])


@cache
def listed(n: int, m: int) -> ListedMatchings | None:
    """None where there are more than MARGINALS_MOST_LISTED of them."""
    if sum(comb(n, k) * perm(m, k) for k in range(min(n, m) + 1)) > MARGINALS_MOST_LISTED:
        return None
    if n > m:
        across = listed(m, n)
        assert across is not None
        has = across.has.reshape(-1, m, n).swapaxes(1, 2)
    else:
        columns = np.array([c for c in product(range(m + 1), repeat=n) if _is_matching(c, m)])
        has = (columns[:, :, None] == np.arange(m)).astype(float)
    column = np.where(has.any(axis=2), has.argmax(axis=2), m)
    choice = np.ascontiguousarray((column + (m + 1) * np.arange(n)).T)
    return ListedMatchings(choice, np.ascontiguousarray(has.reshape(len(has), n * m)))


def _is_matching(columns: tuple[int, ...], none: int) -> bool:
    taken = [column for column in columns if column != none]
    return len(set(taken)) == len(taken)
