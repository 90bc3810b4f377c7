"""Scores as probabilities: Platt's sigmoid, fitted to detections of which one knows whether they were right."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit, logit

from swarmtrack.lab.score.detector_score import Matches
from swarmtrack.messages import Array

LEAST_SCORE_PROBABILITY = 1e-6
BINS = 10


class Platt(NamedTuple):
    """Probability = σ(slope · logit(score) + offset)."""

    slope: float
    offset: float

    def __call__(self, score: Array) -> Array:
        return np.asarray(
            expit(
                self.slope * logit(np.clip(score, LEAST_SCORE_PROBABILITY, 1 - LEAST_SCORE_PROBABILITY))
                + self.offset
            )
        )


def fit(matches: Matches) -> Platt:
    """By maximum likelihood, with Platt's targets, which keep the slope finite (Platt 1999, section 2.2).

    A score says the more the higher it is: the slope is positive. Fewer than ten right or ten wrong detections say
    nothing, and leave the scores as they are.
    """
    right, wrong = int(matches.hit.sum()), int((~matches.hit).sum())
    if min(right, wrong) < 10:
        return Platt(1.0, 0.0)
    x = logit(np.clip(matches.score, LEAST_SCORE_PROBABILITY, 1 - LEAST_SCORE_PROBABILITY))
    target = np.where(matches.hit, (right + 1) / (right + 2), 1 / (wrong + 2))

    def surprise(p: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        z = p[0] * x + p[1]
        slope = expit(z) - target
        return float((np.logaddexp(0.0, z) - target * z).sum()), np.array([slope @ x, slope.sum()])

    found = minimize(surprise, np.array([1.0, 0.0]), jac=True, bounds=[(1e-3, 1e3), (None, None)])
    return Platt(float(found.x[0]), float(found.x[1]))


def expected_error(probability: Array, right: NDArray[np.bool_]) -> float:
    """Mean distance between what was said and how often it was so, over `BINS` bins of equally many (ECE)."""
    if not len(probability):
        return 0.0
    bins = np.array_split(np.argsort(probability, kind="stable"), BINS)
    return float(
        sum(abs(float((probability[b] - right[b]).sum())) for b in bins if len(b)) / len(probability)
    )
