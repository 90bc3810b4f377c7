"""Commanded against flown: who is slow obeys, who is pushed does not."""

import math

import pytest

from swarmtrack.formation.divergence import DivergenceWatch
from swarmtrack.formation.law import towards
from swarmtrack.formation.margins import DIVERGENCE_AGREES_S, DIVERGENCE_HOLDS_S, DIVERGENCE_WITHIN_S
from swarmtrack.formation.setpoint import STANDSTILL
from swarmtrack.lab.world.response import (
    ARDUPILOT_RESPONSE,
    PX4_RESPONSE,
    RESPONSE_STEP_S,
    SetPoint,
    advance,
    at_rest,
)

DT = 0.1
STEPS = {
    "a step": [(0.0, (2.5, 0.0, 0.0))],
    "a turn": [(0.0, (1.5, 0.0, 0.0)), (6.0, (0.0, 1.5, 0.0))],
    "an evasion": [(0.0, (2.5, 0.0, 0.0)), (8.0, (-2.5, 0.0, 0.0))],
    "a climb": [(0.0, (0.0, 0.0, -1.0)), (6.0, (0.0, 0.0, 1.0))],
}


def flown(response, story, *, slew=math.inf, push=STANDSTILL, seconds=16.0):
    """(t, doubt) of a drone that flies by an autopilot's measured response; push [m/s]: from 6 s on, beside it."""
    watch, state, told, said = DivergenceWatch(), at_rest(0.0, (0.0, 0.0, -9.0), 0.0), STANDSTILL, []
    late = [STANDSTILL] * 3
    while state.t < seconds:
        wanted = next(v for t, v in reversed(story) if t <= state.t + 1e-9)
        told = towards(told, wanted, slew * DT) if math.isfinite(slew) else wanted
        for _ in range(round(DT / RESPONSE_STEP_S)):
            state = advance(state, SetPoint(state.t, velocity=told, yaw_rate=0.0), response)
        beside = push if state.t > 6.0 else STANDSTILL
        # A velocity is that of the last 0.3 s.
        late = [*late[1:], tuple(a + b for a, b in zip(state.velocity, beside, strict=True))]
        mean = tuple(sum(axis) / len(late) for axis in zip(*late, strict=True))
        watch.add_sample(state.t, told, mean)
        said.append((state.t, watch.doubt(state.t)))
    return said


@pytest.mark.parametrize("response", [ARDUPILOT_RESPONSE, PX4_RESPONSE], ids=["ArduPilot", "PX4"])
@pytest.mark.parametrize("story", STEPS.values(), ids=STEPS)
@pytest.mark.parametrize("slew", [1.5, math.inf])
def test_an_autopilot_as_slow_as_was_measured_obeys(response, story, slew):
    assert [doubt for _, doubt in flown(response, story, slew=slew) if doubt] == []


@pytest.mark.parametrize("speed", [0.0, 1.5])
@pytest.mark.parametrize("way", range(0, 360, 45))
def test_a_push_of_a_metre_per_second_is_said_within_five_seconds(way, speed):
    push = math.cos(math.radians(way)), math.sin(math.radians(way)), 0.0
    said = flown(ARDUPILOT_RESPONSE, [(0.0, (speed, 0.0, 0.0))], push=push)
    first = next(t for t, doubt in said if doubt)
    assert 6.0 < first < 11.0
    assert all(doubt for t, doubt in said if t > first)
    assert said[-1][1].endswith("m/s off its command")


def told(watch, seconds, commanded, velocity, begin):
    """The same for a while; the doubts."""
    times = [begin + (k + 1) * DT for k in range(round(seconds / DT))]
    doubts = []
    for t in times:
        watch.add_sample(t, commanded, velocity)
        doubts.append(watch.doubt(t))
    return doubts


def test_it_is_said_until_the_drone_has_obeyed_for_a_while_and_a_moment_of_it_changes_nothing():
    watch = DivergenceWatch()
    told(watch, 1.0, STANDSTILL, STANDSTILL, 0.0)
    assert told(watch, 5.0, STANDSTILL, (1.5, 0.0, 0.0), 1.0)[-1] == "flies 1.4 m/s off its command"
    for k in range(6):
        # By turns it obeys for 2 s and does not for 2 s.
        assert all(told(watch, 2.0, STANDSTILL, STANDSTILL, 6.0 + 4.0 * k))
        assert all(told(watch, 2.0, STANDSTILL, (1.5, 0.0, 0.0), 8.0 + 4.0 * k))
    doubts = told(watch, 12.0, STANDSTILL, STANDSTILL, 30.0)
    assert all(doubts[: round(DIVERGENCE_AGREES_S / DT)])
    assert doubts[-1] is None


def test_who_begins_in_flight_or_knew_no_velocity_has_time_to_obey():
    watch = DivergenceWatch()
    watch.add_sample(0.0, STANDSTILL, (4.0, 0.0, 0.0))
    for k in range(1, 40):
        speed = 4.0 * math.exp(-k * DT / 0.8)
        watch.add_sample(k * DT, STANDSTILL, (speed, 0.0, 0.0))
        assert watch.doubt(k * DT) is None
    for k in range(40, 100):
        # A place that leaps makes a velocity that nobody flew.
        watch.add_sample(k * DT, STANDSTILL, (9.0, 0.0, 0.0), usable=False)
    watch.add_sample(10.0, STANDSTILL, STANDSTILL)
    assert watch.doubt(10.0) is None


def test_a_slot_that_gets_farther_away_although_it_is_flown_to_is_said_for_a_while():
    watch = DivergenceWatch()
    for k in range(round(DIVERGENCE_WITHIN_S / DT) + 15):
        t = k * DT
        watch.add_sample(t, (1.0, 0.0, 0.0), (1.0, 0.0, 0.0))
        watch.follow(t, (2.0 + 0.4 * t, 0.0, 0.0), STANDSTILL)
    assert watch.doubt(t).endswith("m farther off its slot, against its command")
    assert watch.doubt(t + DIVERGENCE_HOLDS_S) is None


def test_a_leader_that_is_faster_than_its_follower_may_fly_is_no_fault_of_the_follower():
    watch = DivergenceWatch()
    for k in range(100):
        t = k * DT
        watch.add_sample(t, (1.0, 0.0, 0.0), (1.0, 0.0, 0.0))
        watch.follow(t, (2.0 + 0.5 * t, 0.0, 0.0), (1.5, 0.0, 0.0))
        assert watch.doubt(t) is None
