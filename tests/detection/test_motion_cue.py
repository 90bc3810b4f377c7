"""What moved is likelier a drone, whatever the camera did meanwhile, and nothing is ever made less likely."""

import math

import cv2
import numpy as np
import pytest

from swarmtrack.detection.heads import Candidates
from swarmtrack.detection.motion_cue import (
    MOST_KEPT,
    MOTION_FRAMES_APART_S,
    MOTION_LONGEST_GAP_S,
    MOTION_SURE_SCORE,
    MotionCue,
)
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Frame, StampKind

CAMERA = PinholeCamera(430.0, 430.0, 160.0, 120.0, 320, 240)
STILL_THEN, STILL_NOW = np.array([80.0, 70.0]), np.array([80.0, 70.0])
MOVED_THEN, MOVED_NOW = np.array([212.0, 150.0]), np.array([200.0, 144.0])
THRESHOLD = 0.34
rng = np.random.default_rng(8)
CLUTTER = cv2.GaussianBlur(rng.uniform(90, 220, (240, 320)), (0, 0), 3.0) * 3.0 - 300.0


def picture(*centres, background=CLUTTER, noise=1.5):
    """Dark blobs, as wide as a small drone, before clutter."""
    v, u = np.mgrid[0:240, 0:320]
    image = background + rng.normal(0.0, noise, (240, 320))
    for centre in centres:
        blob = np.exp(-((u - centre[0]) ** 2 + (v - centre[1]) ** 2) / (2 * 3.0**2))
        image = image * (1 - blob) + 20.0 * blob
    return np.clip(image, 0, 255).astype(np.uint8)


def frame(t, image):
    return Frame(t, 0.0, round(1000 * t), image, StampKind.MEDIA)


def candidates(*centres, score=0.25):
    n = len(centres)
    return Candidates(
        np.array(centres, float), np.full((n, 2), 14.0), np.full(n, score), np.zeros(n, np.intp)
    )


def same_place(pixels):
    return pixels


class Turned:
    """Expects no tracks; `pixels_then` is where the pixels of a frame lie in any earlier one."""

    def __init__(self, pixels_then=same_place):
        self.asked = None
        self._pixels_then = pixels_then

    def boxes(self, exposed):
        return np.empty((0, 6))

    def pixels_at(self, then, now):
        self.asked = then
        return self._pixels_then


def keep(cue, t, image):
    cue.weigh(frame(t, image), candidates(), THRESHOLD, None)


def frames_kept(cue):
    return len(cue._kept)


def compared_with(cue, t):
    """When the frame was exposed that one of t is compared with."""
    expectation = Turned()
    cue.compare(t, expectation)
    return expectation.asked


def weighed(then, now, found, pixels_then=same_place):
    """What becomes of candidates 0.1 s after the picture `then`, with the scores that motion makes."""
    cue = MotionCue()
    keep(cue, 1.0, then)
    comparison = cue.compare(1.1, Turned(pixels_then))
    rows, score = cue.weigh(frame(1.1, now), found, THRESHOLD, comparison)
    return found.select(rows)._replace(score=score)


def test_a_weak_candidate_that_moved_is_shown_and_one_that_stands_still_is_as_weak_as_before():
    shown = weighed(
        picture(STILL_THEN, MOVED_THEN), picture(STILL_NOW, MOVED_NOW), candidates(STILL_NOW, MOVED_NOW)
    )
    assert shown.centre.tolist() == [MOVED_NOW.tolist()]
    assert shown.score[0] > MOTION_SURE_SCORE
    assert shown.size.tolist() == [[14.0, 14.0]]


def test_what_the_net_would_have_shown_stays_at_its_score_where_it_stands_still_and_the_surest_comes_first():
    found = candidates(STILL_NOW, MOVED_NOW, score=0.4)
    shown = weighed(picture(STILL_THEN, MOVED_THEN), picture(STILL_NOW, MOVED_NOW), found)
    assert shown.centre.tolist() == [MOVED_NOW.tolist(), STILL_NOW.tolist()]
    assert shown.score[1] == 0.4
    assert shown.score[0] > 0.7


