"""What a track's bearings say, all of them and since some instant."""

import math

import numpy as np
import pytest

from swarmtrack.team.comparison import Compared, ComparedTrack, compare
from swarmtrack.team.deviation import Deviation
from swarmtrack.team.evidence import design
from swarmtrack.team.priors import (
    BEARINGS_LAST_S,
    BOX_SIZE_SIGMA_LN,
    BOX_SPAN_SIGMA_LN,
    DISTANCE_STEP_LN,
    SEGMENTS_KEPT,
)
from swarmtrack.team.track_evidence import COLUMN_OF_NOBODY, Bearing, Past, TrackEvidence

MATES = 3


def add(track, t, chance, *, is_near=True, within=(0.0, math.inf), distance=8.0, farthest=math.inf, span=1.0):
    direction = np.array([1.0, *chance.normal(0.0, 0.05, 2)])
    bearing = Bearing(t, np.zeros(3), np.zeros(2), direction / np.linalg.norm(direction), 1e-4, distance)
    places = np.tile([8.0, 0.0, 0.0], (MATES, 1)) + chance.normal(0.0, 0.3, (MATES, 3))
    ones = np.ones(MATES)
    deviation = Deviation(0.1 * ones, 0.5 * ones, 0.01 * ones)
    near = np.full(MATES, is_near)
    mates = Compared(
        np.arange(MATES),
        design(places, np.zeros(3)),
        deviation,
        0.0 * ones,
        BOX_SPAN_SIGMA_LN**2 * ones,
        near,
        0.0 * ones,
        farthest * ones,
        within,
        span,
    )
    compare([ComparedTrack(track, bearing, np.arange(MATES))], mates)


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
    assert begun.told().M[1] == pytest.approx(fresh.told().M[0], rel=1e-9, abs=1e-9)
    assert begun.told().M[0] == pytest.approx(flown([0.0, 0.5, 1.0, 1.5, 2.0]).told().M[0])


def test_a_bearing_from_before_a_segment_is_not_of_it():
    track = flown([0.0, 0.5, 1.0, 1.5], begin=1.2)
    before = track.told()
    add(track, 1.1, np.random.default_rng(1))
    after = track.told()
    assert after.M[1] == pytest.approx(before.M[1])
    # The last bearing of each teammate is newer: this one is none.
    assert after.M[0] == pytest.approx(before.M[0])


def test_a_segment_waits_for_its_first_bearing_and_what_comes_until_then_is_of_before():
    track = flown([0.0, 0.5, 1.0])
    assert not track.waits
    track.begin_segment(1.2, -5.0, np.zeros(4))
    assert track.waits
    past = Past(np.array([-2.0, -3.0]), np.array([0, COLUMN_OF_NOBODY]), np.array([-4.0, -3.0]))
    assert track.begin_waiting_on(past, np.array([0, 2])).log == pytest.approx([-7.0, -8.0])
    assert track.pasts(4).log[1] == pytest.approx([-7.0, -5.0, -8.0, -5.0])
    assert track.pasts(4).without(0)[1] == pytest.approx([-9.0, -5.0, -8.0, -5.0])
    add(track, 1.5, np.random.default_rng(15))
    assert not track.waits


def test_what_was_before_a_segment_fades_as_the_rest_does():
    """From the last bearing on, however long before the segment that was."""
    track = flown([0.0, 0.5, 1.0])
    track.begin_segment(4.0, -5.0, np.full(4, 80.0))
    add(track, 4.5, np.random.default_rng(45))
    assert track.pasts(4).log[1] == pytest.approx(80.0 * math.exp(-3.5 / BEARINGS_LAST_S) - 5.0)


def test_what_is_said_of_a_teammate_is_carried_into_another_frame_as_one_number():
    track = flown([0.0, 0.5, 1.0, 1.5], begin=1.2)
    others = track.told().M[0][[0, 2]]
    track.carry(1, 4.0, 1.5, by_place=3.0)
    told = track.told()
    assert len(track.segments) == 1
    assert told.log[0, 1] == pytest.approx(4.0)
    assert told.by_motion(0, np.array([1]))[1] == pytest.approx(np.array([[1.0]]))
    assert not told.M[0, 1].any()
    assert told.M[0][[0, 2]] == pytest.approx(others)
    add(track, 2.0, np.random.default_rng(20))
    # Its box was counted in the frame before.
    assert np.isinf(track.told().size_log[1, 1])


def test_what_bearings_say_fades_as_more_is_said():
    early, late = flown([0.0, 0.5]), flown([0.5 + BEARINGS_LAST_S])
    before = early.told().M[0]
    add(early, 0.5 + BEARINGS_LAST_S, np.random.default_rng(int((0.5 + BEARINGS_LAST_S) * 10)))
    # By then nothing is left of how far the teammate was aside.
    assert early.told().M[0] == pytest.approx(before / math.e + late.told().M[0], rel=1e-6)


