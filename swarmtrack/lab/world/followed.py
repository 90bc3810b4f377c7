"""Drones that somebody else flies: where they truly are, as it is told, for whoever draws them or judges by them.

Truth comes in samples, late by some tens of milliseconds. Between two samples the position is linear and the attitude
turns on the geodesic; beyond the newest, and across a gap, nothing is known, and nothing is made up: `NotTold`.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from typing import NamedTuple

from swarmtrack.geometry import rotation
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Array

# s between two samples that may be joined. At 4 rad/s², the hardest that a multirotor yaws, a straight line between
# them is 5 mrad off (a dt² / 8): two pixels at a focal length of 430.
LONGEST_GAP = 0.1
TAKEN_OFF_M = 1.0  # above its first sample: more than an estimate of its height wanders on the ground
FOLLOWED_KEPT_S = 2.0  # s of samples that a drone is followed with, unless it is told to keep more


class NotTold(Exception):
    """Nobody told where a drone was at that time, or not yet."""


class ToldPose(NamedTuple):
    """One sample of truth. t: world time [s]; pose: world_from_body."""

    t: float
    pose: Pose


class FollowedDrone:
    """The poses of one drone, as told. keep_s: how much of the past can be asked for; inf: all of it."""

    def __init__(self, keep_s: float = FOLLOWED_KEPT_S) -> None:
        self._keep_s = keep_s
        # Cameras ask from threads of their own while a sample comes in: this list only grows at its end, and when it
        # is cut, the shorter one replaces it.
        self._samples: list[ToldPose] = []
        self._ground = math.nan
        self.took_off_at = math.inf
        """World time of the first sample that is `TAKEN_OFF_M` above the first one; inf before it."""

    @property
    def newest(self) -> float:
        """World time of the newest sample; −inf before the first."""
        return self._samples[-1].t if self._samples else -math.inf

    @property
    def samples(self) -> list[ToldPose]:
        """What is kept, in the order of time. Not to be written to."""
        return self._samples

    def add_pose(self, t: float, pose: Pose) -> bool:
        """Take in one sample; False where it is no newer than the last one, which then stands."""
        if not t > self.newest:
            return False
        down = float(pose.position[2])
        if not self._samples:
            self._ground = down
        elif math.isinf(self.took_off_at) and self._ground - down > TAKEN_OFF_M:
            self.took_off_at = t
        self._samples.append(ToldPose(t, pose))
        oldest = t - self._keep_s
        if self._samples[0].t < oldest - self._keep_s:
            self._samples = self._samples[bisect_left(self._samples, oldest, key=_time) :]
        return True

    def pose(self, t: float) -> Pose:
        """world_from_body. Raises NotTold."""
        before, after, share = self._around(t)
        if share == 0.0:
            return before.pose
        turn = rotation.log(before.pose.rotation.T @ after.pose.rotation)
        return Pose(
            before.pose.rotation @ rotation.exp(share * turn),
            before.pose.position + share * (after.pose.position - before.pose.position),
        )

    def position(self, t: float) -> Array:
        """(3,) m, NED. Raises NotTold."""
        before, after, share = self._around(t)
        return before.pose.position + share * (after.pose.position - before.pose.position)

    def _around(self, t: float) -> tuple[ToldPose, ToldPose, float]:
        """The samples on both sides of t, and how far t is from the first to the second, 0…1."""
        samples = self._samples
        k = bisect_right(samples, t, key=_time)
        if k > 0 and samples[k - 1].t == t:
            return samples[k - 1], samples[k - 1], 0.0
        if k == 0 or k == len(samples):
            raise NotTold(f"at {t:.3f} s, told is {_span(samples)}")
        before, after = samples[k - 1], samples[k]
        if after.t - before.t > LONGEST_GAP:
            raise NotTold(f"at {t:.3f} s, told are {before.t:.3f} s and then {after.t:.3f} s")
        return before, after, (t - before.t) / (after.t - before.t)


def _time(sample: ToldPose) -> float:
    return sample.t


def _span(samples: list[ToldPose]) -> str:
    return f"{samples[0].t:.3f} … {samples[-1].t:.3f} s" if samples else "nothing"
