"""How an autopilot flies what it is told: from set points to motion, step by step.

ArduCopter 4.7 and PX4 1.15 were measured in flight: velocity steps, yaw steps, go-tos. A jerk- and acceleration-limited
demand goes through a lag, which stands for the tilt; yaw rate is of second order behind a dead time. The model is pure:
the next state is a function of this one and of the set point, at a fixed step, so the same commands give the same
flight. World is NED; metres, seconds, radians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

Triple = tuple[
    float, float, float
]  # north, east, down: plain numbers, as this runs 200 times per second of flight

RESPONSE_STEP_S = 0.005  # s
NO_MOTION: Triple = (0.0, 0.0, 0.0)
NOSE_FROM_M = 0.5  # m: of a way point nearer than this the bearing says nothing
NOSE_FROM_M_S = 0.5  # m/s: the nose turns once the drone is on its way, as ArduCopter's does


@dataclass(frozen=True, slots=True)
class Axis:
    """Response along the horizontal, or along the vertical.

    The demanded acceleration follows `gain` times the error of velocity [1/s], or less where it could not be taken back
    in time (the square-root controller of ArduPilot); `integral` [1/s²] is the gain on its integral. `lag` [s]: from
    demand to acceleration. foresight: the share of the lag that the controller makes up for; less overshoots, and less
    than none stands for a delay of its own. drag [1/s]: deceleration per speed. approach [m/s²]: deceleration in front
    of a way point.
    """

    speed: float
    acceleration: float
    jerk: float
    lag: float
    gain: float
    approach: float
    foresight: float = 1.0
    integral: float = 0.0
    drag: float = 0.0


@dataclass(frozen=True, slots=True)
class Response:
    """Of one kind of autopilot.

    yaw_omega [rad/s], yaw_zeta and yaw_dead_s [s] are of the yaw rate, whose demand is at most yaw_rate [rad/s] and is
    yaw_gain [1/s] times the error of a commanded heading, or less: it can be taken back by yaw_acceleration [rad/s²].
    After hold_s [s] without a set point the drone brakes.
    """

    level: Axis
    vertical: Axis
    yaw_omega: float
    yaw_zeta: float
    yaw_dead_s: float
    yaw_rate: float
    yaw_gain: float
    yaw_acceleration: float
    hold_s: float


ARDUPILOT_RESPONSE = Response(
    level=Axis(speed=5.0, acceleration=2.5, jerk=5.0, lag=0.14, gain=2.5, approach=0.9),
    vertical=Axis(speed=2.5, acceleration=1.17, jerk=2.8, lag=0.07, gain=5.6, approach=0.57, foresight=-0.5),
    yaw_omega=6.0,
    yaw_zeta=0.46,
    yaw_dead_s=0.07,
    yaw_rate=1.05,
    yaw_gain=2.0,
    yaw_acceleration=3.0,
    hold_s=3.0,
)
# Its simulator has drag, which only the slow integral of the velocity controller takes up: a steep start, a long tail.
PX4_RESPONSE = Response(
    level=Axis(
        speed=12.0, acceleration=9.0, jerk=54.0, lag=0.13, gain=1.9, approach=2.0, integral=0.36, drag=0.82
    ),
    vertical=Axis(speed=3.0, acceleration=4.0, jerk=8.0, lag=0.10, gain=3.0, approach=1.5),
    yaw_omega=7.0,
    yaw_zeta=0.5,
    yaw_dead_s=0.07,
    yaw_rate=2.3,
    yaw_gain=2.5,
    yaw_acceleration=6.0,
    hold_s=0.5,
)


class SetPoint(NamedTuple):
    """What a drone was told at `t` [s]: a velocity [m/s], or a position [m]; NED. Neither: stay where it is.

    At most one of yaw [rad] and yaw_rate [rad/s]; with neither, a go-to turns the nose to its way point.
    """

    t: float
    position: Triple | None = None
    velocity: Triple | None = None
    yaw: float | None = None
    yaw_rate: float | None = None


class Flown(NamedTuple):
    """One instant of a flight: position, velocity, acceleration and jerk in m, m/s, m/s², m/s³, NED.

    thrust [m/s²] and thrust_jerk [m/s³]: acceleration and jerk but for the drag, which is what the drone tilts for.
    yaw [rad, not wrapped], yaw_rate [rad/s], yaw_acceleration [rad/s²]. The rest is the controllers' memory: the
    acceleration demanded, the integral, the yaw rates in the dead time, the place where the drone holds, and the
    heading to which a go-to turns it.
    """

    t: float
    position: Triple
    velocity: Triple
    acceleration: Triple
    jerk: Triple
    thrust: Triple
    thrust_jerk: Triple
    yaw: float
    yaw_rate: float
    yaw_acceleration: float
    demand: Triple
    integral: Triple
    rates: tuple[float, ...]
    hold: Triple | None
    nose: float | None


def at_rest(t: float, position: Triple, yaw: float) -> Flown:
    """On the ground, or in a perfect hover, at `position` [m]."""
    return Flown(
        t,
        position,
        NO_MOTION,
        NO_MOTION,
        NO_MOTION,
        NO_MOTION,
        NO_MOTION,
        yaw,
        0.0,
        0.0,
        NO_MOTION,
        NO_MOTION,
        rates=(),
        hold=None,
        nose=None,
    )


def advance(state: Flown, told: SetPoint, response: Response, heading_error: float = 0.0) -> Flown:
    """The state RESPONSE_STEP_S later. heading_error: by how much the autopilot believes its nose too far clockwise
    [rad]."""
    told = _held(told, state.t, response)
    (vx, vy, vz), hold = _wanted_velocity(state, told, response)
    level, vertical = response.level, response.vertical
    jx, jy = _demand_jerk(state, (vx, vy), level, 0)
    (jz,) = _demand_jerk(state, (vz,), vertical, 2)
    moved = [
        _moved(state, axis, k, jerk) for k, axis, jerk in ((0, level, jx), (1, level, jy), (2, vertical, jz))
    ]
    position, velocity, acceleration, jerk, thrust, thrust_jerk, demand = zip(*moved, strict=True)
    gains = (level.integral, level.integral, vertical.integral)
    ix, iy, iz = (
        old + RESPONSE_STEP_S * gain * (wanted - speed)
        for gain, wanted, speed, old in zip(gains, (vx, vy, vz), state.velocity, state.integral, strict=True)
    )
    nose = _nose(state, told)
    wanted_rate = _wanted_yaw_rate(told, nose, response, state.yaw + heading_error)
    delayed, rates = _delayed(state.rates, wanted_rate, response.yaw_dead_s)
    yaw, yaw_rate, yaw_acceleration = _turned(state, delayed, response)
    return Flown(
        state.t + RESPONSE_STEP_S, position, velocity, acceleration, jerk, thrust, thrust_jerk,
        yaw, yaw_rate, yaw_acceleration, demand, (ix, iy, iz), rates, hold, nose,
    )  # fmt: skip


def _held(told: SetPoint, t: float, response: Response) -> SetPoint:
    """What a set point still means at t: a velocity without another for `hold_s` is a brake; go-tos hold for ever."""
    if told.velocity is None or told.position is not None or t - told.t <= response.hold_s:
        return told
    return told._replace(velocity=NO_MOTION, yaw_rate=None)


def _wanted_velocity(state: Flown, told: SetPoint, response: Response) -> tuple[Triple, Triple | None]:
    """The velocity to have now [m/s], and the place that the drone holds, if it does."""
    if told.velocity is not None and told.position is None:
        return told.velocity, None
    goal = told.position or state.hold or state.position
    north, east, down = (there - here for there, here in zip(goal, state.position, strict=True))
    level, vertical = response.level, response.vertical
    distance = math.hypot(north, east)
    share = (
        min(_square_root(distance, 1.0, level.approach), level.speed) / distance if distance > 0.0 else 0.0
    )
    climb = math.copysign(min(_square_root(abs(down), 1.0, vertical.approach), vertical.speed), down)
    return (share * north, share * east, climb), goal


def _square_root(error: float, gain: float, limit: float) -> float:
    """The rate at which to take back an error ≥ 0, in proportion while small; never more than `limit` can brake.

    ArduPilot's `sqrt_controller`.
    """
    linear = limit / gain**2
    return gain * error if error <= linear else math.sqrt(2.0 * limit * (error - linear / 2.0))


def _demand_jerk(state: Flown, wanted: tuple[float, ...], axis: Axis, first: int) -> list[float]:
    """How the demanded acceleration changes in this step [m/s³], in the directions from `first` on."""
    among = range(first, first + len(wanted))
    ahead = axis.foresight * axis.lag
    error = [v - state.velocity[k] - ahead * state.thrust[k] for k, v in zip(among, wanted, strict=True)]
    size = math.hypot(*error)
    push = _square_root(size, axis.gain, axis.jerk) / size if size > 0.0 else 0.0
    demand = [push * e + state.integral[k] for k, e in zip(among, error, strict=True)]
    length = math.hypot(*demand)
    cut = min(1.0, axis.acceleration / length) if length > 0.0 else 1.0
    jerk = [(cut * d - state.demand[k]) / RESPONSE_STEP_S for k, d in zip(among, demand, strict=True)]
    length = math.hypot(*jerk)
    cut = min(1.0, axis.jerk / length) if length > 0.0 else 1.0
    return [cut * j for j in jerk]


def _moved(state: Flown, axis: Axis, k: int, demand_jerk: float) -> tuple[float, ...]:
    """Position, velocity, acceleration, jerk, thrust, its jerk, and demand of direction k one step later."""
    x = (state.position[k], state.velocity[k], state.thrust[k], state.demand[k], demand_jerk)
    (_, p1, p2, p3, p4), (_, v1, v2, v3, v4), (_, _, a2, a3, a4) = _transition(axis.lag, axis.drag)
    position = x[0] + p1 * x[1] + p2 * x[2] + p3 * x[3] + p4 * x[4]
    velocity = v1 * x[1] + v2 * x[2] + v3 * x[3] + v4 * x[4]
    thrust = a2 * x[2] + a3 * x[3] + a4 * x[4]
    demand = x[3] + RESPONSE_STEP_S * demand_jerk
    thrust_jerk = (demand - thrust) / axis.lag
    acceleration = thrust - axis.drag * velocity
    jerk = thrust_jerk - axis.drag * acceleration
    return position, velocity, acceleration, jerk, thrust, thrust_jerk, demand


@cache
def _transition(lag: float, drag: float) -> tuple[tuple[float, ...], ...]:
    """(3, 5): position, velocity and thrust after a step, from these, the demand, and the demand's jerk.

    Exact, so that position and its derivatives fit each other to rounding, however they are interpolated.
    """
    from scipy.linalg import expm  # noqa: PLC0415  (0.1 s of import: only what is flown needs it)

    A = np.zeros((5, 5))
    A[0, 1] = 1.0
    A[1, 1:3] = -drag, 1.0
    A[2, 2:4] = -1.0 / lag, 1.0 / lag
    A[3, 4] = 1.0
    return tuple(tuple(row) for row in expm(A * RESPONSE_STEP_S)[:3].tolist())


def _nose(state: Flown, told: SetPoint) -> float | None:
    """The heading to which a go-to turns the drone: to the way point, and that of the way when it is near."""
    if told.yaw is not None or told.yaw_rate is not None or told.position is None:
        return None
    north, east = told.position[0] - state.position[0], told.position[1] - state.position[1]
    on_its_way = math.hypot(state.velocity[0], state.velocity[1]) >= NOSE_FROM_M_S
    if on_its_way and math.hypot(north, east) >= NOSE_FROM_M:
        return math.atan2(east, north)
    return state.nose


def _wanted_yaw_rate(told: SetPoint, nose: float | None, response: Response, believed: float) -> float:
    """believed: the heading that the autopilot takes for its own [rad]."""
    if told.yaw_rate is not None:
        return min(max(told.yaw_rate, -response.yaw_rate), response.yaw_rate)
    heading = told.yaw if told.yaw is not None else nose
    if heading is None:
        return 0.0
    error = math.remainder(heading - believed, 2.0 * math.pi)
    rate = _square_root(abs(error), response.yaw_gain, response.yaw_acceleration)
    return math.copysign(min(rate, response.yaw_rate), error)


def _delayed(rates: tuple[float, ...], newest: float, dead_s: float) -> tuple[float, tuple[float, ...]]:
    """The rate that leaves the dead time, and those still in it."""
    rates = (*rates, newest)
    return (rates[0], rates[1:]) if len(rates) > round(dead_s / RESPONSE_STEP_S) else (0.0, rates)


def _turned(state: Flown, wanted: float, response: Response) -> tuple[float, float, float]:
    """Yaw, its rate and its acceleration after one step of a second order, semi-implicit."""
    omega, zeta = response.yaw_omega, response.yaw_zeta
    push = omega**2 * (wanted - state.yaw_rate) - 2.0 * zeta * omega * state.yaw_acceleration
    acceleration = state.yaw_acceleration + RESPONSE_STEP_S * push
    rate = state.yaw_rate + RESPONSE_STEP_S * 0.5 * (state.yaw_acceleration + acceleration)
    return state.yaw + RESPONSE_STEP_S * 0.5 * (state.yaw_rate + rate), rate, acceleration
