"""A drone that flies where it is told, while it flies: its past is remembered, its future is nobody's yet.

Others follow a path that is known beforehand. This one stands on the ground until it is told to fly; then the measured
response of an autopilot (`lab.world.response`) is integrated as far as somebody asks, so that pictures, sensors and
truth show where it really is. It sways as all do that hold their place in the air.
"""

from __future__ import annotations

import math
import threading
from bisect import bisect_right
from collections.abc import Callable

import numpy as np

from swarmtrack.geometry.pose import Pose
from swarmtrack.lab.world.response import (
    NO_MOTION,
    RESPONSE_STEP_S,
    Response,
    SetPoint,
    Triple,
    advance,
    at_rest,
)
from swarmtrack.lab.world.response import Flown as FlownState
from swarmtrack.lab.world.trajectory import GRAVITY, Motion, Path, attitude_and_rate
from swarmtrack.messages import Array
from swarmtrack.motion.smooth import scaled, smooth_step

GUIDED_REMEMBERED_S = 20.0  # s: frames, filters and truth ask for tenths of a second
SWAYS_FROM_M = 1.0  # m above the ground: there it sways in full, on the ground not at all
ON_THE_GROUND = 1e-6  # m
REMEMBERED_WAY_M = 100.0  # of the first flight


class GuidedDrone:
    """An entry of `World.drones`. All times are world times [s]; positions NED, m.

    start: where it stands on the ground; yaw [rad]; response: of its autopilot; sway: a path about zero. hovers: it has
    always hovered there instead, and the ground is at 0.
    heading_error: by how much its autopilot is off in its heading, clockwise [rad], at a world time.
    Safe to ask from several threads: pictures are drawn beside the loop that flies.
    """

    def __init__(
        self, start: Triple, yaw: float, response: Response, sway: Path, *, hovers: bool = False
    ) -> None:
        self.start = start
        self.takes_off_s = -math.inf if hovers else math.inf
        """World time of its first take-off."""
        self.left_s = 0.0 if hovers else -math.inf
        """World time of its last one."""
        self.touched_s = -math.inf
        """World time of its last touch-down."""
        self.heading_error: Callable[[float], float] = lambda t: 0.0
        self.against_wind: Triple = NO_MOTION
        """m/s²: the thrust that a steady wind's drag takes in the air. The drone leans into the wind by it."""
        self._response = response
        self._sway = sway
        self._told = SetPoint(math.inf)
        self._states = [at_rest(-math.inf, start, yaw), at_rest(0.0, start, yaw)]
        self.ground = 0.0 if hovers else start[2]
        """m, NED."""
        self._way_m = 0.0
        self._metres: list[float] = []
        """World time of each metre over ground since its first take-off."""
        self._lock = threading.Lock()

    @property
    def airborne(self) -> bool:
        return self.left_s > self.touched_s

    def flown_from(self, way_m: float) -> float:
        """See `OwnDrone`; to whole metres, `REMEMBERED_WAY_M` at most."""
        if math.isinf(self.takes_off_s):
            return self.takes_off_s
        metres = math.ceil(way_m)
        return self._metres[metres - 1] if len(self._metres) >= metres else math.inf

    def take_off(self, t: float, told: SetPoint) -> None:
        """At t leave the ground, towards a set point above it."""
        with self._lock:
            self.left_s = self._newest_at(t).t
            self.takes_off_s = min(self.takes_off_s, self.left_s)
            self._told = told

    def command(self, t: float, told: SetPoint) -> None:
        """From t on go towards another set point. On the ground it changes nothing."""
        with self._lock:
            self._newest_at(t)
            self._told = told

    def turn(self, t: float, heading: float) -> None:
        """From t on look that way [rad], whatever else it was told."""
        self.command(t, self._told._replace(yaw=heading, yaw_rate=None))

    def state(self, t: float) -> FlownState:
        """At t, without its sway; of longer ago than is remembered, the oldest."""
        with self._lock:
            if t >= self._states[-1].t:
                self._newest_at(t)
            after = bisect_right(self._states, t, key=lambda state: state.t)
            return _carried_on(self._states[max(after - 1, 0)], t)

    def pose(self, t: float) -> Pose:
        """world_from_body."""
        motion = self.motion(t)
        return Pose(motion.attitude, motion.position)

    def position(self, t: float) -> Array:
        """(3,) m, NED."""
        state = self.state(t)
        share = self._height_share(state)[0]
        return np.asarray(share * self._sway.derivatives(state.t)[0] + state.position)

    def yaw(self, t: float) -> float:
        """Rad, from north, clockwise seen from above."""
        return self.state(t).yaw

    def motion(self, t: float) -> Motion:
        """Everything at once."""
        state = self.state(t)
        grown = self._height_share(state)
        sway = scaled(grown, self._sway.derivatives(state.t))
        position, velocity, acceleration = (
            np.add(now, extra)
            for now, extra in zip((state.position, state.velocity, state.acceleration), sway, strict=False)
        )
        # It tilts for its thrust and for its sway; what the drag takes needs no tilt.
        lean = np.multiply.outer(grown[:2], self.against_wind)
        thrust, jerk = np.add(state.thrust, lean[0]), np.add(state.thrust_jerk, lean[1])
        attitude, rate = attitude_and_rate(thrust + sway[2], jerk + sway[3], state.yaw, state.yaw_rate)
        return Motion(position, velocity, attitude, rate, attitude.T @ (acceleration - GRAVITY))

    def _height_share(self, state: FlownState) -> Array:
        """The share of sway and wind that it has, which grows smoothly with the height, and its derivatives (4,)."""
        heights = [
            (self.ground - state.position[2]) / SWAYS_FROM_M,
            *(-rate[2] / SWAYS_FROM_M for rate in (state.velocity, state.acceleration, state.jerk)),
        ]
        share, s1, s2, s3 = smooth_step(heights[0]).tolist()
        _, h1, h2, h3 = heights
        # Faà di Bruno: the share as a function of the time.
        return np.array((share, s1 * h1, s2 * h1**2 + s1 * h2, s3 * h1**3 + 3.0 * s2 * h1 * h2 + s1 * h3))

    def _newest_at(self, t: float) -> FlownState:
        """Fly on to t, unless it has been there; the newest state."""
        state = self._states[-1]
        if not self.airborne:
            if t > state.t:
                state = at_rest(t, state.position, state.yaw)
                self._states.append(state)
        else:
            while state.t < t and self.airborne:
                off = self.heading_error(state.t)
                state = self._above_ground(advance(state, self._told, self._response, off))
                self._states.append(state)
                self._measure_way(state)
        self._forget(state.t - GUIDED_REMEMBERED_S)
        return self._states[-1]

    def _measure_way(self, state: FlownState) -> None:
        if self._way_m < REMEMBERED_WAY_M:
            self._way_m += RESPONSE_STEP_S * math.hypot(*state.velocity[:2])
            if self._way_m >= len(self._metres) + 1:
                self._metres.append(state.t)

    def _above_ground(self, state: FlownState) -> FlownState:
        """The same state, or that of a drone that has just touched the ground."""
        north, east, down = state.position
        if down < self.ground - ON_THE_GROUND or state.velocity[2] <= 0.0:
            return state
        self.touched_s = state.t
        return at_rest(state.t, (north, east, self.ground), state.yaw)

    def _forget(self, before: float) -> None:
        """Now and then, so that it costs nothing."""
        first = bisect_right(self._states, before, key=lambda state: state.t) - 1
        if first > len(self._states) // 2:
            del self._states[:first]


def _carried_on(state: FlownState, t: float) -> FlownState:
    """The state at t, within a step after `state`: to third order in position, as its derivatives say."""
    s = min(t - state.t, RESPONSE_STEP_S)
    if not s > 0.0:
        return state

    def grown(value: Triple, *rates: Triple) -> Triple:
        """By Taylor's series."""
        factors = [s**k / math.factorial(k) for k in range(1, len(rates) + 1)]
        north, east, down = (
            value[axis] + sum(f * rate[axis] for f, rate in zip(factors, rates, strict=True))
            for axis in range(3)
        )
        return north, east, down

    return state._replace(
        t=t,
        position=grown(state.position, state.velocity, state.acceleration, state.jerk),
        velocity=grown(state.velocity, state.acceleration, state.jerk),
        acceleration=grown(state.acceleration, state.jerk),
        thrust=grown(state.thrust, state.thrust_jerk),
        yaw=state.yaw + s * state.yaw_rate + 0.5 * s * s * state.yaw_acceleration,
        yaw_rate=state.yaw_rate + s * state.yaw_acceleration,
    )
