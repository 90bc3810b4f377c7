"""Is the observer where it thinks, and does it look where it thinks? And what becomes of who doubts it."""

import math

import numpy as np
import pytest

from support.observer import LEFT, MIDDLE, RIGHT, SCAN_S, Observer, shifted
from swarmtrack.identity import own_pose
from swarmtrack.identity.weighing import OFF_ALONE, PLACE_ALONE
from swarmtrack.messages import FOREIGN, Announcement

# m: of what is 8 m ahead of where the observer thinks it is; it stands 3 m further ahead.
THOUGHT, TRUE = 8.0, 5.0


def turned(pixel, degrees):
    """Where that is in the image of a camera that looks so much further to the left than it thinks."""
    return (320.0 + 430.0 * math.tan(math.atan((pixel[0] - 320.0) / 430.0) + math.radians(degrees)), 240.0)


def nearer(pixel):
    """What the observer sees there, seen from where it really stands: no turn of its heading explains two of these."""
    return (320.0 + (pixel[0] - 320.0) * THOUGHT / TRUE, 240.0)


@pytest.mark.parametrize("sigma_deg", [0.5, 1.5, 3.0, 20.0])
def test_the_prior_of_the_azimuth_is_the_autopilots_with_a_tail(sigma_deg):
    of = own_pose.components(math.radians(sigma_deg))
    weight = np.exp(of.log_prior)
    known = 1.0 - own_pose.ON_ANOTHERS_PAD - own_pose.MISPLACED - own_pose.LOST
    assert weight.sum() == pytest.approx(known)
    assert weight == pytest.approx(weight[::-1])
    variance = (weight * of.azimuth**2).sum() / known
    wide = (1.0 - own_pose.ASKEW) * math.radians(sigma_deg) ** 2 + own_pose.ASKEW * own_pose.ASKEW_SIGMA**2
    assert 0.3 * wide < variance < 1.2 * wide
    # However well the compass is known: one in a hundred or so is off by more than 10°.
    assert weight[np.abs(of.azimuth) >= math.radians(10.0)].sum() > 0.008


@pytest.mark.parametrize("sigma_deg", [1.5, 60.0])
def test_of_compasses_a_few_point_anywhere_which_only_motion_finds(sigma_deg):
    near = own_pose.components(math.radians(sigma_deg))
    of = own_pose.components(math.radians(sigma_deg), all_around=True)
    assert np.exp(of.log_prior).sum() == pytest.approx(np.exp(near.log_prior).sum())
    far = len(of.azimuth) - len(near.azimuth)
    assert far == (15 if sigma_deg < 2.0 else 0)
    # No azimuth is further from a component than that is wide, all the way around.
    every = np.radians(np.arange(-180.0, 180.0))
    off = np.abs((every[:, None] - of.azimuth + math.pi) % (2.0 * math.pi) - math.pi)
    assert far == 0 or (off < 2.0 * of.sigma.max()).any(axis=1).all()


@pytest.mark.parametrize("degrees", [-10.0, -5.0, 5.0, 10.0])
def test_a_heading_that_is_off_shifts_all_teammates_and_two_of_them_reveal_it(observer, degrees):
    """The autopilot's heading is known to 0.6°: one look that took each for itself could explain neither."""
    names = observer.sees(1.0, a=turned(LEFT, degrees), b=turned(RIGHT, degrees))
    assert names == {"a": 2, "b": 3}


def test_one_teammate_between_two_places_is_nobody(observer):
    assert observer.sees(1.0, a=MIDDLE) == {"a": None}


def test_a_name_by_place_alone_is_never_surer_than_starts_are(observer):
    observer.sees(2.0, a=LEFT, b=RIGHT)
    stated = [entry.identity_probability for entry in observer.identities.label(observer.tracks)]
    assert stated == pytest.approx([PLACE_ALONE, PLACE_ALONE])


def test_a_start_that_is_more_than_three_sigmas_off_gives_a_name_and_no_claim(observer):
    """The heading explains what is off sideways, and nothing what is off in height."""
    assert observer.sees(2.0, a=shifted(LEFT, 40.0, 20.0), b=RIGHT) == {"a": 2, "b": 3}
    stated = [entry.identity_probability for entry in observer.identities.label(observer.tracks)]
    assert stated == pytest.approx([OFF_ALONE, PLACE_ALONE])
    assert OFF_ALONE < 0.95


