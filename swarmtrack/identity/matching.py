"""Which track is which announced drone: the paper's Algorithm 1, and ours."""

from __future__ import annotations

import math

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.identity.reprojection import Reprojections
from swarmtrack.messages import Array
from swarmtrack.tracking.association import gate_threshold, most_likely_matching
from swarmtrack.tracking.gaussian import innovations

Assignment = dict[int, tuple[int, float]]
"""Row of the track -> (drone id, probability)."""

P_EXPLAINED = 0.9  # prior: that a confirmed track is one of the announced drones in view
GATE_PROBABILITY = 0.999


def nearest(mean: Array, projected: Reprojections) -> Assignment:
    """Algorithm 1 as printed: every track takes the ID of the nearest projection, twice the same if so it falls.

    mean (n, 4) of the tracks. No gate, no "unknown": the stated probability is 1.
    """
    if not projected.drone_id:
        return {}
    distance = np.linalg.norm(mean[:, None, ::2] - projected.pixel[None], axis=2)
    return {row: (projected.drone_id[column], 1.0) for row, column in enumerate(distance.argmin(axis=1))}


def gated_one_to_one(
    mean: Array, cov: Array, projected: Reprojections, *, camera: PinholeCamera, probability: float
) -> Assignment:
    """The most likely one-to-one matching of tracks and announced drones, where nothing else is nearly as likely.

    mean (n, 4), cov (n, 4, 4) of the tracks. A pair is stated when the best matching that has it is p / (1 − p) times
    as likely as the best one that has not; a track may also be none of the announced, uniformly over the image.
    """
    none_density = (1.0 - P_EXPLAINED) / (camera.width * camera.height)
    still = innovations(mean, cov, projected.pixel, projected.cov_still)
    flown = innovations(mean, cov, projected.pixel, projected.cov_flown)
    with np.errstate(divide="ignore"):  # of a pose that is no second old nothing has flown off
        log_density = np.logaddexp(
            np.log(projected.p_still) + still.log_density, np.log(1.0 - projected.p_still) + flown.log_density
        )
    log_ratio = log_density + math.log(P_EXPLAINED / none_density)
    log_ratio[flown.distance > gate_threshold(GATE_PROBABILITY)] = -np.inf
    rows, columns = most_likely_matching(log_ratio)
    best = log_ratio[rows, columns].sum()
    stated: Assignment = {}
    for row, column in zip(rows, columns, strict=True):
        without = log_ratio.copy()
        without[row, column] = -np.inf
        margin = best - without[most_likely_matching(without)].sum()
        p = 1.0 / (1.0 + math.exp(-margin))
        if p >= probability:
            stated[int(row)] = (projected.drone_id[column], p)
    return stated
