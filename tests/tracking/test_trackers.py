"""What every tracker must do; each name in TRACKERS passes the same list."""

import itertools
import math
import runpy

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment
from scipy.special import ndtr

from support.places import DOCS
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import Equidistant, PinholeCamera, RadTan
from swarmtrack.tracking import TRACKERS, Scan, create_tracker
from swarmtrack.tracking.association import most_likely_matching
from swarmtrack.tracking.base import Filter
from swarmtrack.tracking.lifecycle import probability_in_view

CAMERA = PinholeCamera(430.0, 430.0, 320.0, 240.0, 640, 480)
SMALLEST = DOCS / "examples" / "nearest_neighbour.py"
EXAMPLE = runpy.run_path(str(SMALLEST))["NearestNeighbour"]
TRACKERS.pop("nearest")  # which the example has put there
every_tracker = pytest.mark.parametrize("name", [*TRACKERS, "nearest"])


@pytest.fixture(autouse=True)
def _with_the_example(monkeypatch):
    monkeypatch.setitem(TRACKERS, "nearest", EXAMPLE)


def play(tracker, truth, rng, *, hz=15.0, seconds=6.0, sigma=1.5, p_detection=0.9, clutter=2.0, rate=None):
    """Feed scans of `truth(t) -> (n, 2)` px; returns [(t, truth, tracks)]. `rate` (3,) rad/s: the camera turns."""
    history = []
    for k in range(int(seconds * hz)):
        t = k / hz
        points = truth(t)
        seen = points[rng.random(len(points)) < p_detection]
        false = rng.uniform([0, 0], [640, 480], (rng.poisson(clutter), 2))
        z = np.concatenate([seen + rng.normal(0, sigma, seen.shape), false])
        tracker.predict(t, None if rate is None else rotation.exp(-np.asarray(rate) / hz))
        assert tracker.update(Scan(t, rng.permutation(z)))
        history.append((t, points, tracker.tracks))
    return history


def confirmed(tracks):
    return [track for track in tracks if track.status == "confirmed"]


def errors(points, tracks):
    return [min(np.linalg.norm(p - track.mean[::2]) for track in tracks) for p in points]


def crossing(t):
    return np.array([[100.0 + 60 * t, 150.0 + 20 * t], [460.0 - 60 * t, 160.0 + 20 * t], [300.0, 400.0]])


@every_tracker
@pytest.mark.parametrize(
    "seeds", [4, pytest.param(10, marks=pytest.mark.long("more seeds, a narrower interval"))]
)
def test_targets_are_found_without_being_told_and_kept(name, seeds):
    for seed in range(seeds):
        tracker = create_tracker(name, camera=CAMERA, clutter_per_scan=2.0, measurement_sigma=1.5)
        for t, points, tracks in play(tracker, crossing, np.random.default_rng(seed)):
            if t > 1.0:
                held = [track for track in tracks if track.status != "tentative"]
                assert max(errors(points, held)) < 12.0, (seed, t)


@every_tracker
@pytest.mark.parametrize(
    ("seeds", "most"),
    [(6, 1), pytest.param(20, 2, marks=pytest.mark.long("more seeds, a narrower interval"))],
)
def test_clutter_alone_confirms_next_to_nothing(name, seeds, most):
    """In six seconds for each seed."""
    ids = set()
    for seed in range(seeds):
        tracker = create_tracker(name, camera=CAMERA, clutter_per_scan=5.0)
        for _, _, tracks in play(
            tracker, lambda t: np.empty((0, 2)), np.random.default_rng(seed), clutter=5.0
        ):
            ids |= {(seed, track.id) for track in confirmed(tracks)}
    assert len(ids) <= most


@every_tracker
def test_a_target_that_leaves_is_dropped_in_a_second(name):
    tracker = create_tracker(name, camera=CAMERA)
    here = np.array([[200.0, 200.0]])
    play(tracker, lambda t: here if t < 3.0 else here[:0], np.random.default_rng(1), seconds=4.2, clutter=0.0)
    assert tracker.tracks == ()


