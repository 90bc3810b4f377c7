"""What is true in a simulated flight: where every drone is, how it is turned, what shape it has.

A `World` is a value: it has no clock and no state, so it can be asked about any time in any order. World time
starts at 0 s. The world frame is the team's NED frame with the ground at z = 0; bodies are FRD.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from swarmtrack.geometry.pose import Pose
from swarmtrack.lab.world.airframe import Airframe
from swarmtrack.lab.world.followed import FollowedDrone
from swarmtrack.lab.world.trajectory import Motion
from swarmtrack.messages import Array


class Drawn(Protocol):
    """A drone as a picture and a judge need it: they ask nothing else."""

    def pose(self, t: float) -> Pose:
        """world_from_body."""
        ...

    def position(self, t: float) -> Array:
        """(3,) m, NED."""
        ...


@runtime_checkable
class OwnDrone(Drawn, Protocol):
    """A drone that we fly ourselves, so that sensors of ours can measure how it moves."""

    @property
    def takes_off_s(self) -> float:
        """World time, s; −inf of a drone that was in the air before, inf of one that stays on the ground."""
        ...

    def flown_from(self, way_m: float) -> float:
        """World time from which on it has flown so far over ground since its take-off, s; −inf of a drone that was in
        the air before, inf before it is known."""
        ...

    def yaw(self, t: float) -> float:
        """Rad, from north, clockwise seen from above."""
        ...

    def motion(self, t: float) -> Motion:
        """Everything at once."""
        ...


def frame_numbers(drone_id: int, camera: int, index: int) -> tuple[int, ...]:
    """What `World.chance` is asked with for one frame: those of the first camera are as if it were the only one."""
    return (drone_id, index) if camera == 0 else (drone_id, index, camera)


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """Drones, by their ID, on their trajectories; `seed` decides everything that is left to chance."""

    seed: int
    drones: Mapping[int, Drawn]
    airframes: Mapping[int, Airframe] = field(default_factory=dict)

    def airframe(self, drone_id: int) -> Airframe:
        return self.airframes.get(drone_id, Airframe())

    def pose(self, drone_id: int, t: float) -> Pose:
        """world_from_body."""
        return self.drones[drone_id].pose(t)

    @property
    def told_until(self) -> float:
        """Up to which time all poses are known [s]: inf where we fly everybody ourselves."""
        told = (drone.newest for drone in self.drones.values() if isinstance(drone, FollowedDrone))
        return min(told, default=math.inf)

    @property
    def took_off_at(self) -> float:
        """When the first drone that others fly left the ground [s]; inf before it."""
        followed = (drone for drone in self.drones.values() if isinstance(drone, FollowedDrone))
        return min((drone.took_off_at for drone in followed), default=math.inf)

    def flown(self, drone_id: int) -> OwnDrone:
        """The drone, where it is one of ours to fly."""
        drone = self.drones[drone_id]
        if not isinstance(drone, OwnDrone):
            raise TypeError(f"drone {drone_id}: is flown by another simulator, which alone has its motion")
        return drone

    def body_rate(self, drone_id: int, t: float) -> Array:
        """(3,) rad/s in body axes."""
        return self.flown(drone_id).motion(t).body_rate

    def chance(self, purpose: str, *numbers: int) -> np.random.Generator:
        """The generator for one purpose and index. Equal arguments draw equal numbers, in whatever order asked."""
        return np.random.default_rng(
            [self.seed, zlib.crc32(purpose.encode()), *(number & 0xFFFFFFFF for number in numbers)]
        )
