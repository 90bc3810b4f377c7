"""How well the own heading is known, and whether it has just jumped.

Theory of operation. An autopilot's heading is wrong by a bias that lasts, not by noise: on the ground by the compass
next to steel and motors, 1.5 to 2.6° on eleven boots of an ArduPilot. In flight the estimator compares the compass
with GPS and its own motion, and aligns the heading again ("in-flight yaw alignment"), after which about 1° was left.
So its standard deviation is a state of knowledge, and `HeadingKnowledge` keeps it: one value on the ground and one in
flight, once it is aligned.

The alignment is a step: from one attitude to the next the heading changes by some degrees while the gyro says that the
drone did not turn. `HeadingSteps` looks for these. Where the heading was right already there is none, so
`HEADING_ALIGNED_AFTER_S` after take-off it counts as aligned without. Everything here is a function of stamps, so a
replay finds the same.

A step that the sigmas of ground and flight together do not explain is no alignment but a reset: an estimator that gave
its heading up. Either the heading before was wrong by the step or the one since is, and nothing here tells which. Two
values that are equally likely have half their distance as standard deviation, so that is what the heading is known to
until it is reset back, or the drone lands.
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
from swarmtrack.motion.priors import (
    HEADING_ALIGNED_AFTER_S,
    HEADING_ATTITUDE_LAG_S,
    HEADING_GYRO_BIAS_RAD_S,
    HEADING_GYRO_SCALE_ERROR,
    HEADING_LONGEST_GAP_S,
    HEADING_NEWS_PERIOD_S,
    HEADING_STEP_ATTITUDES,
    HEADING_STEP_RAD,
    HEADING_STEP_SIGMAS,
    TAKE_OFF_DISTANCE_M,
    TAKE_OFF_SIGMAS,
)


@dataclass(frozen=True, slots=True)
class HeadingSigma:
    """Standard deviation of the autopilot's heading [rad]: on the ground, and in flight once it is aligned."""

    ground: float = math.radians(3.0)
    flight: float = math.radians(1.5)


class HeadingKnowledge:
    """Quality of the own heading, given whether the drone flies."""

    def __init__(self, sigma: HeadingSigma) -> None:
        self._sigma = sigma
        self._since: float | None = None
        self._is_told = False
        self._first: Array | None = None
        self._rebooted_at = self._stepped_at = -math.inf
        self._reset = 0.0

    def fly(self, state: FlightState) -> None:
        """The autopilot's own word."""
        self._is_told = True
        self._since = state.airborne_since
        if self._since is None:
            self._reset = 0.0

    def add_pose(self, pose: EgoPose) -> None:
        """Add a pose of the autopilot. An autopilot without a flight state counts as flying once it has left its
        place.
        """
        if self._is_told or self._since is not None or pose.position is None:
            return
        far = max(TAKE_OFF_DISTANCE_M, TAKE_OFF_SIGMAS * max(pose.position_sigma, pose.vertical_sigma or 0.0))
        if self._first is None:
            self._first = pose.position
        elif float(np.linalg.norm(pose.position - self._first)) > far:
            self._since = pose.t

    def step(self, t: float, by: float) -> None:
        """The heading has stepped by t [s], by so much [rad]."""
        self._stepped_at = t
        if self._since is not None and (abs(by) > self._largest_alignment or self._reset):
            reset = math.remainder(self._reset + by, 2.0 * math.pi)
            self._reset = reset if abs(reset) > self._largest_alignment else 0.0

    def restart(self, t: float) -> None:
        """The autopilot has rebooted at t [s]: what was aligned is forgotten."""
        self._rebooted_at = t
        self._reset = 0.0

    @property
    def _largest_alignment(self) -> float:
        """Of a step that the sigmas explain [rad]."""
        return HEADING_STEP_SIGMAS * math.hypot(self._sigma.ground, self._sigma.flight)

    @property
    def doubt(self) -> float:
        """Standard deviation that resets in flight have left [rad]; 0 without."""
        return 0.5 * abs(self._reset)

    @property
    def is_on_ground(self) -> bool:
        """Whether the autopilot reports that the drone does not fly."""
        return self._is_told and self._since is None

    def is_aligned(self, t: float) -> bool:
        """Whether the heading at t is as good as in flight."""
        if self._since is None or self._reset:
            return False
        since = max(self._since, self._rebooted_at)
        return t - since >= HEADING_ALIGNED_AFTER_S or self._stepped_at > since

    def sigma(self, t: float) -> float:
        """Standard deviation of the heading at t [rad]."""
        return math.hypot(self._sigma.flight if self.is_aligned(t) else self._sigma.ground, self.doubt)


class _BesideGyro(NamedTuple):
    """One attitude beside the gyro. excess [rad]: what the heading has turned beyond the gyro since the first one;
    rate rad/s in the camera's axes and turned [rad], in all, by the gyro."""

    t: float
    excess: float
    rate: Vector
    turned: float