@every_tracker
@pytest.mark.parametrize("lens", [RadTan((-0.28, 0.07, 0.0, 0.0)), Equidistant((0.0, 0.0, 0.0, 0.0))])
def test_a_target_in_the_corner_of_a_wide_image_is_tracked_as_one(name, lens):
    camera = PinholeCamera(400.0, 400.0, 320.0, 240.0, 640, 480, lens)
    tracker = create_tracker(name, camera=camera)
    rng = np.random.default_rng(2)
    corner = camera.undistort(np.array([[15.0, 12.0]]))
    assert (corner < -50.0).all()  # undistorted, it lies outside of width x height
    for k in range(30):
        tracker.predict(k / 15)
        tracker.update(Scan(k / 15, corner + rng.normal(0.0, 1.0, (1, 2))))
    assert [track.status for track in tracker.tracks] == ["confirmed"]


@every_tracker
@pytest.mark.parametrize("hz", [7.0, 60.0])
def test_a_target_the_camera_turns_away_from_stays_finite_until_it_is_dropped(name, hz):
    tracker = create_tracker(name, camera=CAMERA)
    for k in range(10):
        tracker.predict(k / hz)
        tracker.update(Scan(k / hz, np.array([[320.0, 240.0], [100.0, 200.0]])))
    assert len(confirmed(tracker.tracks)) == 2
    step = rotation.exp(np.array([0.0, -3.0 / hz, 0.0]))  # 3 rad/s: they are behind it in half a second
    for k in range(10, 10 + int(0.9 * hz)):
        tracker.predict(k / hz, step)
        tracker.update(Scan(k / hz, np.empty((0, 2))))
        for track in (*tracker.tracks, *tracker.at((k + 1) / hz, step)):
            assert np.abs(track.mean).max() < 1e6
            assert np.abs(track.cov).max() < 1e12
    assert tracker.tracks == ()


@every_tracker
def test_what_the_camera_turned_its_back_to_is_shown_nowhere(name):
    tracker = create_tracker(name, camera=CAMERA)
    points = np.array([[320.0, 240.0], [40.0, 30.0], [630.0, 400.0]])
    for k in range(10):
        tracker.predict(k / 15)
        tracker.update(Scan(k / 15, points))
    for yaw, pitch in itertools.product(np.linspace(2.4, 3.9, 40), np.linspace(-0.5, 0.5, 21)):
        assert tracker.at(0.61, rotation.from_euler(pitch, yaw, 0.0)) == ()
    assert len(tracker.at(0.61, rotation.from_euler(0.0, 0.1, 0.0))) == 3


@every_tracker
def test_a_camera_that_yaws_and_rolls_does_not_disturb_it(name):
    rate = np.array([0.1, 1.5, 0.4])
    start = rotation.exp(np.array([0.0, -0.6, 0.0])) @ np.array([0.1, 0.0, 1.0])

    def still_in_the_world(t):
        x, y, z = rotation.exp(-rate * t) @ rotation.exp(np.array([0.0, 1.2, 0.0])) @ start
        return np.array([[430 * x / z + 320, 430 * y / z + 240]])

    tracker = create_tracker(name, camera=CAMERA, measurement_sigma=0.5)
    history = play(
        tracker,
        still_in_the_world,
        np.random.default_rng(3),
        seconds=0.8,
        sigma=0.5,
        clutter=0.0,
        p_detection=1.0,
        rate=rate,
    )
    _, points, tracks = history[-1]
    (track,) = confirmed(tracks)
    assert track.mean[::2] == pytest.approx(points[0], abs=3.0)
    assert np.abs(track.mean[1::2]).max() < 60.0  # px/s: its own velocity is nil, the flow is 650


@every_tracker
def test_known_starts_are_confirmed_at_once(name):
    tracker = create_tracker(name, camera=CAMERA)
    ids = tracker.initiate(0.0, np.array([[100.0, 100.0], [300.0, 200.0]]))
    assert [track.id for track in confirmed(tracker.tracks)] == ids
    assert tracker.tracks[1].mean == pytest.approx([300.0, 0.0, 200.0, 0.0])


