"""One-to-one matchings of tracks and teammates by each component, of log ratios however large."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.team.log_sums import log_sum
from swarmtrack.team.priors import BELIEFS_LACK_PER_TRACK, LOG_RATIO_LEAST, LOG_RATIO_MOST, LOG_SLEEPS
from swarmtrack.tracking.beliefs_of_each import believed
from swarmtrack.tracking.listed_matchings import MatchedOfEach
from swarmtrack.tracking.marginals_of_each import matched_of_each
from swarmtrack.tracking.priors import MARGINALS_OF_EACH_MOST_ROWS


def match_all(log_ratio: Array) -> MatchedOfEach:
    """As `matched_of_each`, of log ratios (k, n, m) however large: of a track that is a teammate by more than
    LOG_RATIO_MOST, that it is none is as unlikely as exp(-LOG_RATIO_MOST)."""
    within, beyond = _within(log_ratio)
    found = matched_of_each(within)
    return MatchedOfEach(found.probability, found.log_total + beyond.sum(axis=1))


def log_total(log_ratio: Array) -> Array:
    """Log weight (k,) of all matchings, of log ratios (n, k, m)."""
    return match_all(_possible(log_ratio)).log_total


def log_parts(log_ratio: Array, of: Sequence[int], worth: NDArray[np.bool_]) -> list[Array]:
    """What of the log weight of all matchings is of each of some rows: (k,), beyond the rows that are not among them.
    log_ratio (n, k, m). In a small matching, of each what it adds to those that follow; in a wide one their parts of
    the beliefs, which are as good as in a matching for the components that are worth it (k,)."""
    left, found = list(range(len(log_ratio))), []
    if is_wide(len(log_ratio), log_ratio.shape[2]):
        part = _believed_parts(log_ratio, worth)
        others = _believed_parts(np.delete(log_ratio, of, axis=0), worth)
        # What the rows of before share with these was theirs.
        more = (part.sum(axis=1) - others.sum(axis=1) - part[:, of].sum(axis=1)) / len(of)
        return [part[:, i] + more for i in of]
    total = log_total(log_ratio)
    for i in of:
        left.remove(i)
        others = log_total(log_ratio[left])
        found.append(total - others)
        total = others
    return found


def is_wide(n: int, m: int) -> bool:
    """Whether a matching of n rows and m columns is worked out by beliefs."""
    return min(n, m) > MARGINALS_OF_EACH_MOST_ROWS


def _believed_parts(log_ratio: Array, worth: NDArray[np.bool_]) -> Array:
    """(k, n): the rows' parts of the log weight, of log ratios (n, k, m)."""
    within, beyond = _within(_possible(log_ratio))
    return believed(within, worth)[1] + beyond if within.size else beyond


def _possible(log_ratio: Array) -> Array:
    """(k, n, m), of (n, k, m): without what is next to impossible."""
    return np.where(log_ratio <= LOG_RATIO_LEAST, -np.inf, log_ratio).swapaxes(0, 1)


def _within(log_ratio: Array) -> tuple[Array, Array]:
    """Log ratios (k, n, m) that are nowhere above LOG_RATIO_MOST, and what was taken (k, n) from each row."""
    beyond = np.maximum(log_ratio.max(axis=2, initial=-np.inf) - LOG_RATIO_MOST, 0.0)
    return log_ratio - beyond[:, :, None], beyond


def worth_matching(R: Array, log_w: Array) -> NDArray[np.intp]:
    """The components that may have weight, by bounds; R (k, n, m) log ratios, log_w (k,) log weights without them. In
    wide matchings bounds are far apart, and beliefs tell, with what these may lack."""
    if not R.size:
        return np.flatnonzero(log_w > log_w.max() + LOG_SLEEPS)
    if is_wide(R.shape[1], R.shape[2]):
        within, beyond = _within(R)
        log_w = log_w + believed(within, np.zeros(len(R), bool))[0].log_total + beyond.sum(axis=1)
        lack = BELIEFS_LACK_PER_TRACK * min(R.shape[1:])
        return np.flatnonzero(log_w > log_w.max() + LOG_SLEEPS - lack)
    by_row = np.logaddexp(0.0, log_sum(R, 2)).sum(axis=1)
    by_column = np.logaddexp(0.0, log_sum(R, 1)).sum(axis=1)
    upper = log_w + np.minimum(by_row, by_column)
    left, lower, k = R.copy(), log_w.copy(), np.arange(len(R))
    for _ in range(min(R.shape[1:])):
        n, m = np.divmod(left.reshape(len(R), -1).argmax(axis=1), R.shape[2])
        lower += np.maximum(left[k, n, m], 0.0)
        left[k, n, :] = -np.inf
        left[k, :, m] = -np.inf
    return np.flatnonzero(upper > lower.max() + LOG_SLEEPS)
