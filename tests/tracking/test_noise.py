"""Is the noise found that detections and targets really have, whatever was told, and told apart?"""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import TrackStatus
from swarmtrack.tracking import TRACKERS, Scan, create_tracker
from swarmtrack.tracking.noise import NoiseScales, Scale, SurePairs, size_class, whitened
from swarmtrack.tracking.priors import PIXEL_SIGMA_PX, R_SCALE_BOUNDS

CAMERA = PinholeCamera(430.0, 430.0, 5000.0, 5000.0, 10_000, 10_000)
TOLD_SIGMA, TOLD_PSD = 2.0, 1000.0
BY_HAND = {"size_noise": 0.0, "score_noise": 0.0, "birth_speed_sigma": 1.0, "clutter_per_scan": 0.1}
CALM = {"acceleration_psd": 10.0 * TOLD_PSD}  # of which mbm takes a tenth for calm flight


def wander(rng, n, scans, psd, hz):
    """(scans, n, 2) px: constant velocity with white acceleration."""
    dt = 1.0 / hz
    Q = psd * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    noise = rng.multivariate_normal(np.zeros(2), Q, (scans, n, 2))
    velocity = np.cumsum(noise[..., 1], axis=0)
    return np.cumsum(noise[..., 0] + dt * np.concatenate([np.zeros((1, n, 2)), velocity[:-1]]), axis=0)


def flown(name, seed, *, sigma, psd=TOLD_PSD, hz=15.0, n=6, seconds=25.0, side=40.0, jolts=None, **told):
    """A tracker of n targets far apart; sigma (…,) px of their detections, psd px²/s³: the truth. jolts (scans,) px:
    everything in the image moves by so much, there and back."""
    rng = np.random.default_rng(seed)
    parameters = {"measurement_sigma": TOLD_SIGMA, "learn_noise": "both"} | BY_HAND | CALM | told
    tracker = create_tracker(name, camera=CAMERA, **parameters)
    scans = round(seconds * hz)
    start = 800.0 + 1300.0 * np.arange(n)[:, None] * [1.0, 0.9]
    truth = start + wander(rng, n, scans, psd, hz)
    tracker.initiate(0.0, start)
    for k, points in enumerate(truth):
        z = points + rng.normal(0.0, 1.0, points.shape) * np.broadcast_to(sigma, n)[:, None]
        seen = rng.random(n) < 0.95
        sizes = np.broadcast_to(side, n)[seen, None] * np.ones(2)
        tracker.update(Scan((k + 1) / hz, z[seen], size=sizes, score=np.full(seen.sum(), 0.9)))
    return tracker, truth[-1]


def assumed(tracker, side):
    """R (2, 2) px² that it gives to a detection of that size now."""
    scan = Scan(1e9, np.full((1, 2), 5000.0), size=np.full((1, 2), side), score=np.array([0.9]))
    return tracker._sensor.usable(scan).R[0]


def nis_over_expected(tracker):
    found = tracker.consistency
    return 2.0 * found.nis / (found.low + found.high)


@pytest.mark.parametrize("seeds", [(0,), pytest.param((1, 2, 3), marks=pytest.mark.long("three seeds more"))])
@pytest.mark.parametrize(
    "sigma",
    [
        0.5,
        4.0,
        *(
            pytest.param(sigma, marks=pytest.mark.long("noise between that of the default run"))
            for sigma in (1.0, 2.0)
        ),
    ],
)
def test_the_noise_of_detections_is_found_both_ways(sigma, seeds):
    for seed in seeds:
        tracker, _ = flown("mbm", seed, sigma=sigma)
        assert TOLD_SIGMA * tracker.measured_noise.detections == pytest.approx(sigma, rel=0.15)
        assert 0.7 < nis_over_expected(tracker) < 1.4


