"""Two autopilots under one ID are told from one whose frames come by two ports or two ways."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from swarmtrack.autopilot.limits import CONTRADICTION_TURNS
from swarmtrack.autopilot.senders import (
    NumberedStamps,
    SenderWatch,
    StampedAttitude,
    StampedPlace,
    attitudes_apart,
    clocks_apart,
    flight_states_apart,
    places_apart,
)
from swarmtrack.geometry.rotation import from_euler


def alternating(*first_numbers: int, rounds: int) -> Iterator[tuple[int, int]]:
    """(sender, number of its frame) of senders that take turns."""
    for n in range(rounds):
        for sender, first in enumerate(first_numbers):
            yield sender, (first + n) % 256


def contradiction(watch: SenderWatch, said: dict[int, object], rounds: int, first=(10, 200)) -> str:
    for k, (sender, number) in enumerate(alternating(*first, rounds=rounds)):
        watch.on_frame(number)
        watch.compare(0.01 * k, "state", said[sender], flight_states_apart)
    return watch.contradiction(0.02 * rounds)


def test_two_counts_that_contradict_each_other_are_two_autopilots():
    assert contradiction(SenderWatch(), {0: "landed", 1: "armed"}, 400) == "their flight states differ"
    # Soon enough to be a change of the mode that comes late by another port.
    assert contradiction(SenderWatch(), {0: "landed", 1: "armed"}, CONTRADICTION_TURNS // 2) == ""


def test_two_counts_that_agree_are_one_autopilot_s():
    assert contradiction(SenderWatch(), {0: "armed", 1: "armed"}, 400) == ""


@pytest.mark.parametrize("lost", [0, 3, 7, 20])
def test_one_count_that_changes_its_mind_is_one_autopilot_s(lost):
    watch = SenderWatch()
    for k in range(2000):
        watch.on_frame(k * (lost + 1) % 256)
        watch.compare(0.01 * k, "state", k // 20 % 2, flight_states_apart)
        assert watch.contradiction(0.01 * k) == ""


def test_what_comes_late_by_a_second_way_contradicts_nobody():
    watch = SenderWatch()
    for k, (sender, number) in enumerate(alternating(10, 200, rounds=400)):
        watch.on_frame(number)
        watch.on_stamped(1.3 if sender else None)
        watch.compare(0.01 * k, "state", sender, flight_states_apart)
        assert watch.contradiction(0.01 * k) == ""
        assert watch.delay == (1.3 if sender else 0.0)


def test_a_contradiction_is_forgotten_once_the_other_is_gone():
    watch = SenderWatch()
    assert contradiction(watch, {0: 1, 1: 2}, 20)
    assert watch.contradiction(10.0) == ""


def test_frames_that_are_missing_are_counted():
    watch = SenderWatch()
    for number in (250, 251, 254, 0, 1):
        watch.on_frame(number)
    assert (watch.came, watch.lost) == (5, 3)


def test_a_place_is_carried_on_by_its_velocity():
    here = StampedPlace(10.0, np.zeros(3), np.array((20.0, 0.0, 0.0)))
    later = StampedPlace(10.2, np.array((4.0, 0.0, 0.5)), np.zeros(3))
    assert places_apart(here, later) == ""
    assert (
        places_apart(here, later._replace(position=np.array((4.0, 50.0, 0.0))))
        == "their places are 50 m apart"
    )
    # Too long after to say.
    assert places_apart(here, StampedPlace(12.0, np.full(3, 90.0), np.zeros(3))) == ""
    assert places_apart(here, later._replace(position=np.full(3, math.nan))) == ""


def test_a_drone_that_flips_turns_between_two_attitudes():
    level, turned = from_euler(0.0, 0.0, 0.0), from_euler(0.4, 0.0, 0.0)
    assert attitudes_apart(StampedAttitude(1.0, level, 0.1), StampedAttitude(1.02, turned, 0.1)) == (
        "their attitudes are 23° apart"
    )
    assert attitudes_apart(StampedAttitude(1.0, level, 20.0), StampedAttitude(1.02, turned, 20.0)) == ""


def test_clocks_as_far_apart_as_a_way_delays_may_be_one():
    assert clocks_apart(40.0, 44.0) == ""
    assert clocks_apart(40.0, -460.0) == "their clocks are 500 s apart"


def test_a_frame_fits_where_the_first_way_lost_it():
    numbers = NumberedStamps()
    assert not numbers.holds(1.0, 1)
    for k in range(100):
        if k not in (40, 41, 42):
            numbers.add(0.005 * k, (250 + 2 * k) % 256)
    assert all(numbers.holds(0.005 * k, (250 + 2 * k) % 256) for k in (40, 41, 42))
    assert not numbers.holds(0.2, (250 + 2 * 60) % 256)
    # One that came is a copy by its content; and nothing is known beyond the ends.
    assert not numbers.holds(0.005 * 50, (250 + 100) % 256)
    assert not numbers.holds(9.0, 0)
