"""Where this drone itself is, over the last seconds, in the frame its team shares."""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from dataclasses import dataclass, replace

import numpy as np

from swarmtrack.geometry import rotation
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Array, EgoPose

SPEED_SIGMA = 1.0  # m/s: how fast a drone may be moving where no pose says so
RATE_SIGMA = 0.5  # rad/s, likewise
# m: of a drone that hovers where it was put, by an autopilot that knows no position
HELD_POSITION_SIGMA = 0.3
LEVEL_SIGMA = 0.05  # rad: how far a hovering drone tilts
# An estimator that finds its heading, or finds it anew, jumps; a drone turns no faster than this.
YAW_JUMP, FASTEST_YAW, YAW_STEP = 0.2, 4.0, 0.5  # rad, rad/s, s between two poses that are compared


@dataclass(frozen=True, slots=True, eq=False)
class TeamPose:
    """This drone in the team frame at t: position (3,) m, world_from_body (3, 3), one sigma per axis [m], [rad]."""

    t: float
    position: Array
    world_from_body: Array
    position_sigma: float
    attitude_sigma: float

    @property
    def pose(self) -> Pose:
        """world_from_body, without its errors."""
        return Pose(self.world_from_body, self.position)


class EgoHistory:
    """Ego poses of the autopilot, moved into the team frame by where the drone was told it starts.

    The autopilot's local frame begins wherever it was switched on. `start` says where that is for the team; both frames
    are level, so one yaw and one translation, taken from the first attitude and the first position, connect them. Until
    the autopilot knows a position, and without an autopilot, the drone is where it started. Without `start` the
    autopilot's own frame is the team's, moved to `origin` (3,) m. `absolute`: the poses are in the team frame already,
    also those after a reboot (GPS).

    Heading and place are continuous in the team frame: when the estimator's heading jumps (it aligns itself seconds
    after boot, and again in flight) the connection is turned along, and a rebooted autopilot, whose frame has a new
    origin, goes on from where the drone was last.
    """

    def __init__(
        self,
        *,
        start: Pose | None = None,
        origin: Array | None = None,
        absolute: bool = False,
        history_s: float = 2.0,
    ) -> None:
        self.start = start
        self.origin = np.zeros(3) if origin is None else origin
        self.absolute = absolute
        self.history_s = history_s
        self.out_of_order = 0
        self.without_position = 0
        self.heading_jumps = 0
        self._turn: Array | None = None
        self._shift: Array | None = None
        self._yaw: tuple[float, float] | None = None
        self._placed: TeamPose | None = None  # the last whose position the autopilot knew
        self._poses: list[TeamPose] = []

    @property
    def counters(self) -> dict[str, int]:
        """What it had to mend or refuse."""
        return {
            "poses_out_of_order": self.out_of_order,
            "poses_without_place": self.without_position,
            "heading_jumps": self.heading_jumps,
        }

    def append(self, pose: EgoPose) -> None:
        """Add a pose in the autopilot's frame. One that is older than the history is dropped and counted."""
        if self._poses and pose.t <= self._poses[-1].t - self.history_s:
            self.out_of_order += 1
            return
        turn = self._connect_heading(pose)
        position, sigma = self._place(pose)
        if position is None:
            self.without_position += 1
            return
        turned = turn @ pose.world_from_body
        placed = TeamPose(pose.t, position, turned, sigma, pose.attitude_sigma)
        insort(self._poses, placed, key=lambda kept: kept.t)
        if pose.position is not None:
            self._placed = placed
        if len(self._poses) > 2 and self._poses[1].t < pose.t - self.history_s:
            del self._poses[0]

    def restart(self) -> None:
        """The autopilot has rebooted: its frame may begin anywhere, the drone goes on from where it was."""
        if not self.absolute:
            self._shift = None

    def at(self, t: float) -> TeamPose | None:
        """The pose at t: interpolated, or the nearest one with the uncertainty that its age brings."""
        if not self._poses:
            if self.start is None:
                return None
            return TeamPose(t, self.start.position, self.start.rotation, HELD_POSITION_SIGMA, LEVEL_SIGMA)
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
        return TeamPose(
            t,
            before.position + fraction * (after.position - before.position),
            before.world_from_body @ rotation.exp(fraction * turn),
            max(before.position_sigma, after.position_sigma),
            max(before.attitude_sigma, after.attitude_sigma),
        )

    def _place(self, pose: EgoPose) -> tuple[Array | None, float]:
        """Position in the team frame and its sigma; None where nobody can tell."""
        start = None if self.start is None else self.start.position
        last = self._poses[-1].position if self._poses else start
        if pose.position is None:
            if self._placed is None:
                return last, HELD_POSITION_SIGMA
            # It was known and is no more: the drone may have moved on.
            age = abs(pose.t - self._placed.t)
            return last, math.hypot(self._placed.position_sigma, SPEED_SIGMA * age)
        assert self._turn is not None
        if self._shift is None:
            self._shift = self.origin if last is None else last - self._turn @ pose.position
        return self._turn @ pose.position + self._shift, pose.position_sigma

    def _connect_heading(self, pose: EgoPose) -> Array:
        """team_from_local (3, 3), made with the first pose and turned along with a heading that jumps."""
        yaw = _heading(pose.world_from_body)
        if self._turn is None:
            turn = 0.0 if self.start is None else _heading(self.start.rotation) - yaw
            self._turn = rotation.from_euler(0.0, 0.0, turn)
        elif self._yaw is not None and self.start is not None:
            t, before = self._yaw
            jump = math.remainder(yaw - before, 2.0 * math.pi)
            dt = abs(pose.t - t)
            if dt < YAW_STEP and abs(jump) > YAW_JUMP + FASTEST_YAW * dt:
                self._turn = self._turn @ rotation.from_euler(0.0, 0.0, -jump)
                self._shift = None  # the old one was made with the old heading
                self.heading_jumps += 1
        self._yaw = (pose.t, yaw)
        return self._turn


def _heading(world_from_body: Array) -> float:
    return math.atan2(world_from_body[1, 0], world_from_body[0, 0])
