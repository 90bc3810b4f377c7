"""JPDA: one update against all joint events written out, existence against the textbook, and what it does in scenes."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.tracking import Scan, create_tracker
from swarmtrack.tracking.gaussian import update
from swarmtrack.tracking.jpdaf import Jpdaf, JpdafParameters, combined
from swarmtrack.tracking.sensor_model import Measurements, SensorModel
from swarmtrack.tracking.table import TrackIds

CAMERA = PinholeCamera(430.0, 430.0, 320.0, 240.0, 640, 480)
AREA = 640.0 * 480.0
MIDDLE = np.array([320.0, 240.0])
H = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])


def filter_of(points, rng, **parameters):
    """A filter of confirmed tracks near these points (n, 2), each with its own covariance and existence."""
    told = JpdafParameters(gate_probability=1.0 - 1e-15, end_doubles=False, **parameters)
    jpdaf = Jpdaf(SensorModel(CAMERA, told), told, TrackIds())
    jpdaf.initiate(0.0, points)
    A = rng.normal(0.0, 2.0, (len(points), 4, 4))
    jpdaf.table.cov = A @ A.swapaxes(1, 2) + np.eye(4)
    jpdaf.table.mean[:, 1::2] = rng.normal(0.0, 20.0, (len(points), 2))
    jpdaf.table.existence = rng.uniform(0.2, 0.999, len(points))
    return jpdaf, told


def measured(z, rng):
    """Each detection with its own R."""
    A = rng.normal(0.0, 1.0, (len(z), 2, 2))
    R = A @ A.swapaxes(1, 2) + 0.5 * np.eye(2)
    return Measurements(z, R, np.full((len(z), 2), np.nan), np.ones(len(z)), np.ones(len(z), bool))


def density(y, S):
    return math.exp(-0.5 * y @ np.linalg.solve(S, y)) / (2.0 * math.pi * math.sqrt(np.linalg.det(S)))


def written_out(table, scan, told):
    """Existence (n,), mean (n, 4), cov (n, 4, 4) by definition: every joint event, of tracks that are not there, are
    missed, or made one of the detections; the others are clutter or new."""
    n, m = len(table), len(scan.z)
    clutter = told.clutter_per_scan / AREA
    other = clutter * (1.0 + told.birth_per_scan / told.clutter_per_scan)
    weights = {}
    for event in itertools.product(range(-2, m), repeat=n):
        made = [j for j in event if j >= 0]
        if len(set(made)) < len(made):
            continue
        weight = 1.0
        for i, j in enumerate(event):
            r = table.existence[i]
            if j == -2:
                weight *= 1.0 - r
            elif j == -1:
                weight *= r * (1.0 - told.p_detection)
            else:
                S = H @ table.cov[i] @ H.T + scan.R[j]
                weight *= r * told.p_detection * density(scan.z[j] - H @ table.mean[i], S) / other
        weights[event] = weight
    total = sum(weights.values())
    existence, mean, cov = np.zeros(n), np.zeros((n, 4)), np.zeros((n, 4, 4))
    for i in range(n):
        share = np.array(
            [sum(w for event, w in weights.items() if event[i] == j) / total for j in range(-1, m)]
        )
        existence[i] = share.sum()
        share = share / share.sum()
        parts = [(table.mean[i], table.cov[i])]
        for j in range(m):
            x, P = update(table.mean[i][None], table.cov[i][None], scan.z[j][None], scan.R[j][None])
            parts.append((x[0], P[0]))
        mean[i] = sum(p * x for p, (x, _) in zip(share, parts, strict=True))
        cov[i] = sum(
            p * (P + np.outer(x - mean[i], x - mean[i])) for p, (x, P) in zip(share, parts, strict=True)
        )
    return existence, mean, cov


@given(st.integers(1, 3), st.integers(0, 4), st.integers(0, 10_000))
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_an_update_is_that_of_all_joint_events_written_out(n, m, seed):
    rng = np.random.default_rng(seed)
    jpdaf, told = filter_of(
        MIDDLE + rng.normal(0.0, 4.0, (n, 2)), rng, clutter_per_scan=3.0, birth_per_scan=0.2
    )
    scan = measured(MIDDLE + rng.normal(0.0, 5.0, (m, 2)), rng)
    existence, mean, cov = written_out(jpdaf.table, scan, told)
    jpdaf.update(0.0, scan)
    table = jpdaf.table
    assert table.existence[:n] == pytest.approx(np.maximum(existence, 0.05), abs=1e-6)
    assert table.mean[:n] == pytest.approx(mean, rel=1e-9, abs=1e-9)
    assert table.cov[:n] == pytest.approx(cov, rel=1e-9, abs=1e-9)


def test_two_equal_explanations_leave_the_middle_and_the_distance_between_them():
    """P = 4, R = 4, detections 6 px to either side: gain a half, so ±3 px, and P = 2 + 3²."""
    mean, cov = np.zeros((1, 4)), 4.0 * np.eye(4)[None]
    z, R = np.array([[6.0, 0.0], [-6.0, 0.0]]), np.tile(4.0 * np.eye(2), (2, 1, 1))
    middle, spread = combined(mean, cov, z, R, np.array([[0.5, 0.5]]))
    assert middle == pytest.approx(np.zeros((1, 4)))
    assert spread[0].diagonal() == pytest.approx([11.0, 4.0, 2.0, 4.0])


def test_a_detection_of_next_to_no_noise_leaves_a_positive_covariance():
    """Where P − K S Kᵀ is rounding alone."""
    A = np.random.default_rng(0).normal(0.0, 1e4, (5, 4, 4))
    cov = A @ A.swapaxes(1, 2)
    R = np.tile(1e-6 * np.eye(2), (5, 1, 1))
    _, after = combined(np.zeros((5, 4)), cov, np.ones((5, 2)), R, np.eye(5))
    assert np.linalg.eigvalsh(after[:, ::2, ::2]).min() > 0.0
    assert np.linalg.eigvalsh(after).min() > 0.0
    assert after[:, ::2, ::2] == pytest.approx(R, rel=1e-6)


def test_existence_follows_the_integrated_pda():
    """Musicki, Evans & Stankovic (1994) by hand: r Λ / (1 − r + r Λ), Λ = 1 − p_D + p_D N / λ; then a miss."""
    told = JpdafParameters(clutter_per_scan=2.0, birth_per_scan=0.02, p_detection=0.9)
    jpdaf = Jpdaf(SensorModel(CAMERA, told), told, TrackIds())
    jpdaf.initiate(0.0, np.array([[300.0, 200.0]]))
    jpdaf.table.existence[:] = 0.3
    variance = 4.0 + 4.0  # P of a known start and R: measurement_sigma² each
    density = math.exp(-0.5 * 4.0 / variance) / (2.0 * math.pi * variance)
    likelihood = 0.1 + 0.9 * density / ((2.0 + 0.02) / AREA)
    expected = 0.3 * likelihood / (0.7 + 0.3 * likelihood)
    z = np.array([[302.0, 200.0]])
    jpdaf.update(
        0.0,
        Measurements(
            z, np.tile(4.0 * np.eye(2), (1, 1, 1)), np.full((1, 2), np.nan), np.ones(1), np.ones(1, bool)
        ),
    )
    assert jpdaf.table.existence[0] == pytest.approx(expected, rel=1e-9)
    jpdaf.update(0.0, measured(np.empty((0, 2)), np.random.default_rng(0)))
    assert jpdaf.table.existence[0] == pytest.approx(expected * 0.1 / (1.0 - 0.9 * expected), rel=1e-6)


def crowd(tracker, n, rng, scans=10):
    """n known targets that hover within a few px of each other, detected with σ 2 px and P_D 0.9."""
    points = MIDDLE + rng.normal(0.0, 3.0, (n, 2))
    tracker.initiate(0.0, points)
    for k in range(1, scans + 1):
        seen = points[rng.random(n) < 0.9]
        tracker.predict(k / 15)
        tracker.update(Scan(k / 15, seen + rng.normal(0.0, 2.0, seen.shape)))


def test_a_crowd_wider_than_stated_is_approximated_and_counted():
    for n, approximated in ((10, 0), (14, 10)):
        tracker = create_tracker("jpdaf", camera=CAMERA)
        crowd(tracker, n, np.random.default_rng(n))
        assert tracker.counters["scans_approximated"] == approximated
        assert len(tracker.tracks) >= n - 1


def test_a_crowd_is_approximated_well():
    """The same scans, shares exact and as beliefs: nobody is further off than a few px."""
    exact, believed = (create_tracker("jpdaf", camera=CAMERA, exact_width=width) for width in (10, 1))
    for tracker in (exact, believed):
        crowd(tracker, 8, np.random.default_rng(3))
    assert exact.counters["scans_approximated"] == 0
    assert believed.counters["scans_approximated"] == 10
    for one, other in zip(exact.tracks, believed.tracks, strict=False):
        assert one.id == other.id
        assert np.linalg.norm(one.mean[::2] - other.mean[::2]) < 3.0


def test_three_that_cross_at_once_keep_their_names():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        tracker = create_tracker(
            "jpdaf", camera=CAMERA, clutter_per_scan=5.0, measurement_sigma=1.5, acceleration_psd=600.0
        )
        direction = np.array([[60.0, 20.0], [-60.0, 20.0], [5.0, -60.0]])
        truth = lambda t, v=direction: MIDDLE + v * (t - 2.0)  # noqa: E731
        ids = tracker.initiate(0.0, truth(0.0))
        for k in range(1, 60):
            t = k / 15
            points = truth(t)
            seen = points[rng.random(3) < 0.9]
            false = rng.uniform([0, 0], [640, 480], (rng.poisson(5.0), 2))
            tracker.predict(t)
            tracker.update(Scan(t, np.concatenate([seen + rng.normal(0.0, 1.5, seen.shape), false])))
        at = {track.id: track.mean[::2] for track in tracker.tracks}
        for track_id, point in zip(ids, truth(t), strict=True):
            assert np.linalg.norm(at[track_id] - point) < 12.0, seed


def test_a_newcomer_takes_nothing_from_who_is_known():
    """Known and tentative in one place: of one detection the tentative track gets next to nothing, and soon ends."""
    tracker = create_tracker("jpdaf", camera=CAMERA)
    (known,) = tracker.initiate(0.0, np.array([[200.0, 200.0]]))
    tracker.update(Scan(0.0, np.array([[200.0, 200.0], [209.0, 200.0]])))
    assert len(tracker.tracks) == 2
    for k in range(1, 8):
        tracker.predict(k / 15)
        tracker.update(Scan(k / 15, np.array([[200.0, 200.0]])))
    (track,) = tracker.tracks
    assert track.id == known
    assert track.mean[::2] == pytest.approx([200.0, 200.0], abs=1.0)


@pytest.mark.parametrize("apart", [0.0, 3.0])
def test_of_two_tracks_on_one_target_the_older_stays(apart):
    here = np.array([200.0, 200.0])
    for seed in range(10):
        rng = np.random.default_rng(seed)
        tracker = create_tracker("jpdaf", camera=CAMERA)
        older, _ = tracker.initiate(0.0, np.array([[200.0, 200.0], [200.0 + apart, 200.0]]))
        for k in range(1, 45):
            tracker.predict(k / 15)
            tracker.update(Scan(k / 15, here + rng.normal(0.0, 2.0, (1, 2))))
        assert [track.id for track in tracker.tracks] == [older], seed


def test_a_width_of_nothing_is_refused():
    with pytest.raises(ValueError, match="exact_width: found 0, expected 1 or more"):
        create_tracker("jpdaf", camera=CAMERA, exact_width=0)
