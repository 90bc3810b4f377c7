"""Exact probabilities of pairs when things are matched one to one: of tracks and detections, of tracks and drones.

A matching gives every row at most one column and every column at most one row. Its weight is the product of the
ratios r[i, j] of its pairs: how much more likely "i is j" is than "i is nothing and j is something else". The
probability of a pair is the weight of all matchings that have it over the weight of all matchings.

Theory of operation. Matchings are not enumerated (30 rows have more than anybody can count). A sweep over the columns
needs to remember only the *set* of rows already used, and of those only rows that later columns still want: the open
ones. With F_j[S] the weight of what the first j columns can do using the set S, and B_j[S] of what the rest can add,

    F_j[S] = F_{j-1}[S] + Σ_{i ∈ S} r[i, j] F_{j-1}[S − i]
    B_{j-1}[S] = B_j[S] + Σ_{i ∉ S} r[i, j] B_j[S + i]
    p[i, j] ∝ r[i, j] Σ_{S ∌ i} F_{j-1}[S] B_j[S + i]

which adds and multiplies what is not negative and so cancels nothing. The cost is exponential in the largest number
of rows open at once, so columns are ordered to keep it small, and pairs that share nothing are solved apart. The two
passes are the forward-backward recursion over the joint events of JPDA (Fortmann, Bar-Shalom & Scheffe, 1983). In a
small cluster all rows may as well be open all the time: then both passes are the same few products of small matrices.
The smallest have so few matchings that these are listed after all (listed_matchings.py).

Where more than `MARGINALS_MOST_OPEN_ROWS` rows would be open, pairs are left out of the sweep until no more are: those
that loopy belief propagation (Williams & Lau, "Approximate evaluation of marginal association probabilities with belief
propagation", IEEE T-AES 50(4), 2014, eqs. 10-11) thinks least likely. It always converges, but alone it is too sure of
itself where many pairs compete; a pair left out keeps its belief, and so much less is there for the others of its row
and column. Who has no time for that, as a tracker between two images, takes the beliefs as they are: `beyond=beliefs`.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Iterable
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.tracking.association import most_likely_matching
from swarmtrack.tracking.listed_matchings import ListedMatchings, listed
from swarmtrack.tracking.priors import (
    BELIEF_CUTS,
    BELIEF_ITERATIONS,
    BELIEF_TOLERANCE,
    MARGINALS_LARGEST_EXPONENT,
    MARGINALS_LARGEST_LOG_RATIO,
    MARGINALS_MOST_OPEN_ROWS,
    MARGINALS_SMALL,
    MARGINALS_UNORDERED,
)

"""Up to so many rows all are open all the time: without asking, and where an order of the columns closes one at
most."""
"""What a pair must be believed to be swept: the first that leaves few enough rows open. Above 0.5 nobody has two."""

Beyond = Callable[[Array, int], Array]
"""What p (n, m) is to be of a cluster, log r (n, m), that has more rows open than the second argument allows."""


class Matched(NamedTuple):
    """p (n, m) of each pair, and the logarithm of the weight of all matchings."""

    probability: Array
    log_total: float


class Weights(NamedTuple):
    """Weights of a matching: the product of pair (n, m) over its pairs, and of row (n,) and column (m,) over those
    without; all times e^log_scale.
    """

    pair: Array
    row: Array
    column: Array
    log_scale: float

    @property
    def transposed(self) -> Weights:
        return Weights(self.pair.T, self.column, self.row, self.log_scale)


class IndependentBlock(NamedTuple):
    """Rows and columns that share nothing with any others."""

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]


def matching_marginals(
    log_ratio: Array, widest: int = MARGINALS_MOST_OPEN_ROWS, beyond: Beyond | None = None
) -> Array:
    """The probability (n, m) of each pair; what a row lacks to one is that of "none of them".

    log_ratio (n, m): log r, −inf forbids a pair. Where more rows than `widest`, one or more, would be open, the
    answer is `beyond`'s; None: pairs are left out of the sweep.
    """
    return matched(log_ratio, widest, beyond).probability


def matched(
    log_ratio: Array, widest: int = MARGINALS_MOST_OPEN_ROWS, beyond: Beyond | None = None
) -> Matched:
    """As `matching_marginals`, with the weight of all matchings: how well these ratios explain what is matched.

    Of pairs that were left out of the sweep, and of what `beyond` answers, it is no more than a lower bound.
    """
    if not log_ratio.size:
        return Matched(np.zeros(log_ratio.shape), 0.0)
    if min(log_ratio.shape) <= min(widest, MARGINALS_SMALL) and (every := listed(*log_ratio.shape)):
        return _of_one(every, log_ratio)
    allowed = log_ratio > -np.inf
    contested = allowed & (np.count_nonzero(allowed, axis=0) > 1)
    disputing = contested.any(axis=1)
    probability, log_total = np.zeros(log_ratio.shape), 0.0
    if not disputing.all():
        probability[~disputing], log_total = _of_choices(log_ratio[~disputing])
    for rows, columns in independent_blocks(allowed, np.flatnonzero(disputing).tolist()):
        block = rows[:, None], columns
        found = _of_cluster(log_ratio[block], widest, beyond)
        probability[block] = found.probability
        log_total += found.log_total
    return Matched(probability, log_total)


def _of_one(every: ListedMatchings, log_ratio: Array) -> Matched:
    found = every.matched(log_ratio[None])
    return Matched(found.probability[0], found.log_total.item())


def sweep_width(log_ratio: Array) -> int:
    """How many rows are open at once at most, in the sweep over all allowed pairs."""
    allowed = log_ratio > -np.inf
    blocks = [
        allowed[rows[:, None], columns] for rows, columns in independent_blocks(allowed, range(len(allowed)))
    ]
    return max((min(_sweep_order(block)[1], _sweep_order(block.T)[1]) for block in blocks), default=0)


def _of_choices(log_ratio: Array) -> Matched:
    """Where every row chooses one of its columns, or none, and nobody else wants them."""
    top = np.maximum(log_ratio.max(axis=1, initial=0.0), 0.0)[:, None]
    weight = np.exp(log_ratio - top)
    total = np.exp(-top) + weight.sum(axis=1, keepdims=True)
    return Matched(weight / total, float((top + np.log(total)).sum()))


def _sets(member: NDArray[np.bool_]) -> list[int]:
    """Each row of member (n, m) as a set of columns: a number whose bit j is set where column j is in it."""
    return [int.from_bytes(row.tobytes(), "little") for row in np.packbits(member, axis=1, bitorder="little")]


def independent_blocks(allowed: NDArray[np.bool_], rows: Iterable[int]) -> list[IndependentBlock]:
    """Connected parts of the graph of allowed pairs, of these rows; a row without any pair is in none."""
    wanted = _sets(allowed)
    found: list[tuple[list[int], int]] = []
    for i in rows:
        joined, columns = [i], wanted[i]
        apart = []
        for group in found:
            if group[1] & wanted[i]:
                joined, columns = group[0] + joined, columns | group[1]
            else:
                apart.append(group)
        found = [*apart, (joined, columns)] if columns else found
    return [IndependentBlock(np.array(rows), np.flatnonzero(allowed[rows].any(axis=0))) for rows, _ in found]


def _of_cluster(log_ratio: Array, widest: int, beyond: Beyond | None) -> Matched:
    n, m = log_ratio.shape
    if m == 1:
        return _transposed(_of_choices(log_ratio.T))
    fewer = min(n, m)
    if fewer <= min(widest, MARGINALS_SMALL):
        return _of_one(every, log_ratio) if (every := listed(n, m)) else _swept_at_once(log_ratio)
    allowed = log_ratio > -np.inf
    by_columns, width = _sweep_order(allowed, widest)
    by_rows, width_transposed = _sweep_order(allowed.T, min(widest, width))
    narrower = min(width, width_transposed)
    if narrower > widest:
        return _of_thinned(log_ratio, widest) if beyond is None else Matched(beyond(log_ratio, widest), 0.0)
    if fewer <= min(narrower + 1, MARGINALS_UNORDERED):
        return _swept_at_once(log_ratio)
    weights = _weights(log_ratio, narrower)
    if width_transposed < width:
        return _transposed(_swept(weights.transposed, by_rows))
    return _swept(weights, by_columns)


def _transposed(found: Matched) -> Matched:
    return Matched(found.probability.T, found.log_total)


def _of_thinned(log_ratio: Array, widest: int) -> Matched:
    """Without sweeping over the least likely pairs.

    With i → none: "i is in none of the pairs left out", p(i = j) = p(i = j | i → none) p(i → none). The sweep gives
    the first factor, but for what the pairs left out do to others; beliefs give the second.
    """
    belief = beliefs(log_ratio)

    def swept(least: float) -> NDArray[np.bool_]:
        return (log_ratio > -np.inf) & (belief >= least)

    def is_narrow(least: float) -> bool:
        return min(_sweep_order(swept(least), widest)[1], _sweep_order(swept(least).T, widest)[1]) <= widest

    kept = swept(BELIEF_CUTS[bisect_left(BELIEF_CUTS, True, key=is_narrow, hi=len(BELIEF_CUTS) - 1)])
    left_out = np.where(kept, 0.0, belief)
    remaining = 1.0 - np.maximum(left_out.sum(axis=1)[:, None], left_out.sum(axis=0))
    given_none, log_total = matched(np.where(kept, log_ratio, -np.inf), widest)
    return Matched(given_none * np.maximum(remaining, 0.0) + left_out, log_total)


def _sweep_order(allowed: NDArray[np.bool_], widest: int | None = None) -> tuple[list[int], int]:
    """An order of the columns that keeps few rows open, and how many that is at most. Greedy: the best order is
    hard. Where it is more than `widest` the order ends there."""
    wanting = _sets(allowed.T)
    members = [np.flatnonzero(column).tolist() for column in allowed.T]
    wanted = allowed.sum(axis=1).tolist()  # columns that still want each row
    last = sum(1 << i for i, columns in enumerate(wanted) if columns == 1)  # rows that one column still wants
    is_open = 0
    left = list(range(len(wanting)))
    order: list[int] = []
    width = 0

    def opens_and_closes(column: int) -> tuple[int, int]:
        opens = (wanting[column] & ~is_open).bit_count()
        return opens - (wanting[column] & last).bit_count(), opens

    while left and (widest is None or width <= widest):
        column = min(left, key=opens_and_closes)
        left.remove(column)
        order.append(column)
        is_open |= wanting[column]
        width = max(width, is_open.bit_count())
        is_open &= ~(wanting[column] & last)
        last &= ~wanting[column]
        for i in members[column]:
            wanted[i] -= 1
            if wanted[i] == 1:
                last |= 1 << i
    return order, width


def _weights(log_ratio: Array, width: int) -> Weights:
    """As factors of which `width` can be multiplied without overflow; what then underflows does not count.

    Where ratios themselves could not, those of row i are divided by e^profit[i] and those of column j by e^price[j],
    the dual prices of the most likely matching: its weight becomes one, and no factor is above one.
    """
    n, m = log_ratio.shape
    if log_ratio.max() <= MARGINALS_LARGEST_EXPONENT / width:
        return Weights(np.exp(log_ratio), np.ones(n), np.ones(m), 0.0)
    log_ratio = np.minimum(log_ratio, MARGINALS_LARGEST_LOG_RATIO)
    rows, columns = most_likely_matching(log_ratio)
    profit, price = np.zeros(n), np.zeros(m)
    # Prices rise along paths of the matching, none of which has more rows (Bellman & Ford).
    for _ in range(n):
        profit[rows] = log_ratio[rows, columns] - price[columns]
        price = np.maximum((log_ratio - profit[:, None]).max(axis=0), 0.0)
    profit[rows] = log_ratio[rows, columns] - price[columns]
    scale = float(profit.sum() + price.sum())
    return Weights(np.exp(log_ratio - profit[:, None] - price), np.exp(-profit), np.exp(-price), scale)


def _swept_at_once(log_ratio: Array) -> Matched:
    """Of one small cluster, all of whose rows are open all the time; in the order of the columns."""
    if len(log_ratio) > log_ratio.shape[1]:
        return _transposed(_swept_at_once(log_ratio.T))
    n, m = log_ratio.shape
    weights = _weights(log_ratio, n)
    halves = _halves(n)
    # The forward pass takes column j together with the backward pass's column m - 1 - j.
    column = np.concatenate([weights.pair.T, weights.column[:, None]], axis=1)
    entries = np.concatenate([column, column[::-1]], axis=1)[:, halves.source]
    # One piece of memory for the matrices of all steps: new ones for each would cost more than filling them.
    matrices = np.zeros(2 * (halves.first**2 + halves.others**2))
    left = matrices[: 2 * halves.first**2].reshape(2, halves.first, halves.first)
    right = matrices[2 * halves.first**2 :].reshape(2, halves.others, halves.others)
    sets = np.empty((m + 1, 2, halves.first, halves.others))
    sets[0, 0] = 0.0
    sets[0, 0, 0, 0] = 1.0
    sets[0, 1] = np.where(halves.member, 1.0, weights.row).prod(axis=2)
    others = np.empty(sets.shape[1:])
    for before, after, entry in zip(sets[:-1], sets[1:], entries, strict=True):
        matrices[halves.place] = entry
        np.matmul(left, before, out=after)
        np.matmul(before, right, out=others)
        np.add(after, others, out=after)
    forward, backward = sets[:-1, 0], sets[m - 1 :: -1, 1]
    total = sets[m, 1, 0, 0]
    # Σ F[S] B[S + i] over the sets of the half that i is not in, and then over the others.
    by_first = (backward @ forward.swapaxes(1, 2)).reshape(m, -1)[:, halves.add_first].sum(axis=2)
    by_others = (backward.swapaxes(1, 2) @ forward).reshape(m, -1)[:, halves.add_others].sum(axis=2)
    probability = weights.pair * np.concatenate([by_first, by_others], axis=1).T / total
    return Matched(probability, float(np.log(total)) + weights.log_scale)


class Halves(NamedTuple):
    """The sets of n rows as a matrix (first, others): which of the first half of the rows are in it gives its row,
    which of the others its column. Adding one of the rows is then a matrix on its left or right, (first, first) or
    (others, others), which only depends on that half.

    member (first, others, n): whether the set has the row. add_first (rows of the half, ·): flat indices, in the
    matrix on the left, of [S + i, S]; add_others likewise. place (k,): flat indices, in the two matrices on the left
    (of the forward pass, of the backward pass) and the two on the right, of what a step fills in; source (k,): where
    from, in [r[:, j] and column[j] of the forward pass, and those of the backward pass].
    """

    first: int
    others: int
    member: NDArray[np.bool_]
    add_first: NDArray[np.intp]
    add_others: NDArray[np.intp]
    place: NDArray[np.intp]
    source: NDArray[np.intp]


@cache
def _halves(n: int) -> Halves:
    half = (n + 1) // 2
    first, others = 1 << half, 1 << (n - half)
    member = (np.arange(others) << half | np.arange(first)[:, None])[:, :, None] >> np.arange(n) & 1 > 0
    add_first, add_others = _additions(half), _additions(n - half)
    stay = np.arange(first) * (first + 1)  # the diagonal: nobody takes the column
    rows_first, rows_others = np.arange(half), np.arange(half, n)
    pieces = [
        (add_first, rows_first),
        (stay[None], np.array([n])),
        (_flipped(add_first, first) + first**2, rows_first + n + 1),
        (stay[None] + first**2, np.array([n + n + 1])),
        (_flipped(add_others, others) + 2 * first**2, rows_others),
        (add_others + 2 * first**2 + others**2, rows_others + n + 1),
    ]
    place = np.concatenate([places.ravel() for places, _ in pieces])
    source = np.concatenate([np.repeat(sources, places.shape[1]) for places, sources in pieces])
    return Halves(first, others, member, add_first, add_others, place, source)


def _additions(rows: int) -> NDArray[np.intp]:
    """Flat indices (rows, sets / 2) of the entries [S + i, S] of a matrix over the sets of so many rows."""
    sets = np.arange(1 << rows)
    without = np.array([sets[sets >> i & 1 == 0] for i in range(rows)], np.intp).reshape(rows, -1)
    return (without | 1 << np.arange(rows)[:, None]) * len(sets) + without


def _flipped(entries: NDArray[np.intp], size: int) -> NDArray[np.intp]:
    """The same entries of the transposed (size, size) matrix."""
    return entries % size * size + entries // size


def _swept(weights: Weights, order: list[int]) -> Matched:
    """Of one cluster. A set of open rows is an index: bit b is set where the row `open_rows[b]` is used."""
    ratio, unused, free = weights.pair, weights.row.tolist(), weights.column.tolist()
    last_use = {int(i): k for k, j in enumerate(order) for i in np.flatnonzero(ratio[:, j])}
    open_rows: list[int] = []
    forward, log_total = np.ones(1), weights.log_scale
    # Open rows and F before each column, and rows left open.
    tape: list[tuple[list[int], Array, list[int]]] = []
    for k, j in enumerate(order):
        for i in np.flatnonzero(ratio[:, j]).tolist():
            if i not in open_rows:
                open_rows.append(i)
                # Its bit is the highest, not used yet.
                forward = np.concatenate((forward, np.zeros_like(forward)))
        before, here = forward, list(open_rows)
        forward = free[j] * before
        for bit, i in enumerate(here):
            if ratio[i, j] > 0.0:
                _with(forward, bit)[...] += ratio[i, j] * _without(before, bit)
        for i in [i for i in here if last_use[i] == k]:
            bit = open_rows.index(i)
            forward = (unused[i] * _without(forward, bit) + _with(forward, bit)).ravel()
            open_rows.remove(i)
        largest = float(forward.max())  # a common factor for each column drops out of p
        forward /= largest
        log_total += math.log(largest)
        tape.append((here, before, list(open_rows)))

    probability = np.zeros(ratio.shape)
    backward = np.ones(1)
    for k in range(len(order) - 1, -1, -1):
        j = order[k]
        here, before, after = tape[k]
        for bit, i in enumerate(here):
            if i not in after:  # what follows does not care whether it is used
                backward = np.repeat(backward.reshape(-1, 1, 1 << bit), 2, axis=1).ravel()
                _without(backward, bit)[...] *= unused[i]
        earlier = free[j] * backward
        total = float(before @ earlier)
        for bit, i in enumerate(here):
            if ratio[i, j] > 0.0:
                used = _with(backward, bit)
                weight = ratio[i, j] * float((_without(before, bit) * used).sum())
                probability[i, j] = weight
                total += weight
                _without(earlier, bit)[...] += ratio[i, j] * used
        probability[:, j] /= total
        # Rows that this column opened have the highest bits, and are not used before it.
        backward = earlier[: 1 << len(tape[k - 1][2])] if k else earlier[:1]
        backward = backward / backward.max()
    return Matched(probability, log_total + math.log(forward.item()))


def _without(sets: Array, bit: int) -> Array:
    """View of the entries whose bit is clear."""
    return sets.reshape(-1, 2, 1 << bit)[:, 0]


def _with(sets: Array, bit: int) -> Array:
    """View of the entries whose bit is set."""
    return sets.reshape(-1, 2, 1 << bit)[:, 1]


def beliefs(log_ratio: Array, widest: int = 0) -> Array:
    """Approximate p (n, m) by loopy belief propagation, however wide."""
    n, m = log_ratio.shape
    ratio = np.exp(np.minimum(log_ratio, MARGINALS_LARGEST_EXPONENT / 2.0))
    # Sums over all others, not over all less one: of ratios this different the difference would be rounding alone.
    other_rows, other_columns = 1.0 - np.eye(n), 1.0 - np.eye(m)
    to_rows = np.ones_like(ratio)
    for _ in range(BELIEF_ITERATIONS):
        to_columns = ratio / (1.0 + (ratio * to_rows) @ other_columns)
        updated = 1.0 / (1.0 + other_rows @ to_columns)
        change = np.abs(updated - to_rows).max()
        to_rows = updated
        if change < BELIEF_TOLERANCE:
            break
    weighted = ratio * to_rows
    belief = weighted / (1.0 + weighted.sum(axis=1, keepdims=True))
    # By columns only where it has not converged.
    return np.asarray(belief / np.maximum(belief.sum(axis=0), 1.0))
