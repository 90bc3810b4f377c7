"""The simulated autopilots respond as ArduCopter 4.7 and PX4 were measured to: times and overshoots of their steps."""

from __future__ import annotations

import math

import numpy as np
import pytest

from swarmtrack.lab.world.response import (
    ARDUPILOT_RESPONSE,
    PX4_RESPONSE,
    RESPONSE_STEP_S,
    Flown,
    Response,
    SetPoint,
    Triple,
    advance,
    at_rest,
)
from swarmtrack.messages import Array

TIMES = (0.10, 0.63, 0.90)
NORTH, DOWN = 0, 2


def flown(
    response: Response, told: SetPoint, seconds: float, start: Flown | None = None, silent: bool = False
) -> list[Flown]:
    """A flight; told again at every step, unless silent."""
    flight = [start or at_rest(0.0, (0.0, 0.0, -5.0), 0.0)]
    for _ in range(round(seconds / RESPONSE_STEP_S)):
        now = flight[-1].t
        flight.append(advance(flight[-1], told if silent else told._replace(t=now), response))
    return flight


def along(axis: int, speed: float) -> Triple:
    velocity = [0.0, 0.0, 0.0]
    velocity[axis] = speed
    return (velocity[0], velocity[1], velocity[2])


def step(response: Response, axis: int, before: float, after: float) -> tuple[Array, Array]:
    """Seconds since the step, and the share of it that is done."""
    start = flown(response, SetPoint(0.0, velocity=along(axis, before)), 5.0)[-1]
    flight = flown(response, SetPoint(start.t, velocity=along(axis, after)), 6.0, start)
    t = np.array([state.t for state in flight]) - start.t
    return t, (np.array([state.velocity[axis] for state in flight]) - before) / (after - before)


def reached(t: Array, share: Array, of: float) -> float:
    return float(t[np.argmax(share >= of)])


# sitl.md, section 7: speed before and after, times to 10, 63 and 90 %, overshoot
ARDUPILOT_STEPS = [
    (NORTH, 0.0, 1.0, (0.32, 0.72, 1.3), 0.0),
    (NORTH, 0.0, 2.0, (0.41, 0.90, 1.5), 0.01),
    (NORTH, 0.0, 4.0, (0.52, 1.35, 2.0), 0.01),
    (NORTH, 0.0, 8.0, (0.68, 2.4, 3.4), 0.01),
    (NORTH, 4.0, -4.0, (0.72, 2.4, 3.3), 0.0),
    (DOWN, 0.0, -1.0, (0.30, 0.80, 1.04), 0.09),
    (DOWN, 0.0, -2.0, (0.40, 1.36, 1.88), 0.05),
    (DOWN, 0.0, 1.0, (0.30, 0.80, 1.06), 0.08),
    (DOWN, 0.0, 1.5, (0.36, 1.08, 1.44), 0.08),
]


@pytest.mark.parametrize(("axis", "before", "after", "times", "overshoot"), ARDUPILOT_STEPS)
def test_a_step_of_velocity_takes_the_time_that_arducopter_takes(
    axis: int, before: float, after: float, times: tuple[float, ...], overshoot: float
) -> None:
    t, share = step(ARDUPILOT_RESPONSE, axis, before, after)
    assert [reached(t, share, of) for of in TIMES] == pytest.approx(times, rel=0.15)
    assert share.max() - 1.0 == pytest.approx(overshoot, abs=0.035)


@pytest.mark.parametrize(("told", "got"), [(0.3, 0.3), (0.6, 0.6), (1.0, 1.0), (2.0, 1.05)])
def test_a_step_of_yaw_rate_takes_the_time_that_arducopter_takes(told: float, got: float) -> None:
    flight = flown(ARDUPILOT_RESPONSE, SetPoint(0.0, velocity=(0.0, 0.0, 0.0), yaw_rate=told), 2.5)
    t, share = np.array([state.t for state in flight]), np.array([state.yaw_rate for state in flight]) / got
    assert [reached(t, share, of) for of in TIMES] == pytest.approx((0.16, 0.32, 0.42), rel=0.15)
    assert share.max() == pytest.approx(1.20, abs=0.02)


