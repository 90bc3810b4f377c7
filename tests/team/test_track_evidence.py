"""What a track's bearings say since some instant is their sum, less the faded sum of then."""

import math

import numpy as np
import pytest

from swarmtrack.team.priors import BEARINGS_LAST_S, BOX_SPAN_SIGMA_LN, SEGMENTS_KEPT
from swarmtrack.team.track_evidence import Bearing, Compared, TrackEvidence

MATES = 3


def add(track, t, chance):
    direction = np.array([1.0, *chance.normal(0.0, 0.05, 2)])
    bearing = Bearing(t, np.zeros(3), np.zeros(2), direction / np.linalg.norm(direction), 1e-4, 8.0)
    places = np.tile([8.0, 0.0, 0.0], (MATES, 1)) + chance.normal(0.0, 0.3, (MATES, 3))
    ones = np.ones(MATES)
    mates = Compared(np.arange(MATES), places, 0.12 * ones, 0.0 * ones, BOX_SPAN_SIGMA_LN**2 * ones)
    track.add(bearing, mates, np.zeros(3))


def flown(times, begin=None):
    """A track with bearings at these times; a segment begins at `begin`."""
    track = TrackEvidence(MATES, 0)
    for t in times:
        if begin is not None and t >= begin and len(track.segments) == 1:
            track.begin_segment(begin, -5.0, np.zeros(4))
        add(track, t, np.random.default_rng(int(t * 10)))
    return track


def test_a_segment_is_what_was_said_since_it_began():
    begun, fresh = flown([0.0, 0.5, 1.0, 1.5, 2.0], begin=1.2), flown([1.5, 2.0])
    later = begun.told(2.0).M[1] - begun.size
    assert later == pytest.approx(fresh.told(2.0).M[0] - fresh.size, rel=1e-9, abs=1e-9)
    assert begun.told(2.0).M[0] == pytest.approx(flown([0.0, 0.5, 1.0, 1.5, 2.0]).told(2.0).M[0])


def test_a_bearing_from_before_a_segment_is_not_of_it():
    track = flown([0.0, 0.5, 1.0, 1.5], begin=1.2)
    before = track.told(1.6)
    add(track, 1.1, np.random.default_rng(1))
    after = track.told(1.6)
    assert after.M[1] == pytest.approx(before.M[1])
    # The last bearing of each teammate is newer: this one is none.
    assert after.M[0] == pytest.approx(before.M[0])


def test_what_bearings_say_fades():
    track = flown([0.0, 0.5])
    now, later = track.told(0.5).M[0] - track.size, track.told(0.5 + BEARINGS_LAST_S).M[0] - track.size
    assert later == pytest.approx(now / math.e)


def test_only_so_many_segments_are_kept_the_likeliest_and_the_last():
    track = flown([0.0])
    for k in range(SEGMENTS_KEPT + 4):
        track.begin_segment(1.0 + k, -5.0, np.zeros(4))
        track.segments[-1].weight = 0.9 if k == 1 else 0.01 * k
    assert len(track.segments) == SEGMENTS_KEPT + 1
    assert [segment.since for segment in track.segments] == [-math.inf, 2.0, 6.0, 7.0]


def test_a_teammate_may_be_added_and_removed():
    track = flown([0.0, 0.5, 1.0], begin=0.7)
    track.grow(MATES + 1)
    told = track.told(1.0)
    assert told.M.shape == (2, MATES + 1, 8, 8)
    assert told.known.tolist() == [True] * MATES + [False]
    track.remove(0)
    assert pytest.approx(told.M[:, 1:]) == track.told(1.0).M
    assert track.told(1.0).log == pytest.approx(told.log[:, 1:])


def test_another_life_of_a_teammate_begins_with_nothing():
    track = flown([0.0, 0.5, 1.0], begin=0.7)
    track.forget(1)
    told = track.told(1.0)
    assert not told.M[:, 1].any()
    assert told.log[:, 1] == pytest.approx(0.0)
    assert told.M[:, 0].any()
