"""How long a drone whose process is gone remains a candidate for a track."""

import numpy as np

from swarmtrack.identity.teammates import DEPARTED_S, Teammates
from swarmtrack.messages import Announcement, PeerArrived, PeerDeparted

FLOWN_S = 1000.0


def teammates() -> Teammates:
    """Of drone 1; drone 2 announced itself long ago."""
    known = Teammates(1)
    known.on_membership(PeerArrived(2, "b2"))
    known.announce(Announcement(2, "b2", 1, 0.0, 0.0, np.zeros(3), np.eye(3), np.eye(3)))
    known.forget(FLOWN_S, {2})
    return known


def test_time_counts_from_the_departure_and_not_from_the_announcement():
    known = teammates()
    known.on_membership(PeerDeparted(2, "b2"))
    known.forget(FLOWN_S + 1.0, set())
    known.forget(FLOWN_S + DEPARTED_S, set())
    assert 2 in known.announced
    known.forget(FLOWN_S + DEPARTED_S + 2.0, set())
    assert 2 not in known.announced


def test_a_drone_with_a_track_is_not_forgotten_and_the_time_counts_from_the_end_of_its_track():
    known = teammates()
    known.on_membership(PeerDeparted(2, "b2"))
    for t in np.arange(FLOWN_S, FLOWN_S + 2.0 * DEPARTED_S, 10.0):
        known.forget(t, {2})
    known.forget(t + DEPARTED_S, set())
    assert 2 in known.announced


def test_a_drone_that_comes_back_is_not_forgotten():
    known = teammates()
    known.on_membership(PeerDeparted(2, "b2"))
    known.forget(FLOWN_S + 1.0, set())
    known.on_membership(PeerArrived(2, "b2"))
    known.forget(FLOWN_S + 2.0 * DEPARTED_S, set())
    assert 2 in known.announced
