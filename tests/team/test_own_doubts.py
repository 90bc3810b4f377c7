"""What a drone makes of its own start and heading; tracks are put by hand."""

import math
from dataclasses import fields

import pytest

from support.observer import LEFT, MIDDLE, RIGHT, SCAN_S, Observer
from swarmtrack.formation.parameters import FormationParameters
from swarmtrack.messages import FOREIGN

# m: of what is 8 m ahead of where the observer thinks it is; it stands 3 m further ahead.
THOUGHT, TRUE = 8.0, 5.0


def turned(pixel, degrees):
    """Where that is in the image of a camera that looks so much further to the left than it thinks."""
    return (320.0 + 430.0 * math.tan(math.atan((pixel[0] - 320.0) / 430.0) + math.radians(degrees)), 240.0)


def nearer(pixel):
    """What the observer sees there, seen from where it really stands: no turn of its heading explains two of these."""
    return (320.0 + (pixel[0] - 320.0) * THOUGHT / TRUE, 240.0)


@pytest.mark.parametrize("degrees", [-10.0, -5.0, 5.0, 10.0])
def test_a_heading_that_is_off_shifts_all_teammates_and_two_of_them_reveal_it(observer, degrees):
    """The autopilot's heading is known to 0.6°: one look that took each for itself could explain neither."""
    names = observer.sees(1.0, a=turned(LEFT, degrees), b=turned(RIGHT, degrees))
    assert names == {"a": 2, "b": 3}


def test_one_teammate_between_two_places_is_nobody(observer):
    assert observer.sees(1.0, a=MIDDLE) == {"a": None}


def test_who_stands_on_anothers_pad_says_so_once_it_has_lasted_and_names_nobody(observer):
    observer.hears(4, MIDDLE, metres=THOUGHT - TRUE)
    seen = {"a": nearer(LEFT), "b": nearer(RIGHT)}
    observer.sees(3 * SCAN_S, **seen)
    assert not observer.identities.self_doubt
    names = observer.sees(1.0, **seen)
    assert observer.identities.self_doubt
    assert names == {"a": None, "b": None}


def test_a_teammate_that_is_not_seen_is_no_reason_to_doubt_oneself(observer):
    observer.sees(5.0, a=LEFT)
    assert not observer.identities.self_doubt
    observer.sees(5.0)
    assert not observer.identities.self_doubt


def test_a_stranger_beside_the_team_is_no_reason_to_doubt_oneself(observer):
    assert observer.sees(5.0, a=LEFT, b=RIGHT, c=(320.0, 100.0)) == {"a": 2, "b": 3, "c": FOREIGN}
    assert not observer.identities.self_doubt


def test_alone_under_the_sky_nothing_is_known_of_the_own_pose():
    alone = Observer()
    alone.sees(5.0, a=MIDDLE, b=LEFT)
    assert not alone.identities.self_doubt


# By default: a formation's `sure`.
FORMATION_NEEDS = next(field.default for field in fields(FormationParameters) if field.name == "sure")


@pytest.mark.parametrize("teammates", [2, 5, 9])
def test_places_alone_make_no_name_as_sure_as_a_formation_needs(teammates):
    observer = Observer()
    pixels = {drone: (50.0 * drone, 240.0) for drone in range(2, 2 + teammates)}
    for drone, pixel in pixels.items():
        observer.hears(drone, pixel)
    for _ in range(20):
        for drone, pixel in pixels.items():
            observer.is_told(drone, pixel)
        observer.sees(1.0, **{chr(95 + drone): pixel for drone, pixel in pixels.items()})
        stated = [entry.identity_probability for entry in observer.identities.label(observer.tracks)]
        assert 0.95 < min(stated) <= max(stated) < 0.997 < FORMATION_NEEDS
