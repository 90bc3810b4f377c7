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
passes are the forward-backward recursion over the joint events of JPDA (Fortmann, Bar-Shalom & Scheffe, 1983).

Where more than `WIDEST` rows would be open, pairs are left out of the sweep until no more are: those that loopy belief
propagation (Williams & Lau, "Approximate evaluation of marginal association probabilities with belief propagation",
IEEE T-AES 50(4), 2014, eqs. 10-11) thinks least likely. It always converges, but alone it is too sure of itself where
many pairs compete; a pair left out keeps its belief, and so much less is there for the others of its row and column.
"""

from __future__ import annotations

from bisect import bisect_left

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array

WIDEST = 13  # rows open at once: 8192 sets, some milliseconds
LARGEST_EXPONENT = 600.0  # of a product of one ratio for each open row: a double ends at 709
BELIEF_ITERATIONS, BELIEF_TOLERANCE = 200, 1e-6
LEAST_BELIEF = np.geomspace(1e-6, 0.51, 40)
"""What a pair must be believed to be swept: the first that leaves few enough rows open. Above 0.5 nobody has two."""

Cluster = tuple[NDArray[np.int64], NDArray[np.int64]]


def matching_marginals(log_ratio: Array, widest: int = WIDEST) -> Array:
    """The probability (n, m) of each pair; what a row lacks to one is that of "none of them".

    log_ratio (n, m): log r, −inf forbids a pair. widest: pairs are left out where more rows than this, one or more,
    would be open.
    """
    probability = np.zeros(log_ratio.shape)
    for rows, columns in _clusters(log_ratio > -np.inf):
        block = np.ix_(rows, columns)
        probability[block] = _of_cluster(log_ratio[block], widest)
    return probability


def sweep_width(log_ratio: Array) -> int:
    """How many rows are open at once at most, in the sweep over all allowed pairs."""
    blocks = [log_ratio[np.ix_(rows, columns)] > -np.inf for rows, columns in _clusters(log_ratio > -np.inf)]
    return max((_narrower(block) for block in blocks), default=0)


def _clusters(allowed: NDArray[np.bool_]) -> list[Cluster]:
    """Connected parts of the graph of allowed pairs, as (rows, columns)."""
    left = np.asarray(allowed.any(axis=1))
    found: list[Cluster] = []
    while left.any():
        rows = np.zeros_like(left)
        rows[left.argmax()] = True
        while True:
            columns = allowed[rows].any(axis=0)
            grown = np.asarray(allowed[:, columns].any(axis=1))
            if (grown == rows).all():
                break
            rows = grown
        left = left & ~rows
        found.append((np.flatnonzero(rows), np.flatnonzero(columns)))
    return found


def _of_cluster(log_ratio: Array, widest: int) -> Array:
    n, m = log_ratio.shape
    if n == 1 or m == 1:  # one chooses among all the others, or none
        top = max(0.0, float(log_ratio.max()))
        weight = np.exp(log_ratio - top)
        return np.asarray(weight / (np.exp(-top) + weight.sum()))
    allowed = log_ratio > -np.inf
    by_columns, width = _sweep_order(allowed)
    by_rows, width_transposed = _sweep_order(allowed.T)
    narrower = min(width, width_transposed)
    if narrower > widest:
        return _of_thinned(log_ratio, widest)
    limit = LARGEST_EXPONENT / narrower  # nothing is as certain as a ratio beyond it
    ratio = np.where(allowed, np.exp(np.clip(log_ratio, -limit, limit)), 0.0)
    if width_transposed < width:
        return _sweep(np.ascontiguousarray(ratio.T), by_rows).T
    return _sweep(ratio, by_columns)


def _of_thinned(log_ratio: Array, widest: int) -> Array:
    """p (n, m) without sweeping over the least likely pairs.

    With i → none: "i is in none of the pairs left out", p(i = j) = p(i = j | i → none) p(i → none). The sweep gives
    the first factor, but for what the pairs left out do to others; beliefs give the second.
    """
    belief = beliefs(log_ratio)

    def swept(least: float) -> NDArray[np.bool_]:
        return (log_ratio > -np.inf) & (belief >= least)

    def is_narrow(least: float) -> bool:
        return _narrower(swept(least)) <= widest

    kept = swept(LEAST_BELIEF[bisect_left(LEAST_BELIEF, True, key=is_narrow, hi=len(LEAST_BELIEF) - 1)])
    left_out = np.where(kept, 0.0, belief)
    remaining = 1.0 - np.maximum(left_out.sum(axis=1)[:, None], left_out.sum(axis=0))
    given_none = matching_marginals(np.where(kept, log_ratio, -np.inf), widest)
    return np.asarray(given_none * np.maximum(remaining, 0.0) + left_out)


def _narrower(allowed: NDArray[np.bool_]) -> int:
    """The width of the narrower sweep: over columns, or over rows."""
    return min(_sweep_order(allowed)[1], _sweep_order(allowed.T)[1])


def _sweep_order(allowed: NDArray[np.bool_]) -> tuple[list[int], int]:
    """An order of the columns that keeps few rows open, and how many that is at most. Greedy: the best order is
    hard."""
    wanted = allowed.sum(axis=1)  # columns that still want each row
    is_open = np.zeros(len(allowed), dtype=bool)
    left = list(range(allowed.shape[1]))
    order: list[int] = []
    width = 0
    while left:
        columns = allowed[:, left]
        opens = (columns & ~is_open[:, None]).sum(axis=0)
        closes = (columns & (wanted == 1)[:, None]).sum(axis=0)
        column = left.pop(int(np.lexsort((opens, opens - closes))[0]))
        is_open |= allowed[:, column]
        width = max(width, int(is_open.sum()))
        wanted = wanted - allowed[:, column]
        is_open &= wanted > 0
        order.append(column)
    return order, width


def _sweep(ratio: Array, order: list[int]) -> Array:
    """p (n, m) of one cluster. A set of open rows is an index: bit b is set where the row `open_rows[b]` is used."""
    last_use = {int(i): k for k, j in enumerate(order) for i in np.flatnonzero(ratio[:, j])}
    open_rows: list[int] = []
    forward = np.ones(1)
    tape: list[
        tuple[list[int], Array, list[int]]
    ] = []  # open rows and F before each column, and rows left open
    for k, j in enumerate(order):
        for i in np.flatnonzero(ratio[:, j]).tolist():
            if i not in open_rows:
                open_rows.append(i)
                forward = np.concatenate(
                    (forward, np.zeros_like(forward))
                )  # its bit is the highest, not used yet
        before, here = forward, list(open_rows)
        forward = before.copy()
        for bit, i in enumerate(here):
            if ratio[i, j] > 0.0:
                _with(forward, bit)[...] += ratio[i, j] * _without(before, bit)
        for i in [i for i in here if last_use[i] == k]:
            bit = open_rows.index(i)
            forward = (_without(forward, bit) + _with(forward, bit)).ravel()
            open_rows.remove(i)
        forward /= forward.max()  # a common factor for each column drops out of p
        tape.append((here, before, list(open_rows)))

    probability = np.zeros(ratio.shape)
    backward = np.ones(1)
    for k in range(len(order) - 1, -1, -1):
        j = order[k]
        here, before, after = tape[k]
        for bit, i in enumerate(here):
            if i not in after:  # what follows does not care whether it is used
                backward = np.repeat(backward.reshape(-1, 1, 1 << bit), 2, axis=1).ravel()
        total = float(before @ backward)
        earlier = backward.copy()
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
    return probability


def _without(sets: Array, bit: int) -> Array:
    """View of the entries whose bit is clear."""
    return sets.reshape(-1, 2, 1 << bit)[:, 0]


def _with(sets: Array, bit: int) -> Array:
    """View of the entries whose bit is set."""
    return sets.reshape(-1, 2, 1 << bit)[:, 1]


def beliefs(log_ratio: Array) -> Array:
    """Approximate p (n, m) by loopy belief propagation."""
    n, m = log_ratio.shape
    ratio = np.exp(np.minimum(log_ratio, LARGEST_EXPONENT / 2.0))
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
    return np.asarray(
        belief / np.maximum(belief.sum(axis=0), 1.0)
    )  # by columns only where it has not converged
