"""What is true of a simulated drone, as an autopilot in a simulator tells it beside its own estimates."""

from __future__ import annotations

from typing import NamedTuple

from swarmtrack.geometry.geodesy import Geodetic, from_ned
from swarmtrack.lab.world.world import World
from swarmtrack.messages import Array


class TrueState(NamedTuple):
    """place: height above mean sea level; attitude world_from_body (3, 3); velocity (3,) m/s NED; gyro (3,) rad/s and
    accel (3,) m/s², what perfect sensors read, body FRD."""

    place: Geodetic
    attitude: Array
    velocity: Array
    gyro: Array
    accel: Array


class DroneTruth:
    """Of one drone of a world. epoch: world time 0 on the caller's clock; origin: the world's, on the Earth."""

    def __init__(self, world: World, drone_id: int, epoch: float, origin: Geodetic) -> None:
        self._drone = world.flown(drone_id)
        self._epoch = epoch
        self._origin = origin

    def at(self, t: float) -> TrueState:
        """At t on the caller's clock."""
        motion = self._drone.motion(t - self._epoch)
        return TrueState(
            place=from_ned(motion.position, self._origin),
            attitude=motion.attitude,
            velocity=motion.velocity,
            gyro=motion.body_rate,
            accel=motion.specific_force,
        )
