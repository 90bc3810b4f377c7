"""Named flights: who flies where, and which camera everyone carries. `SCENARIOS` is the list.

All begin with `HOVER` seconds of hovering in view of drone 1, so that the announced initial poses fit what it
sees; then they move, without end. Distances between drones stay above a metre.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import BODY_FROM_FORWARD_CAMERA
from swarmtrack.simulation.trajectory import (
    Facing,
    Handover,
    Hover,
    Lissajous,
    Path,
    SwingingYaw,
    Together,
    Trajectory,
    YawProfile,
    wander,
)
from swarmtrack.simulation.world import World

HOVER = 4.0  # s: an agent needs one to start, and one to see and name everyone
DEPARTURE = 5.0  # s: from hover into the flight proper
CAMERA = PinholeCamera(fx=430.0, fy=430.0, cx=319.5, cy=239.5, width=640, height=480)
BODY_FROM_CAMERA = Pose(BODY_FROM_FORWARD_CAMERA, np.array([0.1, 0.0, 0.0]))


@dataclass(frozen=True, slots=True, eq=False)
class Scenario:
    """A world, and the camera that every drone in it carries."""

    world: World
    camera: PinholeCamera = CAMERA
    body_from_camera: Pose = BODY_FROM_CAMERA

    @property
    def initial_poses(self) -> Mapping[int, Pose]:
        """world_from_body at world time 0, by drone."""
        return {drone_id: self.world.pose(drone_id, 0.0) for drone_id in self.world.drones}


@dataclass(frozen=True, slots=True, eq=False)
class _Plan:
    """Hover at `start`; then, unless `flight` is None, go over into it."""

    start: ArrayLike
    yaw: YawProfile
    flight: Path | None = None


def _scenario(seed: int, plans: Mapping[int, _Plan]) -> Scenario:
    drones = {}
    for drone_id, plan in plans.items():
        path: Path = Hover(plan.start)
        if plan.flight is not None:
            path = Handover(path, plan.flight, HOVER, DEPARTURE)
        drift = wander(World(seed, {}).chance("wander", drone_id))
        drones[drone_id] = Trajectory(Together((path, drift)), plan.yaw)
    return Scenario(World(seed, drones))


def hover_triangle(seed: int) -> Scenario:
    """Drones 1, 2, 3 in a triangle, facing its middle. Then 2 and 3 cross again and again in front of 1."""
    middle = (0.5, 0.0, -2.5)
    return _scenario(
        seed,
        {
            1: _Plan((-4.0, 0.0, -2.5), Facing(middle)),
            2: _Plan(
                (0.2, -1.4, -3.8),
                Facing((-6.0, 0.0, -2.5)),
                Lissajous((0.2, 0.0, -3.6), (0.4, 1.6, 0.5), (0.16, 0.08, 0.12), (0.0, -1.3, 0.5)),
            ),
            3: _Plan(
                (1.8, 1.6, -3.4),
                Facing((-6.0, 0.0, -2.5)),
                Lissajous((1.9, 0.0, -3.8), (0.4, 1.9, 0.6), (0.10, 0.07, 0.14), (1.0, 1.3, 0.0)),
            ),
        },
    )


def yawing_observer(seed: int) -> Scenario:
    """Drones 2 and 3 fly gently ahead of drone 1, which swings its view left and right at up to 2 rad/s."""
    return _scenario(
        seed,
        {
            1: _Plan((-4.0, 0.0, -2.5), SwingingYaw(0.0, peak_rate=2.0, period=1.4, start=HOVER)),
            2: _Plan(
                (0.2, -0.7, -3.8),
                Facing((-6.0, 0.0, -2.5)),
                Lissajous((0.2, -0.4, -3.7), (0.4, 0.5, 0.3), (0.11, 0.13, 0.17), (0.0, -1.2, 0.4)),
            ),
            3: _Plan(
                (1.8, 0.9, -3.4),
                Facing((-6.0, 0.0, -2.5)),
                Lissajous((1.8, 0.6, -3.6), (0.4, 0.6, 0.3), (0.12, 0.09, 0.15), (1.0, 1.2, 0.0)),
            ),
        },
    )


def crossing(seed: int) -> Scenario:
    """Drones 2, 3 and 4 cross in front of drone 1, each at its own distance."""
    return _scenario(
        seed,
        {
            1: _Plan((-4.0, 0.0, -2.5), SwingingYaw(0.0, peak_rate=0.3, period=6.0, start=HOVER)),
            **{
                drone_id: _Plan(
                    (north, side, -3.7 - 0.3 * math.copysign(1.0, side)),
                    Facing((-7.0, 0.0, -2.5)),
                    Lissajous(
                        (north, 0.0, -3.7),
                        (0.3, reach, 0.4),
                        (0.1, frequency, 0.13),
                        (0.0, math.asin(side / reach), drone_id),
                    ),
                )
                for drone_id, north, side, reach, frequency in (
                    (2, 0.0, -1.4, 1.6, 0.09),
                    (3, 1.4, 1.6, 1.9, 0.075),
                    (4, 2.8, -0.3, 2.6, 0.06),
                )
            },
        },
    )


SCENARIOS: dict[str, Callable[[int], Scenario]] = {
    "hover-triangle": hover_triangle,
    "yawing-observer": yawing_observer,
    "crossing": crossing,
}
