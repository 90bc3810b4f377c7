"""Scores as log odds, and back. By NumPy alone: an agent does without SciPy."""

from __future__ import annotations

import numpy as np

from swarmtrack.messages import Array

LEAST_PROBABILITY = 1e-6  # a score is not nearer to 0 or 1 than that


def logit(score: Array | float) -> Array:
    clipped = np.clip(score, LEAST_PROBABILITY, 1.0 - LEAST_PROBABILITY)
    return np.asarray(np.log(clipped / (1.0 - clipped)))


def probability(log_odds: Array | float) -> Array:
    return np.asarray(1.0 / (1.0 + np.exp(-log_odds)))
