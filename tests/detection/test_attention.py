"""Where a guided detector looks: at every track, at the image's own pixels, and at all of the image in the end."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmtrack.detection.attention import (
    CUT,
    UNKNOWN_SIZE,
    AttentionParameters,
    AttentionWindows,
    TimeShare,
    Window,
    coverage,
    tiles,
)
from swarmtrack.detection.detector import Detector
from swarmtrack.detection.heads import Candidates, of_several_looks, together
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.score.swarm_truth import SwarmTruth
from swarmtrack.lab.world.rendering import Renderer
from swarmtrack.messages import Frame, StampKind
from swarmtrack.training import render

IMAGE = (1280, 720)
side = st.integers(64, 2000)
images = st.tuples(side, side)


def box_of(u, v, sigma=2.0, size=20.0):
    return [u, v, 3 * sigma, 3 * sigma, size, size]


@st.composite
def scenes(draw):
    image = draw(images)
    n = draw(st.integers(0, 12))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    boxes = np.empty((n, 6))
    boxes[:, :2] = rng.uniform(-0.2, 1.2, (n, 2)) * image
    boxes[:, 2:4] = rng.exponential(10.0, (n, 2))
    boxes[:, 4:6] = np.where(rng.random((n, 1)) < 0.3, np.nan, rng.uniform(4.0, 80.0, (n, 2)))
    return image, boxes


def shows(window, centre):
    return (
        window.x <= centre[0] < window.x + window.width and window.y <= centre[1] < window.y + window.height
    )


@pytest.mark.parametrize("fixed", [None, (320, 320), (640, 384)])
@given(scene=scenes(), whole_scale=st.sampled_from([0.25, 0.5, 1.0]))
def test_every_track_in_the_image_is_looked_at_in_every_frame(fixed, scene, whole_scale):
    image, boxes = scene
    attention = AttentionWindows(AttentionParameters(), fixed)
    for _ in range(7):
        windows = attention.next(image, whole_scale, boxes)
        assert windows
        for window in windows:
            assert 0 <= window.x < window.x + window.width <= image[0]
            assert 0 <= window.y < window.y + window.height <= image[1]
        for box in boxes:
            if (box[:2] >= 0).all() and (box[:2] < np.array(image)).all():
                assert any(shows(window, box[:2]) for window in windows)


@given(scene=scenes())
def test_a_window_holds_the_box_and_its_uncertainty_up_to_the_image_s_edge(scene):
    image, boxes = scene
    attention = AttentionWindows(AttentionParameters(most_windows=99, whole_every=10**6))
    attention.next(image, 0.5, np.empty((0, 6)))  # the first frame is a whole one
    windows = attention.next(image, 0.5, boxes)[:-1]  # without the tile
    for box in boxes:
        size = np.where(np.isnan(box[4:]), UNKNOWN_SIZE, box[4:])
        low = np.clip(box[:2] - box[2:4] - size / 2, 0, np.array(image) - 1)
        high = np.clip(box[:2] + box[2:4] + size / 2, 0, np.array(image) - 1)
        if (high > low).all() and windows:
            assert any(
                (low >= [w.x - 1, w.y - 1]).all() and (high <= [w.x + w.width, w.y + w.height]).all()
                for w in windows
            )


def test_a_small_drone_is_enlarged_and_a_large_one_seen_as_it_is():
    for size, scale in ((8.0, 3.0), (24.0, 2.0), (48.0, 1.0), (90.0, 1.0)):
        attention = AttentionWindows(AttentionParameters(tiles=False))
        attention.next(IMAGE, 0.5, np.empty((0, 6)))
        (window,) = attention.next(IMAGE, 0.5, np.array([box_of(600, 300, size=size)]))
        assert window.scale == pytest.approx(scale)


def test_a_track_that_may_be_far_off_gets_a_window_that_the_net_can_still_afford():
    attention = AttentionWindows(AttentionParameters(tiles=False))
    attention.next(IMAGE, 0.5, np.empty((0, 6)))
    (window,) = attention.next(IMAGE, 0.5, np.array([box_of(600, 300, sigma=60.0, size=12.0)]))
    assert max(window.width, window.height) * window.scale <= AttentionParameters().largest_px + 1
    assert window.width >= 360


def test_neighbours_share_a_window():
    attention = AttentionWindows(AttentionParameters(tiles=False))
    attention.next(IMAGE, 0.5, np.empty((0, 6)))
    assert (
        len(attention.next(IMAGE, 0.5, np.array([box_of(600, 300), box_of(630, 310), box_of(100, 100)]))) == 2
    )


def test_whole_frames_come_as_often_as_asked_and_without_tracks_always():
    attention, boxes = AttentionWindows(AttentionParameters(whole_every=4)), np.array([box_of(600, 300)])
    whole = [Window(0, 0, *IMAGE, 0.5) in attention.next(IMAGE, 0.5, boxes) for _ in range(9)]
    assert whole == [True, False, False, False, True, False, False, False, True]
    assert all(attention.next(IMAGE, 0.5, np.empty((0, 6)))[0].area == math.prod(IMAGE) for _ in range(3))


def test_a_crowd_is_seen_as_a_whole():
    boxes = np.array([box_of(u, v) for u in range(100, 1200, 200) for v in (100, 500)])
    attention = AttentionWindows(AttentionParameters())
    for _ in range(6):
        assert attention.next(IMAGE, 0.5, boxes)[0] == Window(0, 0, *IMAGE, 0.5)


@given(image=images, tile=st.tuples(st.integers(64, 700), st.integers(64, 700)))
def test_tiles_show_all_of_the_image_and_overlap(image, tile):
    seen = np.zeros(image, np.int64)
    for window in tiles(image, tile):
        assert window.width <= image[0]
        assert window.height <= image[1]
        seen[window.x : window.x + window.width, window.y : window.y + window.height] += 1
    assert seen.min() >= 1
    if image[0] > tile[0] > 160:  # a drone of 16 px on a border is whole in one of them
        assert max(np.diff(sorted({w.x for w in tiles(image, tile)})), default=0) <= tile[0] - 16


def test_one_tile_after_the_other_goes_through_the_image():
    attention, every = AttentionWindows(AttentionParameters()), tiles(IMAGE, (256, 256))
    seen = [attention.next(IMAGE, 0.5, np.empty((0, 6)))[-1] for _ in range(2 * len(every))]
    assert seen == [*every, *every]


def test_half_a_drone_at_a_window_s_edge_is_none_but_at_the_image_s_it_is():
    centre, size = np.array([[105.0, 150.0], [150.0, 150.0], [195.0, 150.0]]), np.full((3, 2), 12.0)
    assert Window(100, 100, 100, 100, 1.0).cuts(centre, size, IMAGE).tolist() == [True, False, True]
    assert (
        not Window(0, 0, *IMAGE, 0.5).cuts(np.array([[2.0, 300.0], [1278.0, 300.0]]), size[:2], IMAGE).any()
    )
    assert CUT < 6.0


def test_coverage_is_the_share_of_the_image_that_was_looked_at():
    assert coverage([Window(0, 0, *IMAGE, 0.5)], IMAGE) == 1.0
    assert coverage([Window(0, 0, 640, 720, 1.0), Window(320, 0, 320, 720, 2.0)], IMAGE) == pytest.approx(0.5)


def test_the_same_drone_in_two_looks_is_one():
    def look(centre, size, score):
        return Candidates(
            np.array([centre]), np.array([[size, size]]), np.array([score]), np.zeros(1, np.intp)
        )

    near = together([look([100.0, 100.0], 14.0, 0.6), look([105.0, 101.0], 12.0, 0.9)])
    assert near.select(of_several_looks(near, limit=9)).centre.tolist() == [[105.0, 101.0]]
    apart = together([look([100.0, 100.0], 14.0, 0.6), look([112.0, 101.0], 12.0, 0.9)])
    assert of_several_looks(apart, limit=9) == [0, 1]


def test_a_share_of_the_time_leaves_room_for_tiles_now_and_then():
    time = TimeShare(0.1)
    tiles = []
    for k in range(400):
        has_time = time.comes_to(0.1 * k)
        tiles.append(has_time)
        time.spend(0.015 if has_time else 0.005)  # 0.01 is earned from frame to frame
    assert np.mean(tiles[100:]) == pytest.approx(0.5, abs=0.05)


def test_looks_that_cost_more_than_their_share_have_no_tiles_and_forget_most_of_the_debt():
    time = TimeShare(0.1)
    for k in range(100):
        has_time = time.comes_to(0.1 * k)
        assert not has_time
        time.spend(0.05)
    assert time.comes_to(30.0), "after a pause"
    assert TimeShare(1.0).comes_to(0.0), "without a bound"


def test_without_time_there_is_no_tile():
    windows = AttentionWindows(AttentionParameters())
    boxes = np.array([box_of(600, 300)])
    windows.next(IMAGE, 0.5, boxes)
    with_tile, without = (windows.next(IMAGE, 0.5, boxes, has_time=has_time) for has_time in (True, False))
    assert len(with_tile) == len(without) + 1


# --- with the shipped net


class Tracks:
    """Expects them where it is told, and knows of no turn."""

    def __init__(self, boxes):
        self._boxes = boxes

    def boxes(self, exposed):
        return self._boxes

    def pixels_at(self, then, now):
        return None


def sky_with(centres, *, size, width=1280, height=720):
    rng = np.random.default_rng(0)
    image = np.full((height, width, 3), (220, 170, 130), np.float32)
    for centre in centres:
        render.paste_into(rng, image, render.multirotor(rng), np.array(centre), size)
    return Frame(0.0, 0.0, 0, image.astype(np.uint8), StampKind.MEDIA)


def test_what_a_shrunk_frame_hides_a_guided_look_finds_where_it_is():
    there = [(300.0, 200.0), (900.0, 500.0)]
    frame = sky_with(there, size=16.0)
    boxes = np.array([box_of(*centre, size=16.0) for centre in there])
    whole = Detector(input_scale=0.25, second_stage="none", look="whole")
    missed = whole.detect(whole.plan(frame, Tracks(boxes)))
    guided = Detector(input_scale=0.25, second_stage="none")
    found = guided.detect(guided.plan(frame, Tracks(boxes)))
    assert len(missed.score) < 2
    assert len(found.score) == 2
    order = np.argsort(found.centre[:, 0])
    assert found.centre[order] == pytest.approx(np.array(there), abs=2.0)
    assert dict(guided.status().counters)["windows"] == 4  # the first frame: whole, two windows, a tile


def test_it_is_guided_only_where_the_frame_is_shrunk_or_it_is_asked_for():
    frame = Frame(0.0, 0.0, 0, np.zeros((*IMAGE[::-1], 3), np.uint8), StampKind.MEDIA)
    tracks = Tracks(np.array([box_of(600, 300)]))

    def is_guided(**how):
        return len(Detector(**how).plan(frame, tracks).windows) > 1

    assert not is_guided()
    assert is_guided(input_scale=0.5)
    assert is_guided(look="guided")
    assert not is_guided(input_scale=0.5, look="whole")


@pytest.mark.parametrize("sequence", [93, 94, 96, 97])
def test_a_house_that_seems_likelier_at_first_does_not_hide_the_drone_before_it(sequence):
    scenario = load_scenario("hover-triangle", seed=1)
    camera, t = scenario.cameras[0], sequence / 20
    image = Renderer(scenario.world, camera.lens, camera.body_from_camera).image(1, t, sequence)
    boxes = SwarmTruth(scenario.world, scenario.cameras).view(1, t).in_view
    tracks = Tracks(np.array([box_of(u, v, size=70.0) for u, v, *_ in boxes.values()]))
    detector = Detector(input_scale=0.5)
    found = detector.detect(detector.plan(Frame(t, 0.0, sequence, image, StampKind.EXPOSURE), tracks))
    assert np.hypot(*(found.centre - np.array(boxes[3][:2])).T).min() < 3.0


@pytest.mark.parametrize("shape", [(0, 0, 3), (480, 0), (100,), (100, 100, 4)])
def test_an_image_that_is_none_is_not_planned_for_but_refused(shape):
    detector, image = Detector(look="guided"), np.zeros(shape, np.uint8)
    look = detector.plan(Frame(0.0, 0.0, 0, image, StampKind.MEDIA), Tracks(np.empty((0, 6))))
    assert look.windows == ()
    assert detector.detect(look) is None
    assert dict(detector.status().counters)["refused_frames"] == 1


def test_without_tracks_told_the_whole_is_looked_at():
    detector = Detector(look="guided")
    found = detector.detect(detector.plan(sky_with([(300.0, 200.0)], size=30.0)))
    assert found.coverage == 1.0
    assert len(found.score) == 1
