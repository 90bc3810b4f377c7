"""A drone that loses its place, and finds another."""

import numpy as np
import pytest

from support.observer import LEFT, RIGHT, Observer, at
from swarmtrack.team.adrift import Adrift


def states(adrift, *sigmas):
    """Whether it has no place, at each of these, a second apart."""
    begin = max(adrift.stated_t, 0.0)
    return [adrift.is_at(begin + 1.0 + k, sigma) for k, sigma in enumerate(sigmas)]


def test_a_place_that_becomes_uncertain_is_lost_until_it_is_known_again():
    adrift = Adrift(0.1)
    assert states(adrift, 0.1, 1.0, 3.0, 9.0) == [False, False, True, True]
    assert not adrift.found
    assert states(adrift, 0.1) == [False]
    assert adrift.found
    assert adrift.begin_frame() == pytest.approx(9.0, rel=0.01)
    assert (adrift.lost, adrift.found) == (0.0, False)


def test_a_receiver_that_knows_little_and_always_as_little_has_a_place():
    adrift = Adrift(0.3)
    assert states(adrift, 0.3, 4.0, 4.0) == [False, True, False]
    assert adrift.found
    adrift.begin_frame()
    assert states(adrift, 4.0, 4.2, 3.9) == [False, False, False]
    assert not adrift.found


def test_a_peer_that_states_anything_by_turns_begins_no_frame_at_will():
    adrift, begun = Adrift(0.1), 0
    for k in range(100):
        adrift.is_at(0.1 * k, 9.0 + k if k % 2 else 0.1)
        if adrift.found:
            adrift.begin_frame()
            begun += 1
    assert 1 <= begun <= 10


def test_what_is_said_of_an_earlier_time_changes_nothing():
    adrift = Adrift(0.1)
    states(adrift, 0.1, 3.0, 9.0)
    assert adrift.is_at(2.5, 6.0)
    assert not adrift.found


def test_a_drone_that_doubts_itself_has_lost_nothing():
    adrift = Adrift(0.1)
    assert states(adrift, 1000.0, 0.1) == [False, False]
    assert not adrift.found


@pytest.mark.parametrize("by_motion", [False, True], ids=["places", "velocity"])
def test_a_teammate_that_finds_itself_elsewhere_keeps_its_name(by_motion):
    observer, off = Observer(), np.array([0.3, -1.5, 0.0])
    observer.hears(2, LEFT)
    observer.hears(3, RIGHT)
    observer.sees(3.0, a=LEFT, b=RIGHT)
    for sigma in np.arange(1.0, 9.0):
        observer.is_told(2, LEFT, sigma=sigma)
        observer.is_told(3, RIGHT)
        assert observer.sees(1.0, a=LEFT, b=RIGHT) == {"a": 2, "b": 3}
    for _ in range(10):
        if by_motion:
            observer.says_it_moved(2, off)
        observer.is_told_at(2, at(LEFT) + off)
        observer.is_told(3, RIGHT)
        assert observer.sees(1.0, a=LEFT, b=RIGHT) == {"a": 2, "b": 3}