@pytest.mark.parametrize(
    ("name", "sigma"),
    [
        pytest.param(
            name,
            sigma,
            marks=() if told else pytest.mark.long("each filter and each noise is in the default run"),
        )
        for k, name in enumerate(("kalman", "jpdaf", "gmphd"))
        for i, sigma in enumerate((0.5, 1.0, 4.0))
        for told in (k == i,)
    ],
)
def test_so_it_is_by_filters_of_one_motion_model_that_were_told_the_motion(name, sigma):
    tracker, _ = flown(name, 0, sigma=sigma, acceleration_psd=TOLD_PSD)
    assert TOLD_SIGMA * tracker.measured_noise.detections == pytest.approx(sigma, rel=0.2)
    assert tracker.measured_noise.motion is None
    assert 0.7 < nis_over_expected(tracker) < 1.4


@pytest.mark.parametrize("psd", [30.0, 200.0, 1000.0])
def test_a_calmer_or_wilder_flight_is_no_noise_of_detections(psd):
    """The motion is told up to 30 times too wild; Q learns it, R stays what it is."""
    tracker, _ = flown("mbm", 1, sigma=1.0, psd=psd)
    assert TOLD_SIGMA * tracker.measured_noise.detections == pytest.approx(1.0, rel=0.15)
    assert 0.7 < nis_over_expected(tracker) < 1.4
    assert tracker.measured_noise.motion**2 == pytest.approx(psd / TOLD_PSD, rel=0.7)


@pytest.mark.parametrize(
    ("sigma", "psd"),
    [
        (0.5, 100.0),
        pytest.param(3.0, 1000.0, marks=pytest.mark.long("another noise, another motion")),
    ],
)
def test_tracks_then_know_how_wrong_they_are(sigma, psd):
    """NEES of the position over 2, of 6 targets and 7 flights: 99.9 % of right ones lie within 1 ± 0.51."""
    nees = []
    for seed in range(7):
        tracker, truth = flown("mbm", seed, sigma=sigma, psd=psd, seconds=12.0)
        for track in tracker.tracks:
            if track.status is TrackStatus.CONFIRMED:
                e = track.mean[::2] - truth[np.abs(truth - track.mean[::2]).sum(axis=1).argmin()]
                nees.append(0.5 * e @ np.linalg.solve(track.cov[::2, ::2], e))
    assert len(nees) > 36
    assert 0.5 < np.mean(nees) < 1.5


def test_each_class_of_sizes_has_its_own():
    tracker, _ = flown(
        "mbm",
        0,
        sigma=[0.5, 0.5, 0.5, 3.0, 3.0, 3.0],
        side=[24.0, 24.0, 24.0, 90.0, 90.0, 90.0],
        seconds=40.0,
    )
    small, large, unseen = assumed(tracker, 24.0), assumed(tracker, 90.0), assumed(tracker, 40.0)
    assert math.sqrt(small[0, 0]) == pytest.approx(0.5, rel=0.2)
    assert math.sqrt(large[0, 0]) == pytest.approx(3.0, rel=0.2)
    assert unseen[0, 0] == TOLD_SIGMA**2


def test_who_was_told_a_sigma_uses_it_unless_asked_to_learn():
    tracker, _ = flown("mbm", 0, sigma=0.5, learn_noise="upwards")
    assert tracker.measured_noise is None
    assert assumed(tracker, 40.0) == pytest.approx(TOLD_SIGMA**2 * np.eye(2))
    assert nis_over_expected(tracker) < 0.4


def test_nothing_is_believed_to_be_exact():
    tracker, _ = flown("mbm", 0, sigma=1e-6, psd=1e-6)
    assert assumed(tracker, 40.0) == pytest.approx(PIXEL_SIGMA_PX**2 * np.eye(2))
    assert all(track.cov[0, 0] > 0.0 for track in tracker.tracks)


def test_a_turn_that_begins_teaches_nothing_of_detections():
    """A clock that is off moves everything once the camera turns: as misfits of steady scans R follows, else not."""
    told, size = np.array([[2.5, -2.5]] * 4), np.full((4, 2), 40.0)
    scales = {steady: NoiseScales(motion=True) for steady in (False, True)}
    for steady, noise in scales.items():
        for k in range(60):
            e = told if k % 2 else -told
            pairs = SurePairs(np.arange(4), np.arange(4), e, np.full(4, 0.5), np.ones(4), np.full(4, 12.5))
            noise.update(pairs, size, steady=steady)
    R = np.tile(np.eye(2), (1, 1, 1))
    assert scales[False].applied(R, size[:1])[0] == pytest.approx(np.eye(2))
    assert scales[True].applied(R, size[:1])[0, 0, 0] > 4.0


