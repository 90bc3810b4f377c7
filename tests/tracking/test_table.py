"""Rows of a table as messages."""

import numpy as np

from swarmtrack.messages import TrackStatus
from swarmtrack.tracking.table import TrackTable


def table_of(n):
    return TrackTable(
        id=np.arange(1, n + 1),
        mean=np.arange(4.0 * n).reshape(n, 4),
        cov=np.tile(np.eye(4), (n, 1, 1)),
        existence=np.linspace(0.5, 0.9, n),
        size=np.full((n, 2), 12.0),
        confirmed=np.ones(n, np.bool_),
        lost=np.zeros(n, np.bool_),
        last_seen=np.zeros(n),
        missed_since=np.full(n, np.nan),
        likeness=np.ones(n),
        looks=np.ones(n),
        looked=np.zeros(n),
    )


def test_a_row_says_what_the_table_says():
    table = table_of(4)
    table.confirmed[:] = [True, False, True, False]
    table.lost[:] = [False, False, True, True]
    table.missed_since[2:] = [3.0, 4.0]
    tracks = table.tracks(7.0, table.mean, table.cov)
    assert [track.status for track in tracks] == [
        TrackStatus.CONFIRMED,
        TrackStatus.TENTATIVE,
        TrackStatus.LOST,
        TrackStatus.TENTATIVE,  # whoever was never confirmed cannot be lost
    ]
    assert [track.coasting_since for track in tracks] == [None, None, 3.0, 4.0]
    assert [track.id for track in tracks] == [1, 2, 3, 4]
    assert all(type(track.id) is int and type(track.probability) is float for track in tracks)
    assert [track.probability for track in tracks] == table.existence.tolist()
    assert {track.t for track in tracks} == {7.0}
    np.testing.assert_array_equal([track.mean for track in tracks], table.mean)
    assert tracks[0].cov.shape == (4, 4)
    assert TrackTable.empty().tracks(0.0, np.empty((0, 4)), np.empty((0, 4, 4))) == ()


def test_a_size_that_was_handed_out_stays_as_it_was():
    table = table_of(2)
    (track, _) = table.tracks(0.0, table.mean, table.cov)
    table.size[:] = 50.0
    assert track.size.tolist() == [12.0, 12.0]


def test_rows_are_kept_and_appended_in_their_order():
    table = table_of(3)
    table.keep(np.array([True, True, True]))
    table.keep(np.array([True, False, True]))
    assert table.id.tolist() == [1, 3]
    assert table.mean[:, 0].tolist() == [0.0, 8.0]
    table.append(TrackTable.empty())
    table.append(table_of(1))
    assert table.id.tolist() == [1, 3, 1]
    assert table.cov.shape == (3, 4, 4)
    table.keep(np.zeros(3, np.bool_))
    assert len(table) == 0
