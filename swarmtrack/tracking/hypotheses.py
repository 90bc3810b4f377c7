"""The most likely ways to explain a whole scan: the K best matchings of tracks and detections, under every earlier
one.

Theory of operation. A matching gives each track a detection or none, and no detection to two. Its value is the sum of
the gains of its pairs (log-likelihood over "not detected"). Put a price p ≥ 0 on every detection: whatever the
prices, no matching is worth more than

    Σ_tracks max(0, max_j gain[i, j] − p_j) + Σ_j p_j                              (weak duality)

and a track that does not choose its best falls short of this bound by its *slack*, as does a detection that was not
taken by its price. At the prices of the best matching the bound is reached (strong duality): then a good matching is
one with little slack in sum. So tracks are gone through one after the other, all earlier hypotheses and all partial
matchings at once as arrays, and whatever has more slack than `least` allows is left out. Every matching within `least`
of the best is found and none twice; only where there are more than `breadth` partial ones at once are the most
promising kept, and `complete` says so. Murty's K best (1968) in breadth instead of depth: his asks for an assignment
to be solved for each track of each hypothesis, this one for a few in all.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.tracking.association import most_likely_matching
from swarmtrack.tracking.priors import MATCHINGS_BREADTH, MATCHINGS_LEAST_BREADTH, MATCHINGS_ROUNDING

Indices = NDArray[np.intp]

UNDETECTED = -1  # the column of a track that made no detection


class Matchings(NamedTuple):
    """q matchings, best first. prior (q,): which earlier hypothesis each goes on from; column (q, k): the detection of
    each track, or `UNDETECTED`; log_weight (q,), not normalised. complete: none that belongs here was left out."""

    prior: Indices
    column: Indices
    log_weight: Array
    complete: bool


def best_matchings(log_weight: Array, gain: Array, count: int, least: float) -> Matchings:
    """The `count` best, down to log `least` times the weight of the best.

    log_weight (h,) of the earlier hypotheses; gain (h, k, m): under hypothesis h, the log-likelihood of "track k made
    detection m" over "track k made none and m is something else"; −inf forbids a pair.
    """
    h, k, m = gain.shape
    depth = -np.log(least)
    breadth = max(MATCHINGS_BREADTH * count, MATCHINGS_LEAST_BREADTH)
    price, reached = tightest_prices(log_weight, gain)
    net = np.concatenate([gain - price[:, None], np.zeros((h, k, 1))], axis=2)
    best = net.max(axis=2)
    slack = best[:, :, None] - net
    bound = log_weight + best.sum(axis=1) + price.sum(axis=1)
    floor = reached - depth
    floor -= MATCHINGS_ROUNDING * (1.0 + abs(floor) + price.sum(axis=1).max())

    prior = np.flatnonzero(bound >= floor)
    value = bound[prior]
    used = np.zeros((len(prior), m + 1), np.bool_)
    column = np.empty((len(prior), k), np.intp)
    left_out = -np.inf
    for row in _widest_last(slack, depth):
        options = value[:, None] - slack[prior, row]
        options[used] = -np.inf
        parent, choice = np.nonzero(options >= floor)
        value = options[parent, choice]
        if len(parent) > breadth:
            kept = np.argpartition(-value, breadth)
            left_out = max(left_out, float(value[kept[breadth:]].max()))
            kept = kept[:breadth]
            parent, choice, value = parent[kept], choice[kept], value[kept]
        prior, used, column = prior[parent], used[parent], column[parent]
        column[:, row] = choice
        used[np.arange(len(choice)), choice] = choice < m
    value = value - (~used[:, :m] * price[prior]).sum(axis=1)
    order = np.argsort(-value, kind="stable")[:count]
    order = order[value[order] >= value[order[0]] - depth]
    return Matchings(
        prior[order],
        np.where(column[order] < m, column[order], UNDETECTED),
        value[order],
        left_out <= (value[order[-1]] if len(order) == count else floor),
    )


def _widest_last(slack: Array, depth: float) -> list[int]:
    """The tracks, those with the fewest open choices first."""
    open_choices = (slack <= depth).any(axis=0).sum(axis=1)
    return [int(row) for row in np.argsort(open_choices, kind="stable")]


def tightest_prices(log_weight: Array, gain: Array) -> tuple[Array, float]:
    """Prices (h, m) with which no hypothesis is promised more than the best matching of all is worth; and its value.

    Branch and bound: a hypothesis with a bound above the best matching found so far is solved for its own best and its
    prices, which also suit hypotheses that are like it.
    """
    h, _, m = gain.shape
    price, promised, reached = np.zeros((h, m)), np.full(h, np.inf), -np.inf
    promising = int(log_weight.argmax())
    while promised[promising] > reached:
        fair, value = fair_prices(gain[promising])
        bound = log_weight + (gain - fair).max(axis=2, initial=0.0).sum(axis=1) + fair.sum()
        tighter = bound < promised
        price[tighter], promised[tighter] = fair, bound[tighter]
        promised[promising] = log_weight[promising] + value
        reached = max(reached, float(promised[promising]))
        promising = int(promised.argmax())
    return price, reached


def fair_prices(gain: Array) -> tuple[Array, float]:
    """Prices (m,) ≥ 0 at which the best matching of gain (k, m) leaves no track any slack, and its value.

    The lowest such: no track prefers another's detection to its own, so p_j ≥ p_i + gain_j − gain_i for the
    i of each track, along chains of tracks that would move on. No chain is longer than there are tracks.
    """
    k, m = gain.shape
    track, detection = most_likely_matching(gain)
    own, held = np.zeros(k), np.full(k, m)
    own[track], held[track] = gain[track, detection], detection
    price = np.zeros(m + 1)  # the last is that of none
    for _ in range(len(track) + 1):
        dearer = (gain - (own - price[held])[:, None]).max(axis=0, initial=0.0)
        if (dearer <= price[:m]).all():
            break
        price[:m] = np.maximum(price[:m], dearer)
    return price[:m], float(own.sum())