@every_tracker
def test_looking_ahead_changes_nothing(name):
    tracker = create_tracker(name, camera=CAMERA)
    play(tracker, crossing, np.random.default_rng(0), seconds=1.0)
    before = tracker.tracks
    ahead = tracker.at(3.0, rotation.exp(np.array([0.0, 0.2, 0.0])))
    assert [track.t for track in ahead] == [3.0] * len(before)
    for was, now in zip(before, tracker.tracks, strict=True):
        assert (was.mean == now.mean).all()
        assert (was.cov == now.cov).all()


@every_tracker
def test_a_late_scan_and_the_same_scan_again_are_refused_and_counted(name):
    tracker = create_tracker(name, camera=CAMERA)
    tracker.update(Scan(1.0, np.array([[10.0, 10.0]])))
    assert not tracker.update(Scan(1.0, np.array([[10.0, 10.0]])))
    assert not tracker.update(Scan(0.5, np.array([[10.0, 10.0]])))
    assert tracker.counters["late_scans"] == 2


@every_tracker
def test_predicting_to_a_late_scan_leaves_the_state_alone(name):
    tracker = create_tracker(name, camera=CAMERA)
    tracker.initiate(1.0, np.array([[100.0, 100.0]]))
    before = tracker.tracks[0].mean
    for late in (0.5, np.nan):
        tracker.predict(late, rotation.exp(np.array([0.0, 0.3, 0.0])))
        assert not tracker.update(Scan(late, np.array([[10.0, 10.0]])))
    assert tracker.tracks[0].mean == pytest.approx(before, abs=0.0)


@every_tracker
@pytest.mark.parametrize(
    "z",
    [
        np.empty((0, 2)),
        [[np.nan, 3.0]],
        [[np.inf, 3.0]],
        [[1e12, 3.0]],
        [[-900.0, 9999.0]],
        [[50.0, 50.0]] * 3,
    ],
)
def test_odd_measurements_have_a_defined_outcome(name, z):
    tracker = create_tracker(name, camera=CAMERA)
    tracker.initiate(0.0, np.array([[50.0, 50.0]]))
    for k in range(1, 4):
        tracker.predict(0.1 * k)
        assert tracker.update(Scan(0.1 * k, np.array(z)))
    for track in tracker.tracks:
        assert np.isfinite(track.mean).all()
        assert 0.0 <= track.probability <= 1.0


measurements = st.lists(st.tuples(st.floats(-50, 700), st.floats(-50, 530)), max_size=8)


@every_tracker
@given(scans=st.lists(st.tuples(st.floats(1e-3, 0.8), measurements), min_size=1, max_size=12))
@settings(max_examples=20, deadline=None)
def test_covariances_stay_symmetric_and_positive(name, scans):
    tracker = create_tracker(name, camera=CAMERA, measurement_sigma=0.1)
    t = 0.0
    for dt, z in scans:
        t += dt
        tracker.predict(t, rotation.exp(np.array([0.05, -0.1, 0.2])), 1e-5)
        tracker.update(Scan(t, np.array(z).reshape(-1, 2)))
        for track in tracker.tracks:
            assert track.cov == pytest.approx(track.cov.T, rel=1e-9)
            assert np.linalg.eigvalsh(track.cov).min() > 0.0


@every_tracker
def test_wrong_parameters_are_named(name):
    with pytest.raises(ValueError, match="did you mean clutter_per_scan"):
        create_tracker(name, camera=CAMERA, cluter_per_scan=1.0)
    with pytest.raises(ValueError, match="measurement_sigma: found inf, expected a finite number above 0"):
        create_tracker(name, camera=CAMERA, measurement_sigma=math.inf)
    with pytest.raises(ValueError, match=r"p_detection: found 1\.4, expected a probability"):
        create_tracker(name, camera=CAMERA, p_detection=1.4)


def test_an_unknown_tracker_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match="found 'sort', expected one of kalman"):
        create_tracker("sort", camera=CAMERA)


@given(st.integers(0, 4), st.integers(0, 4), st.integers(0, 10_000))
@settings(max_examples=80, deadline=None)
def test_the_matching_is_the_best_of_all(n, m, seed):
    gain = np.random.default_rng(seed).normal(0.0, 2.0, (n, m))
    best = 0.0
    for k in range(min(n, m) + 1):
        for rows in itertools.combinations(range(n), k):
            for columns in itertools.permutations(range(m), k):
                best = max(best, sum(gain[i, j] for i, j in zip(rows, columns, strict=True)))
    rows, columns = most_likely_matching(gain)
    assert gain[rows, columns].sum() == pytest.approx(best)


