"""Do two observers mean the same drone? Rays that meet or miss."""

from dataclasses import replace

import numpy as np
import pytest

from swarmtrack.identity.consensus import MEMORY_S, SIMULTANEOUS, Consensus, OwnView
from swarmtrack.messages import Sighting, SightingReport

NORTH, EAST, DOWN = np.eye(3)
HERE = np.zeros(3)  # of observer 1, who looks north
THERE = 4.0 * EAST  # of observer 2, four metres east of it
ABOVE = np.array([0.0, 2.0, -3.0])  # of observer 4
TARGET = np.array([8.0, 2.0, -1.0])  # of drone 3
ELSEWHERE = np.array([8.0, 5.0, 1.0])


def sighting(drone_id, origin, target, probability=0.99, sigma=0.005):
    direction = target - origin
    return Sighting(drone_id, probability, direction / np.linalg.norm(direction), sigma)


def own_view(*sightings, t=10.0, position=HERE):
    return OwnView(t, position, 0.1, {entry.drone_id: entry for entry in sightings})


def report(*sightings, t=10.0, observer=2, position=THERE, t_sigma=0.0):
    known = tuple(entry.drone_id for entry in sightings)
    return SightingReport(observer, "0000000a", 1, t, t_sigma, position, 0.1, known, sightings)


def judge(ours, theirs):
    """What observer 1, with its own view, makes of a report."""
    consensus = Consensus()
    consensus.remember(ours)
    return consensus, consensus.compare(theirs)


def test_rays_that_meet_agree():
    consensus, found = judge(own_view(sighting(3, HERE, TARGET)), report(sighting(3, THERE, TARGET)))
    assert found == []
    assert (consensus.agreed, consensus.disagreed) == (1, 0)


def test_rays_that_miss_each_other_disagree_by_their_distance():
    theirs = report(sighting(3, THERE, TARGET + 3.0 * DOWN))
    consensus, (found,) = judge(own_view(sighting(3, HERE, TARGET)), theirs)
    assert (found.observer, found.drone_id) == (2, 3)
    assert 1.0 < found.miss_m < 3.0
    assert (consensus.agreed, consensus.disagreed) == (0, 1)


def test_the_errors_of_position_mounting_and_time_are_allowed_for():
    """30 cm off at 8 m: within a tenth of a metre of place and three hundredths of a radian of frame, each."""
    theirs = report(sighting(3, THERE, TARGET + 0.3 * DOWN))
    assert judge(own_view(sighting(3, HERE, TARGET)), theirs)[1] == []


def test_a_point_behind_an_observer_is_no_meeting():
    """The lines cross, but behind observer 2: it sees something else the other way."""
    away = THERE - (TARGET - THERE)
    theirs = report(sighting(3, THERE, away))
    assert len(judge(own_view(sighting(3, HERE, TARGET)), theirs)[1]) == 1


@pytest.mark.parametrize("metres", [50.0, 200.0, 1e4])
def test_rays_to_something_far_off_are_nearly_parallel_and_agree(metres):
    far = np.array([metres, 2.0, -1.0])
    assert judge(own_view(sighting(3, HERE, far)), report(sighting(3, THERE, far)))[1] == []


@pytest.mark.parametrize("metres", [30.0, 100.0])
def test_rays_that_errors_turned_apart_may_still_be_to_one_drone_far_off(metres):
    """Each observer's north is off by a sigma, outwards: their rays diverge."""
    target = metres * NORTH + 2.0 * EAST
    ours = own_view(sighting(3, HERE, target - 0.03 * metres * EAST))
    theirs = report(sighting(3, THERE, target + 0.03 * metres * EAST))
    assert judge(ours, theirs)[1] == []


def test_parallel_rays_agree_only_as_far_as_something_distant_may_explain_them():
    near, wide = HERE + 4.0 * EAST, HERE + 400.0 * EAST
    ours = own_view(Sighting(3, 0.99, NORTH, 0.005))
    assert judge(ours, report(Sighting(3, 0.99, NORTH, 0.005), position=near))[1] == []
    assert len(judge(ours, report(Sighting(3, 0.99, NORTH, 0.005), position=wide))[1]) == 1


def test_two_observers_at_one_spot_that_look_the_same_way_agree():
    ours = own_view(sighting(3, HERE, TARGET))
    assert judge(ours, report(sighting(3, HERE, TARGET), position=HERE))[1] == []


def test_a_drone_that_says_it_stands_elsewhere_is_not_the_one_seen():
    """Observer 1 calls a track drone 2; drone 2 itself says where it stands, and knows best."""
    mistaken = own_view(sighting(2, HERE, THERE + 6.0 * NORTH, probability=0.99999))
    (found,) = judge(mistaken, report())[1]
    assert (found.observer, found.drone_id) == (2, 2)
    assert judge(own_view(sighting(2, HERE, THERE)), report())[1] == []


@pytest.mark.parametrize("vague", [{"t_sigma": 1e9}, {"position_sigma": 1e7}, {"sigma": 3.0}])
def test_a_report_that_agrees_with_everything_supports_nothing(vague):
    theirs = sighting(3, THERE, ELSEWHERE, sigma=vague.pop("sigma", 0.005))
    consensus, found = judge(own_view(sighting(3, HERE, TARGET)), replace(report(theirs), **vague))
    assert (found, consensus.agreed, consensus.disagreed) == ([], 0, 0)


def test_only_views_of_nearly_the_same_instant_are_compared():
    ours, theirs = own_view(sighting(3, HERE, TARGET), t=10.0), sighting(3, THERE, ELSEWHERE)
    for late in (SIMULTANEOUS + 0.05, 5.0, -SIMULTANEOUS - 0.05):
        consensus, found = judge(ours, report(theirs, t=10.0 + late))
        assert found == []
        assert (consensus.agreed, consensus.disagreed) == (0, 0)
    assert len(judge(ours, report(theirs, t=10.0 + 0.1))[1]) == 1


def test_of_all_views_remembered_that_of_the_report_s_instant_is_compared():
    """The drone flew off; a report that was a second under way is compared with what was seen then."""
    consensus = Consensus()
    consensus.remember(own_view(sighting(3, HERE, TARGET), t=10.0))
    consensus.remember(own_view(sighting(3, HERE, ELSEWHERE), t=11.0))
    assert consensus.compare(report(sighting(3, THERE, TARGET), t=10.0)) == []
    assert len(consensus.compare(report(sighting(3, THERE, TARGET), t=11.0))) == 1
    consensus.remember(own_view(t=11.0 + MEMORY_S))
    assert consensus.compare(report(sighting(3, THERE, ELSEWHERE), t=10.0)) == []  # forgotten by now


def test_what_only_one_of_them_sees_is_no_matter_of_dispute():
    ours = own_view(sighting(3, HERE, TARGET))
    assert judge(ours, report(sighting(4, THERE, ELSEWHERE)))[1] == []
    assert judge(own_view(), report(sighting(3, THERE, TARGET)))[1] == []
    assert Consensus().compare(report(sighting(3, THERE, TARGET))) == []
