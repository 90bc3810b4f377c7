import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from support.formation_states import Flying, in_slot, parameters, state, track
from swarmtrack.formation.barrier import HalfSpace, excess, stepped
from swarmtrack.formation.formation import Formation
from swarmtrack.formation.squeezed import best_of, least_closing, no_faster_than_asked

FASTEST = 2.5
NORTH, SOUTH = (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)
number = st.floats(-3.0, 3.0)
vector = st.tuples(number, number, number)


def directed(v):
    length = float(np.linalg.norm(v))
    return tuple((np.array(v) / length).tolist()) if length > 0.1 else NORTH


spaces = st.builds(HalfSpace, st.builds(directed, vector), st.floats(-3.0, 2.0))
limits = st.builds(HalfSpace, st.builds(directed, vector), st.floats(0.0, 2.0))


def least_excess(near, held):
    """By a linear program, in the cube around the ball of speeds: nothing within the ball does better."""
    rows = [[*space.normal, -1.0] for space in near] + [[*space.normal, 0.0] for space in held]
    bounds = [(-FASTEST, FASTEST)] * 3 + [(None, None)]
    return linprog([0.0, 0.0, 0.0, 1.0], rows, [space.bound for space in (*near, *held)], bounds=bounds).fun


@given(st.lists(spaces, min_size=1, max_size=6), st.lists(limits, max_size=3))
@settings(max_examples=100, deadline=None)
def test_nothing_within_the_limits_closes_in_slower(near, held):
    found = least_closing((0.0, 0.0, 0.0), near, held, FASTEST)
    assert math.hypot(*found) <= FASTEST + 1e-9
    # About: whoever calls it projects the answer once more.
    assert excess(found, held) <= 0.4
    # The same limits, and the ball as a hull of many planes: an independent optimum from outside.
    ball = [HalfSpace(directed(v), FASTEST) for v in np.random.default_rng(0).normal(size=(400, 3))]
    assert excess(found, near) <= least_excess(near, [*held, *ball]) + 0.4


@given(st.lists(st.tuples(vector, st.floats(0.2, 1.4), vector), min_size=2, max_size=5), st.booleans())
@settings(max_examples=100, deadline=None)
def test_between_some_that_are_too_near_no_command_closes_in_faster_than_standing_would(others, rests):
    flying = Flying(Formation(parameters()))
    seen, ways = {}, []
    for k, (way, away, velocity) in enumerate(others):
        direction = np.array(directed(way))
        moves = np.zeros(3) if rests else 0.5 * np.array(velocity)
        ways.append((direction, moves))
        seen[k] = state(away * direction, moves, drone_id=0)
    told = flying.tell(in_slot(), seen, [track(None, k) for k in seen], seconds=1.0).velocity
    worst = max(float(direction @ (np.array(told) - moves)) for direction, moves in ways)
    standing = max(float(direction @ -moves) for direction, moves in ways)
    assert worst <= max(standing, 0.0) + 1e-6


def test_between_two_that_stand_nobody_is_flown_into():
    flying = Flying(Formation(parameters()))
    seen = {k: state((north, 0.0, 0.0), drone_id=0) for k, north in enumerate((0.7, -1.2))}
    setpoint = flying.tell(in_slot(), seen, [track(None, 0), track(None, 1)], seconds=1.0)
    assert setpoint.velocity == (0.0, 0.0, 0.0)
    assert setpoint.clear_of == (0, 1)


def test_of_one_that_comes_and_one_that_stands_the_drone_is_between_in_the_middle_of_both_speeds():
    near = [HalfSpace(NORTH, -2.0), HalfSpace(SOUTH, 0.0)]
    assert least_closing((0.0, 0.0, 0.0), near, [], FASTEST)[0] == pytest.approx(-1.0, abs=0.01)


def test_a_step_aside_that_closes_in_on_nobody_is_kept():
    near = [HalfSpace(NORTH, -2.0), HalfSpace(SOUTH, 0.0)]
    assert least_closing((0.0, 2.0, 0.0), near, [], FASTEST)[1] == pytest.approx(2.0, abs=0.05)


def test_a_retreat_is_no_faster_than_it_is_asked_to_be():
    asked = [HalfSpace(NORTH, -0.5), HalfSpace((0.0, 1.0, 0.0), 1.0)]
    assert no_faster_than_asked((-2.0, -1.0, 0.0), asked) == pytest.approx((-0.5, -0.25, 0.0))
    assert no_faster_than_asked((2.0, 0.0, 0.0), asked) == (0.0, 0.0, 0.0)


def test_of_commands_that_close_in_on_nobody_the_first_is_taken():
    near = [HalfSpace(NORTH, 0.0)]
    assert best_of([(-1.0, 0.0, 0.0), (-2.0, 0.0, 0.0)], near) == (-1.0, 0.0, 0.0)
    assert best_of([(1.0, 0.0, 0.0), (0.5, 0.0, 0.0)], near) == (0.5, 0.0, 0.0)


@given(vector, vector, st.floats(0.05, 2.0), st.lists(limits, max_size=3))
def test_no_step_is_longer_than_allowed_and_where_it_is_possible_it_ends_within_the_limits(
    now, wanted, most, held
):
    now, wanted = (tuple((0.1 * np.array(v)).tolist()) for v in (now, wanted))
    wanted = wanted if excess(wanted, held) <= 0.0 else (0.0, 0.0, 0.0)
    step = stepped(now, wanted, most, held)
    assert math.dist(step, now) <= most + 1e-9
    assert excess(step, held) <= max(excess(now, held), 0.0) + 1e-6
    if math.hypot(*now) + 1e-6 < most:
        assert excess(step, held) <= 1e-4
