"""Wide matchings under several hypotheses at once: beliefs, and exact sums where beliefs would be too sure.

Loopy belief propagation (Williams & Lau, "Approximate evaluation of marginal association probabilities with belief
propagation", IEEE T-AES 50(4), 2014, eqs. 10-11) is exact where pairs make no loop, and errs by what goes around one.
Let w[i, j] be the odds of j among the choices of row i, and u[i, j] those of i among the choices of column j. Then the
logarithm of the weight of all matchings is about (Yedidia, Freeman & Weiss, IEEE T-IT 51(7), 2005)

    Σ_i log(1 + Σ_j w[i, j]) + Σ_j log(1 + Σ_i u[i, j]) − Σ_ij log(1 + u[i, j] w[i, j] / r[i, j])

A loop enters each of its columns from a row. Of what it brings there, no more goes on than the share of the column in
the row while the row's likeliest other is taken, times the largest such share of another row in the column. Pairs of
more than `BELIEF_LOOP_LEAST` that are in loops of such are swept exactly (`marginals.py`), with what the others leave
to their rows and columns. Where more than `BELIEF_LOOP_WIDEST` rows would be open, the weakest of them are not.

Against exact sums, of 13 x 29 as recorded with thirty drones: p within 1e-4, log weights within 3e-4. Of random ones:
13 x 29 with sure pairs and six swaps, p within 0.01, and above 0.9 at most 0.004 too sure; 12 x 16 of normal ratios,
within 0.03, at most 0.01 too sure. Where nearly all pairs of a square compete, 12 x 12, p is off by up to 0.12 and log
weights lack up to 1.6. `tests/tracking/test_beliefs_of_each.py` has such. Beliefs alone take two that fit two places
alike for sure: off by 0.4, and by 0.5 in the log weight.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.tracking.listed_matchings import MatchedOfEach
from swarmtrack.tracking.marginals import matched, sweep_width
from swarmtrack.tracking.priors import (
    BELIEF_ITERATIONS,
    BELIEF_LOOP_CUTS,
    BELIEF_LOOP_LEAST,
    BELIEF_LOOP_WIDEST,
    BELIEF_TOLERANCE,
)


class PairBeliefs(NamedTuple):
    """Odds (c, n, m) of each pair against the rest of its row, as far as its column is `free` of other rows, and of its
    column."""

    of_row: Array
    of_column: Array
    free: Array

    @classmethod
    def of(cls, log_ratio: Array) -> PairBeliefs:
        """log_ratio (c, n, m), none above 300: log r by each of c hypotheses."""
        ratio = np.exp(log_ratio)
        free, going = np.ones_like(ratio), np.arange(len(ratio))
        for _ in range(BELIEF_ITERATIONS):
            r, before = ratio[going], free[going]
            after = 1.0 / (1.0 + _sum_of_others(r / (1.0 + _sum_of_others(r * before, 2)), 1))
            free[going] = after
            going = going[np.abs(after / before - 1.0).max(axis=(1, 2)) > BELIEF_TOLERANCE]
            if not going.size:
                break
        of_row = ratio * free
        return cls(of_row, ratio / (1.0 + _sum_of_others(of_row, 2)), free)

    def looping(self) -> Array:
        """(c, n, m): how much goes on through each pair of a loop, at most."""
        of_row, of_column = _share_without_first(self.of_row, 2), _share_without_first(self.of_column, 1)
        return np.maximum(of_row * _most_of_others(of_column, 1), of_column * _most_of_others(of_row, 2))


def believed(log_ratio: Array, worth: NDArray[np.bool_] | None = None) -> tuple[MatchedOfEach, Array]:
    """As `matched_of_each`, however wide; and what part (c, n) of the log totals is of each row.

    log_ratio (c, n, m): none above 300; worth (c,): the hypotheses whose loops are swept; None: all.
    """
    beliefs = PairBeliefs.of(log_ratio)
    of_row, of_column = beliefs.of_row, beliefs.of_column
    wanted = of_column.sum(axis=1)
    row, column = 1.0 + of_row.sum(axis=2), 1.0 + wanted
    probability = of_row / row[:, :, None]
    # A column's part is theirs who may have it.
    in_column = np.log(column) - np.log1p(of_column * beliefs.free).sum(axis=1)
    of_wanted = in_column / np.where(wanted > 0.0, wanted, 1.0)
    part = np.log(row) + (of_column @ of_wanted[:, :, None])[:, :, 0]
    looping = beliefs.looping()
    swept = _loops(looping > BELIEF_LOOP_LEAST)
    has_loops = swept.any(axis=(1, 2)) if worth is None else swept.any(axis=(1, 2)) & worth
    for k in np.flatnonzero(has_loops).tolist():
        inside = _narrow(swept[k], looping[k])
        row_left = 1.0 + np.where(inside, 0.0, of_row[k]).sum(axis=1)
        column_left = 1.0 + np.where(inside, 0.0, of_column[k]).sum(axis=0)
        left = log_ratio[k] - np.log(row_left)[:, None] - np.log(column_left)
        exact = matched(np.where(inside, left, -np.inf))
        none = (1.0 - exact.probability.sum(axis=1)) / row_left
        probability[k] = np.where(inside, exact.probability, none[:, None] * of_row[k])
        as_believed = np.log(row[k] / row_left).sum() + np.log(column[k] / column_left).sum()
        as_believed -= np.log1p((of_column[k] * beliefs.free[k])[inside]).sum()
        rows = inside.any(axis=1)
        part[k, rows] += (exact.log_total - as_believed) / max(np.count_nonzero(rows), 1)
    # By columns only where it has not converged.
    probability /= np.maximum(probability.sum(axis=1, keepdims=True), 1.0)
    return MatchedOfEach(probability, part.sum(axis=1)), part


def _narrow(pairs: NDArray[np.bool_], looping: Array) -> NDArray[np.bool_]:
    """(n, m): of pairs in loops, as many as are swept with few rows open."""
    for least in BELIEF_LOOP_CUTS:
        if sweep_width(np.where(pairs, 0.0, -np.inf)) <= BELIEF_LOOP_WIDEST:
            break
        pairs = _loops(looping[None] > least)[0]
    return pairs


def _loops(pairs: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Those (c, n, m) of some pairs that are in loops of them, or between loops."""
    while True:
        inside = pairs & (pairs.sum(axis=2, keepdims=True) > 1) & (pairs.sum(axis=1, keepdims=True) > 1)
        if np.array_equal(inside, pairs):
            return pairs
        pairs = inside


