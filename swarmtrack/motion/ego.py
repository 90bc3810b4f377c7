"""Where this drone itself is, over the last seconds, in the frame its team shares."""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from dataclasses import replace

import numpy as np

from swarmtrack.geometry import rotation
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Array, EgoPose

SPEED_SIGMA = 1.0  # m/s: how fast a drone may be moving where no pose says so
RATE_SIGMA = 0.5  # rad/s, likewise


class EgoHistory:
    """Ego poses of the autopilot, moved into the team frame by where the drone was told it starts.

    The autopilot's local frame begins wherever it was switched on. `start` says where that is for the team; both
    frames are level, so one yaw and one translation, taken from the first pose, connect them. Without an autopilot the
    drone stays at `start`; without `start` the autopilot's own frame is the team's, moved to `origin` (3,) m.
    """

    def __init__(
        self, *, start: Pose | None = None, origin: Array | None = None, history_s: float = 2.0
    ) -> None:
        self.start = start
        self.origin = np.zeros(3) if origin is None else origin
        self.history_s = history_s
        self.out_of_order = 0
        self._team_from_local: Pose | None = None
        self._poses: list[EgoPose] = []

    def append(self, pose: EgoPose) -> None:
        """Add a pose in the autopilot's frame. One that is older than the history is dropped and counted."""
        if self._poses and pose.t <= self._poses[-1].t - self.history_s:
            self.out_of_order += 1
            return
        if self._team_from_local is None:
            self._team_from_local = self._align(pose)
        moved = self._team_from_local @ Pose(pose.world_from_body, pose.position)
        insort(
            self._poses,
            replace(pose, position=moved.position, world_from_body=moved.rotation),
            key=lambda kept: kept.t,
        )
        if len(self._poses) > 2 and self._poses[1].t < pose.t - self.history_s:
            del self._poses[0]

    def at(self, t: float) -> EgoPose | None:
        """The pose at t: interpolated, or the nearest one with the uncertainty that its age brings."""
        if not self._poses:
            return None if self.start is None else EgoPose(t, self.start.position, self.start.rotation)
        k = bisect_left(self._poses, t, key=lambda kept: kept.t)
        if k in (0, len(self._poses)):
            nearest = self._poses[min(k, len(self._poses) - 1)]
            age = abs(t - nearest.t)
            return replace(
                nearest,
                t=t,
                position_sigma=math.hypot(nearest.position_sigma, SPEED_SIGMA * age),
                attitude_sigma=math.hypot(nearest.attitude_sigma, RATE_SIGMA * age),
            )
        before, after = self._poses[k - 1], self._poses[k]
        fraction = (t - before.t) / (after.t - before.t) if after.t > before.t else 1.0
        turn = rotation.log(before.world_from_body.T @ after.world_from_body)
        return EgoPose(
            t,
            before.position + fraction * (after.position - before.position),
            before.world_from_body @ rotation.exp(fraction * turn),
            max(before.position_sigma, after.position_sigma),
            max(before.attitude_sigma, after.attitude_sigma),
        )

    def _align(self, first: EgoPose) -> Pose:
        if self.start is None:
            return Pose(np.eye(3), self.origin)
        turn = _heading(self.start.rotation) - _heading(first.world_from_body)
        team_from_local = rotation.from_euler(0.0, 0.0, turn)
        return Pose(team_from_local, self.start.position - team_from_local @ first.position)


def _heading(world_from_body: Array) -> float:
    return math.atan2(world_from_body[1, 0], world_from_body[0, 0])
