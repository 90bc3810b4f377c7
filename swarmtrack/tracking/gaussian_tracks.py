"""Common parts of filters that show each track as one Gaussian: birth, motion, and deletion of tracks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.tracking.base import Filter
from swarmtrack.tracking.motion_model import Course
from swarmtrack.tracking.parameters import CommonParameters
from swarmtrack.tracking.passage import Passage
from swarmtrack.tracking.population import Population
from swarmtrack.tracking.sensor_model import SensorModel
from swarmtrack.tracking.table import TrackIds, TrackTable
from swarmtrack.tracking.target_motion import TargetMotion


class GaussianTracks(Filter):
    """A `Filter` but for its `update`, which is where such filters differ."""

    def __init__(self, sensor: SensorModel, parameters: CommonParameters, ids: TrackIds) -> None:
        self._sensor = sensor
        self._motion = TargetMotion(sensor.camera, parameters)
        self._population = Population(sensor, parameters, ids)

    @property
    def table(self) -> TrackTable:
        return self._population.table

    def initiate(self, t: float, points: Array) -> list[int]:
        return self._population.initiate(t, points)

    def predict(self, dt: float, rotation: Array | None, rotation_variance: float) -> None:
        table = self.table
        table.mean, table.cov = self._motion.carried(table.mean, table.cov, dt, rotation, rotation_variance)
        self._population.survive(dt)

    def course(self) -> Course:
        return self._motion.course(self.table.mean, self.table.cov)

    def release(
        self, rows: NDArray[np.bool_], dt: float, rotation: Array | None, rotation_variance: float
    ) -> Passage:
        leaving = self._population.release(rows, dt)
        leaving.mean, leaving.cov = self._motion.handed_over(
            leaving.mean, leaving.cov, dt, rotation, rotation_variance
        )
        return Passage(leaving, None)
