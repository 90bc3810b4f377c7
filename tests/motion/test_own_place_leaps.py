"""An autopilot's place that leaps: the drone goes on from where it was, until somebody finds that it is elsewhere."""

import math

import numpy as np
import pytest

from swarmtrack.messages import EgoPose, FlightState
from swarmtrack.motion.ego import EgoHistory

LEAP = np.array([6.0, -8.0, 0.0])
HZ = 50.0


def fly(ego, seconds, *, begin=0.0, velocity=(1.5, 0.0, 0.0), leap=(0.0, 0.0, 0.0), hz=HZ):
    """Straight on from the origin, `leap` m beside that by its autopilot's word; returns when it ends."""
    end = begin + seconds
    for t in np.arange(round(begin * hz), round(end * hz)) / hz:
        place = t * np.array(velocity) + leap
        ego.append(EgoPose(t=float(t), position=place, world_from_body=np.eye(3)))
    return end


@pytest.fixture
def ego():
    """That has flown for a second, and whose autopilot's place has leapt half a second ago."""
    ego = EgoHistory(origin=np.zeros(3))
    t = fly(ego, 1.0)
    fly(ego, 0.5, begin=t, leap=LEAP)
    return ego


def test_the_drone_goes_on_from_where_it_was_as_fast_as_it_flew(ego):
    assert ego.place_leaps == 1
    assert ego.leaps_believed_at == -math.inf
    assert ego.leapt == pytest.approx(LEAP)
    for t in np.arange(0.2, 1.48, 0.07):
        assert ego.at(t).position == pytest.approx([1.5 * t, 0.0, 0.0])
        assert ego.velocity(t)[0] == pytest.approx([1.5, 0.0, 0.0])
    assert ego.moved(1, "00000001", 1).velocity == pytest.approx([1.5, 0.0, 0.0])


def test_a_leap_back_leaves_nothing_of_it(ego):
    fly(ego, 0.5, begin=1.5)
    assert ego.place_leaps == 2
    assert ego.leapt == pytest.approx(np.zeros(3), abs=1e-9)
    assert ego.at(1.9).position == pytest.approx([1.5 * 1.9, 0.0, 0.0])


def test_a_way_that_is_told_goes_on_through_leaps_whether_they_are_believed_or_not():
    ego = EgoHistory(origin=np.zeros(3))
    fly(ego, 1.0)
    first = ego.moved(1, "00000001", 1)
    fly(ego, 0.5, begin=1.0, leap=LEAP)
    for sequence in (2, 3):
        report = ego.moved(1, "00000001", sequence)
        flown = report.displacement - first.displacement
        assert flown == pytest.approx([1.5 * (report.t - first.t), 0.0, 0.0])
        ego.believe_leaps()


def test_leaps_that_are_believed_move_the_last_seconds_and_no_velocity(ego):
    ego.believe_leaps()
    assert not ego.leapt.any()
    for t in (0.5, 1.0, 1.4):
        assert ego.at(t).position == pytest.approx(np.array([1.5 * t, 0.0, 0.0]) + LEAP)
        assert ego.velocity(t)[0] == pytest.approx([1.5, 0.0, 0.0])
    fly(ego, 0.5, begin=1.5, leap=LEAP)
    assert ego.at(1.9).position == pytest.approx(np.array([1.5 * 1.9, 0.0, 0.0]) + LEAP)
    assert ego.place_leaps == 1


def test_a_fast_drone_whose_poses_are_few_has_not_leapt():
    ego = EgoHistory(origin=np.zeros(3))
    fly(ego, 2.0, velocity=(20.0, 0.0, 0.0), hz=5.0)
    assert ego.place_leaps == 0
    assert ego.at(1.8).position == pytest.approx([36.0, 0.0, 0.0])


def test_after_a_gap_a_drone_is_where_its_autopilot_says():
    ego = EgoHistory(origin=np.zeros(3))
    fly(ego, 1.0)
    fly(ego, 0.5, begin=2.0, leap=LEAP)
    assert ego.place_leaps == 0
    assert ego.at(2.4).position == pytest.approx(np.array([3.6, 0.0, 0.0]) + LEAP)


def test_a_place_that_comes_back_after_the_autopilot_knew_none_is_no_leap():
    ego = EgoHistory(absolute=True)
    fly(ego, 1.0)
    for k in range(50, 150):
        ego.append(EgoPose(t=k / HZ, position=None, world_from_body=np.eye(3)))
    fly(ego, 0.5, begin=3.0)
    assert ego.place_leaps == 0
    assert ego.at(3.4).position == pytest.approx([5.1, 0.0, 0.0])


@pytest.mark.parametrize(("airborne_since", "leaps"), [(None, 0), (0.0, 1)])
def test_by_gps_a_drone_is_where_it_is_found_to_be_as_long_as_it_stands(airborne_since, leaps):
    ego = EgoHistory(absolute=True)
    ego.fly(FlightState(0.0, airborne_since))
    fly(ego, 1.0, velocity=(0.0, 0.0, 0.0))
    fly(ego, 0.5, begin=1.0, velocity=(0.0, 0.0, 0.0), leap=LEAP)
    assert ego.place_leaps == leaps
    assert ego.at(1.4).position == pytest.approx(np.zeros(3) if leaps else LEAP)


def test_by_gps_a_drone_whose_autopilot_rebooted_is_where_that_says():
    ego = EgoHistory(absolute=True)
    fly(ego, 1.0)
    fly(ego, 0.5, begin=1.0, leap=LEAP)
    ego.restart()
    fly(ego, 0.5, begin=3.0, leap=LEAP)
    assert ego.at(3.4).position == pytest.approx(np.array([1.5 * 3.4, 0.0, 0.0]) + LEAP)
    assert not ego.leapt.any()
