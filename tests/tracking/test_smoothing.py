"""The fixed-lag output, against the smoother that has all scans in one piece, and against what it must not do."""

import itertools

import numpy as np
import pytest

from swarmtrack.agents import main as swarmtrack
from swarmtrack.benchmarks.trackers import fixed_lag
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.tracking import TRACKERS, Scan, create_tracker, smoothing
from swarmtrack.tracking.motion_model import propagate, turn_by_flow, turn_exactly
from swarmtrack.tracking.smoothing import transition

CAMERA = PinholeCamera(430.0, 430.0, 320.0, 240.0, 640, 480)
WIDE = PinholeCamera(2500.0, 2500.0, 2000.0, 2000.0, 4000, 4000)
SIGMA, PSD, HZ = 1.5, 600.0, 10.0
every_tracker = pytest.mark.parametrize("name", TRACKERS)


def tracker_of(name, lag_s, camera=CAMERA, **parameters):
    told = {"measurement_sigma": SIGMA, "acceleration_psd": PSD, "clutter_per_scan": 0.1, "p_detection": 0.9}
    one_model = {"interacting": False} if name == "mbm" else {}
    return create_tracker(name, camera=camera, lag_s=lag_s, **told | one_model | parameters)


def wander(rng, starts, scans):
    """(scans, n, 2) px at HZ, from (n, 2): constant velocity with white acceleration of density PSD."""
    dt, n = 1.0 / HZ, len(starts)
    Q = PSD * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    noise = rng.multivariate_normal(np.zeros(2), Q, (scans - 1, n, 2))
    velocity = np.cumsum(noise[..., 1], axis=0)
    before = np.concatenate([np.zeros((1, n, 2)), velocity[:-1]])
    moved = np.cumsum(noise[..., 0] + dt * before, axis=0)
    return starts + np.concatenate([np.zeros((1, n, 2)), moved])


def in_one_piece(z, hz, birth_speed_sigma):
    """Mean (k, 4) and covariance (k, 4, 4) of one target's states given all of z (k, 2), NaN where missed: the weighted
    least squares over the whole trajectory, one system of linear equations."""
    k, dt = len(z), 1.0 / hz
    A = np.eye(4)
    A[0, 1] = A[2, 3] = dt
    Q = PSD * np.kron(np.eye(2), np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]))
    information, vector = np.zeros((4 * k, 4 * k)), np.zeros(4 * k)
    information[:4, :4] += np.diag([0.0, birth_speed_sigma**-2, 0.0, birth_speed_sigma**-2])
    W = np.linalg.inv(Q)
    for i in range(k):
        here = slice(4 * i, 4 * i + 4)
        if np.isfinite(z[i]).all():
            information[here, here][[0, 2], [0, 2]] += SIGMA**-2
            vector[here][[0, 2]] += z[i] / SIGMA**2
        if i + 1 < k:
            pair = slice(4 * i, 4 * i + 8)
            J = np.hstack([-A, np.eye(4)])
            information[pair, pair] += J.T @ W @ J
    cov = np.linalg.inv(information)
    mean = (cov @ vector).reshape(k, 4)
    return mean, np.array([cov[4 * i : 4 * i + 4, 4 * i : 4 * i + 4] for i in range(k)])


@every_tracker
def test_it_is_the_best_estimate_from_all_scans_until_now(name):
    """Of a lone target without clutter, where each filter is a Kalman filter; a scan in five misses it."""
    rng = np.random.default_rng(4)
    lag = 8
    truth = wander(rng, np.array([[300.0, 200.0]]), 30)[:, 0]
    z = truth + rng.normal(0.0, SIGMA, truth.shape)
    z[4::5] = np.nan
    tracker = tracker_of(name, lag / HZ, clutter_per_scan=1e-6, occlusion=False, learn_noise="no")
    tracker.initiate(0.0, z[:1])
    compared = 0
    for k in range(1, len(z)):
        tracker.update(Scan(k / HZ, z[k : k + 1][np.isfinite(z[k : k + 1, 0])]))
        if k < lag:
            assert tracker.smoothed == ()
            continue
        mean, cov = in_one_piece(z[: k + 1], HZ, 100.0)
        (track,) = tracker.smoothed
        assert track.t == pytest.approx((k - lag) / HZ)
        assert track.id == tracker.tracks[0].id
        assert track.mean == pytest.approx(mean[k - lag], rel=1e-3, abs=0.05)
        assert track.cov == pytest.approx(cov[k - lag], rel=2e-2, abs=0.02)
        compared += 1
    assert compared == 22


