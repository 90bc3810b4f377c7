"""Algorithm 1 as printed; tracks are put by hand."""

import pytest

from support.observer import LEFT, RIGHT, SCAN_S, Observer
from swarmtrack.messages import PeerExpelled


@pytest.fixture
def paper():
    """It has named drones 2 and 3."""
    observer = Observer(profile="paper")
    observer.hears(2, LEFT)
    observer.hears(3, RIGHT)
    assert observer.sees(SCAN_S, a=LEFT, b=RIGHT) == {"a": 2, "b": 3}
    return observer


def test_one_drone_may_have_two_tracks():
    alone = Observer(profile="paper")
    alone.hears(2, LEFT)
    assert alone.sees(SCAN_S, a=LEFT, b=RIGHT) == {"a": 2, "b": 2}


def test_a_track_is_matched_again_when_its_drone_announces_itself_again(paper):
    paper.hears(2, RIGHT, sequence=2)
    paper.hears(4, LEFT)
    assert paper.sees(SCAN_S, a=LEFT, b=RIGHT) == {"a": 4, "b": 3}


def test_a_drone_that_is_expelled_has_no_track(paper):
    paper.identities.on_membership(PeerExpelled(2))
    assert paper.sees(SCAN_S, a=LEFT, b=RIGHT) == {"a": 3, "b": 3}


def test_drones_behind_the_camera_have_no_track():
    observer = Observer(profile="paper")
    observer.hears(2, LEFT, metres=-8.0)
    assert observer.sees(SCAN_S, a=LEFT) == {"a": None}
