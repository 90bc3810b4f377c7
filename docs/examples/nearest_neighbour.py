"""The smallest tracker: each track, in turn, takes the likeliest detection within its gate (docs/add_a_tracker.md).

`python nearest_neighbour.py replay flight --tracker nearest` replays a recorded flight with it.
"""

import sys
from dataclasses import dataclass

import numpy as np

from swarmtrack.agents.main import main
from swarmtrack.tracking import TRACKERS, lifecycle
from swarmtrack.tracking.base import Explained
from swarmtrack.tracking.gaussian import update
from swarmtrack.tracking.gaussian_tracks import GaussianTracks
from swarmtrack.tracking.noise import pairs_of
from swarmtrack.tracking.parameters import CommonParameters


@dataclass(frozen=True, slots=True, kw_only=True)
class NearestParameters(CommonParameters):
    """Keys of [tracker] in a config. Own ones would be fields here, with a docstring below each."""


class NearestNeighbour(GaussianTracks):
    Parameters = NearestParameters

    def update(self, t, measured):
        table, population, sensor = self.table, self._population, self._sensor
        population.drop(t)
        visibility = sensor.visibility(table.mean, table.cov)
        boxes = sensor.box_likelihoods(table.size, measured)
        log_ratio = sensor.likelihoods(table.mean, table.cov, boxes, measured).log_ratio
        i, j = nearest(log_ratio)
        pairs = pairs_of(table.id, (table.mean, table.cov), (measured.z, measured.R), (i, j))
        evidence = 1.0 - visibility.p_detection
        evidence[i] += visibility.p_detection[i] * np.exp(log_ratio[i, j])
        table.existence = lifecycle.reweigh(table.existence, evidence)
        table.mean[i], table.cov[i] = update(table.mean[i], table.cov[i], measured.z[j], measured.R[j])
        population.learn_looks(t, i, measured.select(j))
        population.update_status(t, np.isin(np.arange(len(table)), i), visibility)
        clutter = len(measured.z) - float(table.existence[i].sum())
        population.drop(t)
        population.give_birth(t, measured.select(~np.isin(np.arange(len(measured.z)), j)))
        return Explained(pairs, clutter)


def nearest(log_ratio):
    left, pairs = log_ratio.copy(), []
    for row in range(len(left) if left.size else 0):
        if np.isfinite(left[row, best := left[row].argmax()]):
            pairs.append((row, best))
            left[:, best] = -np.inf
    return np.array(pairs, int).reshape(-1, 2).T


TRACKERS["nearest"] = NearestNeighbour
if __name__ == "__main__":
    sys.exit(main())
