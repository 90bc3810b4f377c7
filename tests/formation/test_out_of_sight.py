import numpy as np
import pytest

from support.formation_states import Flying, in_slot, parameters, state, track
from swarmtrack.formation.formation import Formation
from swarmtrack.formation.margins import OUT_OF_SIGHT_REMEMBERED_S
from swarmtrack.formation.out_of_sight import OutOfSight

COMES = state((4.0, 0.0, 0.0), (-1.0, 0.0, 0.0), drone_id=0)


def told(own=None, state=COMES):
    """A memory of track 7, which was seen there for long, until 0 s."""
    memory = OutOfSight()
    for t in (-5.0, 0.0):
        assert memory.states({7: state}, own or in_slot(), t) == {}
    return memory


def test_who_has_left_the_picture_is_expected_along_its_last_velocity_for_three_seconds():
    memory = told()
    after = memory.states({}, in_slot(), 2.0)[7]
    assert after.position == pytest.approx((2.0, 0.0, 0.0))
    assert after.velocity == pytest.approx((-1.0, 0.0, 0.0))
    assert memory.states({}, in_slot(), OUT_OF_SIGHT_REMEMBERED_S + 0.1) == {}
    assert memory.states({}, in_slot(), 2.0) == {}


def test_nobody_is_remembered_for_longer_than_it_was_seen():
    memory = OutOfSight()
    for t in (-1.0, 0.0):
        memory.states({7: COMES}, in_slot(), t)
    assert list(memory.states({}, in_slot(), 0.9)) == [7]
    assert memory.states({}, in_slot(), 1.1) == {}


def test_it_is_known_worse_every_moment():
    memory = told()
    sigmas = [np.sqrt(memory.states({}, in_slot(), t)[7].cov[0, 0]) for t in (0.5, 1.5, 2.5)]
    assert 0.1 < sigmas[0] < sigmas[1] < sigmas[2]


def test_that_this_drone_moved_meanwhile_is_counted():
    memory = told(in_slot(velocity=(0.5, 0.0, 0.0)))
    # Against this drone, which flew at 0.5 m/s, it came at 1 m/s: over ground at 0.5.
    after = memory.states({}, in_slot(off=(1.0, 0.0, 0.0), velocity=(1.0, 0.0, 0.0)), 2.0)[7]
    assert after.position == pytest.approx((2.0, 0.0, 0.0))
    assert after.velocity == pytest.approx((-1.5, 0.0, 0.0))


def test_who_is_seen_there_on_another_track_is_no_second_one():
    memory = told()
    assert memory.states({8: state((2.5, 0.5, 0.0), drone_id=0)}, in_slot(), 2.0) == {}
    assert memory.states({}, in_slot(), 2.1) == {}


@pytest.mark.parametrize("speed", [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)])
def test_who_did_not_come_is_not_remembered(speed):
    assert told(state=state((4.0, 0.0, 0.0), speed, drone_id=0)).states({}, in_slot(), 0.5) == {}


@pytest.mark.parametrize("facts", [{"leap_age": 1.0}, {"heading_step_age": 1.0}])
def test_places_from_before_the_own_frame_stepped_are_forgotten(facts):
    memory = told()
    assert memory.states({}, in_slot(**facts), 2.0) == {}


def test_who_comes_and_leaves_the_picture_is_still_retreated_from():
    flying = Flying(Formation(parameters()))
    for k in range(31):
        seen = {7: state((6.0 - 0.1 * k, 0.0, 0.0), (-1.0, 0.0, 0.0), drone_id=0)}
        flying.tell(in_slot(), seen, [track(None, 7)])
    setpoint = flying.tell(in_slot(), seconds=1.0)
    assert setpoint.velocity[0] < -0.5
    assert setpoint.clear_of == (7,)
    assert flying.tell(in_slot(), seconds=4.0).velocity == (0.0, 0.0, 0.0)
