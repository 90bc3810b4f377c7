"""The guard on its own: whatever it is told, what it sends is within the limits, slower, or nothing."""

import ast
import itertools
import math
import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from support.places import ROOT
from swarmtrack import guard
from swarmtrack.guard import (
    SETPOINT_DEAD_S,
    SETPOINT_STALE_S,
    ZERO,
    Command,
    Decision,
    Guard,
    GuardLimits,
    Speaker,
)

LIMITS = GuardLimits(
    speed=2.5, climb=1.0, yaw_rate=0.8, acceleration=1.5, evasion=6.0, yaw_acceleration=3.0,
    fence_radius=20.0, fence_height=10.0,
)  # fmt: skip
HERE = (5.0, -3.0, -8.0)
STILL = (0.0, 0.0, 0.0)


def decision(t, velocity=(1.0, 0.0, 0.0), yaw_rate=0.0, **other):
    given = {"number": 1, "place": HERE, "place_t": t, "room": 6.0}
    return Decision(t=t, velocity=velocity, yaw_rate=yaw_rate, **(given | other))


class Told:
    """A guard that is told a decision each tenth of a second; `sent` by time."""

    def __init__(self):
        self.guard, self.now, self.sent, self.releases = Guard(LIMITS), 100.0, [], []

    def decide(self, seconds=0.1, **what):
        for _ in range(round(10.0 * seconds)):
            if self.guard.decided(decision(self.now, **what), self.now):
                self.send()
            self.wait(0.1)
        return self

    def wait(self, seconds, *, gone=False):
        ends = self.now + seconds
        while self.guard.due() < ends - 1e-9:
            self.now = max(self.now, self.guard.due())
            self.send(gone=gone)
        self.now = ends
        return self

    def send(self, *, gone=False):
        point = self.guard.command(self.now, gone=gone)
        if point is not None:
            self.sent.append((self.now, point))
        why = self.guard.take_release()
        if why:
            self.releases.append(why)

    @property
    def last(self):
        return self.sent[-1][1]

    def since(self, t):
        return [(at, point) for at, point in self.sent if at >= t]


def test_a_decision_is_sent_as_it_is_once_the_step_to_it_is_flown():
    told = Told().decide(1.0, yaw_rate=0.5)
    assert told.last == Command((1.0, 0.0, 0.0), 0.5)
    assert [at for at, _ in told.sent] == pytest.approx([100.0 + 0.1 * k for k in range(10)])


def test_no_step_is_larger_than_evading_needs():
    told = Told().decide(1.0, velocity=(2.5, 0.0, 0.0)).decide(1.0, velocity=(-2.5, 0.0, 0.0))
    steps = [after[1].velocity[0] - before[1].velocity[0] for before, after in itertools.pairwise(told.sent)]
    assert max(map(abs, steps)) <= LIMITS.evasion * 0.1 + 1e-9
    assert told.last.velocity == (-2.5, 0.0, 0.0)


def test_an_old_decision_is_zero_at_once_and_a_dead_one_the_end():
    told = Told().decide(1.0)
    decided = told.now - 0.1
    told.wait(3.0)
    old = told.since(decided + SETPOINT_STALE_S - 1e-9)
    assert old[0][0] == pytest.approx(decided + SETPOINT_STALE_S)
    assert {point for _, point in old} == {ZERO}
    assert old[-1][0] <= decided + SETPOINT_DEAD_S + guard.AGAIN_S + 1e-9
    assert told.releases == ["no decision for 1.1 s"]


def test_an_agent_that_is_gone_is_zero_at_once_for_as_long_as_a_decision_may_be_old():
    told = Told().decide(1.0)
    gone = told.now
    told.send(gone=True)
    told.wait(3.0, gone=True)
    assert {point for _, point in told.since(gone)} == {ZERO}
    assert told.since(gone)[0][0] == gone
    assert SETPOINT_DEAD_S - 0.2 < told.since(gone)[-1][0] - gone < SETPOINT_DEAD_S + 0.2


