"""A drift of the own height is found by the camera, and nothing else is taken for one."""

import itertools
import math

import numpy as np
import pytest

from swarmtrack.formation.heights import HeightWatch
from swarmtrack.formation.margins import (
    HEIGHT_DRIFT_GONE_M,
    HEIGHT_DRIFT_REPORTED_M,
    HEIGHT_DRIFT_STALE_S,
    HEIGHT_LEAP_AFTER_S,
    TILT_ERROR_LASTS_S,
    TILT_ERROR_RAD,
)
from swarmtrack.relative.heights import HeightSight

DT, LEVEL, LEVER, SIGMA = 0.15, 5.0, 0.1, 0.1


def sight(t, off, drone_id=1, word="a moved"):
    return HeightSight(drone_id, word, t, off, SIGMA, LEVEL, LEVER)


class Seen:
    """What a camera sees of teammates for a while, with the errors that the filter believes in; `drift` [m/s] is that
    of the own height, or of those named in `drifting`."""

    def __init__(self, seed, drones=(1,)):
        self.rng = np.random.default_rng(seed)
        self.t = 0.0
        self.constant = {drone: self.rng.normal(0.0, 2.0) for drone in drones}
        self.distance = {drone: self.rng.standard_normal() for drone in drones}
        self.tilt = self.rng.normal(0.0, TILT_ERROR_RAD)
        self.off = dict.fromkeys(drones, 0.0)

    def fly(self, watch, seconds, drift=0.0, drifting=None):
        """The time at which something is said; None where nothing is."""
        for _ in range(round(seconds / DT)):
            self.t += DT
            share = math.exp(-DT / TILT_ERROR_LASTS_S)
            self.tilt = (
                share * self.tilt + TILT_ERROR_RAD * math.sqrt(1.0 - share**2) * self.rng.standard_normal()
            )
            for drone in self.off if drifting is None else drifting:
                self.off[drone] += drift * DT
            watch.add_sights(
                [
                    sight(
                        self.t,
                        self.constant[drone]
                        + off
                        + LEVEL * self.tilt
                        + LEVER * self.distance[drone]
                        + self.rng.normal(0.0, SIGMA),
                        drone,
                    )
                    for drone, off in self.off.items()
                ],
                self.t,
            )
            if watch.doubt is not None:
                return self.t
        return None


def learned_distance(seed, first=0.2, last=0.05, learns_s=4.0):
    """(sigma, error) of the logarithm of a distance, scan by scan, as an estimate's that takes in what it sees."""
    rng = np.random.default_rng(seed)
    sigma, error = first, first * rng.standard_normal()
    for k in range(200):
        before, sigma = sigma, last + (first - last) * math.exp(-DT * k / learns_s)
        left = sigma / before
        error = left**2 * error + sigma * math.sqrt(1.0 - left**2) * rng.standard_normal()
        yield sigma, error


def test_a_distance_that_is_learned_is_no_drift():
    below, rng = 2.5, np.random.default_rng(0)
    for seed in range(100):
        watch = HeightWatch((1,))
        for k, (sigma, error) in enumerate(learned_distance(seed)):
            off = below * error + rng.normal(0.0, SIGMA)
            seen = HeightSight(1, "a moved", DT * k, off, SIGMA, LEVEL, below * sigma, 0.0, sigma)
            watch.add_sights([seen], seen.t)
            assert watch.doubt is None


@pytest.mark.parametrize("drift", [0.1, -0.1, 0.3])
def test_a_drift_is_said_before_it_is_a_metre(drift):
    for seed in range(20):
        watch, seen = HeightWatch((1,)), Seen(seed)
        assert seen.fly(watch, 20.0) is None
        assert seen.fly(watch, 20.0, drift) is not None
        assert 0.2 < abs(seen.off[1]) < 1.0


def test_an_honest_height_is_said_of_nobody_and_the_filter_is_as_good_as_it_thinks():
    nees = []
    for seed in range(40):
        watch, seen = HeightWatch((1, 3)), Seen(seed, (1, 3))
        assert seen.fly(watch, 60.0) is None
        nees += [(drift.off / drift.sigma) ** 2 for drift in watch.drifts]
    # It allows for drifts, of which there were none: it may be too modest, not too sure.
    assert 0.05 < np.mean(nees) < 1.3


def test_a_constant_between_two_heights_is_no_drift():
    for seed, constant in enumerate((60.0, -60.0, 4000.0)):
        watch, seen = HeightWatch({1}), Seen(seed)
        seen.constant[1] = constant
        assert seen.fly(watch, 60.0) is None
        assert abs(watch.drifts[0].off) < HEIGHT_DRIFT_REPORTED_M


