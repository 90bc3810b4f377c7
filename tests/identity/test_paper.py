"""Algorithm 1 as printed; tracks are put by hand."""

from support.observer import LEFT, RIGHT, SCAN_S, Observer
from swarmtrack.messages import PeerExpelled


def test_algorithm_1_names_in_one_shot_and_twice_if_so_it_falls():
    paper = Observer(profile="paper")
    paper.hears(2, LEFT)
    assert paper.sees(SCAN_S, a=LEFT, b=RIGHT) == {"a": 2, "b": 2}


def test_algorithm_1_looks_once_more_when_a_drone_announces_itself_again():
    paper = Observer(profile="paper")
    paper.hears(2, LEFT)
    paper.hears(3, RIGHT)
    assert paper.sees(SCAN_S, a=LEFT, b=RIGHT) == {"a": 2, "b": 3}
    paper.hears(2, RIGHT, sequence=2)
    paper.hears(4, LEFT)
    assert paper.sees(SCAN_S, a=LEFT, b=RIGHT) == {"a": 4, "b": 3}


def test_a_drone_that_is_expelled_has_no_track():
    paper = Observer(profile="paper")
    paper.hears(2, LEFT)
    paper.hears(3, RIGHT)
    assert paper.sees(SCAN_S, a=LEFT, b=RIGHT) == {"a": 2, "b": 3}
    paper.identities.on_membership(PeerExpelled(2))
    assert paper.sees(SCAN_S, a=LEFT, b=RIGHT) == {"a": 3, "b": 3}