def test_a_guard_that_stood_still_itself_says_no_last_word():
    told = Told().decide(1.0)
    stood = told.now
    told.now += 2.0
    told.send()
    assert told.since(stood) == []
    assert told.releases == ["no decision for 2.1 s"]


def test_after_its_end_an_engagement_is_never_flown_again_and_the_next_one_is():
    told = Told().decide(1.0).wait(3.0)
    begun = told.now
    told.decide(1.0)
    assert told.since(begun) == []
    told.decide(1.0, number=2)
    assert told.last.velocity == (1.0, 0.0, 0.0)
    told.guard.end(2)
    ended = told.now
    told.decide(1.0, number=2)
    assert told.since(ended) == []


BAD = {
    "nan": {"velocity": (math.nan, 0.0, 0.0)},
    "infinite": {"velocity": (0.0, 0.0, math.inf)},
    "fast": {"velocity": (50.0, 0.0, 0.0)},
    "sinks": {"velocity": (0.0, 0.0, 5.0)},
    "spins": {"yaw_rate": 20.0},
    "spins by no number": {"yaw_rate": math.nan},
    "where": {"place": (math.nan, 0.0, 0.0), "velocity": (2.0, 0.0, 0.0)},
    "long ago": {"place_t": 90.0, "velocity": (2.0, 0.0, 0.0)},
    "tomorrow": {"place_t": 1e6, "velocity": (2.0, 0.0, 0.0)},
    "beyond the fence": {"place": (30.0, -3.0, -8.0), "velocity": (2.0, 0.0, 0.0)},
    "below the floor": {"place": (5.0, -3.0, -0.5), "velocity": (2.0, 0.0, 0.9)},
    "above the ceiling": {"place": (5.0, -3.0, -20.0), "velocity": (2.0, 0.0, -0.9)},
}


@pytest.mark.parametrize("what", BAD.values(), ids=BAD)
def test_what_may_not_be_flown_slows_the_drone_down_and_is_over_after_a_second(what):
    told = Told().decide(1.0)
    wrong = told.now
    told.decide(3.0, **what)
    sent = [math.hypot(*point.velocity) for _, point in told.since(wrong)]
    falls = [before - after for before, after in itertools.pairwise([1.0, *sent])]
    assert min(falls) >= 0.0
    assert max(falls) <= LIMITS.acceleration * 0.1 + 1e-9
    assert sent[-1] == 0.0
    assert told.since(wrong + SETPOINT_DEAD_S + 0.2) == []
    assert told.releases[0].startswith("refused: ")


def test_what_is_put_right_within_a_second_goes_on():
    told = Told().decide(1.0).decide(0.5, velocity=(math.nan, 0.0, 0.0)).decide(1.0)
    assert told.releases == []
    assert told.last.velocity == (1.0, 0.0, 0.0)


def test_beyond_the_fence_the_way_back_is_free():
    told = Told().decide(1.0).decide(2.0, place=(40.0, -3.0, -8.0), velocity=(-1.0, 0.0, 0.0))
    assert told.releases == []
    assert told.last.velocity == (-1.0, 0.0, 0.0)


def test_whoever_brakes_may_do_so_anywhere():
    told = Told().decide(1.0, velocity=(2.0, 0.0, 0.0))
    for k in range(20):
        told.decide(velocity=(max(1.9 - 0.14 * k, 0.0), 0.0, 0.0), place=(math.nan,) * 3)
    assert told.releases == []


def test_without_a_place_nobody_is_moved():
    told = Told().decide(3.0, place_t=-math.inf)
    assert {point for _, point in told.sent} == {ZERO}
    assert told.releases == ["refused: its position is unknown"]


def test_the_fence_stands_where_the_drone_was_engaged_and_its_floor_as_far_below_as_was_said_then():
    told = Told().decide(0.2)
    # Later words do not move it.
    told.decide(3.0, velocity=(0.0, 0.0, 0.9), place=(5.0, -3.0, -1.0), room=50.0)
    assert "towards the floor, -1.0 m" in told.releases[0]