def test_a_height_that_leaps_is_said_and_a_single_wrong_box_is_not():
    watch, seen = HeightWatch((1,)), Seen(1)
    seen.fly(watch, 10.0)
    watch.add_sights([sight(seen.t + 0.01, seen.constant[1] + 4.0)], seen.t + 0.01)
    assert watch.doubt is None
    assert seen.fly(watch, 3.0) is None
    seen.off[1] = 3.0
    leapt = seen.t
    assert leapt < seen.fly(watch, 3.0) < leapt + HEIGHT_LEAP_AFTER_S + 3 * DT
    assert "wrong by 3." in watch.doubt or "wrong by 2." in watch.doubt


def test_it_is_said_no_more_once_the_heights_agree_again():
    watch, seen = HeightWatch((1,)), Seen(2)
    seen.fly(watch, 10.0)
    seen.fly(watch, 10.0, 0.2)
    assert watch.doubt is not None
    assert abs(watch.drifts[0].off) > HEIGHT_DRIFT_REPORTED_M
    while seen.off[1] > 0.0:
        seen.fly(watch, DT, -0.2)
    for _ in range(round(3.0 / DT)):
        seen.fly(watch, DT)
    assert watch.doubt is None
    assert abs(watch.drifts[0].off) < HEIGHT_DRIFT_GONE_M


def test_of_two_that_agree_the_third_is_wrong():
    watch, seen = HeightWatch((1,)), Seen(3, (1, 3))
    seen.fly(watch, 10.0)
    seen.fly(watch, 20.0, 0.2)
    while len([drift for drift in watch.drifts if drift.is_reported]) < 2:
        seen.fly(watch, DT, 0.2)
    assert watch.doubt.startswith("own height seems wrong by 0.")
    watch, seen = HeightWatch((1,)), Seen(3, (1, 3))
    seen.fly(watch, 10.0)
    seen.fly(watch, 20.0, 0.2, drifting=(1,))
    assert watch.doubt.startswith("drone 1's height seems wrong by 0.")
    watch, seen = HeightWatch((1,)), Seen(3)
    seen.fly(watch, 10.0)
    seen.fly(watch, 20.0, 0.2)
    assert watch.doubt.startswith("own or drone 1's height seems wrong by 0.")


def test_a_teammate_by_whom_nobody_flies_holds_nobody():
    watch, seen = HeightWatch((1,)), Seen(4, (1, 3))
    seen.fly(watch, 10.0)
    assert seen.fly(watch, 15.0, 0.2, drifting=(3,)) is None
    assert [drift.drone_id for drift in watch.drifts if drift.is_reported] == [3]


def test_a_leader_that_was_lost_while_it_drifted_is_no_witness_for_the_own_height():
    watch, seen = HeightWatch((1,)), Seen(4, (1, 3))
    seen.fly(watch, 10.0)
    while watch.drifts[0].off < HEIGHT_DRIFT_GONE_M:
        assert seen.fly(watch, DT, 0.2) is None
    assert watch.drifts[0].off < HEIGHT_DRIFT_REPORTED_M
    seen.off = {3: seen.off[3]}
    assert seen.fly(watch, 5.0, 0.2) is not None
    assert watch.doubt.startswith("own or drone 3's height seems wrong by 0.")


def test_another_life_of_a_teammate_and_a_long_silence_begin_anew():
    for word, pause in (("b moved", 0.0), ("a moved", HEIGHT_DRIFT_STALE_S + 1.0)):
        watch, seen = HeightWatch((1,)), Seen(5)
        seen.fly(watch, 10.0)
        seen.fly(watch, 20.0, 0.2)
        assert watch.doubt is not None
        t = seen.t + pause
        watch.add_sights([], t)
        watch.add_sights([sight(t + DT, 0.0, word=word)], t + DT)
        assert watch.doubt is None


def test_the_same_sight_counts_once_and_what_is_no_number_never():
    once, often = HeightWatch((1,)), HeightWatch((1,))
    for k in range(50):
        seen = sight(k * DT, 0.1 * (k % 3))
        once.add_sights([seen], k * DT)
        for _ in range(3):
            often.add_sights([seen, sight(k * DT + 0.01, math.nan)], k * DT)
    assert all(a == b for a, b in itertools.zip_longest(once.drifts, often.drifts))
