"""A teammate whose process starts anew in flight is the same drone, unless it says otherwise."""

from support.observer import LEFT, MIDDLE, RIGHT, SCAN_S, Observer, shifted


def known():
    """Drones 2 and 3 have been in view for a while, hovering."""
    observer = Observer()
    observer.hears(2, LEFT)
    observer.hears(3, RIGHT)
    assert observer.sees(4.0, a=LEFT, b=RIGHT) == {"a": 2, "b": 3}
    return observer


def test_it_keeps_its_name_though_it_knows_its_place_less_well():
    observer = known()
    observer.hears(2, LEFT, boot="0000000b", sigma=4.0)
    for _ in range(20):
        assert observer.sees(SCAN_S, a=LEFT, b=RIGHT) == {"a": 2, "b": 3}


def test_a_name_that_goes_on_in_another_frame_is_proved_by_motion_only_if_it_was_before():
    """Drone 2 hovers all the time, and for two seconds it does not know where it is."""
    observer = known()
    for sigma in (3.0, 4.0, 4.0, 4.0, 4.0, 4.0):
        observer.is_told(2, LEFT, sigma=sigma)
        assert observer.sees(0.5, a=LEFT, b=RIGHT) == {"a": 2, "b": 3}
        assert [entry.proof for entry in observer.identities.label(observer.tracks)] == [None, None]


def test_it_loses_its_name_by_a_place_that_is_not_that_of_its_track():
    observer = known()
    observer.hears(2, shifted(MIDDLE, down=-150.0), boot="0000000b")
    assert observer.sees(SCAN_S, a=LEFT, b=RIGHT) == {"a": None, "b": 3}