def test_acceleration_and_jerk_keep_arducopters_limits() -> None:
    flight = flown(ARDUPILOT_RESPONSE, SetPoint(0.0, position=(9.0, -7.0, -12.0)), 12.0)
    acceleration = np.array([state.acceleration for state in flight])
    jerk = np.array([state.jerk for state in flight])
    assert np.hypot(*acceleration[:, :2].T).max() <= 2.5 + 1e-9
    assert np.hypot(*jerk[:, :2].T).max() <= 5.0 + 1e-9
    assert np.abs(acceleration[:, 2]).max() <= 1.2
    assert np.abs(jerk[:, 2]).max() <= 2.9


@pytest.mark.parametrize("response", [ARDUPILOT_RESPONSE, PX4_RESPONSE])
def test_the_derivatives_are_those_of_the_motion(response: Response) -> None:
    flight = flown(response, SetPoint(0.0, position=(4.0, 2.0, -8.0)), 4.0)
    for lower, upper in (("position", "velocity"), ("velocity", "acceleration"), ("acceleration", "jerk")):
        x = np.array([getattr(state, lower) for state in flight])
        rate = np.array([getattr(state, upper) for state in flight])
        change = np.diff(x, axis=0) / RESPONSE_STEP_S
        assert np.abs(change - (rate[:-1] + rate[1:]) / 2.0).max() < 0.02 * np.abs(rate).max()


def test_px4_starts_steeply_and_then_takes_its_time() -> None:
    t, share = step(PX4_RESPONSE, NORTH, 0.0, 5.0)
    assert [reached(t, share, of) for of in (0.10, 0.50, 0.63, 0.80)] == pytest.approx(
        (0.27, 0.69, 1.07, 3.6), rel=0.15
    )
    assert share[t <= 4.0].max() < 0.90


def test_px4_turns_by_ninety_degrees_in_a_second() -> None:
    flight = flown(PX4_RESPONSE, SetPoint(0.0, yaw=math.pi / 2.0), 4.0)
    t, share = (
        np.array([state.t for state in flight]),
        np.array([state.yaw for state in flight]) * 2.0 / math.pi,
    )
    times = [reached(t, share, of) for of in (0.10, 0.50, 0.63, 0.80, 0.90)]
    assert times == pytest.approx((0.30, 0.64, 0.74, 0.88, 0.98), rel=0.15)
    assert max(state.yaw_rate for state in flight) == pytest.approx(2.7, rel=0.05)


def test_silence_keeps_the_velocity_for_three_seconds_and_then_brakes() -> None:
    flight = flown(
        ARDUPILOT_RESPONSE, SetPoint(0.0, velocity=(2.0, 0.0, 0.0), yaw_rate=0.5), 9.0, silent=True
    )
    speed = {round(state.t, 3): state.velocity[NORTH] for state in flight}
    assert speed[3.0] == pytest.approx(2.0, rel=0.02)
    assert speed[3.1] > 1.9
    assert abs(speed[6.0]) < 0.05
    assert abs(flight[-1].yaw_rate) < 1e-3


def test_a_go_to_turns_the_nose_to_the_way_point_and_rests_there() -> None:
    flight = flown(ARDUPILOT_RESPONSE, SetPoint(0.0, position=(0.0, -4.0, -5.0)), 12.0)
    assert flight[-1].position == pytest.approx((0.0, -4.0, -5.0), abs=0.02)
    assert flight[-1].yaw == pytest.approx(-math.pi / 2.0, abs=0.02)
    assert np.abs([state.yaw_rate for state in flight]).max() > 1.0


def test_a_go_to_with_yaw_turns_there_and_not_to_the_way_point() -> None:
    flight = flown(ARDUPILOT_RESPONSE, SetPoint(0.0, position=(0.0, -4.0, -5.0), yaw=0.4), 12.0)
    assert max(state.yaw for state in flight) == pytest.approx(0.4, abs=0.08)
    assert min(state.yaw for state in flight) > -0.01


def test_without_a_set_point_it_stays_where_it_is() -> None:
    moving = flown(ARDUPILOT_RESPONSE, SetPoint(0.0, velocity=(1.0, 0.0, 0.0)), 2.0)[-1]
    flight = flown(ARDUPILOT_RESPONSE, SetPoint(moving.t), 8.0, moving)
    assert flight[-1].position == pytest.approx(moving.position, abs=0.02)
    assert flight[-1].velocity == pytest.approx((0.0, 0.0, 0.0), abs=0.01)
