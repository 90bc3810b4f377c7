"""One-to-one matchings of tracks and teammates by each component, of log ratios however large."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.team.log_sums import log_sum
from swarmtrack.team.priors import LOG_RATIO_LEAST, LOG_RATIO_MOST, LOG_SLEEPS
from swarmtrack.tracking.listed_matchings import MatchedOfEach
from swarmtrack.tracking.marginals_of_each import matched_of_each


def match_all(log_ratio: Array) -> MatchedOfEach:
    """As `matched_of_each`, of log ratios (k, n, m) however large: of a track that is a teammate by more than
    LOG_RATIO_MOST, that it is none is as unlikely as exp(-LOG_RATIO_MOST)."""
    beyond = np.maximum(log_ratio.max(axis=2, initial=-np.inf) - LOG_RATIO_MOST, 0.0)
    found = matched_of_each(log_ratio - beyond[:, :, None])
    return MatchedOfEach(found.probability, found.log_total + beyond.sum(axis=1))


def log_total(log_ratio: Array) -> Array:
    """Log weight (k,) of all matchings, of log ratios (n, k, m)."""
    R = np.where(log_ratio <= LOG_RATIO_LEAST, -np.inf, log_ratio).swapaxes(0, 1)
    return match_all(R).log_total


def worth_matching(R: Array, log_w: Array) -> NDArray[np.intp]:
    """The components that may have weight, by bounds; R (k, n, m) log ratios, log_w (k,) log weights without them."""
    if not R.size:
        return np.flatnonzero(log_w > log_w.max() + LOG_SLEEPS)
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
