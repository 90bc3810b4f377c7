"""What a teammate says of itself, put together."""

import numpy as np
import pytest

from swarmtrack.messages import Announcement, MotionReport, SightingReport
from swarmtrack.team.priors import REPORTED_WHITE_M
from swarmtrack.team.teammates import Teammate

BOOT = "0000000a"


def climbs(t):
    """Drone 2, from a second on at 2 m/s."""
    return np.array([0.0, 0.0, -2.0 * max(t - 1.0, 0.0)])


def announcement(t):
    return Announcement(2, BOOT, 0, t, 0.0, climbs(t), np.eye(3), 0.01 * np.eye(3))


def report(t):
    return SightingReport(2, BOOT, 1, t, 0.0, climbs(t), 0.1, (), ())


def motion(t):
    velocity = (climbs(t + 0.1) - climbs(t)) / 0.1
    return MotionReport(2, BOOT, 1, t, 0.0, climbs(t), 0.01 * np.eye(3), velocity, 0.01 * np.eye(3))


def reporting(*times):
    mate = Teammate.of(announcement(0.0), 0, [])
    for t in times:
        mate.report(report(t))
    return mate


@pytest.mark.parametrize("again", ["announcement", "report"])
def test_what_it_says_shortly_after_a_report_leaves_its_speed_as_it_is(again):
    mate = reporting(1.0, 2.0, 3.0)
    if again == "report":
        mate.report(report(3.1))
    else:
        mate.announce(announcement(3.1))
    assert mate.goes_on(3.2)
    assert mate.at(3.8).place == pytest.approx(climbs(3.8), abs=0.01)


def test_it_bends_between_two_reports_though_another_came_just_before():
    """It began to climb between them, and is not on the line."""
    mate = reporting(0.7, 0.8, 1.8)
    assert abs(mate.at(1.3).place[2]) < 0.75 * 0.5 * abs(climbs(1.8)[2]) + 0.01
    assert mate.at(1.3).white > 1.4 * REPORTED_WHITE_M**2


def test_one_that_only_announces_itself_is_not_waited_for_and_stays_where_it_said():
    mate = Teammate.of(announcement(0.0), 0, [])
    mate.announce(announcement(2.0))
    assert not mate.goes_on(2.1)
    assert mate.at(3.0).place == pytest.approx(climbs(2.0))


def test_a_place_that_it_announces_while_it_says_how_it_moves_changes_nothing():
    mate = Teammate.of(announcement(0.0), 0, [])
    for k in range(20):
        mate.move(motion(0.2 * k))
    before = mate.at(3.9)
    mate.announce(announcement(3.85))
    assert mate.at(3.9).white == before.white
    assert mate.at(3.9).place == pytest.approx(before.place)
