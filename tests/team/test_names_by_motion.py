"""Names that motion gives, or takes."""

import numpy as np
import pytest

from support.observer import LEFT, MIDDLE, RIGHT, SCAN_S, at, shifted
from support.swaying import Sway
from swarmtrack.team.proof import P_PROVED


def test_a_name_that_its_place_gave_is_proved_by_motion_in_seconds_and_says_since_when():
    flight = Sway({"a": LEFT, "b": RIGHT}, {2: 12, 3: 13}, {2: LEFT, 3: RIGHT})
    assert flight.flies(1.0) == {"a": 2, "b": 3}
    assert set(flight.proofs().values()) == {None}
    flight.flies(9.0)
    for proof in flight.proofs().values():
        assert proof.probability > P_PROVED
        assert 1.0 < proof.since < 10.0
    assert flight.told == []


@pytest.mark.parametrize("is_taken", [False, True], ids=["nobody came near", "a stranger took the track"])
def test_a_proof_outlives_a_gap_in_which_the_track_did_not_become_another(is_taken):
    flight = Sway(
        {"a": LEFT, "b": RIGHT, "c": MIDDLE}, {2: 12, 3: 13, 4: 14}, {2: LEFT, 3: RIGHT}, said={2: 12, 3: 13}
    )
    flight.flies(10.0)
    before = flight.proofs()[2]
    flight.missed = ("a",)
    flight.flies(0.5)
    flight.missed = ()
    if is_taken:
        flight.places["a"], flight.sways[2] = shifted(LEFT, 25.0), 14
        del flight.places["c"]
    flight.flies(12 * SCAN_S)
    after = flight.proofs().get(2)
    assert before is not None
    assert (after is not None and after.since == before.since) != is_taken


def test_who_starts_on_the_other_s_pad_gets_its_own_name_by_its_motion_and_that_is_said():
    flight = Sway({"a": LEFT, "b": RIGHT}, {2: 12, 3: 13}, {2: RIGHT, 3: LEFT})
    assert flight.flies(0.5) == {"a": 3, "b": 2}
    assert flight.flies(14.0) == {"a": 2, "b": 3}
    found = {told.drone_id: told for told in flight.told if told.miss_m is not None}
    assert found.keys() == {2, 3}
    apart = np.linalg.norm(at(LEFT) - at(RIGHT))
    for told in found.values():
        assert told.miss_m == pytest.approx(apart, rel=0.2)


def test_a_drone_is_named_by_its_motion_although_it_should_be_behind_the_camera():
    flight = Sway({"a": LEFT, "b": RIGHT}, {2: 12, 3: 13}, {2: LEFT})
    flight.observer.hears(3, RIGHT, metres=-8.0)
    assert flight.flies(1.0)["b"] is None
    assert flight.flies(11.0) == {"a": 2, "b": 3}


def test_a_drone_that_lies_about_its_motion_loses_its_name_and_that_is_said():
    flight = Sway({"a": LEFT, "b": RIGHT}, {2: 12, 3: 13}, {2: LEFT, 3: RIGHT}, said={2: 12, 3: 33})
    assert flight.flies(1.0) == {"a": 2, "b": 3}
    names = flight.flies(11.0)
    assert names["a"] == 2
    assert names["b"] != 3
    assert (3, None) in {(told.drone_id, told.miss_m) for told in flight.told}


def test_a_stranger_that_sways_by_itself_is_nobody_although_it_is_where_a_drone_should_be():
    flight = Sway({"c": MIDDLE, "a": LEFT}, {2: 12, 4: 14}, {2: LEFT, 3: MIDDLE}, said={2: 12, 3: 13})
    names = flight.flies(12.0)
    assert names["a"] == 2
    assert names["c"] != 3


def test_where_all_teammates_move_elsewhere_than_they_say_this_drone_doubts_itself_and_goes_on():
    """Its compass is off by 20°: no place fits, and motion names them all the same."""
    flight = Sway(
        {"a": LEFT, "b": RIGHT}, {2: 12, 3: 13}, {2: shifted(LEFT, -150.0), 3: shifted(RIGHT, -150.0)}
    )
    assert flight.flies(4.0) == {"a": 2, "b": 3}
    for _ in range(8):
        assert flight.observer.identities.self_doubt
        assert flight.flies(1.0) == {"a": 2, "b": 3}


def test_one_that_moves_elsewhere_than_it_says_is_no_reason_to_doubt_oneself():
    flight = Sway({"a": LEFT, "b": RIGHT}, {2: 12, 3: 13}, {2: LEFT, 3: shifted(RIGHT, -150.0)})
    assert flight.flies(12.0) == {"a": 2, "b": 3}
    assert not flight.observer.identities.self_doubt
