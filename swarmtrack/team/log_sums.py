"""Sums of what is known by its logarithm."""

from __future__ import annotations

import numpy as np

from swarmtrack.messages import Array

_LEAST = np.finfo(float).min


def log_sum(log: Array, axis: int) -> Array:
    """As `np.logaddexp.reduce`, in a third of its time: −inf where there is nothing, or nothing but −inf."""
    top = log.max(axis=axis, keepdims=True, initial=_LEAST)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(np.exp(log - top).sum(axis=axis)) + top.squeeze(axis))