def test_one_scan_that_is_missing_parts_neighbours():
    """r is of scans in a row: of the others nothing is learned."""
    noise, size = NoiseScales(motion=True), np.full((1, 2), 40.0)
    none = SurePairs(
        np.empty(0, int), np.empty(0, int), np.empty((0, 2)), np.empty(0), np.empty(0), np.empty(0)
    )
    one = SurePairs(np.array([7]), np.array([0]), np.zeros((1, 2)), np.full(1, 0.5), np.ones(1), np.zeros(1))
    for _ in range(50):
        noise.update(one, size, steady=True)
        noise.update(none, np.empty((0, 2)), steady=True)
    assert noise.measured is None
    assert noise.motion == 1.0


def posterior(log, ratios, information, tau):
    return sum(i * (log + a * np.exp(-log)) for a, i in zip(ratios, information, strict=True)) + log**2 / (
        2 * tau**2
    )


@given(
    ratios=st.lists(st.floats(-2.0, 5.0), min_size=1, max_size=30),
    information=st.floats(0.01, 1.0),
)
@settings(max_examples=60, deadline=None)
def test_the_scale_is_where_its_posterior_is_highest(ratios, information):
    """Against a grid, before the memory fades; samples are of the variance told."""
    scale = Scale(1.0, 0.01, 10.0)
    for ratio in ratios:
        scale.add(ratio, information)
    scale.settle()
    log = np.linspace(math.log(0.01), math.log(10.0), 4001)
    kept = [(1.0 - 1.0 / 200.0) ** (len(ratios) - 1 - k) * information for k in range(len(ratios))]
    total = max(sum(a * i for a, i in zip(ratios, kept, strict=True)), 0.0)
    best = log[(sum(kept) * log + total * np.exp(-log) + 0.5 * log**2).argmin()]
    assert math.log(scale.value) == pytest.approx(best, abs=0.01)


def test_the_scale_stays_within_its_bounds():
    for ratio, bound in ((0.0, R_SCALE_BOUNDS[0]), (5.0, R_SCALE_BOUNDS[1])):
        scale = Scale(math.log(4.0), *R_SCALE_BOUNDS)
        for _ in range(2000):
            scale.add(ratio, 1.0)
            scale.settle()
        assert scale.value == pytest.approx(bound)


def steady_filter(ratio, told_R, told_Q):
    """(u, r) of a filter at constant velocity that runs for long, R = 1 and q dt³ = ratio in truth, told multiples."""
    F, Q = np.array([[1.0, 1.0], [0.0, 1.0]]), ratio * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
    P, H = np.eye(2), np.array([[1.0, 0.0]])
    for _ in range(2000):
        P = F @ P @ F.T + told_Q * Q
        S = P[0, 0] + told_R
        K, before = P[:, :1] / S, P
        P = P - K @ K.T * S
    X, A = before, F @ (np.eye(2) - K @ H)
    for _ in range(4000):
        X = A @ X @ A.T + F @ K @ K.T @ F.T + Q
    lag = (H @ F @ ((np.eye(2) - K @ H) @ X @ H.T - K))[0, 0]
    return (X[0, 0] + 1.0) / S, lag / S


@pytest.mark.parametrize("ratio", [0.01, 0.1, 1.0])
@pytest.mark.parametrize("told", [0.25, 0.5, 2.0, 4.0])
def test_u_less_r_is_what_R_must_be_multiplied_by(ratio, told):
    u, r = steady_filter(ratio, told, 1.0)
    assert told * (u - r) == pytest.approx(1.0, abs=0.2)
    assert (u < 1.0) == (told > 1.0)
    assert (r > 0.0) == (told > 1.0)
    u, r = steady_filter(ratio, 1.0, told)
    assert u - r == pytest.approx(1.0, abs=0.25)
    assert (u + r < 1.0) == (told > 1.0)