@every_tracker
def test_it_halves_the_error_and_knows_it(name):
    filtered, smoothed, nees = [], [], []
    starts = np.array([[1000.0, 1000.0], [3000.0, 1000.0], [2000.0, 3000.0]])
    for seed in range(8):
        rng = np.random.default_rng(seed)
        truth = wander(rng, starts, 50)
        tracker = tracker_of(name, 0.5, camera=WIDE)
        ids = tracker.initiate(0.0, starts)
        for k, points in enumerate(truth[1:], start=1):
            seen = points[rng.random(3) < 0.9]
            tracker.update(Scan(k / HZ, seen + rng.normal(0.0, SIGMA, seen.shape)))
            then = {track.id: track for track in tracker.smoothed}
            for i, track_id in enumerate(ids):
                now = next(track for track in tracker.tracks if track.id == track_id)
                filtered.append(np.sum((now.mean[::2] - points[i]) ** 2))
                if k >= 15:
                    error = then[track_id].mean[::2] - truth[k - 5, i]
                    smoothed.append(error @ error)
                    nees.append(error @ np.linalg.solve(then[track_id].cov[::2, ::2], error))
    assert np.mean(smoothed) < 0.6**2 * np.mean(filtered)
    assert 1.5 < np.mean(nees) < 2.5


def turning_flight(rng, scans):
    """A target at rest in the world, seen by a camera that swings: (k, 2) px, the turns, and its noisy detections."""
    yaw = 0.5 * np.sin(np.arange(scans) / HZ * 3.0)
    axes = [rotation.from_euler(0.3 * angle, angle, 0.4 * angle) for angle in yaw]
    ray = np.array([0.05, 0.1, 1.0])
    seen = np.array([camera_from_world @ ray for camera_from_world in axes])
    pixels = seen[:, :2] / seen[:, 2:] * 430.0 + [320.0, 240.0]
    turns = [None] + [b @ a.T for a, b in itertools.pairwise(axes)]
    return pixels, turns, pixels + rng.normal(0.0, SIGMA, pixels.shape)


@every_tracker
def test_it_looks_back_through_the_cameras_turns(name):
    """The target does not move, so what eight later scans tell of it must help, however much the camera turned."""
    error = {"filtered": [], "smoothed": []}
    for seed in range(6):
        rng = np.random.default_rng(seed)
        pixels, turns, z = turning_flight(rng, 40)
        tracker = tracker_of(name, 0.8, acceleration_psd=50.0)
        tracker.initiate(0.0, z[:1])
        for k in range(1, 40):
            tracker.predict(k / HZ - 0.04)  # in two steps, the first without a turn
            tracker.predict(k / HZ, turns[k], 1e-8)
            tracker.update(Scan(k / HZ, z[k : k + 1]))
            if k >= 16:
                (now,), (then,) = tracker.tracks, tracker.smoothed
                error["filtered"].append(np.sum((now.mean[::2] - pixels[k]) ** 2))
                error["smoothed"].append(np.sum((then.mean[::2] - pixels[k - 8]) ** 2))
    assert np.mean(error["smoothed"]) < 0.65**2 * np.mean(error["filtered"])


@pytest.mark.parametrize("turn", [turn_exactly, turn_by_flow])
@pytest.mark.parametrize("turned", [None, rotation.from_euler(0.05, -0.1, 0.2)])
def test_the_transition_is_that_of_the_motion_model(turn, turned):
    rng = np.random.default_rng(0)
    mean = rng.normal([300.0, 10.0, 200.0, -20.0], 20.0, (3, 4))
    halves = rng.normal(size=(3, 4, 4))
    cov = halves @ halves.swapaxes(1, 2)
    F = transition(mean, 0.1, turned, CAMERA, turn)
    _, carried = propagate(mean, cov, 0.1, psd=0.0, camera=CAMERA, rotation=turned, turn=turn)
    assert F @ cov @ F.swapaxes(1, 2) == pytest.approx(carried, rel=1e-9)


