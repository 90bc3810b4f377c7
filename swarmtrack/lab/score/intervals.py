"""How sure a Monte Carlo experiment is of its figures."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from swarmtrack.messages import Array

NORMAL_975 = 1.959963984540054  # the standard normal's 97.5 % quantile


class Interval(NamedTuple):
    """An estimate and its 95 % confidence interval."""

    value: float
    low: float
    high: float


def mean_interval(samples: Array) -> Interval:
    """Of the mean of independent samples (n,), by the normal approximation; infinitely wide for fewer than two."""
    mean = float(np.mean(samples))
    if len(samples) < 2:
        return Interval(mean, -math.inf, math.inf)
    half = NORMAL_975 * float(np.std(samples, ddof=1)) / math.sqrt(len(samples))
    return Interval(mean, mean - half, mean + half)


def bootstrap_interval(
    samples: Array,
    statistic: Callable[[Array], float],
    rng: np.random.Generator,
    resamples: int = 2000,
) -> Interval:
    """Of any statistic of independent samples (n, …), a row a run: percentiles over runs drawn with replacement.

    What was measured in the same run stays together, so a ratio of two conditions keeps what they share (equal seeds).
    Efron & Tibshirani, "An Introduction to the Bootstrap" (1993), chapter 13.
    """
    n = len(samples)
    drawn = [statistic(samples[rng.integers(n, size=n)]) for _ in range(resamples)]
    low, high = np.percentile(drawn, [2.5, 97.5])
    return Interval(float(statistic(samples)), float(low), float(high))


def fraction_interval(hits: Array, trials: Array, least_effect: float = 1.0) -> Interval:
    """Of the share of trials that are hits, in independent groups (n,) whose trials may hang together.

    Wilson's interval for as many independent trials as bring the same variance: theirs over the design effect, the
    variance between groups over the binomial one (Kish, "Survey Sampling" (1965), section 8.2). least_effect: the
    design effect is not believed to be smaller; where nothing was hit it is all that is known.
    """
    total = float(trials.sum())
    if total == 0.0:
        return Interval(math.nan, 0.0, 1.0)
    p = float(hits.sum()) / total
    effect = least_effect
    if 0.0 < p < 1.0 and len(hits) > 1:
        between = len(hits) / (len(hits) - 1) * float(((hits - p * trials) ** 2).sum()) / total**2
        effect = max(effect, between / (p * (1.0 - p) / total))
    n, z2 = total / effect, NORMAL_975**2
    centre = (p + z2 / (2.0 * n)) / (1.0 + z2 / n)
    half = NORMAL_975 / (1.0 + z2 / n) * math.sqrt(p * (1.0 - p) / n + z2 / (4.0 * n**2))
    return Interval(p, max(centre - half, 0.0), min(centre + half, 1.0))