def test_a_camera_that_turned_makes_nothing_of_a_still_world_likelier():
    """Everything moves by 22 px and rolls; seen through the turn, only what moved in the world has moved."""
    sky = 150.0 + 0.1 * CLUTTER
    turn = rotation.exp(np.array([0.01, 0.05, 0.08]))  # then from now
    H = CAMERA.K @ turn @ CAMERA.K_inverse

    def earlier(pixels):
        return CAMERA.project(CAMERA.bearing(pixels) @ turn.T)[0]

    background = cv2.warpPerspective(sky, H, (320, 240), borderMode=cv2.BORDER_REFLECT)
    then = picture(earlier(STILL_NOW[None])[0], earlier(MOVED_THEN[None])[0], background=background)
    now = picture(STILL_NOW, MOVED_NOW, background=sky)
    places = candidates(STILL_NOW, MOVED_NOW, [120.0, 180.0], [240.0, 60.0], score=0.4)
    shown = weighed(then, now, places, earlier)
    scores = {tuple(centre): score for centre, score in zip(shown.centre, shown.score, strict=True)}
    assert scores.pop(tuple(MOVED_NOW)) > 0.6
    assert set(scores.values()) == {0.4}
    unaware = weighed(then, now, places)
    assert dict(zip(map(tuple, unaware.centre), unaware.score, strict=True))[tuple(STILL_NOW)] > 0.4


@pytest.mark.parametrize("centre", [[0.0, 0.0], [319.0, 239.0], [160.0, 0.0], [-0.4, 120.0]])
def test_at_the_border_only_what_both_pictures_show_is_compared(centre):
    def far_off(pixels):
        return pixels + 1000.0

    def beyond_the_lens(pixels):
        return np.full_like(pixels, math.nan)

    for earlier in (same_place, far_off, beyond_the_lens):
        shown = weighed(picture(), picture(), candidates(centre, score=0.4), earlier)
        assert shown.score.tolist() == [0.4]


@pytest.mark.parametrize("shape", [(240, 320), (240, 320, 1), (240, 320, 3)])
def test_grey_and_colour_are_alike_and_no_candidate_is_no_matter(shape):
    def image(*centres):
        channels = shape[2] if len(shape) == 3 else 1
        return np.repeat(picture(*centres)[..., None], channels, axis=2).reshape(shape)

    shown = weighed(image(MOVED_THEN), image(MOVED_NOW), candidates(MOVED_NOW))
    assert shown.score[0] > MOTION_SURE_SCORE
    nobody = weighed(image(), image(), candidates())
    assert len(nobody.score) == 0


@pytest.mark.parametrize("fps", [7.0, 15.0, 30.0, 120.0])
def test_the_frame_to_compare_with_is_the_youngest_that_is_old_enough_and_few_are_kept(fps):
    cue = MotionCue()
    for k in range(60):
        t = k / fps
        before = compared_with(cue, t)
        if k / fps >= MOTION_FRAMES_APART_S + 1.0 / fps:
            assert before is not None
            assert MOTION_FRAMES_APART_S <= t - before < MOTION_FRAMES_APART_S + 1.0 / fps + 1e-9
        keep(cue, t, np.zeros((16, 16), np.uint8))
        assert frames_kept(cue) <= math.ceil(MOTION_FRAMES_APART_S * fps) + 2


def test_frames_are_not_kept_whoever_asks_for_none_and_however_slowly_their_clock_goes():
    """Nobody asked of the first thousand what they are compared with, as a flight's import once forgot to; of the
    others the stamps say that they were exposed within a millisecond."""
    cue = MotionCue()
    for k in range(1000):
        keep(cue, k / 30.0, np.zeros((16, 16), np.uint8))
        assert frames_kept(cue) <= 4
    for k in range(1000):
        keep(cue, 40.0 + 1e-6 * k, np.zeros((16, 16), np.uint8))
    assert frames_kept(cue) == MOST_KEPT


def test_after_a_pause_a_clock_that_went_back_or_another_size_nothing_is_compared():
    for t, shape in ((1.0 + MOTION_LONGEST_GAP_S + 0.1, (16, 16)), (1.0 - 1e-3, (16, 16)), (1.1, (8, 16))):
        cue = MotionCue()
        keep(cue, 1.0, np.zeros((16, 16), np.uint8))
        assert compared_with(cue, 1.1) == 1.0
        if t < 1.0 + MOTION_LONGEST_GAP_S:
            keep(cue, t, np.zeros(shape, np.uint8))
            assert compared_with(cue, t + 0.05) is None
        else:
            assert compared_with(cue, t) is None


def test_a_camera_that_changes_its_size_is_no_motion():
    shown = weighed(picture()[::2], picture(MOVED_NOW), candidates(MOVED_NOW, score=0.4))
    assert shown.score.tolist() == [0.4]