def test_whitened_innovations_have_the_mahalanobis_length():
    rng = np.random.default_rng(0)
    B = rng.normal(size=(5, 2, 2))
    S, y = B @ B.swapaxes(1, 2) + 0.1 * np.eye(2), rng.normal(size=(5, 2))
    expected = np.einsum("ni,nij,nj->n", y, np.linalg.inv(S), y)
    assert (whitened(y, S) ** 2).sum(axis=1) == pytest.approx(expected)


def test_classes_of_sizes():
    size = np.array([[10.0, 10.0], [20.0, 30.0], [40.0, 40.0], [100.0, 90.0], [np.nan, np.nan]])
    assert size_class(size).tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("name", TRACKERS)
def test_the_same_flight_is_learned_the_same_bit_for_bit(name):
    first, second = (flown(name, 3, sigma=1.0, seconds=6.0)[0] for _ in range(2))
    assert all(
        (a.mean == b.mean).all() and (a.cov == b.cov).all()
        for a, b in zip(first.tracks, second.tracks, strict=True)
    )


def sharp_track(seconds=4.0, side=50.0):
    """A tracker that has learned how little one target at (5000, 5000) px scatters, and the time of its last scan."""
    rng = np.random.default_rng(0)
    tracker = create_tracker("mbm", camera=CAMERA, learn_noise="both", measurement_sigma=TOLD_SIGMA)
    k = 0
    for k in range(round(30 * seconds)):
        z = np.array([[5000.0, 5000.0]]) + rng.normal(0.0, 0.3, (1, 2))
        tracker.update(Scan(k / 30, z, size=np.full((1, 2), side), score=np.array([0.9])))
    return tracker, k / 30


def test_a_box_that_jumps_within_itself_for_a_moment_is_no_new_target():
    """As where the detector sees but a part of the drone: a quarter of its side off, far beyond the noise learned."""
    tracker, t = sharp_track()
    before = [track.id for track in tracker.tracks]
    for k in range(1, 20):
        off = 12.0 if k in (1, 2, 9, 10) else 0.0
        z = np.array([[5000.0 + off, 5000.0]])
        tracker.update(Scan(t + k / 30, z, size=np.full((1, 2), 50.0), score=np.array([0.9])))
        assert [track.id for track in tracker.tracks] == before
    assert tracker.tracks[0].mean[0] == pytest.approx(5000.0, abs=1.0)


def test_a_sharp_track_follows_its_detection_though_a_house_stands_beside_it():
    """Two boxes that may be one for the detector, but are two in this scan: neither is taken for both."""
    tracker, t = sharp_track()
    both = np.array([[5000.0, 5000.0], [5030.0, 5000.0]])
    for k in range(1, 60):
        z = both + np.array([[0.5 * k, 0.0], [0.0, 0.0]]) * (k > 40)
        tracker.update(Scan(t + k / 30, z, size=np.full((2, 2), 50.0), score=np.full(2, 0.9)))
    nearest = min(abs(track.mean[0] - z[0, 0]) for track in tracker.tracks)
    assert nearest < 1.0


@pytest.mark.parametrize("name", TRACKERS)
def test_what_lasts_is_published_but_not_believed_by_the_filter(name):
    def variances(**told):
        tracker = create_tracker(name, camera=CAMERA, **BY_HAND, **told)
        tracker.initiate(0.0, np.array([[5000.0, 5000.0]]))
        (now,), (later,) = tracker.tracks, tracker.at(0.1)
        return tracker.filter.table.cov[0], now.cov, later.cov

    # With one level of manoeuvres, so that a new target is as fast as of a tracker that is told.
    one_level = {"gentle_share": 1.0} if name == "mbm" else {}
    believed, published, later = variances(learn_noise="both", **one_level)
    _, as_told, later_as_told = variances()
    lasting = np.diag([PIXEL_SIGMA_PX**2, 0.0, PIXEL_SIGMA_PX**2, 0.0])
    np.testing.assert_allclose(published, believed + lasting)
    np.testing.assert_allclose(as_told, believed)
    np.testing.assert_allclose(later, later_as_told + lasting)
