"""Names among houses, poles and birds; tracks are put by hand."""

from support.observer import LEFT, MIDDLE, RIGHT, SCAN_S, Observer, shifted

BESIDE = shifted(LEFT, right=14.0)


# --- rivals ---


def test_the_same_house_alone_is_as_good_as_the_drone(observer):
    assert observer.sees(2.0, b=RIGHT, c=BESIDE)["c"] == 2


def test_a_doubted_name_goes_to_no_rival_while_its_own_track_misses_a_detection(observer):
    observer.sees(2.0, b=RIGHT, c=BESIDE)
    both = {"a": shifted(LEFT, right=-4.0), "b": RIGHT, "c": BESIDE}
    observer.sees(1.0, **both)
    assert observer.sees(2 * SCAN_S, coasting="a", **both)["c"] is None
    assert observer.sees(2 * SCAN_S, coasting="c", **both)["a"] is None


def test_a_house_loses_its_name_to_the_drone_once_that_has_said_that_it_moved(observer):
    """Nothing is tracked but the house, at 14 px; then the drone, 1.5 m away from it."""
    observer.sees(2.0, b=RIGHT, c=BESIDE)
    up = shifted(LEFT, down=-80.0)
    for _ in range(3):
        observer.is_told(2, up)
        names = observer.sees(1.0, a=up, b=RIGHT, c=BESIDE)
    assert (names["a"], names["c"]) == (2, None)


def test_who_came_back_elsewhere_is_named_where_it_reports_itself_without_being_asked(observer):
    observer.sees(1.0, a=LEFT, b=RIGHT)
    observer.sees(5.0, b=RIGHT)
    observer.is_told(2, MIDDLE)
    observer.wanted.clear()
    assert observer.sees(3 * SCAN_S, b=RIGHT, c=MIDDLE) == {"b": 3, "c": 2}
    assert observer.wanted == []


def test_who_reports_itself_need_not_be_asked_when_it_comes_into_view():
    observer = Observer()
    observer.hears(2, (1400.0, 240.0))
    observer.sees(5.0)
    observer.is_told(2, (1400.0, 240.0))
    observer.turn(40.0)
    observer.sees(SCAN_S)
    assert observer.wanted == []


def test_a_nameless_ghost_asks_nobody_while_all_who_are_in_view_are_settled(observer):
    observer.sees(10.0, a=LEFT, b=RIGHT)
    observer.sees(10.0, a=LEFT, b=RIGHT, c=(320.0, 40.0))
    assert observer.wanted == []
