"""Names in a frame that stands otherwise than announced, once sightings have shown how."""

import math

import numpy as np
import pytest

from support.observer import LEFT, MIDDLE, RIGHT, Observer, at, shifted
from swarmtrack.geometry import rotation
from swarmtrack.relative.alignment import FrameTransform

WELL = np.diag([0.05, 0.05, 0.05, math.radians(1.0)]) ** 2


def frame(turn_deg, theirs, ours):
    """The one that turns so far and brings theirs (3,) to ours (3,)."""
    turn = math.radians(turn_deg)
    return FrameTransform(turn, ours - rotation.from_euler(0.0, 0.0, turn) @ theirs, WELL)


def test_who_announced_a_wrong_start_is_named_where_its_frame_really_stands(observer):
    elsewhere = shifted(RIGHT, right=60.0)
    assert observer.sees(1.0, a=LEFT, b=elsewhere)["b"] is None
    observer.identities.align(3, frame(8.0, at(RIGHT), at(elsewhere)))
    assert observer.sees(2.0, a=LEFT, b=elsewhere) == {"a": 2, "b": 3}


def test_where_its_word_fits_again_its_word_counts(observer):
    observer.identities.align(3, frame(0.0, at(RIGHT), at(MIDDLE)))
    observer.identities.align(3, None)
    assert observer.sees(1.0, a=LEFT, b=RIGHT) == {"a": 2, "b": 3}


def test_who_knows_no_place_any_more_still_has_one_in_a_frame_that_is_known():
    observer = Observer()
    observer.hears(2, LEFT)
    observer.identities.align(2, frame(0.0, at(MIDDLE), at(LEFT)))
    observer.t += 1.0
    observer.is_told(2, MIDDLE, sigma=1e3)
    assert observer.sees(1.0, a=LEFT) == {"a": 2}


@pytest.mark.parametrize("degrees", [12.0, 25.0])
def test_our_own_heading_is_in_the_frame_already(degrees):
    """A frame is found by our own rays: whoever looks so far beside sees its teammates where the frames say."""
    observer = Observer()
    for drone, pixel in ((2, LEFT), (3, RIGHT)):
        seen = at(pixel)
        true = rotation.from_euler(0.0, 0.0, math.radians(-degrees)) @ seen
        observer.identities.announce(announced(observer, drone, true))
        observer.identities.align(drone, frame(degrees, true, seen))
    assert observer.sees(1.0, a=LEFT, b=RIGHT) == {"a": 2, "b": 3}


def announced(observer, drone, place):
    heard = Observer()
    heard.hears(drone, MIDDLE)
    said = heard.identities.announced[drone]
    return type(said)(drone, said.boot, said.sequence, observer.t, 0.0, place, np.eye(3), said.position_cov)
