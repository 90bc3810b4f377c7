"""How well the own heading is known, and whether it has just jumped.

Theory of operation. An autopilot's heading is wrong by a bias that lasts, not by noise: on the ground by the compass
next to steel and motors, 1.5 to 2.6° on eleven boots of an ArduPilot. In flight the estimator compares the compass with
GPS and its own motion, and aligns the heading anew ("in-flight yaw alignment"), after which about 1° was left. So its
standard deviation is a state of knowledge, and `HeadingKnowledge` keeps it: one value on the ground and one in flight,
once it is aligned.

The alignment is a step: from one attitude to the next the heading changes by some degrees while the gyro says that the
drone did not turn. `HeadingSteps` looks for these. Where the heading was right already there is none, so `ALIGNED_S`
after take-off it counts as aligned without. Everything here is a function of stamps, so a replay finds the same.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from statistics import fmean
from typing import NamedTuple

import numpy as np

from swarmtrack.messages import Array, EgoPose, FlightState, HeadingNews
from swarmtrack.motion.gyro import GyroHistory, Orientation, Vector, rotation_between

# s after take-off: by then the autopilot has aligned its heading in flight.
ALIGNED_S = 20.0
# From where a drone was first, in m and in standard deviations of its position: that far off it flies, where its
# autopilot does not say so.
LEFT_M, LEFT_SIGMAS = 2.0, 5.0
# rad: a smaller step is no news, the compass alone brings as much.
STEP = math.radians(1.0)
# Attitudes before and after a step, whose means are compared.
MEAN_OF = 5
# s: an attitude may be so much older or younger than its stamp, by filters and by the clock.
LAG = 0.03
# rad/s: what a gyro may read at rest before its bias is known.
BIAS = 0.02
# Of the angle turned: the gyro's error of scale.
SCALE = 0.02
# Standard deviations of a mean's error that are no step.
SIGMAS = 4.0
# s between two attitudes, at most; a step within a longer gap cannot be told from a turn.
LONGEST_GAP = 0.5
# s between two pieces of news: each costs the team an announcement.
NEWS_EVERY = 10.0


@dataclass(frozen=True, slots=True)
class HeadingSigma:
    """Standard deviation of the autopilot's heading [rad]: on the ground, and in flight once it is aligned."""

    ground: float = math.radians(3.0)
    flight: float = math.radians(1.5)


class HeadingKnowledge:
    """Told whether the drone flies, it knows how well the heading is known."""

    def __init__(self, sigma: HeadingSigma) -> None:
        self._sigma = sigma
        self._since: float | None = None
        self._is_told = False
        self._first: Array | None = None
        self._rebooted_at = self._stepped_at = -math.inf

    def fly(self, state: FlightState) -> None:
        """The autopilot's own word."""
        self._is_told = True
        self._since = state.airborne_since

    def see(self, pose: EgoPose) -> None:
        """A pose of the autopilot. One that never says whether it flies does so when it has left its place."""
        if self._is_told or self._since is not None or pose.position is None:
            return
        far = max(LEFT_M, LEFT_SIGMAS * max(pose.position_sigma, pose.vertical_sigma or 0.0))
        if self._first is None:
            self._first = pose.position
        elif float(np.linalg.norm(pose.position - self._first)) > far:
            self._since = pose.t

    def step(self, t: float) -> None:
        """The heading has stepped by t [s]."""
        self._stepped_at = t

    def restart(self, t: float) -> None:
        """The autopilot has rebooted at t [s]: what was aligned is forgotten."""
        self._rebooted_at = t

    @property
    def is_on_ground(self) -> bool:
        """Whether its autopilot says that the drone does not fly."""
        return self._is_told and self._since is None

    def is_aligned(self, t: float) -> bool:
        """Whether the heading of t is as good as in flight."""
        if self._since is None:
            return False
        since = max(self._since, self._rebooted_at)
        return t - since >= ALIGNED_S or self._stepped_at > since

    def sigma(self, t: float) -> float:
        """Standard deviation of the heading at t [rad]."""
        return self._sigma.flight if self.is_aligned(t) else self._sigma.ground


class _BesideGyro(NamedTuple):
    """One attitude beside the gyro. excess [rad]: what the heading has turned beyond the gyro since the first one;
    rate rad/s in the camera's axes and turned [rad], in all, by the gyro."""

    t: float
    excess: float
    rate: Vector
    turned: float


