"""Tracks keep the name that they lost just now."""

import numpy as np

from swarmtrack.messages import FOREIGN, IdentifiedTrack, Track, TrackStatus
from swarmtrack.relative.held_names import HeldNames
from swarmtrack.relative.priors import NAME_HELD_S


def entry(track, identity):
    made = Track(track, 0.0, np.zeros(4), np.eye(4), TrackStatus.CONFIRMED, 1.0, np.full(2, 20.0))
    return IdentifiedTrack(made, identity, 0.99)


def test_a_track_keeps_its_last_name_for_a_while_and_no_longer():
    held = HeldNames()
    assert held.of([entry(7, 2), entry(8, None)], 0.0) == ()
    (one,) = held.of([entry(7, None), entry(8, None)], 1.0)
    assert (one.track.id, one.identity) == (7, 2)
    (one,) = held.of([entry(7, FOREIGN)], NAME_HELD_S - 0.1)
    assert (one.track.id, one.identity) == (7, 2)
    assert held.of([entry(7, None)], NAME_HELD_S + 0.1) == ()


def test_a_name_that_another_track_has_is_not_kept():
    held = HeldNames()
    held.of([entry(7, 2)], 0.0)
    assert held.of([entry(7, None), entry(8, 2)], 0.5) == ()
    # Nor does it return when that one loses it.
    (one,) = held.of([entry(7, None), entry(8, None)], 1.0)
    assert one.track.id == 8


def test_a_track_that_was_renamed_had_the_later_name_last():
    held = HeldNames()
    held.of([entry(7, 2)], 0.0)
    held.of([entry(7, 3)], 0.5)
    (one,) = held.of([entry(7, None)], 1.0)
    assert one.identity == 3
