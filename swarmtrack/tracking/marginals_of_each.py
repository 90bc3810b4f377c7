"""One matching under several hypotheses at once: for each of them what `marginals.py` gives, exactly up to so many rows
as `MARGINALS_OF_EACH_MOST_ROWS`; of more, beliefs (`beliefs_of_each.py`).

Small matchings are cheaper to work out than to ask for one by one, so all hypotheses go through one sweep. With F_j[S]
and B_j[S] as there, all sets S of the rows (or columns, if these are fewer) are kept. A step over a column and a row is
one product for half of the sets, of all hypotheses.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.tracking.beliefs_of_each import believed
from swarmtrack.tracking.listed_matchings import MatchedOfEach, listed
from swarmtrack.tracking.marginals import independent_blocks, matched
from swarmtrack.tracking.priors import (
    MARGINALS_LARGEST_EXPONENT,
    MARGINALS_OF_EACH_BY_MATRICES,
    MARGINALS_OF_EACH_MOST_ROWS,
    MARGINALS_OF_EACH_SETS,
)


def matched_of_each(log_ratio: Array) -> MatchedOfEach:
    """log_ratio (c, n, m): log r of n rows and m columns by each of c hypotheses; −inf forbids a pair."""
    if log_ratio.size and (every := listed(*log_ratio.shape[1:])):
        return every.matched(log_ratio)
    found = MatchedOfEach(np.zeros(log_ratio.shape), np.zeros(len(log_ratio)))
    allowed = np.any(log_ratio > -np.inf, axis=0)
    for rows, columns in independent_blocks(allowed, range(len(allowed))):
        block = np.s_[:, rows[:, None], columns]
        probability, log_total = _of_block(log_ratio[block])
        found.probability[block] = probability
        found.log_total[:] += log_total
    return found


def _of_block(log_ratio: Array) -> MatchedOfEach:
    _, n, m = log_ratio.shape
    if every := listed(n, m):
        return every.matched(log_ratio)
    if n > m:
        probability, log_total = _of_block(log_ratio.swapaxes(1, 2))
        return MatchedOfEach(probability.swapaxes(1, 2), log_total)
    if n > MARGINALS_OF_EACH_MOST_ROWS and log_ratio.max() < MARGINALS_LARGEST_EXPONENT / 2.0:
        return believed(log_ratio)[0]
    if n > MARGINALS_OF_EACH_MOST_ROWS or log_ratio.max() > MARGINALS_LARGEST_EXPONENT / n:
        each = [matched(ratios) for ratios in log_ratio]
        return MatchedOfEach(
            np.array([found.probability for found in each]), np.array([found.log_total for found in each])
        )
    return _swept(np.exp(log_ratio))


def _swept(ratio: Array) -> MatchedOfEach:
    if ratio.shape[1] <= MARGINALS_OF_EACH_BY_MATRICES:
        return _by_matrices(ratio)
    c, at_once = len(ratio), MARGINALS_OF_EACH_SETS >> ratio.shape[1]
    probability, log_total = np.empty(ratio.shape), np.empty(c)
    for begin in range(0, c, at_once):
        part = slice(begin, begin + at_once)
        _sweep(ratio[part], probability[part], log_total[part])
    return MatchedOfEach(probability, log_total)


def _sweep(ratio: Array, probability: Array, log_total: Array) -> None:
    """Writes into the last two. Sets are the first axis but one, hypotheses the last."""
    c, n, m = ratio.shape
    by_column = np.ascontiguousarray(ratio.transpose(2, 1, 0))
    forward, backward = np.empty((m + 1, 1 << n, c)), np.empty((m + 1, 1 << n, c))
    forward[0], backward[m] = 0.0, 1.0
    forward[0, 0] = 1.0
    # With and without row i, of all sets.
    halves = [(-1, 2, 1 << i, c) for i in range(n)]
    for j in range(m):
        forward[j + 1], backward[m - 1 - j] = forward[j], backward[m - j]
        for half, r, r_back in zip(halves, by_column[j], by_column[m - 1 - j], strict=True):
            forward[j + 1].reshape(half)[:, 1] += r * forward[j].reshape(half)[:, 0]
            backward[m - 1 - j].reshape(half)[:, 0] += r_back * backward[m - j].reshape(half)[:, 1]
    total = backward[0, 0]
    for i, half in enumerate(halves):
        of_each = (m, *half)
        without, with_it = forward[:-1].reshape(of_each)[:, :, 0], backward[1:].reshape(of_each)[:, :, 1]
        shares = np.einsum("mhlc,mhlc->cm", without, with_it)
        probability[:, i] = by_column[:, i].T * shares / total[:, None]
    log_total[:] = np.log(total)


def _by_matrices(ratio: Array) -> MatchedOfEach:
    """A step over a column is one matrix for each hypothesis."""
    c, n, m = ratio.shape
    sets = 1 << n
    without, with_it = _additions(n)
    by_column = ratio.transpose(2, 0, 1)
    step = np.zeros((m, c, sets, sets))
    step[..., np.arange(sets), np.arange(sets)] = 1.0
    step[:, :, with_it, without] = by_column[..., None]
    forward, backward = np.zeros((m + 1, c, sets)), np.ones((m + 1, c, sets))
    forward[0] = np.arange(sets) == 0
    for j in range(m):
        forward[j + 1] = (step[j] @ forward[j][..., None])[..., 0]
        backward[m - 1 - j] = (backward[m - j][:, None] @ step[m - 1 - j])[:, 0]
    total = backward[0, :, 0]
    shares = (forward[:-1][:, :, without] * backward[1:][:, :, with_it]).sum(axis=-1)
    return MatchedOfEach((by_column * shares).transpose(1, 2, 0) / total[:, None, None], np.log(total))


@cache
def _additions(n: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """(n, sets / 2) each: by row, the sets that lack it, and the same with it."""
    sets = np.arange(1 << n)
    without = np.array([sets[sets >> i & 1 == 0] for i in range(n)], np.intp)
    return without, without | (1 << np.arange(n))[:, None]