class HeadingSteps:
    """Compares headings with a gyro in the camera's axes. body_from_camera (3, 3).

    A step is where the mean excess of `HEADING_STEP_ATTITUDES` attitudes differs from that of as many before by more
    than `HEADING_STEP_RAD`, than their scatter explains, and than the gyro may err in between: by a time offset while
    the rate changes, by its bias, and by its scale.
    """

    def __init__(self, gyro: GyroHistory, body_from_camera: Array) -> None:
        self.found = 0
        self._gyro = gyro
        self._body_from_camera = body_from_camera
        self._waiting: deque[tuple[float, Array]] = deque()
        self._last: tuple[float, Orientation, Array] | None = None
        self._compared: deque[_BesideGyro] = deque(maxlen=2 * HEADING_STEP_ATTITUDES)

    @property
    def counters(self) -> dict[str, int]:
        """Detected steps."""
        return {"heading_steps": self.found}

    def restart(self) -> None:
        """The autopilot has rebooted: its heading starts again."""
        self._waiting.clear()
        self._last = None
        self._compared.clear()

    def add_pose(self, pose: EgoPose) -> list[float]:
        """Add an attitude, which waits until the gyro has reached it. Returns the steps found meanwhile [rad],
        clockwise from above.
        """
        if not self._waiting or pose.t > self._waiting[-1][0]:
            self._waiting.append((pose.t, pose.world_from_body))
        newest, steps = self._gyro.newest, []
        while self._waiting and newest is not None and self._waiting[0][0] <= newest:
            self._compare(*self._waiting.popleft())
            step = self._step()
            if step is not None:
                self._compared.clear()
                steps.append(step)
        while self._waiting and self._waiting[-1][0] - self._waiting[0][0] > HEADING_LONGEST_GAP_S:
            # Without a gyro there is nothing to compare with.
            self._waiting.popleft()
        self.found += len(steps)
        return steps

    def _compare(self, t: float, world_from_body: Array) -> None:
        orientation, looks = self._gyro.orientation(t), world_from_body @ self._body_from_camera
        before, self._last = self._last, (t, orientation, looks)
        if before is None or not 0.0 < t - before[0] < HEADING_LONGEST_GAP_S:
            self._compared.clear()
            return
        then, was, looked = before
        turn = rotation_between(orientation, was).matrix
        # Where the camera looks by the autopilot, beyond where by the gyro.
        beyond = looks @ (looked @ turn).T
        # The part of it about the vertical.
        excess = math.atan2(beyond.item(1, 0) - beyond.item(0, 1), beyond.item(0, 0) + beyond.item(1, 1))
        (_, xy, xz), (yx, _, yz), (zx, zy, _) = turn.tolist()
        twice = 2.0 * (t - then)
        rate = (zy - yz) / twice, (xz - zx) / twice, (yx - xy) / twice
        sum_, turned = (
            (self._compared[-1].excess, self._compared[-1].turned) if self._compared else (0.0, 0.0)
        )
        self._compared.append(_BesideGyro(t, sum_ + excess, rate, turned + math.hypot(*rate) * (t - then)))

    def _step(self) -> float | None:
        if len(self._compared) < 2 * HEADING_STEP_ATTITUDES:
            return None
        excess = [one.excess for one in self._compared]
        before, after = fmean(excess[:HEADING_STEP_ATTITUDES]), fmean(excess[HEADING_STEP_ATTITUDES:])
        step = after - before
        if abs(step) <= HEADING_STEP_RAD:
            return None
        off = [e - before for e in excess[:HEADING_STEP_ATTITUDES]] + [
            e - after for e in excess[HEADING_STEP_ATTITUDES:]
        ]
        scatter = math.hypot(*off) / math.sqrt(2 * HEADING_STEP_ATTITUDES - 2)
        then, now = (
            self._compared[HEADING_STEP_ATTITUDES // 2],
            self._compared[HEADING_STEP_ATTITUDES + HEADING_STEP_ATTITUDES // 2],
        )
        explained = HEADING_STEP_SIGMAS * scatter * math.sqrt(2.0 / HEADING_STEP_ATTITUDES)
        explained += HEADING_ATTITUDE_LAG_S * math.dist(now.rate, then.rate)
        explained += HEADING_GYRO_BIAS_RAD_S * (now.t - then.t) + HEADING_GYRO_SCALE_ERROR * (
            now.turned - then.turned
        )
        return step if abs(step) > explained else None


class HeadingBulletin:
    """What of the own heading is news to the team, at most every `HEADING_NEWS_PERIOD_S` seconds: what comes sooner
    waits."""

    def __init__(self) -> None:
        self._waiting: HeadingNews | None = None
        self._told_at = -math.inf
        self._was_aligned: bool | None = None

    def news(
        self, t: float, steps: list[float], *, is_aligned: bool, doubt: float = 0.0
    ) -> HeadingNews | None:
        """News in the pose of t [s]. steps: those that were just found [rad]; is_aligned: whether the heading is as
        good as in flight; a drone that is when it is first seen has said so with its first announcement; doubt [rad]:
        what resets have left.
        """
        for step in steps:
            self._waiting = HeadingNews(t, step, doubt)
        if is_aligned and self._was_aligned is False and self._waiting is None:
            self._waiting = HeadingNews(t, 0.0)
        self._was_aligned = is_aligned
        if self._waiting is None or t - self._told_at < HEADING_NEWS_PERIOD_S:
            return None
        self._told_at = t
        news, self._waiting = self._waiting, None
        return news
