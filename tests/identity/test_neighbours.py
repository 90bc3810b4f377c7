"""Whose reports a drone of a large team receives."""

import numpy as np
import pytest

from swarmtrack.identity.neighbours import ANNOUNCED_AGAIN_M, NEAREST_RECEIVED, Neighbours, is_far
from swarmtrack.identity.teammates import Teammates
from swarmtrack.messages import Announcement, PeerArrived, SightingReport

OWN, FOCAL_PX, WIDTH_M = 1, 300.0, 0.6
# m: by its camera, and by how far a teammate may have gone unheard.
SIGHT_M = WIDTH_M * FOCAL_PX / 5.0 + 2.0 * ANNOUNCED_AGAIN_M


def announced(drone, north, east=0.0, sigma=0.1):
    place = np.array([north, east, -5.0])
    return Announcement(drone, f"{drone:08x}", 1, 0.0, 0.0, place, np.eye(3), sigma**2 * np.eye(3))


def in_a_row(count, spacing):
    """Teammates 2, 3, … of a drone at the head of a row."""
    team = Teammates(OWN)
    for k in range(count):
        team.announce(announced(2 + k, spacing * (1 + k)))
    return team


def of(team, chosen=None, *, place=(0.0, 0.0, -5.0), seen=(), needed=()):
    chosen = chosen or Neighbours([FOCAL_PX], WIDTH_M)
    return chosen.of(None if place is None else np.array(place), np.reshape(seen, (-1, 3)), team, needed)


def test_in_a_small_team_all_are_received():
    assert of(in_a_row(2 * NEAREST_RECEIVED, 100.0)) is None
    assert of(in_a_row(2 * NEAREST_RECEIVED + 1, 100.0)) is not None


def test_far_apart_the_nearest_are_received():
    assert of(in_a_row(60, 100.0)) == set(range(2, 2 + NEAREST_RECEIVED))


def test_close_together_all_within_sight_are_received_however_many():
    near = round(SIGHT_M / 2.0) - 1
    assert of(in_a_row(100, 2.0)) == set(range(2, 2 + near))
    assert near > NEAREST_RECEIVED


def test_whoever_may_be_a_track_is_received_however_far():
    team = in_a_row(60, 100.0)
    team.announce(announced(90, 0.0, east=8000.0))
    nearest = set(range(2, 2 + NEAREST_RECEIVED))
    assert of(team) == nearest
    assert of(team, seen=[0.1, 0.99, 0.0]) == nearest | {90}
    assert of(team, seen=[0.5, 0.87, 0.0]) == nearest


def test_who_would_receive_most_receives_all():
    assert of(in_a_row(100, 2.0)) is not None
    assert of(in_a_row(100, 1.0)) is None


def test_who_does_not_know_where_it_is_receives_all():
    assert of(in_a_row(60, 100.0), place=None) is None


def test_whoever_may_be_anywhere_is_received_and_whoever_is_needed():
    team = in_a_row(60, 100.0)
    team.on_membership(PeerArrived(90, "0000005a"))
    team.announce(announced(91, 9000.0, sigma=1000.0))
    assert of(team, needed=[60]) == {*range(2, 2 + NEAREST_RECEIVED), 60, 90, 91}


def test_a_teammate_that_comes_near_is_received():
    team = in_a_row(60, 100.0)
    assert 61 not in of(team)
    near = np.array([50.0, 0.0, -5.0])
    team.whereabouts.report(SightingReport(61, f"{61:08x}", 1, 1.0, 0.0, near, 0.1, (), ()))
    assert 61 in of(team)


def test_a_teammate_is_received_until_it_is_clearly_farther_than_another():
    team, chosen = in_a_row(60, 100.0), Neighbours([FOCAL_PX], WIDTH_M)
    last = 1 + NEAREST_RECEIVED
    team.announce(announced(90, -100.0 * NEAREST_RECEIVED - 1.0))
    assert of(team, chosen) == set(range(2, 1 + last))
    assert of(team, chosen, place=(-4.0, 0.0, -5.0)) == set(range(2, 1 + last))
    assert of(team, chosen, place=(-9.0, 0.0, -5.0)) == {*range(2, last), 90}


def test_larger_drones_are_seen_farther_away():
    team = in_a_row(100, 4.0)
    assert len(of(team, Neighbours([FOCAL_PX], 2.0))) > len(of(team))


@pytest.mark.parametrize(
    ("metres", "far"), [(ANNOUNCED_AGAIN_M - 1.0, False), (ANNOUNCED_AGAIN_M + 1.0, True)]
)
def test_a_drone_that_has_flown_far_is_to_announce_itself_again(metres, far):
    assert is_far(np.array([0.0, metres, 0.0]), np.zeros(3)) == far
    assert not is_far(np.array([0.0, metres, 0.0]), None)