@given(st.integers(1, 30), st.integers(1, 40), st.booleans(), st.integers(0, 10_000))
@settings(max_examples=100, deadline=None)
def test_in_a_crowd_the_matching_is_that_of_a_well_known_solver(n, m, ties, seed):
    rng = np.random.default_rng(seed)
    gain = np.where(rng.random((n, m)) < 0.5, rng.normal(0.0, 2.0, (n, m)), -np.inf)
    gain = np.round(gain) if ties else gain
    cost = np.where(gain > 0.0, -gain, 0.0)
    best = -cost[linear_sum_assignment(cost)].sum()
    rows, columns = most_likely_matching(gain)
    assert len(set(rows.tolist())) == len(set(columns.tolist())) == len(rows)
    assert (gain[rows, columns] > 0.0).all()
    assert gain[rows, columns].sum() == pytest.approx(best)


@given(st.lists(st.floats(-40.0, 40.0), min_size=1, max_size=6))
def test_the_probability_of_being_in_view_is_that_of_the_normal_distribution(offsets):
    n, sigma = len(offsets), 7.0
    mean = np.zeros((n, 4))
    mean[:, 0], mean[:, 2] = offsets, 240.0
    cov = np.tile(sigma**2 * np.eye(4), (n, 1, 1))
    low, high = CAMERA.ideal_bounds
    expected = ndtr((high[0] - mean[:, 0]) / sigma) - ndtr((low[0] - mean[:, 0]) / sigma)
    np.testing.assert_allclose(probability_in_view(mean, cov, CAMERA), expected, rtol=1e-12, atol=1e-300)


@every_tracker
def test_a_doubtful_detection_carries_a_track_on_but_confirms_none(name):
    tracker = create_tracker(name, camera=CAMERA, birth_score=0.5)
    for k in range(20):
        score = 0.8 if k < 8 else 0.3
        z = np.array([[100.0 + 2 * k, 100.0], [400.0, 300.0]])
        tracker.predict(k / 15)
        tracker.update(Scan(k / 15, z, score=np.array([score, 0.3])))
    (track,) = confirmed(tracker.tracks)
    assert track.mean[::2] == pytest.approx([138.0, 100.0], abs=3.0)
    assert track.coasting_since is None
    assert {track.status for track in tracker.tracks} == {
        "confirmed",
        "tentative",
    }  # the doubtful one is followed


@every_tracker
def test_what_flies_and_looks_like_a_drone_only_now_and_then_is_confirmed_by_no_motion(name):
    """A gull: the detector is sure that it moves, and in one look of five takes it for a drone."""
    tracker = create_tracker(name, camera=CAMERA, birth_score=0.5)
    for k in range(60):
        looks = [0.7 if k % 5 == 4 else 0.3, 0.3 if k % 5 == 4 else 0.7]
        z = np.array([[100.0 + 2 * k, 100.0], [500.0 - 2 * k, 300.0]])
        tracker.predict(k / 15)
        tracker.update(Scan(k / 15, z, score=np.array([0.95, 0.95]), likeness=np.array(looks)))
    (track,) = confirmed(tracker.tracks)
    assert track.mean[2] > 250.0


@every_tracker
def test_a_likeness_that_is_no_number_is_no_detection_and_a_track_that_was_told_is_one_at_once(name):
    tracker = create_tracker(name, camera=CAMERA)
    tracker.initiate(0.0, np.array([[100.0, 100.0]]))
    for k in range(5):
        tracker.predict(k / 15)
        scores = {"score": np.full(2, 0.9), "likeness": np.array([0.9, math.nan])} if k else {}
        tracker.update(Scan(k / 15, np.array([[100.0, 100.0], [400.0, 300.0]])[: 1 + bool(k)], **scores))
    (track,) = tracker.tracks
    assert track.status == "confirmed"
    assert tracker.counters["unusable_detections"] == 4


