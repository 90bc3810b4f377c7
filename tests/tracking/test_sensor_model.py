"""What the trackers believe of camera and detector, against what simulated ones do."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.tracking import TRACKERS, Scan, Tracker, create_tracker
from swarmtrack.tracking.kalman import Kalman, KalmanParameters
from swarmtrack.tracking.noise import SurePairs
from swarmtrack.tracking.occlusion import hidden_behind, resolutions, unresolved
from swarmtrack.tracking.parameters import CommonParameters
from swarmtrack.tracking.sensor_model import SensorModel
from swarmtrack.tracking.table import TrackIds

CAMERA = PinholeCamera(430.0, 430.0, 320.0, 240.0, 640, 480)
UNKNOWN = np.nan


def sensor(**parameters):
    return SensorModel(CAMERA, CommonParameters(**parameters))


def targets(*positions, sigma=1.0):
    """Means (n, 4) and covariances (n, 4, 4) of targets at rest at these places."""
    mean = np.zeros((len(positions), 4))
    mean[:, ::2] = positions
    return mean, np.tile(np.diag([sigma, 5.0, sigma, 5.0]) ** 2, (len(positions), 1, 1))


def test_targets_far_apart_are_all_resolved():
    mean, cov = targets((100, 100), (140, 100), (300, 200))
    assert not sensor().overlap(mean, cov, np.full((3, 2), 20.0)).any()


def test_whether_two_are_resolved_follows_how_well_their_places_are_known():
    """The closed form is the mean over where the two may be."""
    rng = np.random.default_rng(0)
    mean, _ = targets((100.0, 100.0), (106.0, 103.0))
    halves = rng.normal(size=(2, 4, 4)) * 2.0
    cov = halves @ halves.swapaxes(1, 2)
    resolution = np.array([[8.0, 5.0], [6.0, 9.0]])
    drawn = [rng.multivariate_normal(m[::2], P[::2, ::2], 400_000) for m, P in zip(mean, cov, strict=True)]
    half_axes = resolution.mean(axis=0)
    merged = np.exp(-((((drawn[0] - drawn[1]) / half_axes) ** 2).sum(axis=1)))
    found = unresolved(mean, cov, resolution)
    assert found[0, 1] == pytest.approx(merged.mean(), abs=0.002)
    assert found[0, 1] == found[1, 0]
    assert found[0, 0] == found[1, 1] == 0.0


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 12))
def test_of_many_targets_those_that_may_merge_are_those_that_may_as_two(seed, n):
    rng = np.random.default_rng(seed)
    mean, cov = targets(*rng.uniform(0.0, 200.0, (n, 2)), sigma=rng.uniform(0.5, 8.0))
    resolution = rng.uniform(0.0, 30.0, (n, 2))
    found = unresolved(mean, cov, resolution)
    for i in range(n):
        for j in range(i):
            pair = [i, j]
            alone = unresolved(mean[pair], cov[pair], resolution[pair])
            assert found[i, j] == found[j, i] == alone[0, 1]


def test_the_expected_number_of_merged_pairs_is_that_of_a_sharp_resolution():
    """Exact places, drawn over a wide square: as often merged as if they did below the resolution, above not."""
    rng = np.random.default_rng(1)
    offsets = rng.uniform(-40.0, 40.0, (4000, 2))
    none = np.full((2, 2), UNKNOWN)
    points = sensor(resolution_px=8.0)
    soft = [
        points.overlap(*targets((300, 200), d + np.array([300.0, 200.0]), sigma=1e-3), none)[0, 1]
        for d in offsets
    ]
    assert np.mean(soft) == pytest.approx(np.pi * 8.0**2 / 80.0**2, rel=0.1)


def test_a_smaller_box_hides_behind_a_larger_one_and_equals_share():
    mean, cov = targets((100, 100), (101, 100))
    small_and_large = sensor().visibility(mean, cov, np.array([[20.0, 15.0], [40.0, 30.0]]))
    assert small_and_large.p_detection[0] < 0.1
    assert small_and_large.p_detection[1] > 0.89
    equal = sensor().visibility(mean, cov, np.full((2, 2), 30.0)).p_detection
    assert equal[0] == pytest.approx(equal[1])
    assert 0.45 < equal[0] < 0.5


def test_a_target_that_hardly_exists_hides_nobody():
    mean, cov = targets((100, 100), (101, 100))
    seen = sensor().visibility(mean, cov, np.full((2, 2), 30.0), np.array([1.0, 0.02]))
    assert seen.p_detection[0] > 0.88
    assert seen.p_detection[1] < 0.5


def test_of_points_nothing_is_known_unless_their_resolution_is_told():
    mean, cov = targets((100, 100), (101, 100))
    unknown = np.full((2, 2), UNKNOWN)
    assert sensor().visibility(mean, cov, unknown).p_detection == pytest.approx([0.9, 0.9], abs=1e-9)
    told = sensor(resolution_px=8.0).visibility(mean, cov, unknown).p_detection
    assert told == pytest.approx([told[0]] * 2)
    assert told[0] < 0.5


@pytest.mark.parametrize("off", [{"occlusion": False}, {"profile": "paper"}])
def test_occlusion_can_be_switched_off(off):
    mean, cov = targets((100, 100), (101, 100))
    seen = sensor(**off, resolution_px=8.0).visibility(mean, cov, np.full((2, 2), 30.0))
    assert seen.p_detection == pytest.approx([0.9, 0.9], abs=1e-9)


def test_what_leaves_the_image_is_less_and_less_expected():
    mean, cov = targets((630, 100), (639.5, 200), (648, 300), sigma=3.0)
    seen = sensor().visibility(mean, cov, np.full((3, 2), 10.0))
    assert seen.in_view == pytest.approx([0.999, 0.5, 0.002], abs=0.01)
    assert seen.p_detection == pytest.approx(0.9 * seen.in_view, abs=1e-6)


def test_resolution_is_a_share_of_the_box_or_that_of_points_whichever_is_larger():
    size = np.array([[40.0, 10.0], [UNKNOWN, UNKNOWN]])
    assert resolutions(size, 8.0) == pytest.approx(np.array([[18.0, 8.0], [8.0, 8.0]]))
    assert resolutions(size, 0.0) == pytest.approx(np.array([[18.0, 4.5], [0.0, 0.0]]))


def test_of_two_boxes_0_38_sides_apart_half_the_scans_show_one():
    mean, cov = targets((100.0, 100.0), (115.2, 100.0), sigma=1e-3)
    assert sensor().overlap(mean, cov, np.full((2, 2), 40.0))[0, 1] == pytest.approx(0.5, abs=0.02)


def test_unknown_sizes_hide_either():
    size = np.array([[40.0, 10.0], [UNKNOWN, UNKNOWN]])
    assert hidden_behind(size, 0.2) == pytest.approx(np.full((2, 2), 0.5))


def test_a_negative_resolution_is_refused():
    with pytest.raises(ValueError, match=r"resolution_px: found -1\.0, expected pixels"):
        sensor(resolution_px=-1.0)


def learned_clutter(*, told, true, seeds=8, seconds=12.0, flock=0, p_detection=0.9, **parameters):
    """Median over seeds of the rate a Kalman tracker has learned after so long, at 15 Hz: of three targets that it
    knows from the start, and a flock that nobody announces after two thirds of the time."""
    found = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        told_all = KalmanParameters(clutter_per_scan=told, measurement_sigma=1.5, **parameters)
        model = SensorModel(CAMERA, told_all)
        tracker = Tracker(model, Kalman(model, told_all, TrackIds()))
        position = rng.uniform([100, 100], [540, 380], (3 + flock, 2))
        velocity = rng.normal(0.0, 3.0, position.shape)
        tracker.initiate(0.0, position[:3])
        for k in range(1, int(15 * seconds)):
            t = k / 15
            there = (position + velocity * t)[: 3 if t < seconds / 1.5 else None]
            seen = there[rng.random(len(there)) < p_detection]
            false = rng.uniform([0, 0], [640, 480], (rng.poisson(true), 2))
            tracker.update(Scan(t, np.concatenate([seen + rng.normal(0.0, 1.5, seen.shape), false])))
        found.append(model.clutter_per_scan)
        assert len([track for track in tracker.tracks if track.status == "confirmed"]) >= 2
    return np.median(found)


@pytest.mark.parametrize(
    ("told", "true"),
    [
        (10.0, 2.0),
        (0.04, 0.2),
        *(
            pytest.param(*rates, marks=pytest.mark.long("more rates than one too low and one too high"))
            for rates in [(0.4, 2.0), (1.0, 0.2), (2.0, 2.0)]
        ),
    ],
)
def test_a_clutter_rate_told_five_times_wrong_is_found(told, true):
    assert learned_clutter(told=told, true=true) == pytest.approx(true, rel=0.35)


def test_targets_are_not_learned_as_clutter():
    """Neither eight that appear four seconds before, nor those that are rarely detected, against what is told."""
    assert learned_clutter(told=1.0, true=1.0, flock=8) < 1.3
    assert learned_clutter(told=1.0, true=1.0, p_detection=0.6) < 1.3


def test_what_is_learned_stays_within_a_factor_of_ten():
    model = sensor(clutter_per_scan=0.5)
    for found, limit in ((1000.0, 5.0), (0.0, 0.05)):
        for _ in range(2000):
            model.learn_clutter(found)
        assert model.clutter_per_scan == pytest.approx(limit, rel=1e-6)


def test_clutter_of_a_part_of_the_image_tells_of_the_whole():
    whole, part = sensor(clutter_per_scan=1.0), sensor(clutter_per_scan=1.0)
    for _ in range(400):
        whole.learn_clutter(3.0)
        part.learn_clutter(0.75, 0.25)
    assert whole.clutter_per_scan == pytest.approx(3.0, rel=0.02)
    assert part.clutter_per_scan == pytest.approx(3.0, rel=0.1)


@pytest.mark.parametrize("off", [{"learn_clutter": False}, {"profile": "paper"}])
def test_learning_can_be_switched_off(off):
    model = sensor(clutter_per_scan=0.5, **off)
    model.learn_clutter(100.0)
    assert model.clutter_per_scan == 0.5


def learned_noise(*, factor, seeds=8, seconds=20.0, clutter=1.0):
    """The scales that a Kalman tracker has learned after so long, at 15 Hz, of three targets whose detections are
    `factor` times as far off as it was told."""
    scales = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        told = KalmanParameters(measurement_sigma=1.5, clutter_per_scan=clutter, acceleration_psd=1.0)
        model = SensorModel(CAMERA, told)
        tracker = Tracker(model, Kalman(model, told, TrackIds()))
        position = rng.uniform([100, 100], [540, 380], (3, 2))
        tracker.initiate(0.0, position)
        for k in range(1, int(15 * seconds)):
            seen = position + rng.normal(0.0, 1.5 * factor, position.shape)
            false = rng.uniform([0, 0], [640, 480], (rng.poisson(clutter), 2))
            tracker.update(Scan(k / 15, np.concatenate([seen, false])))
        scales.append(model.noise_scale)
        assert sum(track.status == "confirmed" for track in tracker.tracks) == 3
    return scales


def test_noise_that_is_larger_than_told_is_found():
    assert np.median(learned_noise(factor=2.0)) == pytest.approx(4.0, rel=0.25)


def test_noise_told_right_or_too_large_stays_as_told():
    assert np.median(learned_noise(factor=1.0)) < 1.1
    assert learned_noise(factor=0.5, seeds=2) == [1.0, 1.0]


def misfits(nis):
    """Sure pairs of so large squared distances."""
    n = len(nis)
    none = np.zeros(n)
    return SurePairs(np.arange(n), np.arange(n), np.zeros((n, 2)), none, none, np.array(nis))


def test_a_larger_noise_is_that_of_every_detection():
    model = sensor(measurement_sigma=2.0)
    own = np.array([[9.0, 1.0], [1.0, 4.0]])
    scans = [Scan(0.0, np.array([[10.0, 20.0]])), Scan(0.0, np.array([[10.0, 20.0]]), R=own[None])]
    before = [model.usable(scan).R[0] for scan in scans]
    model.learn_noise(misfits([50.0] * 100), np.full((100, 2), 30.0), steady=True)
    assert model.noise_scale == 10.0
    for scan, R in zip(scans, before, strict=True):
        assert model.usable(scan).R[0] == pytest.approx(10.0 * R)


@pytest.mark.parametrize("off", [{"learn_noise": "no"}, {"profile": "paper"}])
def test_learning_the_noise_can_be_switched_off(off):
    model = sensor(**off)
    model.learn_noise(misfits([50.0] * 100), np.full((100, 2), 30.0), steady=True)
    assert model.noise_scale == 1.0


def test_an_unknown_way_to_learn_the_noise_is_refused():
    with pytest.raises(
        ValueError, match=r"tracker\.learn_noise: found 'down', expected one of no, upwards, both"
    ):
        sensor(learn_noise="down")


ODD = st.sampled_from([math.nan, math.inf, -math.inf, 0.0, -1.0, 1e-300, 1e12, 1e300])
PIXEL = st.floats(-2000.0, 2000.0) | ODD


@st.composite
def odd_scans(draw):
    """Up to six detections of which anything may be odd, some of them twice."""
    m = draw(st.integers(0, 6))

    def values(ordinary, *shape):
        count = m * math.prod(shape)
        return np.array(draw(st.lists(ordinary | ODD, min_size=count, max_size=count))).reshape(m, *shape)

    z = values(PIXEL, 2)
    R = values(st.floats(-1.0, 9.0), 2, 2) if draw(st.booleans()) else None
    size = values(st.floats(1.0, 300.0), 2) if draw(st.booleans()) else None
    score = values(st.floats(0.0, 1.0)) if draw(st.booleans()) else None
    if m > 1 and draw(st.booleans()):
        z[1] = z[0]
    return Scan(0.5, z, R, size, score)


@given(odd_scans())
@settings(max_examples=300, deadline=None)
def test_whatever_comes_what_is_usable_is_sound_and_the_rest_is_counted(scan):
    model = sensor()
    usable = model.usable(scan)
    assert len(usable.z) + model.counters["unusable_detections"] == len(scan.z)
    assert (np.abs(usable.z - [319.5, 239.5]) <= [640.0, 480.0]).all()
    assert np.isfinite(usable.R).all()
    assert np.array_equal(usable.R, usable.R.swapaxes(1, 2))
    assert (np.linalg.eigvalsh(usable.R) > 0.0).all()
    assert (np.isnan(usable.size).all(axis=1) | (usable.size > 0.0).all(axis=1)).all()
    assert not (usable.size > 640.0).any()
    assert ((usable.odds > 0.0) & np.isfinite(usable.odds)).all()
    assert len(usable.R) == len(usable.size) == len(usable.odds) == len(usable.likeness) == len(usable.z)


@pytest.mark.parametrize("name", TRACKERS)
@given(scans=st.lists(odd_scans(), min_size=1, max_size=5))
@settings(max_examples=20, deadline=None)
def test_whatever_comes_the_tracks_stay_sound(name, scans):
    tracker = create_tracker(name, camera=CAMERA, lag_s=0.2)
    tracker.initiate(0.0, np.array([[300.0, 200.0], [306.0, 203.0]]))
    for k, scan in enumerate(scans, start=1):
        with np.errstate(all="raise", under="ignore", divide="ignore"):  # log 0 is −∞, on purpose
            assert tracker.update(Scan(0.1 * k, scan.z, scan.R, scan.size, scan.score))
        for track in (*tracker.tracks, *tracker.smoothed):
            assert np.isfinite(track.mean).all()
            assert np.linalg.eigvalsh(track.cov).min() > 0.0
            assert 0.0 <= track.probability <= 1.0
            assert (np.isnan(track.size) | (track.size > 0.0)).all()


def test_an_empty_scan_is_ordinary_and_a_duplicate_is_two_detections():
    model = sensor()
    assert len(model.usable(Scan(0.0, np.empty((0, 2)))).z) == 0
    assert len(model.usable(Scan(0.0, np.array([[50.0, 50.0]] * 2))).z) == 2
    assert model.counters["unusable_detections"] == 0


def test_a_box_larger_than_the_image_hides_nobody():
    model = sensor()
    usable = model.usable(Scan(0.0, np.array([[50.0, 50.0]]), size=np.array([[1e12, 20.0]])))
    assert np.isnan(usable.size).all()
    assert len(usable.z) == 1


def test_a_larger_box_and_a_doubtful_one_are_less_precise():
    """By hand: 2² + side² (0.01² + (0.02 q)²) with q = (1 − s) / s."""
    model = sensor(size_noise=0.01, score_noise=0.02)
    size = np.array([[100.0, 50.0], [100.0, 50.0], [UNKNOWN, UNKNOWN]])
    scan = Scan(0.0, np.full((3, 2), 100.0), size=size, score=np.array([0.99, 0.5, 0.5]))
    R = model.usable(scan).R
    assert R[0] == pytest.approx(np.diag([5.0, 4.25]), rel=1e-3)
    assert R[1] == pytest.approx(np.diag([4.0 + 1.0 + 4.0, 4.0 + 0.25 + 1.0]))
    assert R[2] == pytest.approx(4.0 * np.eye(2))


def test_noise_of_points_of_the_paper_and_of_scans_that_bring_their_own_is_as_told():
    size, score = np.full((1, 2), 100.0), np.array([0.4])
    z, own = np.full((1, 2), 100.0), 7.0 * np.eye(2)[None]
    assert sensor(profile="paper").usable(Scan(0.0, z, size=size, score=score)).R[0] == pytest.approx(
        4.0 * np.eye(2)
    )
    assert sensor().usable(Scan(0.0, z)).R[0] == pytest.approx(4.0 * np.eye(2))
    assert sensor().usable(Scan(0.0, z, own, size, score)).R[0] == pytest.approx(own[0])
    off = sensor(size_noise=0.0, score_noise=0.0).usable(Scan(0.0, z, size=size, score=score))
    assert off.R[0] == pytest.approx(4.0 * np.eye(2))


def test_a_share_above_one_is_refused():
    with pytest.raises(ValueError, match=r"size_noise: found 4\.0, expected a share in 0…1"):
        sensor(size_noise=4.0)
