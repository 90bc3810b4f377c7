"""Which detection is a teammate's: its own, raw, and none where two might have it."""

import numpy as np
import pytest

from swarmtrack.messages import IdentifiedTrack, Scan, Track, TrackStatus
from swarmtrack.relative.detected import named_boxes

R = np.tile(4.0 * np.eye(2), (3, 1, 1))


def track(track_id, u, v, name, status=TrackStatus.CONFIRMED, missed=None):
    mean, cov = np.array([u, 0.0, v, 0.0]), np.diag([2.0, 50.0, 2.0, 50.0])
    one = Track(track_id, 0.0, mean, cov, status, 0.99, np.array([30.0, 12.0]), missed)
    return IdentifiedTrack(one, name, 0.99 if name else 0.0)


def scan(*pixels):
    z = np.array(pixels, float).reshape(-1, 2)
    sizes = np.column_stack([30.0 + np.arange(len(z)), np.full(len(z), 12.0)])
    return Scan(0.0, z, size=sizes)


def test_each_has_its_own_detection_as_it_was_measured():
    found = named_boxes(
        [track(4, 101.0, 100.0, 2), track(5, 300.0, 100.0, None), track(6, 200.0, 99.0, 3)],
        scan((202.0, 100.0), (100.0, 101.0), (300.0, 100.0)),
        R,
    )
    assert [(box.drone_id, box.track_id) for box in found] == [(2, 4), (3, 6)]
    assert found[0].z == pytest.approx([100.0, 101.0])
    assert found[1].z == pytest.approx([202.0, 100.0])
    assert [box.size[0] for box in found] == [31.0, 30.0]


@pytest.mark.parametrize("other", [3, None], ids=["a teammate", "a stranger"])
def test_a_box_that_two_may_have_is_nobody_s(other):
    found = named_boxes(
        [track(4, 99.0, 100.0, 2), track(5, 103.0, 100.0, other)], scan((101.0, 100.0)), R[:1]
    )
    assert all(np.isnan(box.z).all() and np.isnan(box.size).all() for box in found)


def test_a_tentative_track_next_to_it_takes_nothing_away():
    weak = track(5, 103.0, 100.0, None, status=TrackStatus.TENTATIVE)
    (box,) = named_boxes([track(4, 99.0, 100.0, 2), weak], scan((101.0, 100.0)), R[:1])
    assert box.z == pytest.approx([101.0, 100.0])


@pytest.mark.parametrize("one", [track(4, 100.0, 100.0, 2, missed=0.0), track(4, 160.0, 100.0, 2)])
def test_who_is_not_detected_has_nothing_and_keeps_its_name(one):
    (box,) = named_boxes([one], scan((100.0, 100.0)), R[:1])
    assert (box.drone_id, box.track_id) == (2, 4)
    assert np.isnan(box.z).all()


def test_no_detections_and_no_names_are_ordinary():
    assert (
        named_boxes([track(4, 1.0, 1.0, None), track(5, 1.0, 1.0, "foreign")], scan((1.0, 1.0)), R[:1]) == []
    )
    (box,) = named_boxes([track(4, 1.0, 1.0, 2)], scan(), R[:0])
    assert np.isnan(box.z).all()
