"""Names that motion proves, by the whole of `Identities`: wrong starts, spoofed motion, and what is told of them."""

import numpy as np
import pytest

from support.observer import LEFT, MIDDLE, RIGHT, SCAN_S, at, shifted
from support.swaying import SIZE, Sway
from swarmtrack.identity.proof import LASTS_S, PROVED, Proofs
from swarmtrack.identity.weighing import PLACE_ALONE


def test_a_name_that_its_place_gave_is_proved_by_motion_in_seconds_and_says_since_when():
    flight = Sway({"a": LEFT, "b": RIGHT}, {2: 12, 3: 13}, {2: LEFT, 3: RIGHT})
    assert flight.flies(1.0) == {"a": 2, "b": 3}
    assert set(flight.proofs().values()) == {None}
    flight.flies(9.0)
    for proof in flight.proofs().values():
        assert proof.probability > PROVED
        assert 1.0 < proof.since < 10.0
    assert flight.told == []


def test_a_name_is_stated_more_surely_than_by_place_once_its_proof_has_lasted():
    flight = Sway({"a": LEFT, "b": RIGHT}, {2: 12, 3: 13}, {2: LEFT, 3: RIGHT})
    surest = {True: 0.0, False: 0.0}
    while flight.observer.t < 12.0:
        flight.flies(SCAN_S)
        for entry in flight.observer.identities.label(flight.observer.tracks):
            lasts = entry.proof is not None and flight.observer.t - entry.proof.since >= LASTS_S
            surest[lasts] = max(surest[lasts], entry.identity_probability)
    assert surest[False] <= PLACE_ALONE < PROVED < surest[True]


@pytest.mark.parametrize(
    ("near", "seconds", "stays"),
    [(None, 0.5, True), (25.0, 0.5, False), (None, 1.5, False)],
    ids=["nobody came near", "a stranger did", "for too long"],
)
def test_a_proof_outlives_a_gap_in_which_the_track_cannot_have_become_another(near, seconds, stays):
    flight = Sway(
        {"a": LEFT, "b": RIGHT, "c": MIDDLE}, {2: 12, 3: 13, 4: 14}, {2: LEFT, 3: RIGHT}, said={2: 12, 3: 13}
    )
    flight.flies(10.0)
    before = flight.proofs()[2]
    flight.places["c"] = MIDDLE if near is None else shifted(LEFT, near)
    flight.missed = ("a",)
    flight.flies(seconds)
    flight.missed = ()
    flight.flies(6 * SCAN_S)
    after = flight.proofs()[2]
    assert before is not None
    assert (after is not None and after.since == before.since) == stays


def test_who_starts_on_the_other_s_pad_gets_its_own_name_by_its_motion_and_that_is_said():
    flight = Sway({"a": LEFT, "b": RIGHT}, {2: 12, 3: 13}, {2: RIGHT, 3: LEFT})
    assert flight.flies(0.5) == {"a": 3, "b": 2}
    assert flight.flies(14.0) == {"a": 2, "b": 3}
    found = {told.drone_id: told for told in flight.told if told.miss_m is not None}
    assert found.keys() == {2, 3}
    apart = np.linalg.norm(at(LEFT) - at(RIGHT))
    for told in found.values():
        assert told.miss_m == pytest.approx(apart, rel=0.2)


class Compared:
    """Motion of drones 1 … m compared with tracks: log ratios (n, m)."""

    def __init__(self, *ratios):
        self.ratios = np.array([ratios])
        self.exact = tuple(range(1, 1 + self.ratios.shape[2]))
        self.turn_weight = np.ones(1)

    def log_ratios(self, tracks, drones):
        return self.ratios


@pytest.mark.parametrize(
    ("ratios", "proved"),
    [
        (((13.8, -13.8), (13.8, 13.8)), {(1, 1), (2, 2)}),
        (((13.8, 13.8), (13.8, 13.8)), set()),
        (((13.8, 2.0), (2.0, 3.0)), {(1, 1)}),
    ],
    ids=["one may be both, the other is the first", "both may be both", "neither is a rival"],
)
def test_who_moves_like_others_is_proved_by_who_the_others_cannot_be(ratios, proved):
    proofs = Proofs()
    proofs.judge(1.0, (1, 2), Compared(*ratios))
    assert {pair for pair in ((1, 1), (1, 2), (2, 1), (2, 2)) if proofs.of(*pair)} == proved


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


def test_others_that_see_it_elsewhere_do_not_overrule_what_motion_proves():
    flight = Sway({"a": LEFT, "b": RIGHT}, {2: 12, 3: 13}, {2: LEFT, 3: RIGHT})
    flight.flies(10.0)
    flight.observer.identities.overrule(2, flight.observer.t)
    assert flight.flies(SCAN_S)["a"] == 2


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


def test_who_doubts_itself_does_not_tell_by_their_places_who_is_who_of_two_that_move_alike():
    """Its compass is off by 10°."""
    flight = Sway(
        {"a": LEFT, "b": RIGHT}, {2: 12, 3: 12}, {2: shifted(LEFT, -75.0), 3: shifted(RIGHT, -75.0)}
    )
    flight.flies(6.0)
    assert flight.observer.identities.self_doubt
    for _ in range(20):
        assert flight.flies(SCAN_S) == {"a": None, "b": None}


def test_who_does_not_know_to_which_side_it_looks_names_by_place_who_alone_is_left():
    """Its compass is off by 90°; motion has told it who the first two are, and not yet which way is north."""
    flight = Sway(
        {"a": LEFT, "b": RIGHT}, {2: 31, 3: 32, 4: 33}, {2: LEFT, 3: RIGHT, 4: MIDDLE}, north_deg=90.0
    )
    assert flight.flies(6.0) == {"a": 2, "b": 3}
    assert flight.observer.identities.self_doubt
    flight.places["c"], flight.observer.sizes["c"] = MIDDLE, SIZE
    assert flight.flies(LASTS_S)["c"] == 4
    assert flight.proofs()[4] is None
