"""When the posterior compares and weighs, and what it keeps of a teammate whose process starts again."""

import numpy as np
import pytest

from swarmtrack.messages import AgreedMotion, Announcement, MotionReport
from swarmtrack.team.mixture import OwnKnowledge
from swarmtrack.team.posterior import BearingScan, TeamPosterior
from swarmtrack.team.track_evidence import Bearing

AHEAD, SCAN_S = np.array([8.0, 0.0, 0.0]), 0.1


@pytest.fixture
def posterior():
    return TeamPosterior(1, cameras=1, start_sigma_m=0.1)


def announcement(drone_id, place, boot="0000000a"):
    return Announcement(drone_id, boot, 1, 0.0, 0.0, place, np.eye(3), 0.01 * np.eye(3))


def see(posterior, seconds, begin=0.0):
    """One track straight ahead."""
    for k in range(1, round(seconds / SCAN_S) + 1):
        t = begin + k * SCAN_S
        bearing = Bearing(t, np.zeros(3), np.zeros(2), AHEAD / 8.0, 1e-4, 8.0)
        scan = BearingScan(t, 0, np.zeros(3), {1: bearing}, {})
        posterior.observe(scan, {1}, np.zeros(3), OwnKnowledge(0.1, 0.02))


def stands_still(drone_id, t):
    cov = 1e-4 * np.eye(3)
    return MotionReport(drone_id, "0000000a", round(t / SCAN_S), t, 0.0, np.zeros(3), cov, np.zeros(3), cov)


@pytest.mark.parametrize("place", [AHEAD, 1e5 * AHEAD], ids=["near", "so far that nobody sees it"])
def test_nothing_is_weighed_in_every_scan(posterior, monkeypatch, place):
    weighed, weigh = [], posterior.mixture.weigh
    monkeypatch.setattr(posterior.mixture, "weigh", lambda *args: weighed.append(args) or weigh(*args))
    posterior.announce(announcement(2, AHEAD))
    posterior.announce(announcement(3, place))
    see(posterior, 10.0)
    assert 8 <= len(weighed) <= 22


def test_a_teammate_that_has_just_come_is_compared_at_once(posterior):
    posterior.announce(announcement(2, np.array([2.0, 0.0, -30.0])))
    see(posterior, 5.0)
    assert posterior.named[1].p_none > 0.5
    posterior.announce(announcement(3, AHEAD))
    see(posterior, SCAN_S, begin=5.0)
    assert posterior.named[1].p[3] > 0.5


def test_a_teammate_that_comes_as_a_track_comes_back_is_compared_at_once(posterior):
    posterior.announce(announcement(2, np.array([2.0, 0.0, -30.0])))
    see(posterior, 5.0)
    nothing = BearingScan(5.1, 0, np.zeros(3), {}, {1: 5.1})
    posterior.observe(nothing, {1}, np.zeros(3), OwnKnowledge(0.1, 0.02))
    posterior.announce(announcement(3, AHEAD))
    see(posterior, SCAN_S, begin=6.2)  # between two rounds
    assert posterior.named[1].p[3] > 0.5


def test_agreed_motions_are_all_kept_whoever_speaks_as_the_drone_and_whenever(posterior):
    def motion(begin, north):
        t = np.array([begin, begin + 10.0])
        return AgreedMotion(2, t, np.array([[0.0, 0.0, 0.0], [north, 0.0, 0.0]]), planned=False)

    posterior.agree(motion(0.0, 2.0))
    posterior.announce(announcement(2, AHEAD))
    posterior.agree(motion(20.0, 4.0))
    posterior.announce(announcement(2, AHEAD, boot="0000000b"))
    mate = posterior.teammates[2]
    assert mate.at(5.0)[0].tolist() == [9.0, 0.0, 0.0]
    assert mate.at(25.0)[0].tolist() == [10.0, 0.0, 0.0]
    assert mate.has_said(25.0)
    assert not mate.has_said(15.0)


def test_a_track_whose_name_is_withheld_is_no_other_teammate(posterior):
    posterior.announce(announcement(2, AHEAD))
    posterior.announce(announcement(3, np.array([0.0, 8.0, 0.0])))
    see(posterior, 2.0)
    assert posterior.named[1].p[2] > 0.9
    posterior.expel(2)
    see(posterior, 4.0, begin=2.0)
    assert posterior.named[1].p[3] < 0.05


@pytest.mark.parametrize("missed", [False, True], ids=["in view", "back after a miss"])
def test_each_segment_has_a_known_past_however_often_teammates_report(posterior, missed):
    """Else its track could have been one teammate until then, and another track the same at the same time."""

    def fly(begin, end):
        for k in range(round(begin / SCAN_S), round(end / SCAN_S)):
            for drone in (2, 3):
                posterior.teammates[drone].move(stands_still(drone, k * SCAN_S + 0.05))
            see(posterior, SCAN_S, begin=k * SCAN_S)

    posterior.announce(announcement(2, AHEAD))
    posterior.announce(announcement(3, np.array([0.0, 8.0, 0.0])))
    fly(0.0, 4.4)
    if missed:
        nothing = BearingScan(4.5, 0, np.zeros(3), {}, {1: 4.5})
        posterior.observe(nothing, {1}, np.zeros(3), OwnKnowledge(0.1, 0.02))
        fly(5.4, 6.2)
    else:
        fly(4.4, 8.2)
    begun, column = posterior._tracks[1].segments[1:], posterior.teammates[2].column
    assert len(begun) > 1
    assert [int(segment.past.column[0]) for segment in begun] == [column] * len(begun)