def test_who_stands_on_anothers_pad_says_so_once_it_has_lasted_and_names_nobody(observer):
    observer.hears(4, MIDDLE, metres=THOUGHT - TRUE)
    seen = {"a": nearer(LEFT), "b": nearer(RIGHT)}
    observer.sees(3 * SCAN_S, **seen)
    assert not observer.identities.self_doubt
    names = observer.sees(1.0, **seen)
    assert observer.identities.self_doubt
    assert names == {"a": None, "b": None}


def test_where_one_teammate_alone_is_elsewhere_a_doubt_that_is_not_sure_is_said_once_it_has_lasted():
    """It may be that teammate's start as well as the own."""
    observer = Observer()
    observer.hears(2, LEFT)
    observer.sees(1.0, a=(420.0, 240.0))
    assert not observer.identities.self_doubt
    observer.sees(1.0, a=(420.0, 240.0))
    assert observer.identities.self_doubt


def test_a_doubt_ends_when_teammates_are_where_they_should_be_again(observer):
    observer.sees(1.0, a=nearer(LEFT), b=nearer(RIGHT))
    assert observer.identities.self_doubt
    observer.sees(1.0, c=LEFT, d=RIGHT)
    assert observer.identities.self_doubt
    assert observer.sees(3.0, c=LEFT, d=RIGHT) == {"c": 2, "d": 3}
    assert not observer.identities.self_doubt


def test_a_teammate_that_is_not_seen_is_no_reason_to_doubt_oneself(observer):
    observer.sees(5.0, a=LEFT)
    assert not observer.identities.self_doubt
    observer.sees(5.0)
    assert not observer.identities.self_doubt


def test_a_stranger_beside_the_team_is_no_reason_to_doubt_oneself(observer):
    assert observer.sees(5.0, a=LEFT, b=RIGHT, c=(320.0, 100.0)) == {"a": 2, "b": 3, "c": FOREIGN}
    assert not observer.identities.self_doubt


def nowhere(drone_id, sequence, sigma):
    return Announcement(
        drone_id, "0000000a", sequence, 1.0, 0.0, np.zeros(3), np.eye(3), sigma**2 * np.eye(3)
    )


def test_who_does_not_know_where_it_is_may_be_any_track_until_it_knows_again(observer):
    observer.sees(1.0, a=LEFT, b=RIGHT)
    assert observer.identities.announce(nowhere(2, 2, 1000.0))
    assert observer.sees(SCAN_S, a=LEFT, b=RIGHT) == {"a": None, "b": 3}
    assert observer.sees(4.0, a=LEFT, b=RIGHT) == {"a": None, "b": 3}
    # Said again by a messenger that was slow.
    assert not observer.identities.announce(nowhere(2, 2, 0.1))
    observer.hears(2, LEFT, sequence=3)
    assert observer.sees(1.0, a=LEFT, b=RIGHT) == {"a": 2, "b": 3}


def test_a_name_that_was_overruled_twice_does_not_come_back_by_place(observer):
    observer.sees(1.0, a=LEFT, b=RIGHT)
    for sequence in (2, 3):
        observer.identities.overrule(2, observer.t)
        observer.hears(2, LEFT, sequence=sequence)
        names = observer.sees(1.0, a=LEFT, b=RIGHT)
        assert names == {"a": 2 if sequence == 2 else None, "b": 3}


def test_alone_under_the_sky_nothing_is_known_of_the_own_pose():
    alone = Observer()
    alone.sees(5.0, a=MIDDLE, b=LEFT)
    assert not alone.identities.self_doubt


def test_an_observer_whose_heading_is_lost_has_no_variance_below_zero():
    """Residuals are averaged: what the heading adds to them in one scan is not to be taken off in another."""
    unsure = Observer(probability=0.99)
    unsure.hears(2, LEFT)
    with np.errstate(invalid="raise"):
        unsure.sees(0.5, a=LEFT)
        unsure.attitude_sigma = 0.3
        assert unsure.sees(0.5, a=LEFT) == {"a": None}


def test_a_doubt_does_not_end_because_nobody_is_left_to_compare_with(observer):
    observer.sees(1.0, a=nearer(LEFT), b=nearer(RIGHT))
    assert observer.identities.self_doubt
    for drone_id in (2, 3):
        observer.identities.announce(nowhere(drone_id, 2, 1000.0))
    observer.sees(6.0, a=nearer(LEFT), b=nearer(RIGHT))
    assert observer.identities.self_doubt
