"""What is true in a simulated flight: where every drone is, how it is turned, what shape it has.

A `World` is a value: it has no clock and no state, so it can be asked about any time in any order. World time
starts at 0 s. The world frame is the team's NED frame with the ground at z = 0; bodies are FRD.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Array
from swarmtrack.simulation.airframe import Airframe
from swarmtrack.simulation.trajectory import Trajectory


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """Drones, by their ID, on their trajectories; `seed` decides everything that is left to chance."""

    seed: int
    drones: Mapping[int, Trajectory]
    airframes: Mapping[int, Airframe] = field(default_factory=dict)

    def airframe(self, drone_id: int) -> Airframe:
        return self.airframes.get(drone_id, Airframe())

    def pose(self, drone_id: int, t: float) -> Pose:
        """world_from_body."""
        return self.drones[drone_id].pose(t)

    def body_rate(self, drone_id: int, t: float) -> Array:
        """(3,) rad/s in body axes."""
        return self.drones[drone_id].body_rate(t)

    def specific_force(self, drone_id: int, t: float) -> Array:
        """(3,) m/s² in body axes: (0, 0, -9.81) in hover."""
        return self.drones[drone_id].specific_force(t)

    def chance(self, purpose: str, *numbers: int) -> np.random.Generator:
        """The generator for one purpose and index. Equal arguments draw equal numbers, in whatever order asked."""
        return np.random.default_rng(
            [self.seed, zlib.crc32(purpose.encode()), *(number & 0xFFFFFFFF for number in numbers)]
        )