class HeadingSteps:
    """Compares headings with a gyro in the camera's axes. body_from_camera (3, 3).

    A step is where the mean excess of `MEAN_OF` attitudes differs from that of as many before by more than `STEP`, than
    their scatter explains, and than the gyro may err in between: by a time offset while the rate changes, by its bias,
    and by its scale.
    """

    def __init__(self, gyro: GyroHistory, body_from_camera: Array) -> None:
        self.found = 0
        self._gyro = gyro
        self._body_from_camera = body_from_camera
        self._waiting: deque[tuple[float, Array]] = deque()
        self._last: tuple[float, Orientation, Array] | None = None
        self._compared: deque[_BesideGyro] = deque(maxlen=2 * MEAN_OF)

    @property
    def counters(self) -> dict[str, int]:
        """What it found."""
        return {"heading_steps": self.found}

    def restart(self) -> None:
        """The autopilot has rebooted: its heading begins anew."""
        self._waiting.clear()
        self._last = None
        self._compared.clear()

    def see(self, pose: EgoPose) -> list[float]:
        """An attitude, which waits until the gyro has reached it. Returns the steps that were found meanwhile [rad],
        clockwise from above."""
        if not self._waiting or pose.t > self._waiting[-1][0]:
            self._waiting.append((pose.t, pose.world_from_body))
        newest, steps = self._gyro.newest, []
        while self._waiting and newest is not None and self._waiting[0][0] <= newest:
            self._compare(*self._waiting.popleft())
            step = self._step()
            if step is not None:
                self._compared.clear()
                steps.append(step)
        while self._waiting and self._waiting[-1][0] - self._waiting[0][0] > LONGEST_GAP:
            # Without a gyro there is nothing to compare with.
            self._waiting.popleft()
        self.found += len(steps)
        return steps

    def _compare(self, t: float, world_from_body: Array) -> None:
        orientation, looks = self._gyro.orientation(t), world_from_body @ self._body_from_camera
        before, self._last = self._last, (t, orientation, looks)
        if before is None or not 0.0 < t - before[0] < LONGEST_GAP:
            self._compared.clear()
            return
        then, was, looked = before
        turn = rotation_between(orientation, was).matrix
        # Where the camera looks by the autopilot, beyond where by the gyro.
        beyond = looks @ (looked @ turn).T
        # Of so small a rotation, the part about the vertical.
        excess = 0.5 * (beyond.item(1, 0) - beyond.item(0, 1))
        (_, xy, xz), (yx, _, yz), (zx, zy, _) = turn.tolist()
        twice = 2.0 * (t - then)
        rate = (zy - yz) / twice, (xz - zx) / twice, (yx - xy) / twice
        sum_, turned = (
            (self._compared[-1].excess, self._compared[-1].turned) if self._compared else (0.0, 0.0)
        )
        self._compared.append(_BesideGyro(t, sum_ + excess, rate, turned + math.hypot(*rate) * (t - then)))

    def _step(self) -> float | None:
        if len(self._compared) < 2 * MEAN_OF:
            return None
        excess = [one.excess for one in self._compared]
        before, after = fmean(excess[:MEAN_OF]), fmean(excess[MEAN_OF:])
        step = after - before
        if abs(step) <= STEP:
            return None
        off = [e - before for e in excess[:MEAN_OF]] + [e - after for e in excess[MEAN_OF:]]
        scatter = math.hypot(*off) / math.sqrt(2 * MEAN_OF - 2)
        then, now = self._compared[MEAN_OF // 2], self._compared[MEAN_OF + MEAN_OF // 2]
        explained = SIGMAS * scatter * math.sqrt(2.0 / MEAN_OF)
        explained += LAG * math.dist(now.rate, then.rate)
        explained += BIAS * (now.t - then.t) + SCALE * (now.turned - then.turned)
        return step if abs(step) > explained else None


class HeadingBulletin:
    """What of the own heading is news to the team, at most every `NEWS_EVERY` seconds: what comes sooner waits."""

    def __init__(self) -> None:
        self._waiting: HeadingNews | None = None
        self._told_at = -math.inf
        self._was_aligned: bool | None = None

    def news(self, t: float, steps: list[float], *, is_aligned: bool) -> HeadingNews | None:
        """Of the pose of t [s]. steps: those that were just found [rad]; is_aligned: whether the heading is as good as
        in flight; a drone that is when it is first seen has said so with its first announcement."""
        for step in steps:
            self._waiting = HeadingNews(t, step)
        if is_aligned and self._was_aligned is False and self._waiting is None:
            self._waiting = HeadingNews(t, 0.0)
        self._was_aligned = is_aligned
        if self._waiting is None or t - self._told_at < NEWS_EVERY:
            return None
        self._told_at = t
        news, self._waiting = self._waiting, None
        return news
