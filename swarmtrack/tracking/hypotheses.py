"""The most likely ways to explain a whole scan: the K best matchings of tracks and detections, under every earlier one.

Theory of operation. A matching gives each track a detection or none, and no detection to two. Its value is the sum of
the gains of its pairs (log-likelihood over "not detected"). Put a price p ≥ 0 on every detection: whatever the
prices, no matching is worth more than

    Σ_tracks max(0, max_j gain[i, j] − p_j) + Σ_j p_j                              (weak duality)

and a track that does not choose its best falls short of this bound by its *slack*, as does a detection that nobody
took by its price. An auction (Bertsekas, 1988) finds prices with which the bound is nearly reached; then a good
matching is one with little slack in sum. So tracks are gone through one after the other, all earlier hypotheses and all partial
matchings at once as arrays, and whatever has more slack than the best matching found and `least` allow is left out.
Every matching within `least` of the best is found and none twice; only where there are more than `breadth` partial
ones at once are the most promising kept, and `complete` says so. Murty's K best (1968) in breadth instead of depth:
his asks for an assignment to be solved for each track of each hypothesis, this one for none.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array

Indices = NDArray[np.intp]

NONE = -1  # the column of a track that made no detection
BREADTH = 8  # partial matchings kept at once, in multiples of the count wanted
LEAST_BREADTH = 100
AUCTION_STEP = 0.05  # what a bid exceeds the second best by, in log-likelihood
MAX_ROUNDS = 400


class Matchings(NamedTuple):
    """q matchings, best first. prior (q,): which earlier hypothesis each goes on from; column (q, k): the detection of
    each track, or `NONE`; log_weight (q,), not normalised. complete: none better than the last one was left out."""

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
    breadth = max(BREADTH * count, LEAST_BREADTH)
    first = int(log_weight.argmax())
    price, reached = _auction(gain[first])
    net = np.concatenate([gain - price, np.zeros((h, k, 1))], axis=2)
    best = net.max(axis=2)
    slack = best[:, :, None] - net
    bound = log_weight + best.sum(axis=1) + price.sum()
    floor = log_weight[first] + reached - depth

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
    value = value - (~used[:, :m] * price).sum(axis=1)
    order = np.argsort(-value, kind="stable")[:count]
    order = order[value[order] >= value[order[0]] - depth]
    return Matchings(
        prior[order],
        np.where(column[order] < m, column[order], NONE),
        value[order],
        left_out <= value[order[-1]],
    )


def _widest_last(slack: Array, depth: float) -> list[int]:
    """The tracks, those with the fewest open choices first."""
    open_choices = (slack <= depth).any(axis=0).sum(axis=1)
    return [int(row) for row in np.argsort(open_choices, kind="stable")]


def _auction(gain: Array) -> tuple[Array, float]:
    """Prices (m,) ≥ 0 at which everybody's choice is almost their best, and the value of that matching of gain (k, m).

    Rounds of simultaneous bids: who has nothing yet offers for their best detection as much as would make the second
    best, or none at all, as good; the highest bid takes it, and whoever had it bids again. Bertsekas, "The auction
    algorithm: a distributed relaxation method for the assignment problem" (1988).
    """
    k, m = gain.shape
    price = np.zeros(m)
    if m == 0:
        return price, 0.0
    holder, held = np.full(m, -1), np.full(k, -1)
    bidders = np.arange(k)
    for _ in range(MAX_ROUNDS):
        net = gain[bidders] - price
        wanted = net.argmax(axis=1)
        row = np.arange(len(bidders))
        best = net[row, wanted]
        bids = best > 0.0  # who gains nothing by any detection goes without
        if not bids.any():
            break
        bidders, wanted, best, row = bidders[bids], wanted[bids], best[bids], row[bids]
        net[row, wanted] = -np.inf
        second = np.maximum(net[row].max(axis=1), 0.0)
        offer = best - second + AUCTION_STEP
        order = np.argsort(offer, kind="stable")
        winner = np.full(m, -1)
        winner[wanted[order]] = order  # of several the last one written: the highest
        sold = np.flatnonzero(winner >= 0)
        price[sold] += offer[winner[sold]]
        outbid = holder[sold]
        outbid = outbid[outbid >= 0]
        held[outbid] = -1
        holder[sold] = bidders[winner[sold]]
        held[holder[sold]] = sold
        losers = np.ones(len(bidders), np.bool_)
        losers[winner[sold]] = False
        bidders = np.concatenate([bidders[losers], outbid])
        if not len(bidders):
            break
    happy = np.flatnonzero(held >= 0)
    return price, float(gain[happy, held[happy]].sum())
