"""Where teammates said last that they are."""

import numpy as np
import pytest

from support.observer import LEFT, MIDDLE, at
from swarmtrack.identity.whereabouts import Whereabouts
from swarmtrack.messages import Announcement, SightingReport


def announced(t=0.0, boot="0000000a", sequence=1, position=None, sigma=0.3):
    position = at(LEFT) if position is None else position
    return Announcement(2, boot, sequence, t, 0.0, position, np.eye(3), sigma**2 * np.eye(3))


def report(t, position, sigma=0.1, t_sigma=0.0, boot="0000000a"):
    return SightingReport(2, boot, 1, t, t_sigma, position, sigma, (), ())


def test_a_drone_is_where_it_reported_itself_last_and_no_surer_of_it_than_its_announcement():
    places = Whereabouts()
    places.announce(announced())
    places.report(report(1.0, at(MIDDLE)))
    assert places.latest(2).t == 1.0
    assert places.latest(2).position == pytest.approx(at(MIDDLE))
    assert np.diag(places.latest(2).position_cov).min() >= 0.09


@pytest.mark.parametrize(
    "unusable",
    [
        report(1.0, at(MIDDLE), sigma=5.0),
        report(1.0, at(MIDDLE), t_sigma=2.0),
        report(1.0, at(MIDDLE), boot="0000000b"),
        report(-1.0, at(MIDDLE)),
    ],
    ids=["vague place", "vague time", "another life", "older"],
)
def test_a_report_that_is_no_place_changes_nothing(unusable):
    places = Whereabouts()
    places.report(report(0.5, at(MIDDLE)))
    places.announce(announced())
    places.report(unusable)
    assert places.latest(2).position == pytest.approx(at(LEFT))
