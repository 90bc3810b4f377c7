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
    ratio: Array, none: Sequence[Array], pasts: Sequence[Past], each: Sequence[Array]
) -> Array:
    """Log ratios (n, k, m) of tracks and teammates, in which no teammate has two tracks at one time of the past.

    A track that was a teammate and is something else now leaves another track no more than the time since then; and if
    the other was that teammate all the time, the one was something else. none (k,), each (s, k, m): by track, as of
    `log_ratios`.
    """
    more = np.zeros_like(ratio)
    for i, (past, e) in enumerate(zip(pasts, each, strict=True)):
        for c in np.unique(past.column[past.column != COLUMN_OF_NOBODY]).tolist():
            now = _anybody_but(c, e)
            lost = log_sum(past.without(c) + now, 0)
            lost -= log_sum(past.log + now, 0)
            more[:, :, c] += lost
            more[i, :, c] -= lost
    once = ratio.copy()
    for h, c in np.argwhere(more.min(axis=1, initial=0.0) < 0.0).tolist():
        claims = pasts[h].log + each[h][:, :, c] - none[h]
        late = log_sum(claims[1:], 0)
        once[h, :, c] = np.logaddexp(claims[0] + more[h, :, c], late)
    return once
