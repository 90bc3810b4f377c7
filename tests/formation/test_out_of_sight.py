import numpy as np
import pytest

from support.formation_states import Flying, in_slot, parameters, state, track
from swarmtrack.formation.formation import Formation
from swarmtrack.formation.out_of_sight import REMEMBERED_S, OutOfSight

COMES = state((4.0, 0.0, 0.0), (-1.0, 0.0, 0.0), drone_id=0)


def test_who_has_left_the_picture_is_expected_along_its_last_velocity_for_three_seconds():
    memory = OutOfSight()
    assert memory.states({7: COMES}, in_slot(), 0.0) == {}
    after = memory.states({}, in_slot(), 2.0)[7]
    assert after.position == pytest.approx((2.0, 0.0, 0.0))
    assert after.velocity == pytest.approx((-1.0, 0.0, 0.0))
    assert memory.states({}, in_slot(), REMEMBERED_S + 0.1) == {}
    assert memory.states({}, in_slot(), 2.0) == {}


def test_it_is_known_worse_every_moment():
    memory = OutOfSight()
    memory.states({7: COMES}, in_slot(), 0.0)
    sigmas = [np.sqrt(memory.states({}, in_slot(), t)[7].cov[0, 0]) for t in (0.5, 1.5, 2.5)]
    assert 0.1 < sigmas[0] < sigmas[1] < sigmas[2]


def test_that_this_drone_moved_meanwhile_is_counted():
    memory = OutOfSight()
    memory.states({7: COMES}, in_slot(velocity=(0.5, 0.0, 0.0)), 0.0)
    # Against this drone, which flew at 0.5 m/s, it came at 1 m/s: over ground at 0.5.
    after = memory.states({}, in_slot(off=(1.0, 0.0, 0.0), velocity=(1.0, 0.0, 0.0)), 2.0)[7]
    assert after.position == pytest.approx((2.0, 0.0, 0.0))
    assert after.velocity == pytest.approx((-1.5, 0.0, 0.0))


def test_who_is_seen_there_on_another_track_is_no_second_one():
    memory = OutOfSight()
    memory.states({7: COMES}, in_slot(), 0.0)
    assert memory.states({8: state((2.5, 0.5, 0.0), drone_id=0)}, in_slot(), 2.0) == {}
    assert list(memory.states({}, in_slot(), 2.1)) == [8]


@pytest.mark.parametrize("facts", [{"leap_age": 1.0}, {"heading_step_age": 1.0}])
def test_places_from_before_the_own_frame_stepped_are_forgotten(facts):
    memory = OutOfSight()
    memory.states({7: COMES}, in_slot(), 0.0)
    assert memory.states({}, in_slot(**facts), 2.0) == {}


def test_who_comes_and_leaves_the_picture_is_still_retreated_from():
    flying = Flying(Formation(parameters()))
    flying.tell(in_slot(), {7: state((3.0, 0.0, 0.0), (-1.0, 0.0, 0.0), drone_id=0)}, [track(None, 7)])
    setpoint = flying.tell(in_slot(), seconds=1.0)
    assert setpoint.velocity[0] < -0.5
    assert setpoint.clear_of == (7,)
    assert flying.tell(in_slot(), seconds=4.0).velocity == (0.0, 0.0, 0.0)
