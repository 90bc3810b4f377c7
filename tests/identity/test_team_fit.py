"""A place that fits, among tracks and teammates that do not: names wait, and nobody is called a stranger."""

import numpy as np
import pytest

from support.observer import CAMERA, FORWARD, LEFT, MIDDLE, RIGHT, Observer
from swarmtrack.identity.names import Names
from swarmtrack.identity.reprojection import NOBODY, ObserverCamera
from swarmtrack.identity.team_fit import KEPT_S, TeamFit
from swarmtrack.identity.teammates import Teammates
from swarmtrack.identity.weighing import Weighing
from swarmtrack.messages import Announcement, Track, TrackStatus
from swarmtrack.motion.ego import TeamPose

UP, FAR_UP = (400.0, 60.0), (240.0, 60.0)


def three():
    """Who has heard of drones 2, 3 and 4, from left to right."""
    alone = Observer()
    for drone, pixel in enumerate((LEFT, MIDDLE, RIGHT), start=2):
        alone.hears(drone, pixel)
    return alone


def test_one_that_fits_among_as_many_that_do_not_as_are_missing_is_nobody():
    assert three().sees(2.0, a=LEFT, b=UP, c=FAR_UP) == {"a": None, "b": None, "c": None}


def test_most_that_fit_are_named():
    assert three().sees(2.0, a=LEFT, b=MIDDLE, c=UP) == {"a": 2, "b": 3, "c": None}


def test_a_scene_full_of_things_that_are_no_drones_puts_no_name_in_doubt():
    assert three().sees(2.0, a=LEFT, b=UP, c=FAR_UP, d=(600.0, 60.0))["a"] == 2


def test_who_once_fitted_together_with_another_is_named_whoever_else_is_there():
    observer = three()
    observer.sees(2.0, a=LEFT, b=MIDDLE)
    observer.sees(1.0, c=RIGHT)
    assert observer.sees(2.0, d=LEFT, e=UP, f=FAR_UP)["d"] == 2


def test_another_life_of_it_has_to_fit_again():
    observer = three()
    observer.sees(2.0, a=LEFT, b=MIDDLE)
    observer.sees(1.0, c=RIGHT)
    for drone, pixel in ((2, LEFT), (3, MIDDLE), (4, RIGHT)):
        observer.hears(drone, pixel, boot="0000000b")
    assert observer.sees(1.0, d=LEFT, e=UP, f=FAR_UP)["d"] is None


def test_a_name_given_before_the_others_were_heard_waits_for_motion_where_their_places_fit_no_track():
    observer = Observer()
    observer.hears(2, MIDDLE)
    for drone in (2, 3, 4):
        observer.stands_still(drone)
    assert observer.sees(1.0, a=LEFT, b=MIDDLE, c=RIGHT)["b"] == 2
    observer.hears(3, UP, metres=-8.0)
    observer.hears(4, FAR_UP, metres=-8.0)
    assert observer.sees(KEPT_S - 0.2, a=LEFT, b=MIDDLE, c=RIGHT)["b"] == 2
    assert observer.sees(0.4, a=LEFT, b=MIDDLE, c=RIGHT) == {"a": None, "b": None, "c": None}


@pytest.mark.parametrize(("metres_aside", "may_be"), [(5.0, True), (20.0, False)])
def test_a_track_may_be_a_missing_teammate_that_is_some_metres_beside_its_ray(metres_aside, may_be):
    """No stranger is called foreign while it may be."""
    teammates, names = Teammates(1), Names()
    place = np.array([8.0, metres_aside, 0.0])
    teammates.announce(Announcement(2, "0000000a", 1, 0.0, 0.0, place, np.eye(3), 0.01 * np.eye(3)))
    fit = TeamFit(teammates, names, Weighing([CAMERA], 0.5))
    still = TeamPose(0.0, np.zeros(3), np.eye(3), 0.01 * np.eye(3), 1e-4 * np.eye(3))
    fit.look([], NOBODY, np.zeros((0, 0)), 0.0)
    ahead = Track(
        1, 0.0, np.array([320.0, 0.0, 240.0, 0.0]), np.eye(4), TrackStatus.CONFIRMED, 1.0, np.full(2, 20.0)
    )
    assert fit.may_be_missing(ahead, ObserverCamera.of(still, CAMERA, FORWARD)) is may_be
