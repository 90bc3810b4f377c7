"""What tracks were before they may have gone over to other targets.

A track's newest segment begins with its past: the evidence of all bearings until then, for any target. Two tracks were
never the same teammate at once, in the past as little as now. So a past is what a track says beyond all others, in one
matching; and it is known which teammate it was most likely, for the case that this was another track.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.team.log_sums import log_sum
from swarmtrack.team.matchings import log_parts
from swarmtrack.team.priors import SEGMENT_LEAST_S

COLUMN_OF_NOBODY = -1


class Past(NamedTuple):
    """What a track's bearings until some time say, by component, for any target: log evidence (…, k); the column of the
    teammate that it was most likely, COLUMN_OF_NOBODY where it was none; and log evidence if it was any other."""

    log: Array
    column: NDArray[np.intp]
    log_other: Array

    @classmethod
    def unknown(cls, log: Array) -> Past:
        """A past with nothing known but its evidence."""
        return cls(log, np.full(log.shape, COLUMN_OF_NOBODY), log.copy())

    def of(self, chosen: Any) -> Past:
        """Part of it: chosen is an index into all three."""
        return Past(self.log[chosen], self.column[chosen], self.log_other[chosen])

    def without(self, column: int | NDArray[np.intp]) -> Array:
        """Log evidence (…, k) if that teammate was another track then; column: one, or (k,)."""
        return np.asarray(np.where(self.column == column, self.log_other, self.log))


def log_ratios(base: Sequence[Array], each: Sequence[Array]) -> tuple[list[Array], Array]:
    """base (s, k), each (s, k, m): by track, log evidence before each segment, and of it. Returns by track the log
    evidence (k,) if it is no teammate now; and of each track and teammate the log ratio (n, k, m) to that."""
    nobody = [log_sum(b, 0) for b in base]
    ratio = [
        log_sum(b[:, :, None] + e, 0) - none[:, None] for b, e, none in zip(base, each, nobody, strict=True)
    ]
    return nobody, np.array(ratio)


def pasts_from_now(
    waiting: Sequence[int], pasts: Sequence[Past], each: Sequence[Array], worth: NDArray[np.bool_]
) -> dict[int, Past]:
    """Pasts (k,) of the newest segments of the tracks `waiting`, by index. pasts, each (s, k, m): by track, before each
    segment and of it. Nothing of the newest segment of a waiting track has been compared: bearings of before it that
    came since are of what it was before. worth (k,): the components of which that is worth its time, of many tracks.
    """
    if not waiting:
        return {}
    until = [slice(None, -1) if i in waiting else slice(None) for i in range(len(pasts))]
    before = [past.of(rows) for past, rows in zip(pasts, until, strict=True)]
    of = [e[rows] for e, rows in zip(each, until, strict=True)]
    nobody, ratio = log_ratios([past.log for past in before], of)
    found = {}
    for i, part in zip(waiting, log_parts(ratio, waiting, worth), strict=True):
        log = nobody[i] + part
        column = ratio[i].argmax(axis=1)
        other = log_sum(before[i].without(column) + _anybody_but(column, of[i]), 0)
        found[i] = Past(log, column, np.minimum(other, log))
    return found


def any_or_none(each: Array) -> Array:
    """Log ratio (s, k) of each segment: any teammate, or none, to none. each (s, k, m)."""
    return np.asarray(np.logaddexp(0.0, log_sum(each, 2)))


def _anybody_but(column: int | NDArray[np.intp], each: Array) -> Array:
    """Log ratio (s, k) of each segment: any teammate but one, or none, to none. column: of the excluded one, or (k,) of
    them; each (s, k, m)."""
    left = each.copy()
    left[:, np.arange(each.shape[1]), column] = -np.inf
    return any_or_none(left)


def each_past_once(
    ratio: Array, none: Sequence[Array], pasts: Sequence[Past], each: Sequence[Array], since: Sequence[Array]
) -> Array:
    """Log ratios (n, k, m) of tracks and teammates, in which no teammate has two tracks at one time of the past.

    A track that was a teammate and is something else now leaves another track no more than the time since then: who
    claims more than that makes it pay for having been something else all the time. none (k,), each (s, k, m): by track,
    as of `log_ratios`; since (s,) s: when its segments begin, in order.
    """
    costs = [_cost_of_claims(past, e) for past, e in zip(pasts, each, strict=True)]
    claimed = sorted({c for cost in costs for c in cost})
    if not claimed:
        return ratio
    n, most = len(pasts), max(len(past.log) for past in pasts)
    # A handover is known no better than segments begin.
    begins = np.full((n, most), np.inf)
    claims = np.full((n, most, ratio.shape[1], len(claimed)), -np.inf)
    for h, (past, e) in enumerate(zip(pasts, each, strict=True)):
        begins[h, : len(e)] = since[h] + SEGMENT_LEAST_S
        claims[h, : len(e)] = past.log[:, :, None] + e[:, :, claimed] - none[h][:, None]
    for i, cost in enumerate(costs):
        later = np.searchsorted(since[i], begins, side="right")
        later[i] = len(since[i])
        for c, lost in cost.items():
            claims[..., claimed.index(c)] += lost[later]
    once = ratio.copy()
    once[:, :, claimed] = log_sum(claims, 1)
    return once


def _cost_of_claims(past: Past, each: Array) -> dict[int, Array]:
    """What a track pays if another claims a teammate that it was: by column, (s + 1, k) of a claim from each of its
    segments on; the last is 0, of one from after all of them. Without those that cost nothing."""
    found = {}
    for c in np.unique(past.column[past.column != COLUMN_OF_NOBODY]).tolist():
        now = _anybody_but(c, each)
        was, other = past.log + now, past.without(c) + now
        rows = np.arange(len(was))
        left = np.where(
            rows[:, None, None] < np.arange(len(was) + 1)[None, :, None], was[:, None], other[:, None]
        )
        lost = log_sum(left, 0) - log_sum(was, 0)
        if lost.min() < 0.0:
            found[c] = lost
    return found
