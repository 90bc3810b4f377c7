"""A lens of 190°: targets are tracked from one end of its field to the other, beside and behind the camera."""

import math

import numpy as np
import pytest

from swarmtrack.cameras.rig import Rig, RigCamera
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import Equidistant, PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Detections
from swarmtrack.motion.gyro import GyroHistory
from swarmtrack.tracking import AGENT_PARAMETERS, TRACKERS, create_tracker, create_trackers
from swarmtrack.tracking.lifecycle import probability_in_view, within_reach
from swarmtrack.tracking.motion_model import POSITION, propagate, turn_by_flow, turn_exactly, turn_into
from swarmtrack.tracking.scan import make_scan

# 190 degrees across 640 px.
FISHEYE = PinholeCamera(193.0, 193.0, 319.5, 319.5, 640, 640, Equidistant((0.0, 0.0, 0.0, 0.0)))
ORDINARY = PinholeCamera(320.0, 330.0, 319.5, 239.5, 640, 480)
HZ, SIGMA = 15.0, 1.0
every_tracker = pytest.mark.parametrize("name", TRACKERS)


def seen(rays, rng, camera=FISHEYE, sigma=SIGMA, t=0.0):
    """What a detector finds of rays (n, 3): those in the picture, with noise of the image as the camera gives it."""
    pixels, _, valid = camera.project(rays)
    inside = valid & camera.contains(np.where(valid[:, None], pixels, -1e6))
    centre = pixels[inside] + rng.normal(0.0, sigma, (inside.sum(), 2))
    n = len(centre)
    return Detections(t, 0, centre, np.full((n, 2), 12.0), np.full(n, 0.9))


def fly(tracker, rng, *, rate, seconds, ray, still=0.0):
    """A drone with the wide lens turns at `rate` (3,) rad/s, from `still` s on; one target stands still in the world
    along `ray` (3,) at t = 0. Yields t, the true ray in the camera's axes, and the tracks."""
    rate, before = np.asarray(rate), 0.0
    for k in range(int(seconds * HZ)):
        t = k / HZ
        turned = max(t - still, 0.0)
        tracker.predict(t, rotation.exp(-rate * (turned - before)))
        before = turned
        now = rotation.exp(-rate * turned) @ ray
        scan = make_scan(seen(now[None], rng, t=t), t, FISHEYE, tracker)
        tracker.update(scan)
        yield t, now, tracker.tracks


def off_axis(ray):
    return math.degrees(math.acos(np.clip(ray[2], -1.0, 1.0)))


@every_tracker
def test_a_target_that_goes_through_the_whole_field_while_the_drone_turns_keeps_one_track(name):
    # From 95 degrees on the left, where it is found, to 95 on the right, in 3.3 s at 1 rad/s.
    start = rotation.exp(np.array([0.0, math.radians(-94.5), 0.0])) @ np.array([0.0, 0.05, 1.0])
    start /= np.linalg.norm(start)
    ids, seen_at = set(), []
    tracker = create_tracker(name, camera=FISHEYE, **AGENT_PARAMETERS)
    rng = np.random.default_rng(5)
    for t, now, tracks in fly(tracker, rng, rate=(0.0, -1.0, 0.0), seconds=4.4, still=1.0, ray=start):
        held = [track for track in tracks if track.status == "confirmed"]
        ids |= {track.id for track in held}
        if t > 0.5 and off_axis(now) < 94.9:
            (track,) = held
            (ray,) = FISHEYE.bearing_undistorted(track.mean[None, POSITION])
            assert math.degrees(math.acos(min(ray @ now, 1.0))) < 1.0
            seen_at.append(math.copysign(off_axis(now), now[0]))
    assert len(ids) == 1
    assert seen_at[0] < -94.0
    assert seen_at[-1] > 92.0


