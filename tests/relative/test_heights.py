"""What teammates say of their heights, against what a scan measures of them."""

import numpy as np
import pytest

from swarmtrack.messages import MotionReport, RelativeState, SightingReport
from swarmtrack.relative.heights import SaidHeights
from swarmtrack.relative.looks import TeamLook
from swarmtrack.relative.priors import HEIGHT_CARRIED_S

OWN_HEIGHT, MATE_HEIGHT = 9.0, 8.0
MATE = np.array([4.0, -3.0, 1.0])


def look(t, place=MATE, drone=1, own_height=OWN_HEIGHT, *, seen=True):
    """A teammate that truly is at `place` (3,) m from the own camera."""
    ray = place / np.linalg.norm(place) if seen else np.full(3, np.nan)
    return TeamLook(
        t,
        np.array([0.0, 0.0, -own_height]),
        np.zeros(3),
        ((drone, 10),),
        ray[None],
        1e-4 * np.eye(3)[None],
        np.full(1, 0.1),
        np.ones(1),
    )


def states(place=MATE, drone=1):
    return {10: RelativeState(drone, 0.0, place, np.zeros(3), np.eye(6), 0.1, ("size",))}


def moved(t, up, climb=0.0, boot="a"):
    down = np.array([0.0, 0.0, -up])
    return MotionReport(1, boot, 1, t, 0.01, down, np.eye(3), np.array([0.0, 0.0, -climb]), np.eye(3))


def placed(t, height):
    return SightingReport(1, "a", 1, t, 0.01, np.array([4.0, -3.0, -height]), 0.1, (), ())


def test_heights_that_are_right_are_off_by_nothing_and_a_wrong_own_one_by_its_error():
    said = SaidHeights()
    said.hear_sightings(placed(1.0, MATE_HEIGHT))
    (right,) = said.sights(look(1.0), states())
    assert right.off == pytest.approx(0.0, abs=1e-9)
    assert (right.drone_id, right.t) == (1, 1.0)
    assert right.level == pytest.approx(5.0)
    assert right.lever == pytest.approx(0.1)
    (wrong,) = said.sights(look(1.0, own_height=OWN_HEIGHT + 0.7), states())
    assert wrong.off == pytest.approx(0.7)


def test_a_teammate_that_climbs_as_it_says_is_off_by_as_much_as_before():
    said = SaidHeights()
    for k in range(10):
        said.hear_motion(moved(0.2 * k, 0.5 * 0.2 * k, climb=0.5))
    offs = [
        said.sights(look(t, MATE - (0.0, 0.0, 0.5 * t)), states(MATE - (0.0, 0.0, 0.5 * t)))
        for t in (0.5, 1.9)
    ]
    assert offs[0][0].off == pytest.approx(offs[1][0].off, abs=1e-9)


def test_what_is_older_tells_less_and_then_nothing():
    said = SaidHeights()
    said.hear_sightings(placed(1.0, MATE_HEIGHT))
    sigmas = [said.sights(look(1.0 + age), states())[0].sigma for age in (0.0, 0.2, 0.5)]
    assert sigmas == sorted(sigmas)
    assert sigmas[-1] > 3.0 * sigmas[0]
    assert said.sights(look(1.0 + HEIGHT_CARRIED_S + 0.01), states()) == ()


def test_its_motion_tells_more_than_its_places_and_each_has_a_constant_of_its_own():
    said = SaidHeights()
    said.hear_sightings(placed(1.0, MATE_HEIGHT))
    (by_place,) = said.sights(look(1.0), states())
    said.hear_motion(moved(1.0, 0.0))
    (by_motion,) = said.sights(look(1.0), states())
    said.hear_motion(moved(1.1, 0.0, boot="b"))
    (of_another_life,) = said.sights(look(1.1), states())
    assert len({by_place.word, by_motion.word, of_another_life.word}) == 3


def test_who_is_not_detected_not_named_or_has_said_nothing_is_left_out():
    said = SaidHeights()
    assert said.sights(look(1.0), states()) == ()
    said.hear_sightings(placed(1.0, MATE_HEIGHT))
    assert said.sights(look(1.0, seen=False), states()) == ()
    assert said.sights(look(1.0), states(drone=3)) == ()
    assert said.sights(look(1.0), {}) == ()
    said.remove(1)
    assert said.sights(look(1.0), states()) == ()