@every_tracker
def test_off_by_default_and_free_of_charge(name):
    tracker = create_tracker(name, camera=CAMERA)
    tracker.initiate(0.0, np.array([[100.0, 100.0]]))
    for k in range(1, 30):
        tracker.update(Scan(0.1 * k, np.array([[100.0, 100.0]])))
        assert tracker.smoothed == ()


@every_tracker
def test_it_changes_nothing_in_the_tracker(name):
    rng = np.random.default_rng(0)
    plain, smoothing_too = tracker_of(name, 0.0), tracker_of(name, 0.5)
    for k in range(30):
        z = rng.uniform([0, 0], [640, 480], (4, 2))
        for tracker in (plain, smoothing_too):
            tracker.update(Scan(k / HZ, z))
        assert all(np.isfinite(track.mean).all() for track in smoothing_too.smoothed)
        for a, b in zip(plain.tracks, smoothing_too.tracks, strict=True):
            assert (a.mean == b.mean).all()
            assert (a.cov == b.cov).all()


@every_tracker
def test_a_target_found_later_shows_as_confirmed_in_its_first_scans_and_one_that_left_in_its_last(name):
    tracker = tracker_of(name, 1.5)
    shown = {}
    for k in range(70):
        there = 10 <= k < 30
        tracker.update(Scan(k / HZ, np.array([[300.0, 200.0]] if there else []).reshape(-1, 2)))
        for track in tracker.smoothed:
            shown[round(track.t * HZ)] = track
    assert tracker.tracks == ()
    assert set(range(10, 30)) <= set(shown)
    for k in range(10, 30):
        assert shown[k].status == "confirmed"
        assert np.linalg.norm(shown[k].mean[::2] - [300.0, 200.0]) < 1.0
    assert len({track.id for track in shown.values()}) == 1


@every_tracker
def test_covariances_stay_positive_and_smaller_than_the_filters(name):
    rng = np.random.default_rng(1)
    tracker = tracker_of(name, 0.6, measurement_sigma=0.05, birth_speed_sigma=3000.0)
    tracker.initiate(0.0, np.array([[200.0, 200.0], [230.0, 210.0]]))
    for k in range(1, 60):
        tracker.predict(k / HZ, rotation.exp(rng.normal(0.0, 0.02, 3)), 1e-6)
        tracker.update(Scan(k / HZ, rng.normal([215.0, 205.0], 20.0, (rng.integers(4), 2))))
        for track in tracker.smoothed:
            assert track.cov == pytest.approx(track.cov.T, rel=1e-9)
            assert np.linalg.eigvalsh(track.cov).min() > 0.0


def test_memory_is_bounded_whatever_the_rate(monkeypatch):
    monkeypatch.setattr(smoothing, "SMOOTHER_MOST_SCANS", 20)
    tracker = tracker_of("kalman", 10.0)
    tracker.initiate(0.0, np.array([[100.0, 100.0]]))
    for k in range(1, 60):
        tracker.update(Scan(0.01 * k, np.array([[100.0, 100.0]])))
    (track,) = tracker.smoothed
    assert track.t == pytest.approx(0.40)


def test_a_lag_out_of_range_is_refused():
    with pytest.raises(ValueError, match=r"lag_s: found 60\.0, expected seconds in 0…10"):
        create_tracker("kalman", camera=CAMERA, lag_s=60.0)


def test_the_benchmark_of_the_lag_judges_both_at_the_same_places(tmp_path):
    result = fixed_lag.BENCH.publish(tmp_path, runs=2, tracker="kalman", scene=["noise.75"])
    (row,) = result["rows"]
    assert 1.4 < row["at_once_px"] < 2.0
    assert 0.5 < row["ratio"]["value"] < 0.7
    assert "noise.75" in (tmp_path / "fixed-lag.md").read_text(encoding="utf-8")
    assert swarmtrack.main(["bench", "fixed-lag", "--out", str(tmp_path), "--scene", "births"]) == 2
