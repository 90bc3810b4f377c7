"""How well slots are held: against flights whose errors are known."""

import math

import numpy as np
import pytest

from swarmtrack.lab.score.formation_score import (
    after_it_vanished,
    formation_score,
    nearest_pair,
    slot_errors,
)

SLOTS = np.array([[0.0, 0.0, 0.0], [-4.0, 3.0, -1.0], [-4.0, -3.0, 1.0]])


def flight(*, off=(0.0, 0.0, 0.0), seconds=20.0):
    """Times, and places of a leader that flies north at 1.5 m/s and of two followers; the second is `off` its slot."""
    t = np.arange(0.0, seconds, 0.1)
    leader = np.outer(1.5 * t, (1.0, 0.0, 0.0))
    places = leader[:, None] + SLOTS
    places[:, 2] += off
    return t, places


def test_an_error_is_the_distance_from_the_slot_beside_the_true_leader():
    t, places = flight(off=(0.0, 0.6, 0.8))
    held = slot_errors(t, places, SLOTS, 5.0, 15.0)
    assert held.errors.shape == (100, 2)
    np.testing.assert_allclose(held.errors[:, 0], 0.0, atol=1e-9)
    np.testing.assert_allclose(held.errors[:, 1], 1.0)
    np.testing.assert_allclose(held.last, (0.0, 1.0), atol=1e-9)


def test_what_is_judged_begins_and_ends_but_separations_count_always():
    t, places = flight()
    places[t < 1.0, 1] = places[t < 1.0, 2] + (0.3, 0.4, 0.0)
    places[t > 15.0, 2] += (0.0, -9.0, 0.0)
    held = slot_errors(t, places, SLOTS, 5.0, 15.0)
    assert held.errors.max() < 1e-9
    assert held.nearest == pytest.approx(0.5)
    later = slot_errors(t, places, SLOTS, 5.0, math.inf)
    assert later.errors.max() == pytest.approx(9.0)
    np.testing.assert_allclose(later.last, (0.0, 9.0), atol=1e-9)


def test_a_flight_that_nobody_told_of_says_nothing():
    held = slot_errors(np.empty(0), np.empty((0, 3, 3)), SLOTS, 5.0, 15.0)
    score = formation_score([held])
    assert (score.lost, score.min_separation_m) == (0, math.inf)
    assert math.isnan(score.error_p50_m)
    assert math.isnan(score.end_p95_m)
    assert nearest_pair(np.zeros((4, 1, 3))) == math.inf


def test_over_several_flights_all_errors_count_and_who_is_three_metres_off_is_lost():
    flights = [slot_errors(*flight(off=(0.0, off, 0.0)), SLOTS, 5.0, 20.0) for off in (1.0, 3.5)]
    score = formation_score(flights, holds=2)
    assert (score.followers, score.lost, score.holds) == (4, 1, 2)
    assert score.error_p50_m == pytest.approx(0.5)
    assert score.error_p95_m == pytest.approx(3.5)


def test_when_the_leader_has_gone_the_fastest_and_the_farthest_are_told():
    t, places = flight(seconds=10.0)
    gone_s = 4.0
    for k, brakes_s in ((1, 1.0), (2, 2.5)):
        stop = np.minimum(t, gone_s + brakes_s)
        places[:, k] = np.outer(1.5 * stop, (1.0, 0.0, 0.0)) + SLOTS[k]
    gone = after_it_vanished(t, places[:, 1:], gone_s)
    assert gone.speeds == pytest.approx((1.5, 1.5, 0.0, 0.0), abs=0.05)
    assert gone.flown_on_m == pytest.approx(1.5 * 2.5)
    assert math.isnan(after_it_vanished(t, places[:, 1:], 11.0).flown_on_m)
    # Speeds of times that were not flown are not known.
    assert math.isnan(after_it_vanished(t, places[:, 1:], 8.0).speeds[-1])