@every_tracker
def test_all_over_the_field_a_tracker_is_as_good_as_it_says(name):
    told = {"measurement_sigma": SIGMA, "size_noise": 0.0, "score_noise": 0.0, "learn_noise": "no"}
    nees, at_rest = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        rate = rng.normal(0.0, 0.4, 3)
        about = rng.uniform(-math.pi, math.pi)
        off = math.radians((30.0, 75.0, 91.0)[seed % 3])
        middle = np.array([math.sin(off) * math.cos(about), math.sin(off) * math.sin(about), math.cos(off)])
        tracker = create_tracker(name, camera=FISHEYE, **AGENT_PARAMETERS | told)
        # Half-way through the flight the target is at `middle`.
        for t, now, tracks in fly(
            tracker, rng, rate=rate, seconds=3.0, ray=rotation.exp(rate * 1.5) @ middle
        ):
            (place,), _, (valid,) = FISHEYE.project_undistorted(now[None])
            if t < 1.0 or off_axis(now) > 94.0 or not valid:
                continue
            image = FISHEYE.distort(place[None])
            if not FISHEYE.contains(image, -3.0)[0]:
                continue
            for track in tracks:
                off_px = track.mean[POSITION] - place
                if np.linalg.norm(off_px) < 30.0:
                    P = track.cov[POSITION, POSITION]
                    nees.append(off_px @ np.linalg.solve(P, off_px) / 2.0)
                    v = track.mean[1::2]
                    at_rest.append(v @ np.linalg.solve(track.cov[1::2, 1::2], v) / 2.0)
    assert len(nees) > 100
    assert 0.3 < np.mean(nees) < 1.3
    # A direction that stands still has no motion of its own, wherever in the field it is.
    assert np.mean(at_rest) < 1.5


@pytest.mark.parametrize("rate", [0.3, 1.0])
def test_a_turn_carries_a_gaussian_as_it_carries_its_points(rate):
    """Against a crowd of points, each turned as a ray."""
    rng = np.random.default_rng(3)
    R = rotation.exp(rate * np.array([0.3, -0.8, 0.5]))
    place = FISHEYE.project_undistorted(np.array([[1.2, 0.3, -0.05]]))[0][0]
    mean = np.array([[place[0], 40.0, place[1], -25.0]])
    spread = rng.multivariate_normal(np.zeros(4), np.diag([1.0, 9.0, 2.0, 4.0]), 4000)
    cov = np.cov(spread.T)[None]
    turned, cov = propagate(mean, cov, 0.0, psd=0.0, camera=FISHEYE, rotation=R)
    crowd = turn_exactly(mean + spread, R, FISHEYE)[0]
    assert np.allclose(crowd.mean(axis=0), turned[0], atol=0.3)
    assert np.allclose(np.cov(crowd.T), cov[0], rtol=0.05, atol=0.1)
    now = FISHEYE.bearing_undistorted(mean[:, POSITION]) @ R.T
    assert np.allclose(FISHEYE.project_undistorted(now)[0], turned[:, POSITION], atol=1e-9)


def test_the_papers_turn_is_the_exact_one_for_small_angles():
    R = rotation.exp(np.array([1e-4, -2e-4, 1.5e-4]))
    mean = np.array([[600.0, 3.0, 200.0, 1.0], [900.0, 0.0, 320.0, -4.0]])
    exact, by_flow = turn_exactly(mean, R, FISHEYE), turn_by_flow(mean, R, FISHEYE)
    assert np.allclose(exact[0][:, POSITION], by_flow[0][:, POSITION], atol=1e-3)
    assert np.allclose(exact[1][:, ::2, ::2], by_flow[1][:, ::2, ::2], atol=1e-6)


@pytest.mark.parametrize(("before", "camera"), [(ORDINARY, FISHEYE), (FISHEYE, ORDINARY)])
def test_between_lenses_of_two_kinds_a_state_is_turned_as_its_ray_is(before, camera):
    R = rotation.exp(np.array([0.1, 1.3, -0.2]))
    back = R if before is FISHEYE else R.T
    inside = FISHEYE.project_undistorted((np.array([[0.3, -0.2, 1.0], [-0.2, 0.4, 1.0]])) @ back.T)[0]
    rays = FISHEYE.bearing_undistorted(inside)
    if before is ORDINARY:
        rays = np.array([[0.3, -0.2, 1.0], [-0.2, 0.4, 1.0]])
    turned = R if before is ORDINARY else R.T
    mean = np.zeros((2, 4))
    mean[:, POSITION], mean[:, 1::2] = before.project_undistorted(rays)[0], [[30.0, -10.0], [5.0, 60.0]]
    turn = turn_into(before)
    found, F = turn(mean, turned, camera)
    assert np.allclose(found[:, POSITION], camera.project_undistorted(rays @ turned.T)[0], atol=1e-8)
    for row in range(2):
        numeric = np.empty((4, 4))
        for k in range(4):
            h = np.zeros((1, 4))
            h[0, k] = 1e-3
            ends = [turn(mean[row : row + 1] + s * h, turned, camera)[0][0] for s in (1.0, -1.0)]
            numeric[:, k] = (ends[0] - ends[1]) / 2e-3
        assert np.allclose(F[row], numeric, rtol=1e-5, atol=1e-5)