numbers = st.floats(allow_nan=True, allow_infinity=True, width=32) | st.floats(-5.0, 5.0)
events = st.tuples(
    st.sampled_from(["decide"] * 6 + ["wait", "end", "stand", "gone"]),
    st.floats(0.0, 0.4),
    st.integers(0, 4),
    st.tuples(numbers, numbers, numbers),
    numbers,
    st.tuples(numbers, numbers, numbers),
    numbers,
)


@settings(max_examples=200, deadline=None)
@given(st.lists(events, max_size=30))
def test_whatever_it_is_told_it_sends_nothing_beyond_a_limit(story):
    it, now = Guard(LIMITS), 100.0
    for kind, passed, number, velocity, yaw_rate, place, odd in story:
        now += passed
        if kind == "decide":
            it.decided(
                Decision(
                    number,
                    odd if math.isnan(odd) else now - abs(odd) % 0.5,
                    velocity,
                    yaw_rate,
                    place,
                    now,
                    odd,
                ),
                now,
            )
        elif kind == "end":
            it.end(number)
        elif kind == "stand":
            it.stands(now)
        point = it.command(now, gone=kind == "gone")
        if point is not None:
            assert math.hypot(*point.velocity) <= LIMITS.speed * (1.0 + 2e-6)
            assert abs(point.velocity[2]) <= LIMITS.climb * (1.0 + 2e-6)
            assert abs(point.yaw_rate) <= LIMITS.yaw_rate * (1.0 + 2e-6)


# ── MAVLink ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def decoded(frames, key=None):
    parser = common.MAVLink(None)
    if key is not None:
        parser.signing.secret_key = key
        parser.signing.timestamp = int((1.7e9 - guard.SIGNING_BEGAN) * guard.SIGNING_TICKS)
    return [message for frame in frames for message in parser.parse_buffer(frame) or []]


def test_its_frames_are_those_of_pymavlink():
    speaker = Speaker(7, 192)
    ours = speaker.frame(Command((1.0, -0.5, 0.25), 0.125), 12.345, 1.7e9)
    theirs = common.MAVLink(None, 7, 192)
    message = common.MAVLink_set_position_target_local_ned_message(
        12345, 7, 1, common.MAV_FRAME_LOCAL_NED, 0b010111000111, *STILL, 1.0, -0.5, 0.25, *STILL, 0.0, 0.125
    )
    assert ours == bytes(message.pack(theirs))


def test_to_an_autopilot_of_mavlink_1_its_frames_are_of_that_and_to_the_component_that_was_found():
    speaker = Speaker(7, 192, bytes(range(32)))
    speaker.version_1, speaker.target = True, 42
    ours = speaker.frame(Command((1.0, -0.5, 0.25), 0.125), 12.345, 1.7e9)
    message = common.MAVLink_set_position_target_local_ned_message(
        12345, 7, 42, common.MAV_FRAME_LOCAL_NED, 0b010111000111, *STILL, 1.0, -0.5, 0.25, *STILL, 0.0, 0.125
    )
    assert ours == bytes(message.pack(common.MAVLink(None, 7, 192), force_mavlink1=True))


def test_its_signatures_are_good_and_never_of_the_past():
    key = bytes(range(32))
    speaker = Speaker(7, 192, key)
    # The wall clock steps back once.
    frames = [
        speaker.frame(ZERO, t, utc) for t, utc in ((1.0, 1.7e9), (1.1, 1.7e9 + 0.1), (1.2, 1.7e9 - 9.0))
    ]
    messages = decoded(frames, key)
    assert [message.get_seq() for message in messages] == [0, 1, 2]
    assert all(message.get_signed() for message in messages)


def test_it_needs_nothing_but_the_standard_library():
    tree = ast.parse((ROOT / "swarmtrack" / "guard.py").read_text())
    names = {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    names |= {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    assert {name.partition(".")[0] for name in names} <= set(sys.stdlib_module_names)