def test_a_box_says_how_far_its_drone_is():
    near, anywhere = TrackEvidence(MATES, 0), TrackEvidence(MATES, 0)
    add(near, 0.0, np.random.default_rng(1))
    add(anywhere, 0.0, np.random.default_rng(1), is_near=False)

    def says(track, distance):
        # The box is that of a drone 8 m away, along a ray that is nearly north.
        z = np.array([0.0, 0.0, 0.0, 0.0, 1.0, distance, 0.0, 0.0])
        quadratic = np.einsum("a,rab,b->r", z, track.size[:, 0], z)
        return float(np.logaddexp.reduce(track.size_log[:, 0] - 0.5 * quadratic))

    assert says(near, 8.0) - says(near, 20.0) == pytest.approx(
        says(anywhere, 8.0) - says(anywhere, 20.0), abs=1.0
    )
    # Farther is a smaller share than nearer by as much.
    assert says(anywhere, 20.0) - says(anywhere, 0.8) > 1.0


def test_bearings_are_compared_at_distances_at_which_drones_are():
    """However tiny a box is: else the same jitter would be more metres for a stranger than for a teammate."""
    tiny, ordinary = TrackEvidence(MATES, 0), TrackEvidence(MATES, 0)
    for track, distance in ((tiny, 40.0), (ordinary, 8.0)):
        add(track, 0.0, np.random.default_rng(1), within=(8.0, 8.0), distance=distance)
    found, expected = tiny.told(), ordinary.told()
    assert pytest.approx(expected.M) == found.M
    assert pytest.approx(expected.log) == found.log


def test_a_density_of_bearings_is_by_the_distance_at_which_a_drone_is_supposed():
    track = TrackEvidence(MATES, 0)
    add(track, 0.0, np.random.default_rng(1), is_near=False)
    variance = BOX_SPAN_SIGMA_LN**2 + BOX_SIZE_SIGMA_LN**2
    by_size = -0.5 * DISTANCE_STEP_LN**2 / variance
    more = track.told().size_log[[1, 3], 0] - track.told().size_log[0, 0]
    assert more == pytest.approx([by_size + 2.0 * DISTANCE_STEP_LN, by_size - 2.0 * DISTANCE_STEP_LN])


def test_a_bearing_is_compared_at_no_distance_that_a_drone_can_hardly_have():
    """Else the same angle would be a small part of a neighbour's error, and any track might be a neighbour's."""
    limited, near = TrackEvidence(MATES, 0), TrackEvidence(MATES, 0)
    add(limited, 0.0, np.random.default_rng(1), distance=80.0, farthest=8.0)
    add(near, 0.0, np.random.default_rng(1), distance=8.0)
    assert pytest.approx(near.told().M) == limited.told().M
    assert limited.told().log == pytest.approx(near.told().log)


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
    told = track.told()
    assert told.M.shape == (2, MATES + 1, 8, 8)
    assert told.known.tolist() == [True] * MATES + [False]
    track.remove(0)
    assert pytest.approx(told.M[:, 1:]) == track.told().M
    assert track.told().log == pytest.approx(told.log[:, 1:])


def test_another_life_of_a_teammate_begins_with_nothing():
    track = flown([0.0, 0.5, 1.0], begin=0.7)
    track.forget(1)
    told = track.told()
    assert not told.M[:, 1].any()
    assert told.log[:, 1] == pytest.approx(0.0)
    assert told.M[:, 0].any()


def test_what_a_teammate_says_of_itself_replaces_where_it_was_last_seen():
    expected, fresh = TrackEvidence(MATES, 0), TrackEvidence(MATES, 0)
    expected.expect(Bearing(0.0, np.zeros(3), np.zeros(2), np.array([1.0, 0.0, 0.0]), 1e-4, 8.0), 1, -3.0)
    assert expected.told().log[0] == pytest.approx([0.0, -3.0, 0.0])
    for track in (expected, fresh):
        add(track, 0.5, np.random.default_rng(1))
    assert expected.told().log == pytest.approx(fresh.told().log)
    assert pytest.approx(fresh.told().M) == expected.told().M


def test_errors_of_larger_drones_are_compared_at_larger_distances():
    """What looks eight metres away is sixteen metres away where the team's drones are twice as large."""
    usual, large, far = (TrackEvidence(MATES, 0) for _ in range(3))
    add(usual, 0.0, np.random.default_rng(1))
    add(large, 0.0, np.random.default_rng(1), span=2.0)
    add(far, 0.0, np.random.default_rng(1), distance=16.0)
    assert pytest.approx(far.told().M) == large.told().M
    assert np.trace(large.told().M[0, 0]) < 0.6 * np.trace(usual.told().M[0, 0])
