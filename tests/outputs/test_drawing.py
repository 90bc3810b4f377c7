"""What is drawn over a picture for each track (outputs/drawing.py)."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest

from swarmtrack.messages import FOREIGN, TrackStatus
from swarmtrack.outputs.drawing import DrawnTrack, place_tags
from swarmtrack.outputs.palette import colour_of

SIZE = np.array([30.0, 20.0])


def drawn(
    u=320.0, v=240.0, identity=None, *, status=TrackStatus.CONFIRMED, size=SIZE, alone=False
) -> DrawnTrack:
    cov = np.diag([4.0, 9.0])
    return DrawnTrack(7, identity, status, None, np.array([u, v]), np.array([40.0, -8.0]), cov, size, alone)


def test_a_box_is_around_the_centre_and_an_arrow_leads_a_quarter_of_a_second_ahead():
    one = drawn()
    assert one.box.tolist() == [[305.0, 230.0], [335.0, 250.0]]
    assert one.corners.tolist() == [[305.0, 230.0], [335.0, 230.0], [335.0, 250.0], [305.0, 250.0]]
    assert one.arrow.tolist() == [[320.0, 240.0], [330.0, 238.0]]
    assert one.ellipse == pytest.approx((9.0, 6.0, 0.5 * math.pi))


def test_a_track_without_a_size_has_a_box_of_its_own_size():
    assert np.ptp(drawn(size=np.array([np.nan, 8.0])).box, axis=0).tolist() == [20.0, 8.0]


def test_labels_stay_in_the_picture():
    for u, v in product((0.0, 320.0, 640.0), (0.0, 240.0, 480.0)):
        one = drawn(u, v, identity=2)
        left, baseline = one.label_at(640)
        assert 0.0 <= left <= 640.0 - 9.0 * len(one.label)
        assert 17.0 <= baseline <= 480.0


def test_tags_of_drones_that_cross_lie_in_the_picture_and_not_on_each_other():
    boxes = [
        drawn(u, v).box for u, v in ((320.0, 240.0), (324.0, 238.0), (330.0, 242.0), (2.0, 3.0), (5.0, 4.0))
    ]
    tags = place_tags(boxes, [(60.0, 17.0)] * len(boxes), 640.0, 480.0)
    for k, (left, top, right, bottom) in enumerate(tags):
        assert 0.0 <= left < right <= 640.0
        assert 0.0 <= top < bottom <= 480.0
        assert not any(left < b[2] and b[0] < right and top < b[3] and b[1] < bottom for b in tags[k + 1 :])


def test_only_where_there_is_no_team_a_track_has_a_colour_of_its_own():
    assert drawn().colour == colour_of(None)
    assert drawn(alone=True).colour == colour_of(7)
    assert drawn(identity=2, alone=True).colour == drawn(identity=2).colour == colour_of(2)
    assert len({colour_of(None), colour_of(FOREIGN), *map(colour_of, range(1, 9))}) == 10


def test_what_is_tentative_is_a_dot_and_what_is_lost_is_marked():
    assert drawn(status=TrackStatus.TENTATIVE).is_dot
    lost = drawn(status=TrackStatus.LOST)
    assert (lost.is_dot, lost.is_lost, lost.label) == (False, True, "track 7 (lost)")
