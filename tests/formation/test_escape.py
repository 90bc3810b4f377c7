"""Height as a way out: when, which way, how far, and never into the heights of others."""

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from support.formation_states import SLOTS, Flying, in_slot, parameters, state, track
from swarmtrack.formation.escape import FreeHeights, room, way_out, who_collides
from swarmtrack.formation.formation import Formation
from swarmtrack.formation.margins import AT_HEIGHT_M, ESCAPE_APART_M, ESCAPE_MOST_M
from swarmtrack.formation.obstacles import Obstacle

STILL = (0.0, 0.0, 0.0)


def obstacle(place, velocity):
    distance = math.hypot(*place)
    return Obstacle(1, place, velocity, tuple(x / distance for x in place), distance, 0.0, 0.0)


def test_who_comes_straight_on_collides_when_less_than_a_second_is_left():
    assert who_collides([obstacle((6.0, 0.0, 0.0), (-4.0, 0.0, 0.0))], STILL) is None
    assert who_collides([obstacle((4.5, 0.0, 0.0), (-4.0, 0.0, 0.0))], STILL) is not None


@pytest.mark.parametrize(
    ("place", "velocity", "flies"),
    [
        ((3.0, 2.0, 0.0), (-4.0, 0.0, 0.0), STILL),  # passes
        ((3.0, 0.0, 0.0), (4.0, 0.0, 0.0), STILL),  # leaves
        ((3.0, 0.0, 0.0), (-0.3, 0.0, 0.0), STILL),  # drifts
        ((3.0, 0.0, 0.0), (-4.0, 0.0, 0.0), (-4.0, 0.0, 0.0)),  # is retreated from as fast
    ],
)
def test_who_passes_leaves_drifts_or_is_outrun_does_not_collide(place, velocity, flies):
    assert who_collides([obstacle(place, velocity)], flies) is None


def test_of_two_that_collide_the_first_counts():
    first, second = obstacle((2.0, 0.0, 0.0), (-4.0, 0.0, 0.0)), obstacle((0.0, 4.0, 0.0), (0.0, -4.0, 0.0))
    assert who_collides([second, first], STILL) is first


@given(st.floats(-50.0, 0.0), st.lists(st.floats(-50.0, 0.0), max_size=7))
@example(-0.125, [0.0, -0.75])
def test_no_room_leads_nearer_to_another_slots_height_than_half_a_metre_or_the_own_slot(own, others):
    free = room(own, others)
    assert own - ESCAPE_MOST_M <= free.highest <= own <= free.lowest <= own + ESCAPE_MOST_M
    for other in others:
        for height in free[:2]:
            assert abs(height - other) >= min(ESCAPE_APART_M, abs(own - other)) - 1e-9


def test_it_gives_way_to_the_side_where_the_other_is_not_and_else_where_more_room_is():
    free = FreeHeights(-11.0, -9.5, -10.0)
    lower, higher, level = (obstacle((3.0, 0.0, z), STILL) for z in (0.5, -0.5, 0.0))
    assert way_out(lower, -10.0, free, 1.0) == (0.0, 0.0, -1.0)
    assert way_out(higher, -10.0, free, 1.0) == (0.0, 0.0, 1.0)
    assert way_out(level, -10.0, free, 1.0) == (0.0, 0.0, -1.0)
    assert way_out(level, -9.9, free, 1.0) == (0.0, 0.0, 1.0), "whoever has begun goes on"
    assert way_out(level, -10.0, FreeHeights(-10.0, -10.0, -10.0), 1.0) == STILL


def heights_flown(*beside):
    """m below its slot's height, of a drone that somebody steers at, level, with 4 m/s; beside: how far below it other
    slots are."""
    here = (-4.0, 3.0, -8.0)
    others = {3 + k: (-9.0 - 3.0 * k, 9.0, here[2] + below) for k, below in enumerate(beside)}
    flying = Flying(Formation(parameters(slots={1: STILL, 2: here, **others})))
    off, heights, flown, there = np.zeros(3), [], STILL, np.array([12.0, 0.0, 0.0])
    begun = np.array([0.0, 0.0, here[2] - SLOTS[2][2]])
    for k in range(70):
        own = in_slot(off=tuple(begun + off), velocity=flown)
        place = there - off
        distance = float(np.linalg.norm(place))
        comes = (-4.0 if k > 15 else 0.0) * place / max(distance, 0.1)
        seen, tracks = {}, []
        if distance > 0.3:
            seen[11] = state(tuple(place), tuple(comes - flown), drone_id=0)
            tracks.append(track(None, 11))
        there = there + 0.1 * comes * (1.0, 1.0, 0.0)
        flown = flying.tell(own, seen, tracks).velocity
        off += 0.1 * np.array(flown)
        heights.append(float(off[2]))
    return heights


def test_a_drone_that_is_about_to_be_hit_leaves_its_height_by_no_more_than_it_may():
    assert AT_HEIGHT_M < max(map(abs, heights_flown())) <= ESCAPE_MOST_M + 0.05


def test_it_stays_half_a_metre_off_the_heights_of_others():
    heights = heights_flown(0.9, -0.9)
    assert max(map(abs, heights)) <= 0.9 - ESCAPE_APART_M + 0.05