def _first(of: Array, axis: int) -> tuple[NDArray[np.intp], Array, Array]:
    """Where the largest is along an axis, how large; and the same array with 0 there."""
    at = np.expand_dims(of.argmax(axis=axis), axis)
    rest = of.copy()
    np.put_along_axis(rest, at, 0.0, axis)
    return at, np.take_along_axis(of, at, axis), rest


def _sum_of_others(of: Array, axis: int) -> Array:
    """Sums along an axis over all others. Only of what is not the largest is one subtracted: that cancels nothing."""
    at, first, rest = _first(of, axis)
    total = rest.sum(axis=axis, keepdims=True)
    found: Array = first + (total - rest)
    np.put_along_axis(found, at, total, axis)
    return found


def _most_of_others(of: Array, axis: int) -> Array:
    at, first, rest = _first(of, axis)
    found = np.broadcast_to(first, of.shape).copy()
    np.put_along_axis(found, at, rest.max(axis=axis, keepdims=True), axis)
    return found


def _share_without_first(odds: Array, axis: int) -> Array:
    """Of each in all, without the likeliest of the others."""
    at, first, rest = _first(odds, axis)
    total = 1.0 + rest.sum(axis=axis, keepdims=True)
    found: Array = rest / total
    np.put_along_axis(found, at, first / (first + total - rest.max(axis=axis, keepdims=True)), axis)
    return found