@every_tracker
def test_a_doubtful_look_alike_is_confirmed_once_somebody_vouches_for_it(name):
    tracker = create_tracker(name, camera=CAMERA, birth_score=0.5)
    for k in range(12):
        tracker.predict(k / 15)
        tracker.update(Scan(k / 15, np.array([[100.0, 100.0], [400.0, 300.0]]), score=np.array([0.3, 0.3])))
        if k == 8:
            assert confirmed(tracker.tracks) == []
            (vouched,) = (track.id for track in tracker.tracks if track.mean[0] > 300.0)
            tracker.vouch(vouched)
            tracker.vouch(999)
    (track,) = confirmed(tracker.tracks)
    assert track.id == vouched


@every_tracker
def test_a_target_that_flew_out_of_the_image_is_lost_not_confirmed(name):
    tracker = create_tracker(name, camera=CAMERA)
    for k in range(20):
        u = 560.0 + 10.0 * k
        z = np.array([[u, 200.0]]) if u < 640.0 else np.empty((0, 2))
        tracker.predict(k / 15)
        tracker.update(Scan(k / 15, z))
        for track in tracker.tracks:
            assert track.status != "confirmed" or track.mean[0] < 645.0


@every_tracker
def test_after_a_long_silence_no_track_takes_what_comes_next(name):
    tracker = create_tracker(name, camera=CAMERA)
    (before,) = tracker.initiate(0.0, np.array([[320.0, 240.0]]))
    tracker.predict(2.5)
    tracker.update(Scan(2.5, np.array([[200.0, 150.0]])))
    assert before not in [track.id for track in tracker.tracks]


@every_tracker
def test_at_three_scans_per_second_three_misses_end_no_track_and_six_do(name):
    """What ends a track is time and evidence: `max_coast_s` without a detection, and to be likelier gone than there."""

    def after(misses):
        tracker = create_tracker(name, camera=CAMERA, p_detection=0.9, max_coast_s=1.0)
        (track,) = tracker.initiate(0.0, np.array([[320.0, 240.0]]))
        for k in range(1, 7 + misses):
            tracker.update(Scan(k / 3, np.array([[320.0, 240.0]])[: k < 7]))
        return track in [one.id for one in tracker.tracks]

    assert [after(misses) for misses in (2, 3, 6)] == [True, True, False]


@every_tracker
def test_a_detection_that_leaves_a_doubt_is_not_the_last_chance_at_three_scans_per_second(name):
    """A second detection that is far off leaves it open whether anything is there; the third one settles it."""
    tracker = create_tracker(name, camera=CAMERA)
    for k, u in enumerate((200.0, 240.0, 280.0, 320.0, 360.0)):
        tracker.update(Scan(k / 3, np.array([[u, 200.0]]), score=np.array([0.6])))
    assert [track.status for track in tracker.tracks if abs(track.mean[0] - 360.0) < 5.0] == ["confirmed"]


def test_the_smallest_tracker_is_an_example_of_sixty_lines():
    assert len(SMALLEST.read_text().splitlines()) <= 60


def test_a_filter_without_members_for_several_cameras_hands_its_rows_over_as_one_that_has_them():
    """One that is written from nothing needs five members: `Filter` does the rest with its table and its course."""
    points, turn = np.array([[100.0, 100.0], [300.0, 200.0]]), rotation.exp(np.array([0.1, 0.3, 0.0]))
    first, second, taker = (create_tracker("kalman", camera=CAMERA) for _ in range(3))
    rows = np.array([False, True])
    for tracker in (first, second):
        tracker.initiate(0.0, points)
    plain = Filter.release(first.filter, rows, 0.2, turn, 1e-5)
    own = second.filter.release(rows, 0.2, turn, 1e-5)
    np.testing.assert_allclose(plain.table.mean, own.table.mean, rtol=1e-9)
    np.testing.assert_allclose(plain.table.cov, own.table.cov, rtol=1e-9)
    assert first.filter.table.id.tolist() == second.filter.table.id.tolist() == [1]
    taker.initiate(0.2, points[:0])
    taker.adopt(plain)
    assert [track.id for track in taker.tracks] == [2]