def test_in_view_is_what_the_image_shows_and_not_a_box_around_it():
    off = np.radians([80.0, 94.0, 96.0, 105.0, 130.0])
    level = np.column_stack([np.sin(off), 0.0 * off, np.cos(off)])
    mean, cov = np.zeros((5, 4)), np.tile(0.01 * np.eye(4), (5, 1, 1))
    mean[:, POSITION] = FISHEYE.project_undistorted(level)[0]
    assert probability_in_view(mean, cov, FISHEYE).round(6).tolist() == [1.0, 1.0, 0.0, 0.0, 0.0]
    # In the corners the picture goes on, up to where no lens is believed.
    corner = level @ rotation.exp(np.array([0.0, 0.0, math.radians(45.0)])).T
    mean[:, POSITION] = FISHEYE.project_undistorted(corner)[0]
    assert probability_in_view(mean, cov, FISHEYE).round(6).tolist() == [1.0, 1.0, 1.0, 1.0, 0.0]
    assert within_reach(mean, FISHEYE).all()


@every_tracker
def test_a_target_that_the_drone_turns_its_back_to_stays_finite_and_is_dropped(name):
    tracker = create_tracker(name, camera=FISHEYE, **AGENT_PARAMETERS)
    start = np.array([0.6, 0.1, 0.8]) / math.sqrt(1.01)
    for _, _, tracks in fly(tracker, np.random.default_rng(1), rate=(0.1, 1.5, 0.0), seconds=2.6, ray=start):
        for track in tracks:
            assert np.abs(track.mean).max() < 1e6
            assert np.abs(track.cov).max() < 1e12
    assert tracker.tracks == ()


# --- beside an ordinary camera of the same drone ---


@every_tracker
def test_a_track_goes_over_between_an_ordinary_and_a_wide_lens_that_looks_back(name):
    cameras = [ORDINARY, FISHEYE]
    poses = [
        Pose(rotation.from_euler(0.0, 0.0, yaw) @ rotation.BODY_FROM_FORWARD_CAMERA, np.zeros(3))
        for yaw in (0.0, math.pi)
    ]
    trackers = create_trackers(name, cameras=cameras, **AGENT_PARAMETERS)
    rig = Rig([RigCamera(*part, 0.0) for part in zip(cameras, poses, trackers, strict=True)])
    gyro, chance, yaw, t = GyroHistory(), np.random.default_rng(7), 0.0, 0.0
    gyro.append(0.0, (0.0, 0.0, 0.0))
    target, ids, held_by = np.array([6.0, 0.5, 0.3]), set(), set()
    for k in range(150):
        rate = 0.0 if k < 20 else 1.2
        for _ in range(8):
            t, yaw = t + 0.005, yaw + 0.005 * rate
            gyro.append(t, tuple((poses[0].rotation.T @ [0.0, 0.0, rate]).tolist()))
        number = k % 2
        there = Pose(rotation.from_euler(0.0, 0.0, yaw), np.zeros(3)) @ poses[number]
        found = seen(there.inverse().transform(target[None]), chance, cameras[number], t=t)
        orientation = gyro.orientation(t)
        rig.update(number, make_scan(found, t, cameras[number], trackers[number]), orientation)
        for track in rig.at(t, orientation):
            if track.status == "confirmed":
                ids.add(track.id)
                held_by.add(track.camera)
                there = Pose(rotation.from_euler(0.0, 0.0, yaw), np.zeros(3)) @ poses[track.camera]
                pixel, _, _ = cameras[track.camera].project_undistorted(
                    there.inverse().transform(target[None])
                )
                assert np.linalg.norm(track.mean[POSITION] - pixel[0]) < 6.0
    assert ids == {1}
    assert held_by == {0, 1}
