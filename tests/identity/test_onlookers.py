"""What teammates say of where they see this drone: which of it speaks for a wrong start, and which proves nothing."""

import math

import numpy as np
import pytest

from support.observer import LEFT, Observer
from swarmtrack.identity.onlookers import COUNTS_IN_DOUBT_S, COUNTS_S, Onlookers
from swarmtrack.messages import Sighting, SightingReport

HERE, THERE = np.zeros((1, 3)), np.array([[0.0, 2.0, 0.0]])
EXACT = np.zeros(1)


def report(observer, position, sees, *, t=1.0, drone_id=1, sigma=0.03, position_sigma=0.1):
    """From a drone at `position` (3,) m that sees `drone_id` at `sees` (3,) m."""
    ray = np.asarray(sees, float) - position
    sighting = Sighting(drone_id, 0.97, ray / np.linalg.norm(ray), sigma)
    return SightingReport(
        observer, "0000000a", 1, t, 0.0, np.asarray(position, float), position_sigma, (), (sighting,)
    )


@pytest.fixture
def onlookers():
    """Of drone 1, which thinks that it hovers at the origin."""
    watched = Onlookers(1)
    watched.follow(1.0, np.zeros(3), 0.05, in_doubt=False)
    return watched


def gain(onlookers):
    """By how much what is said speaks for two metres further east, without whoever says most, in nats."""
    return float(onlookers.log_ratios(THERE, EXACT).min())


def by_all(onlookers):
    """The same with all of them."""
    return float(onlookers.log_ratios(THERE, EXACT)[0, 0])


def test_one_that_sees_it_elsewhere_may_be_wrong_and_of_several_all_but_one_count(onlookers):
    onlookers.tell(report(2, (8.0, 0.0, 0.0), THERE[0]))
    one = by_all(onlookers)
    assert one > 1.0
    assert gain(onlookers) == 0.0
    onlookers.tell(report(3, (-8.0, 0.0, 0.0), THERE[0]))
    two = gain(onlookers)
    assert two == pytest.approx(one, rel=0.01)
    assert by_all(onlookers) == pytest.approx(2.0 * one, rel=0.01)
    onlookers.tell(report(4, (8.0, 0.1, 0.0), THERE[0]))
    assert gain(onlookers) == pytest.approx(2.0 * one, rel=0.01)


def test_one_that_says_the_same_again_and_again_is_one(onlookers):
    for t in (0.8, 0.9, 1.0):
        onlookers.tell(report(2, (8.0, 0.0, 0.0), THERE[0], t=t))
    assert onlookers.are_puzzled
    assert gain(onlookers) == 0.0


def test_who_sees_it_in_no_likely_place_at_all_speaks_for_none(onlookers):
    for observer, ahead in ((2, 8.0), (3, -8.0)):
        onlookers.tell(report(observer, (ahead, 0.0, 0.0), (2.0 * ahead, 0.0, 0.0)))
    assert onlookers.are_puzzled
    assert abs(gain(onlookers)) < 0.1


def test_who_sees_it_where_it_says_proves_nothing(onlookers):
    onlookers.tell(report(2, (8.0, 0.0, 0.0), HERE[0]))
    assert gain(onlookers) == 0.0
    assert not onlookers.are_puzzled


def test_two_that_see_it_in_different_places_do_not_agree_on_either(onlookers):
    for observer, ahead in ((2, 8.0), (3, -8.0), (4, 9.0)):
        onlookers.tell(report(observer, (ahead, 0.0, 0.0), THERE[0] * math.copysign(1.0, ahead)))
    disagree = gain(onlookers)
    onlookers.tell(report(3, (-8.0, 0.0, 0.0), THERE[0]))
    assert gain(onlookers) - disagree > 0.0


@pytest.mark.parametrize(
    "said",
    [
        report(2, (8.0, 0.0, 0.0), THERE[0], drone_id=3),
        report(2, (8.0, 0.0, 0.0), THERE[0], sigma=0.5),
        report(2, (8.0, 0.0, 0.0), THERE[0], position_sigma=1000.0),
        report(2, (8.0, 0.0, 0.0), THERE[0], t=2.0),
    ],
    ids=["of another drone", "a vague ray", "from nowhere", "of a time that is not remembered"],
)
def test_what_tells_nothing_of_it_does_not_count(onlookers, said):
    onlookers.tell(said)
    assert not onlookers.are_puzzled


def test_what_was_told_of_a_place_that_it_only_thought_it_had_is_forgotten(onlookers):
    onlookers.tell(report(2, (8.0, 0.0, 0.0), THERE[0]))
    onlookers.follow(1.1, np.array([0.8, 0.0, 0.0]), 0.05, in_doubt=True)
    assert onlookers.are_puzzled  # that fast a drone may fly
    onlookers.follow(1.2, np.array([10.0, 0.0, 0.0]), 0.05, in_doubt=True)
    assert not onlookers.are_puzzled


@pytest.mark.parametrize(("in_doubt", "counts_s"), [(False, COUNTS_S), (True, COUNTS_IN_DOUBT_S)])
def test_a_report_counts_for_longer_while_nobody_can_say_it_again(onlookers, in_doubt, counts_s):
    onlookers.tell(report(2, (8.0, 0.0, 0.0), THERE[0]))
    onlookers.follow(1.0 + counts_s - 0.1, np.zeros(3), 0.05, in_doubt=in_doubt)
    assert onlookers.are_puzzled
    onlookers.follow(1.0 + counts_s + 0.1, np.zeros(3), 0.05, in_doubt=in_doubt)
    assert not onlookers.are_puzzled


@pytest.mark.parametrize(("liars", "doubts"), [(1, False), (2, True)])
def test_one_that_lies_makes_a_drone_without_a_look_of_its_own_doubt_nothing_and_two_may(liars, doubts):
    """What it sees is older than what was said of it, so that its own looks tell nothing."""
    observer = Observer()
    observer.hears(2, LEFT)
    for drone_id, place in ((3, (-6.0, 3.0, 0.0)), (4, (-8.0, -3.0, 0.0))):
        observer.hears_at(drone_id, np.array(place))
    observer.sees(1.0, a=LEFT)
    for _ in range(4):
        for drone_id, place in ((3, (-6.0, 3.0, 0.0)), (4, (-8.0, -3.0, 0.0)))[:liars]:
            said = report(drone_id, place, (0.0, 4.0, 0.0), t=observer.t)
            observer.identities.on_report(said)
        observer.sees(1.0, a=LEFT)
    assert observer.identities.self_doubt == doubts


@pytest.mark.parametrize("objects", [False, True])
def test_a_doubt_that_its_own_looks_began_lasts_while_anybody_sees_it_elsewhere(objects):
    observer = Observer()
    observer.hears(2, LEFT)
    observer.hears_at(3, np.array((-6.0, 3.0, 0.0)))
    observer.sees(3.0, a=(420.0, 240.0))
    assert observer.identities.self_doubt
    if objects:
        observer.identities.on_report(report(3, (-6.0, 3.0, 0.0), (0.0, 8.0, 0.0), t=observer.t))
    for _ in range(4):
        observer.sees(1.0, b=LEFT)
        observer.is_told(2, LEFT)
    assert observer.identities.self_doubt == objects
