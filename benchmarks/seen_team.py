"""The team of a scripted agent: teammates that speak over Zenoh, five of them where its detector finds five drones.

The agent is drone 1. The others stand behind it, and all look at it.
"""

from __future__ import annotations

from contextlib import AbstractAsyncContextManager

import numpy as np
import zenoh

from swarmtrack.benchmarks.lone_agent import CAMERA, HOVERS_AT
from swarmtrack.benchmarks.scripted_agent import PLACES, centres
from swarmtrack.benchmarks.scripted_team import ScriptedDrone, speaking
from swarmtrack.geometry.rotation import BODY_FROM_FORWARD_CAMERA
from swarmtrack.messages import Array

IN_VIEW = tuple(range(2, 2 + len(PLACES)))
"""The drones that are found, in the order of `PLACES`."""
STARTS = {
    "drone.start.position_m": HOVERS_AT.tolist(),
    "drone.start.position_sigma_m": 0.1,
    "team.airframe_span_m": 0.315,
}
"""Of the agent's config."""
# m: so far off boxes of such drones are as large as they are found; and how the others stand.
_DISTANCE_M, _BEHIND_M, _APART_M = 8.0, 12.0, 3.0


class SeenTeammate(ScriptedDrone):
    """Drone 1 is the agent itself, which speaks for itself."""

    def __init__(self, session: zenoh.Session, team: str, drone_id: int) -> None:
        super().__init__(session, team, drone_id, angle=0.0, radius=0.0)

    def position(self, t: float) -> Array:
        if self.drone_id == 1:
            return HOVERS_AT
        if self.drone_id not in IN_VIEW:
            row, column = divmod(self.drone_id - IN_VIEW[-1] - 1, 5)
            return HOVERS_AT - [_BEHIND_M + _APART_M * row, _APART_M * (column - 2), 0.0]
        u, v = centres(t, CAMERA.width, CAMERA.height)[IN_VIEW.index(self.drone_id)]
        ray = np.array([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1.0])
        return np.asarray(HOVERS_AT + BODY_FROM_FORWARD_CAMERA @ ray * (_DISTANCE_M / np.linalg.norm(ray)))

    def body(self, t: float) -> Array:
        north, east, _ = HOVERS_AT - self.position(t)
        c, s = (north, east) / np.hypot(north, east) if north or east else (1.0, 0.0)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def seen_team(team: str, n: int) -> AbstractAsyncContextManager[list[ScriptedDrone]]:
    """A team of n, the agent included, speaks meanwhile."""
    return speaking(team, n, lambda session, drone_id: SeenTeammate(session, team, drone_id), first=2)
