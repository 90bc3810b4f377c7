"""Metrics against cases worked by hand."""

import math

import numpy as np
import pytest

from swarmtrack.lab.score.clip_score import ClipScore, TrackPoints, TruthBoxes, score_clip
from swarmtrack.lab.score.gospa import gospa, ospa
from swarmtrack.lab.score.intervals import bootstrap_interval, mean_interval


def boxes(*entries, size=20.0):
    """Entries (id, u, v); all boxes of one size, so the hit radius is half of it."""
    table = np.array(entries, float).reshape(-1, 3)
    return TruthBoxes(table[:, 0].astype(int), table[:, 1:], np.full((len(table), 2), size))


def points(*entries):
    table = np.array(entries, float).reshape(-1, 3)
    return TrackPoints(table[:, 0].astype(int), table[:, 1:])


LEFT, RIGHT = (100.0, 100.0), (300.0, 100.0)
BOTH = boxes((1, *LEFT), (2, *RIGHT))


def test_perfect_tracks_score_perfectly():
    truth = dict.fromkeys(range(5), BOTH)
    tracks = {frame: points((7, *LEFT), (9, *RIGHT)) for frame in range(5)}
    assert score_clip(truth, tracks, range(5)) == ClipScore(
        frames=5, boxes=10, tracks=10, hits=10, switches=0, squared_error_px2=0.0
    )


def test_a_track_that_ends_for_another_is_one_switch_however_long_it_stays():
    truth = {frame: boxes((1, *LEFT)) for frame in range(6)}
    tracks = {frame: points((7 if frame < 3 else 8, *LEFT)) for frame in range(6)}
    assert score_clip(truth, tracks, range(6)).switches == 1


def test_two_tracks_that_swap_are_one_switch_of_each_object():
    truth = dict.fromkeys(range(6), BOTH)
    tracks = {
        frame: points((7, *LEFT), (9, *RIGHT)) if frame < 3 else points((9, *LEFT), (7, *RIGHT))
        for frame in range(6)
    }
    score = score_clip(truth, tracks, range(6))
    assert score.switches == 2
    assert score.recall == score.precision == 1.0


def test_found_again_by_the_same_track_is_a_miss_and_no_switch():
    truth = {frame: boxes((1, *LEFT)) for frame in range(5)}
    tracks = {frame: points((7, *LEFT)) for frame in (0, 1, 3, 4)}
    score = score_clip(truth, tracks, range(5))
    assert (score.hits, score.boxes, score.switches) == (4, 5, 0)
    assert (score.recall, score.precision) == (0.8, 1.0)


def test_a_second_track_on_one_object_is_a_false_one():
    score = score_clip({0: boxes((1, *LEFT))}, {0: points((7, 100, 101), (8, 100, 99.5))}, range(1))
    assert (score.hits, score.tracks, score.precision) == (1, 2, 0.5)
    assert score.centre_rmse_px == pytest.approx(0.5)  # the nearer one is the hit


def test_a_track_where_nothing_is_labelled_is_a_false_one():
    score = score_clip({}, {0: points((7, *LEFT))}, range(1))
    assert (score.boxes, score.tracks, score.hits) == (0, 1, 0)
    assert score.precision == 0.0
    assert math.isnan(score.recall)


@pytest.mark.parametrize(
    ("size", "offset", "hits"), [(20.0, 10.0, 1), (20.0, 10.01, 0), (4.0, 6.0, 1), (4.0, 6.01, 0)]
)
def test_a_hit_is_within_half_the_longer_side_and_never_less_than_six_pixels(size, offset, hits):
    truth = boxes((1, *LEFT), size=size)
    truth.size[0, 1] = 1.0  # the shorter side does not count
    score = score_clip({0: truth}, {0: points((7, LEFT[0], LEFT[1] + offset))}, range(1))
    assert score.hits == hits


