"""Do two observers mean the same drone? Rays that meet or miss, and who of the two yields."""

import numpy as np
import pytest

from swarmtrack.identity.agreement import MEMORY_S, SIMULTANEOUS, VOTE_S, Agreement, OwnView
from swarmtrack.messages import Sighting, SightingReport

NORTH, EAST, DOWN = np.eye(3)
HERE = np.zeros(3)  # of observer 1, who looks north
THERE = 4.0 * EAST  # of observer 2, four metres east of it
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
    agreement = Agreement()
    agreement.remember(ours)
    return agreement, agreement.compare(theirs)


def test_rays_that_meet_agree():
    agreement, found = judge(own_view(sighting(3, HERE, TARGET)), report(sighting(3, THERE, TARGET)))
    assert found == []
    assert (agreement.agreed, agreement.disagreed) == (1, 0)


def test_rays_that_miss_each_other_disagree_by_their_distance():
    theirs = report(sighting(3, THERE, TARGET + 3.0 * DOWN))
    agreement, (found,) = judge(own_view(sighting(3, HERE, TARGET)), theirs)
    assert (found.observer, found.drone_id) == (2, 3)
    assert 1.0 < found.miss_m < 3.0
    assert (agreement.agreed, agreement.disagreed) == (0, 1)


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


def test_whoever_stands_elsewhere_than_where_it_is_seen_is_not_it():
    """Observer 1 calls a track drone 2; drone 2 itself says where it stands, and knows best."""
    mistaken = own_view(sighting(2, HERE, THERE + 6.0 * NORTH, probability=0.99999))
    (found,) = judge(mistaken, report())[1]
    assert (found.observer, found.drone_id, found.overruled) == (2, 2, True)
    assert judge(own_view(sighting(2, HERE, THERE)), report())[1] == []


def test_of_two_observers_the_less_certain_one_yields_and_only_it():
    """Both hear of the other: 1 is nearly sure that drone 3 is there, 2 only rather."""
    sure, rather = 0.9995, 0.97
    (of_1,) = judge(
        own_view(sighting(3, HERE, TARGET, sure)),
        report(sighting(3, THERE, ELSEWHERE, rather)),
    )[1]
    (of_2,) = judge(
        own_view(sighting(3, THERE, ELSEWHERE, rather), position=THERE),
        report(sighting(3, HERE, TARGET, sure), observer=1, position=HERE),
    )[1]
    assert (of_1.overruled, of_2.overruled) == (False, True)


def test_of_two_that_are_equally_certain_both_yield():
    (of_1,) = judge(own_view(sighting(3, HERE, TARGET)), report(sighting(3, THERE, ELSEWHERE)))[1]
    assert of_1.overruled


def test_whoever_is_outvoted_yields_and_whoever_is_supported_keeps():
    ours = own_view(sighting(3, HERE, TARGET, 0.995))
    against = report(sighting(3, THERE, ELSEWHERE, 0.99), observer=2)
    above = np.array([0.0, 2.0, -3.0])
    agreement = Agreement()
    agreement.remember(ours)
    assert not agreement.compare(against)[0].overruled  # one against one, and ours is the surer
    (outvoting,) = agreement.compare(report(sighting(3, above, ELSEWHERE, 0.9), observer=4, position=above))
    assert outvoting.overruled

    agreement = Agreement()
    agreement.remember(own_view(sighting(3, HERE, TARGET, 0.97)))
    assert agreement.compare(report(sighting(3, above, TARGET, 0.97), observer=4, position=above)) == []
    assert not agreement.compare(against)[0].overruled  # alone it would have yielded
    agreement.forget(3)  # it is another track now: whoever supported the old one has said nothing of it
    assert agreement.compare(against)[0].overruled


def test_an_observer_has_one_vote_however_often_it_speaks():
    agreement = Agreement()
    agreement.remember(own_view(sighting(3, HERE, TARGET, 0.995)))
    for _ in range(20):
        (found,) = agreement.compare(report(sighting(3, THERE, ELSEWHERE, 0.97)))
        assert not found.overruled


def test_a_vote_of_long_ago_no_longer_counts():
    above = np.array([0.0, 2.0, -3.0])
    agreement = Agreement()
    agreement.remember(own_view(sighting(3, HERE, TARGET, 0.97), t=10.0))
    agreement.compare(report(sighting(3, above, TARGET, 0.99), observer=4, position=above, t=10.0))
    later = 10.0 + VOTE_S + 0.1
    agreement.remember(own_view(sighting(3, HERE, TARGET, 0.97), t=later))
    assert agreement.compare(report(sighting(3, THERE, ELSEWHERE, 0.99), t=later))[0].overruled


def test_only_views_of_nearly_the_same_instant_are_compared():
    ours, theirs = own_view(sighting(3, HERE, TARGET), t=10.0), sighting(3, THERE, ELSEWHERE)
    for late in (SIMULTANEOUS + 0.05, 5.0, -SIMULTANEOUS - 0.05):
        agreement, found = judge(ours, report(theirs, t=10.0 + late))
        assert found == []
        assert (agreement.agreed, agreement.disagreed) == (0, 0)
    assert len(judge(ours, report(theirs, t=10.0 + 0.1))[1]) == 1


def test_of_all_views_remembered_that_of_the_report_s_instant_is_compared():
    """The drone flew off; a report that was a second under way is compared with what was seen then."""
    agreement = Agreement()
    agreement.remember(own_view(sighting(3, HERE, TARGET), t=10.0))
    agreement.remember(own_view(sighting(3, HERE, ELSEWHERE), t=11.0))
    assert agreement.compare(report(sighting(3, THERE, TARGET), t=10.0)) == []
    assert len(agreement.compare(report(sighting(3, THERE, TARGET), t=11.0))) == 1
    agreement.remember(own_view(t=11.0 + MEMORY_S))
    assert agreement.compare(report(sighting(3, THERE, ELSEWHERE), t=10.0)) == []  # forgotten by now


def test_what_only_one_of_them_sees_is_no_matter_of_dispute():
    ours = own_view(sighting(3, HERE, TARGET))
    assert judge(ours, report(sighting(4, THERE, ELSEWHERE)))[1] == []
    assert judge(own_view(), report(sighting(3, THERE, TARGET)))[1] == []
    assert Agreement().compare(report(sighting(3, THERE, TARGET))) == []
