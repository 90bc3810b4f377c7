"""Names of a team of which not everybody is where it should be."""

from support.observer import LEFT, MIDDLE, RIGHT, Observer

UP, FAR_UP = (400.0, 60.0), (240.0, 60.0)


def three():
    """Who has heard of drones 2, 3 and 4, from left to right."""
    alone = Observer()
    for drone, pixel in enumerate((LEFT, MIDDLE, RIGHT), start=2):
        alone.hears(drone, pixel)
    return alone


def test_most_that_fit_are_named():
    assert three().sees(2.0, a=LEFT, b=MIDDLE, c=UP) == {"a": 2, "b": 3, "c": None}


def test_a_scene_full_of_things_that_are_no_drones_puts_no_name_in_doubt():
    assert three().sees(2.0, a=LEFT, b=UP, c=FAR_UP, d=(600.0, 60.0))["a"] == 2


def test_who_once_fitted_together_with_another_is_named_whoever_else_is_there():
    observer = three()
    observer.sees(2.0, a=LEFT, b=MIDDLE)
    observer.sees(1.0, c=RIGHT)
    assert observer.sees(2.0, d=LEFT, e=UP, f=FAR_UP)["d"] == 2
