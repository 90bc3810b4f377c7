"""Tracks keep the name that they lost just now."""

import numpy as np

from swarmtrack.messages import FOREIGN, IdentifiedTrack, Track, TrackStatus
from swarmtrack.relative.held_names import HeldNames
from swarmtrack.relative.priors import NAME_HELD_S


def entry(track, identity):
    made = Track(track, 0.0, np.zeros(4), np.eye(4), TrackStatus.CONFIRMED, 1.0, np.full(2, 20.0))
    return IdentifiedTrack(made, identity, 0.99)


def names(held, t, identities):
    """What the tracks with these identities are called."""
    tracks = tuple(entry(*one) for one in identities.items())
    return {one.track.id: one.identity for one in held.of(tracks, t)}


def test_a_track_keeps_its_last_name_for_a_while_and_no_longer():
    held = HeldNames()
    tracks = entry(7, 2), entry(8, None)
    assert held.of(tracks, 0.0) is tracks
    assert names(held, 1.0, {7: None, 8: None}) == {7: 2, 8: None}
    assert names(held, NAME_HELD_S - 0.1, {7: FOREIGN}) == {7: 2}
    assert names(held, NAME_HELD_S + 0.1, {7: None}) == {7: None}


def test_a_name_that_another_track_has_is_not_kept():
    held = HeldNames()
    names(held, 0.0, {7: 2})
    assert names(held, 0.5, {7: None, 8: 2}) == {7: None, 8: 2}
    # Nor does it return when that one loses it.
    assert names(held, 1.0, {7: None, 8: None}) == {7: None, 8: 2}


def test_a_track_that_was_renamed_had_the_later_name_last():
    held = HeldNames()
    names(held, 0.0, {7: 2})
    names(held, 0.5, {7: 3})
    assert names(held, 1.0, {7: None}) == {7: 3}