def test_two_hits_go_before_one_closer_hit():
    """Track 7 is nearer to object 1, but only it can hit object 2."""
    truth = boxes((1, 100, 100), (2, 112, 100))
    score = score_clip({0: truth}, {0: points((7, 105, 100), (8, 92, 100))}, range(1))
    assert score.hits == 2
    assert score.squared_error_px2 == pytest.approx(7.0**2 + 8.0**2)


def test_what_lies_before_the_start_does_not_count():
    truth = {frame: boxes((1, *LEFT)) for frame in range(4)}
    tracks = {0: points((5, *LEFT)), 1: points((6, 0, 0)), 2: points((7, *LEFT)), 3: points((7, *LEFT))}
    assert score_clip(truth, tracks, range(2, 4)) == ClipScore(2, 2, 2, 2, 0, 0.0)


def test_the_score_of_two_clips_weighs_every_box_alike():
    total = ClipScore(10, 10, 10, 10, 1, 40.0) + ClipScore(30, 30, 10, 0, 2, 0.0)
    assert (total.recall, total.precision, total.switches, total.centre_rmse_px) == (0.25, 0.5, 3, 2.0)


def at(*coordinates):
    return np.array(coordinates, float).reshape(-1, 2)


def test_gospa_of_one_pair_one_miss_and_one_false_target():
    found = gospa(at((0, 0), (100, 0)), at((3, 4), (200, 0)), c=20.0, p=2.0)
    assert (found.localisation, found.missed, found.false) == (25.0, 200.0, 200.0)
    assert found.distance == pytest.approx(math.sqrt(425.0))


def test_gospa_counts_targets_where_ospa_divides_by_them():
    """One of four is missed, the others are exact."""
    truth = at((0, 0), (50, 0), (100, 0), (150, 0))
    assert gospa(truth, truth[:3]).distance == pytest.approx(math.sqrt(0.5 * 20.0**2))
    assert ospa(truth, truth[:3]) == pytest.approx(math.sqrt(20.0**2 / 4))


def test_ospa_of_two_pairs_is_their_mean_whatever_the_order():
    truth, estimate = at((0, 0), (100, 0)), at((100, 6), (0, 8))
    assert ospa(truth, estimate, c=20.0, p=1.0) == pytest.approx(7.0)
    assert ospa(truth, estimate, c=20.0, p=2.0) == pytest.approx(math.sqrt(50.0))
    assert ospa(truth, estimate, c=7.0, p=1.0) == pytest.approx(6.5)


def test_empty_sets_are_ordinary():
    nothing, one = at(), at((1, 1))
    assert gospa(nothing, nothing).distance == ospa(nothing, nothing) == 0.0
    assert gospa(nothing, one).distance == pytest.approx(math.sqrt(200.0))
    assert ospa(one, nothing) == pytest.approx(20.0)


def test_the_interval_of_a_mean_covers_the_truth_nineteen_times_in_twenty():
    rng = np.random.default_rng(3)
    covered = 0
    for _ in range(2000):
        interval = mean_interval(rng.normal(5.0, 2.0, 100))
        covered += interval.low <= 5.0 <= interval.high
    assert 0.93 < covered / 2000 < 0.965


def test_a_bootstrapped_ratio_keeps_what_two_conditions_share():
    """Both conditions scale with the run's difficulty; their ratio is always 2, so it is known exactly."""
    rng = np.random.default_rng(5)
    difficulty = rng.uniform(1.0, 10.0, 50)
    runs = np.stack([difficulty, 2.0 * difficulty], axis=1)
    ratio = bootstrap_interval(runs, lambda drawn: float(drawn[:, 1].mean() / drawn[:, 0].mean()), rng)
    assert ratio == pytest.approx((2.0, 2.0, 2.0))


def test_a_bootstrapped_mean_agrees_with_the_normal_approximation():
    rng = np.random.default_rng(6)
    samples = rng.normal(1.0, 1.0, 400)
    drawn = bootstrap_interval(samples, lambda s: float(s.mean()), rng)
    assert drawn == pytest.approx(mean_interval(samples), abs=0.015)
