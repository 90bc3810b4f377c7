"""Several cameras of one drone: tracks that go over from one to the next (cameras/rig.py, cameras/seams.py)."""

import copy
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks import seams as bench
from swarmtrack.cameras.rig import Rig, RigCamera
from swarmtrack.cameras.seams import Seam, SeamComparison
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Scan, TrackStatus
from swarmtrack.motion.gyro import GyroHistory, rotation_between
from swarmtrack.tracking import AGENT_PARAMETERS, TRACKERS, create_tracker, create_trackers
from swarmtrack.tracking.motion_model import optical_flow

CAMERA = PinholeCamera(320.0, 320.0, 319.5, 239.5, 640, 480)
OTHER = PinholeCamera(500.0, 510.0, 400.0, 300.0, 800, 600)
FORWARD = rotation.BODY_FROM_FORWARD_CAMERA


def looking(azimuth_deg, place=(0.0, 0.0, 0.0)):
    return Pose(rotation.from_euler(0.0, 0.0, math.radians(azimuth_deg)) @ FORWARD, np.array(place))


def rig_of(tracker, *poses, cameras=None, sigma_deg=0.5, **parameters):
    cameras = cameras or [CAMERA] * len(poses)
    trackers = create_trackers(tracker, cameras=cameras, **AGENT_PARAMETERS | parameters)
    parts = zip(cameras, poses, trackers, strict=True)
    return Rig([RigCamera(*part, math.radians(sigma_deg)) for part in parts])


class Drone:
    """Hovers, with a clock, and yaws to where it is told; everything around it stands still."""

    def __init__(self, rig, poses, targets, cameras=None, span=0.45):
        self.rig, self.poses, self.targets = rig, poses, np.array(targets)
        self.cameras = cameras or [CAMERA] * len(poses)
        self.gyro = GyroHistory()
        self.span = span
        self.yaw = self.t = 0.0
        self.news = []
        self.gyro.append(0.0, (0.0, 0.0, 0.0))

    def turn(self, rate, seconds, hz=200.0):
        axes = self.poses[0].rotation.T
        for _ in range(round(seconds * hz)):
            self.t += 1.0 / hz
            self.yaw += rate / hz
            self.gyro.append(self.t, tuple((axes @ [0.0, 0.0, rate]).tolist()))

    def seen_by(self, camera, yaw):
        pose = Pose(rotation.from_euler(0.0, 0.0, yaw), np.zeros(3)) @ self.poses[camera]
        pixel, _, ahead = self.cameras[camera].project_undistorted(pose.inverse().transform(self.targets))
        low, high = self.cameras[camera].ideal_bounds
        return pixel, ahead & ((pixel > low) & (pixel < high)).all(axis=1)

    def look(self, camera, late=0.0, rate=0.0, noise=0.0, missed=False):
        """A scan, exposed `late` seconds ago while the drone yawed at that rate; noise px of all it shows."""
        t, yaw = self.t - late, self.yaw - rate * late
        pixel, inside = self.seen_by(camera, yaw)
        width = self.span * self.cameras[camera].fx / np.linalg.norm(self.targets[inside], axis=1)
        orientation = self.gyro.orientation(t)
        if missed:
            inside, width = np.zeros(len(self.targets), bool), width[:0]
        scan = Scan(
            t,
            pixel[inside] + noise,
            size=np.column_stack([width, 0.5 * width]),
            score=np.full(len(width), 0.9),
        )
        self.news += self.rig.update(camera, scan, orientation) or []

    def tracks(self):
        found = self.rig.at(self.t, self.gyro.orientation(self.t))
        return [track for track in found if track.status is TrackStatus.CONFIRMED]


@pytest.mark.parametrize("tracker", TRACKERS)
def test_a_track_that_crosses_the_seam_is_the_same_track_and_where_its_target_is(tracker):
    poses = [looking(-40.0), looking(40.0)]
    drone = Drone(rig_of(tracker, *poses), poses, [[6.0, -2.0, 0.3], [5.0, 3.0, -0.4]])
    known = set()
    for rate in (0.0, 1.0, -1.0, 1.0):
        for _ in range(18):
            drone.turn(rate, 0.05)
            drone.look(0)
            drone.turn(rate, 0.016)
            drone.look(1)
            known |= {track.id for track in drone.tracks()}
        for track in drone.tracks():
            pixel, _ = drone.seen_by(track.camera, drone.yaw)
            assert np.linalg.norm(pixel - track.mean[::2], axis=1).min() < 3.0
    assert len(drone.tracks()) == len(known) == 2
    assert drone.rig.handed_over >= 2


@pytest.mark.parametrize("tracker", TRACKERS)
def test_where_two_pictures_overlap_a_target_has_one_track(tracker):
    poses = [looking(-20.0), looking(20.0)]
    drone = Drone(rig_of(tracker, *poses), poses, [[6.0, 0.2, 0.3], [8.0, 1.6, -0.4]])
    for _ in range(40):
        drone.turn(0.0, 0.04)
        drone.look(0)
        drone.turn(0.0, 0.03)
        drone.look(1)
        assert len(drone.tracks()) <= 2
    assert len(drone.tracks()) == 2
    # Both are seen by both all the time: nobody has gone over.
    assert drone.rig.handed_over == 0


def test_who_goes_over_from_one_camera_to_the_next_is_counted_once_although_both_see_it_on_the_way():
    poses = [looking(-30.0), looking(30.0)]
    drone = Drone(rig_of("mbm", *poses), poses, [[6.0, -0.9, 0.3]])
    counts = []
    # Into the first picture alone, into the second alone, and back.
    for rate in (0.0, 0.5, -0.5, -0.5, 0.5, 0.5):
        for _ in range(30):
            for camera in (0, 1):
                drone.turn(rate, 0.025)
                drone.look(camera)
        for _ in range(20):
            for camera in (0, 1):
                drone.turn(0.0, 0.025)
                drone.look(camera)
        counts.append(drone.rig.handed_over)
    assert [drone.seen_by(camera, drone.yaw)[1].any() for camera in (0, 1)] == [True, False]
    assert counts == [0, 0, 0, 1, 1, 2]


def test_a_target_is_followed_all_around_by_four_cameras_of_different_lenses():
    poses = [looking(azimuth) for azimuth in (0.0, 90.0, 180.0, 270.0)]
    cameras = [CAMERA, OTHER, CAMERA, OTHER]
    drone = Drone(rig_of("mbm", *poses, cameras=cameras), poses, [[6.0, 0.0, 0.3]], cameras=cameras)
    for k in range(260):
        drone.turn(-1.2 if k > 20 else 0.0, 0.033)
        drone.look(k % 4)
    assert [track.id for track in drone.tracks()] == [1]
    assert drone.rig.handed_over >= 3


def test_across_a_gap_that_no_camera_sees_a_track_goes_on_and_is_the_same_on_the_other_side():
    poses = [looking(-55.0), looking(55.0)]
    drone = Drone(rig_of("mbm", *poses), poses, [[6.0, -3.5, 0.3]])
    for k in range(70):
        drone.turn(-1.0 if 20 < k < 50 else 0.0, 0.04)
        drone.look(k % 2)
        if k == 20:
            (before,) = drone.tracks()
    (after,) = drone.tracks()
    assert (before.id, before.camera, after.id, after.camera) == (after.id, 0, before.id, 1)


def test_a_camera_that_is_80_ms_late_takes_tracks_over_and_gives_them_back():
    poses = [looking(-40.0), looking(40.0)]
    drone = Drone(rig_of("mbm", *poses), poses, [[6.0, -1.0, 0.3]])
    for rate in (0.0, -0.8, 0.8):
        for k in range(20):
            drone.turn(rate, 0.05)
            drone.look(0)
            drone.turn(rate, 0.016)
            if k >= 2:
                drone.look(1, late=0.08, rate=rate)
    (track,) = drone.tracks()
    assert track.id == 1
    assert drone.rig.handed_over >= 1


def test_one_camera_is_a_tracker_bit_for_bit():
    alone = create_tracker("mbm", camera=CAMERA, **AGENT_PARAMETERS)
    rig = rig_of("mbm", looking(0.0))
    rng, gyro, before = np.random.default_rng(3), GyroHistory(), None
    for k in range(60):
        t = 0.05 * (k + 1)
        gyro.append(t - 0.025, tuple(rng.normal(size=3) * 0.2))
        gyro.append(t, tuple(rng.normal(size=3) * 0.2))
        z = np.array([[300.0, 200.0], [100.0 + k, 300.0]]) + rng.normal(size=(2, 2))
        now = gyro.orientation(t)
        turn = rotation_between(before or now, now)
        before = now
        alone.predict(t, turn.matrix, turn.variance)
        alone.update(Scan(t, z))
        rig.update(0, Scan(t, z), now)
        for one, other in zip(alone.tracks, rig.tracks(now), strict=True):
            assert one.id == other.id
            np.testing.assert_array_equal(one.mean, other.mean)
            np.testing.assert_array_equal(one.cov, other.cov)


def test_near_targets_cross_a_seam_between_cameras_that_sit_apart():
    poses = [looking(-40.0), looking(40.0, (0.0, 0.25, 0.0))]
    # At 2 m a quarter of a metre is seven degrees.
    drone = Drone(rig_of("mbm", *poses), poses, [[2.0, -0.5, 0.1]])
    for rate in (0.0, -1.0, 1.0):
        for _ in range(16):
            drone.turn(rate, 0.05)
            drone.look(0)
            drone.turn(rate, 0.016)
            drone.look(1)
    (track,) = drone.tracks()
    assert track.id == 1


@pytest.mark.parametrize("tracker", TRACKERS)
@pytest.mark.parametrize(("told_deg", "azimuth_deg"), [(40.8, -4.8), (39.2, -5.2)])
def test_at_a_border_that_is_not_where_it_is_told_a_target_has_one_track_all_the_time(
    tracker, told_deg, azimuth_deg
):
    # The second camera's picture ends at -5 degrees: it shows the target 2 px inside where that was foretold 7 px
    # outside, or does not show it where it was foretold inside.
    azimuth = math.radians(azimuth_deg)
    told, true = ([looking(-40.0), looking(second)] for second in (told_deg, 40.0))
    drone = Drone(rig_of(tracker, *told), true, [[5.0 * math.cos(azimuth), 5.0 * math.sin(azimuth), 0.1]])
    assert drone.seen_by(1, 0.0)[1].any() == (azimuth_deg > -5.0)
    for k in range(60):
        for camera in (0, 1):
            drone.turn(0.0, 0.03)
            drone.look(camera)
            if k > 10:
                (track,) = drone.tracks()
                assert track.id == 1
                assert math.sqrt(track.cov[0, 0]) < 12.0


def test_before_a_track_goes_over_it_is_asked_where_the_other_camera_sees_it():
    # From 0.2 m beside, what is 2 m away is 70 px further on: not in the second picture, whatever its direction says.
    poses = [looking(-40.0), looking(40.0, (0.0, 0.2, 0.0))]
    azimuth = math.radians(-3.0)
    drone = Drone(rig_of("mbm", *poses), poses, [[2.0 * math.cos(azimuth), 2.0 * math.sin(azimuth), 0.0]])
    assert not drone.seen_by(1, 0.0)[1].any()
    for _ in range(30):
        for camera in (0, 1):
            drone.turn(0.0, 0.03)
            drone.look(camera)
            assert {track.camera for track in drone.tracks()} <= {0}
    assert len(drone.tracks()) == 1


@pytest.mark.parametrize("tracker", TRACKERS)
def test_who_has_left_one_picture_and_is_not_exposed_in_the_next_one_yet_is_not_lost(tracker):
    poses = [looking(-40.0), looking(40.0)]
    drone = Drone(rig_of(tracker, *poses), poses, [[5.0, -0.5, 0.1]])
    for _ in range(12):
        for camera in (0, 1):
            drone.turn(0.0, 0.05)
            drone.look(camera)
    # 14 degrees in a twentieth of a second: out of the first picture before the second camera exposes again.
    drone.turn(-5.0, 0.05)
    drone.look(0)
    assert [drone.seen_by(camera, drone.yaw)[1].any() for camera in (0, 1)] == [False, True]
    (track,) = drone.tracks()
    assert (track.id, track.camera) == (1, 0)
    # The second one has stalled: for how long nobody waits.
    for _ in range(10):
        drone.turn(0.0, 0.1)
        drone.look(0)
    assert drone.tracks() == []


def beliefs(rig):
    """All that a rig's cameras hold of their tracks."""
    found = []
    for each in rig._cameras:
        ids, mean, cov = each.tracker.estimates
        found += [ids.tolist(), mean.tolist(), cov.tolist(), each.tracker.t]
    return found


@pytest.mark.parametrize("tracker", TRACKERS)
@pytest.mark.parametrize("late_s", [0.0, 0.03, math.nan])
def test_a_scan_that_is_refused_leaves_the_rig_as_it_was(tracker, late_s):
    poses = [looking(-20.0), looking(20.0)]
    drone = Drone(rig_of(tracker, *poses), poses, [[6.0, 0.2, 0.3], [8.0, 4.0, -0.4]])
    for _ in range(12):
        for camera in (1, 0):
            drone.turn(0.5, 0.03)
            drone.look(camera)
    rig, last = drone.rig, drone.rig._cameras[1].tracker.t
    before, late = beliefs(rig), rig.counters["late_scans"]
    drone.turn(-0.5, 0.05)
    now = drone.gyro.orientation(drone.t)
    shown = [(each.id, each.camera, *each.mean) for each in rig.at(drone.t, now)]
    # The first camera has the one that both see: a scan of the second would take it over.
    refused = Scan(last - late_s, np.array([[10.0, 10.0]]))
    assert rig.update(1, refused, drone.gyro.orientation(last - 0.03)) is None
    assert beliefs(rig) == before
    assert [(each.id, each.camera, *each.mean) for each in rig.at(drone.t, now)] == shown
    assert rig.counters["late_scans"] == late + 1
    # It is still turned from where it stands.
    drone.look(1)
    for track in drone.tracks():
        pixel, _ = drone.seen_by(track.camera, drone.yaw)
        assert np.linalg.norm(pixel - track.mean[::2], axis=1).min() < 3.0


@pytest.mark.parametrize("tracker", TRACKERS)
def test_who_goes_over_has_survived_the_time_until_then(tracker):
    first, _ = create_trackers(tracker, cameras=[CAMERA, CAMERA], **AGENT_PARAMETERS, p_survival=0.5)
    for k in range(12):
        first.update(Scan(0.1 * k, np.array([[200.0, 150.0]])))
    (before,) = first.tracks
    leaving = first.release(np.array([True]), first.t + 0.2, np.eye(3), 0.0)
    assert leaving.table.existence[0] == pytest.approx(before.probability * 0.5**0.2)
    assert first.tracks == ()


@pytest.mark.parametrize("tracker", TRACKERS)
def test_a_passage_that_is_carried_on_leaves_the_one_it_came_from_as_it_was(tracker):
    first, _ = create_trackers(tracker, cameras=[CAMERA, OTHER], **AGENT_PARAMETERS)
    for k in range(12):
        first.update(Scan(0.1 * k, np.array([[200.0, 150.0]])))
    passage = first.release(np.array([True]), first.t, np.eye(3), 0.0)
    kept = copy.deepcopy(passage)
    passage.in_pixels_of(OTHER, CAMERA)
    passage.moved(np.ones((1, 2)), np.eye(2)[None])
    passage.turned_into(OTHER, CAMERA, rotation.exp([0.0, 0.1, 0.0]))
    for column in ("mean", "cov", "size"):
        np.testing.assert_array_equal(getattr(passage.table, column), getattr(kept.table, column))
    for now, before in zip(passage.motion or (), kept.motion or (), strict=True):
        np.testing.assert_array_equal(now, before)


def test_a_camera_that_is_set_apart_neither_gives_nor_takes_tracks():
    poses = [looking(-40.0), looking(40.0)]
    drone = Drone(rig_of("mbm", *poses), poses, [[6.0, -1.0, 0.3]])
    drone.rig.set_apart(frozenset({1}))
    for rate in (0.0, -0.6):
        for _ in range(20):
            for camera in (0, 1):
                drone.turn(rate, 0.03)
                drone.look(camera)
    assert [drone.seen_by(camera, drone.yaw)[1].any() for camera in (0, 1)] == [False, True]
    (track,) = drone.tracks()
    assert track.camera == 1
    assert track.id != 1
    drone.rig.set_apart(frozenset())
    for _ in range(20):
        for camera in (0, 1):
            drone.turn(0.6, 0.03)
            drone.look(camera)
    (back,) = drone.tracks()
    assert (back.id, back.camera) == (track.id, 0)


# --- what crossings tell of the mounting ---


@pytest.mark.long("a benchmark's flight; the default run has seams that learn from crossings")
def test_a_mounting_that_is_two_degrees_off_is_found_in_flight_and_no_track_is_lost_meanwhile():
    row = bench.Row("", 1.5, -10.0, 2.0, 1.0)
    flown = bench.fly(row, "mbm", 3)
    assert "| one | " in report.table_of(
        bench.BENCH.columns, [{"name": "one", **bench.summary([flown, flown])}]
    )
    assert flown.crossings > 50
    assert flown.kept == flown.crossings
    assert flown.error_deg < 0.4
    assert flown.doubles == 0.0


def test_a_turn_that_is_worth_a_word_is_said_once():
    poses = [looking(-40.0), looking(40.0)]
    rig = rig_of("mbm", *poses, sigma_deg=1.0)
    drone = Drone(rig, poses, [[6.0, -1.0, 0.3], [7.0, 1.5, -0.6]])
    drone.poses = [
        poses[0],
        Pose(poses[1].rotation @ rotation.exp([0.0, math.radians(2.0), 0.0]), np.zeros(3)),
    ]
    for rate in (0.0, *[1.0, -1.0] * 8):
        for _ in range(15):
            drone.turn(rate, 0.05)
            drone.look(0)
            drone.turn(rate, 0.016)
            drone.look(1)
    ((first, second, turn, body_from_second),) = drone.news
    assert (first, second) == (0, 1)
    # Rays turn against the camera.
    assert math.degrees(turn.angle[1]) == pytest.approx(-2.0, abs=0.5)
    roll, pitch, yaw = np.degrees(rotation.to_euler(body_from_second @ FORWARD.T))
    assert (roll, pitch, yaw) == pytest.approx((0.0, 0.0, 42.0), abs=0.7)


def test_cameras_whose_cables_are_swapped_do_not_fit_together_and_that_is_said():
    poses = [looking(-40.0), looking(40.0)]
    rig = rig_of("mbm", *poses)
    drone = Drone(rig, poses[::-1], [[6.0, -1.0, 0.3], [7.0, 1.5, -0.6]])
    for rate in (0.0, *[1.0, -1.0, -1.0, 1.0] * 3):
        for _ in range(30):
            drone.turn(rate, 0.05)
            drone.look(0)
            drone.turn(rate, 0.016)
            drone.look(1)
    assert drone.news == [(0, 1, None, None)]


def hover_in_the_overlap(off_deg, *, seconds, baseline=0.04, cameras=(0, 1), seed=2, told_deg=1.0, hz=15.0):
    """A drone 5 m away stays where two pictures overlap, the second of which is turned by so much beside what it is
    told; each camera looks hz times per second. Returns the drone, how far rays to it are off in the end [deg], and of
    the last two thirds the RMS error of its track [px] and the sigma that it claims."""
    poses = [looking(-40.0), looking(40.0, (0.0, baseline, 0.0))]
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    turn = math.radians(off_deg) * axis / np.linalg.norm(axis)
    rig = rig_of("mbm", *poses, sigma_deg=told_deg)
    true = [poses[0], Pose(poses[1].rotation @ rotation.exp(turn), poses[1].position)]
    target = np.array([5.0, 0.3, 0.2])
    drone = Drone(rig, true, [target])
    errors, claimed = [], []
    while drone.t < seconds:
        for camera in (0, 1):
            drone.turn(0.02 * math.cos(drone.t), 0.5 / hz)
            if camera in cameras:
                drone.look(camera, noise=1.5 * rng.normal(size=2), missed=rng.random() < 0.05)
            (track,) = drone.tracks() or (None,)
            if track is not None and drone.t > seconds / 3.0:
                assert track.id == 1
                pixel, _ = drone.seen_by(track.camera, drone.yaw)
                errors.append(track.mean[::2] - pixel[0])
                claimed.append(np.trace(track.cov[::2, ::2]))
    found = rig.found_turns.get((0, 1))
    ray = poses[1].rotation.T @ (target - poses[1].position)
    left = turn + (found.angle if found else 0.0)
    off = math.degrees(np.linalg.norm(np.cross(left, ray / np.linalg.norm(ray))))
    return drone, off, math.sqrt((np.array(errors) ** 2).sum(axis=1).mean()), math.sqrt(np.mean(claimed))


@pytest.mark.long("a minute of flight; the default run has what a seam learns of stays")
def test_a_drone_that_stays_where_two_pictures_overlap_tells_how_they_are_turned():
    _, _, alone, _ = hover_in_the_overlap(2.0, seconds=20.0, cameras=(0,))
    drone, off, together, claimed = hover_in_the_overlap(2.0, seconds=40.0)
    assert off < 0.3
    # Two cameras see twice as much as one, and do not pull the track to and fro.
    assert together < 1.05 * alone
    assert together < 1.5 * claimed
    found = drone.rig.found_turns[0, 1]
    assert (found.crossings, found.compared > 200) == (0, True)
    ((first, second, turn, _),) = drone.news
    assert (first, second) == (0, 1)
    assert math.degrees(np.linalg.norm(turn.angle)) > 0.5


def test_cameras_that_look_twice_per_second_each_tell_it_as_well():
    drone, off, together, claimed = hover_in_the_overlap(2.0, seconds=40.0, hz=2.5)
    assert drone.rig.found_turns[0, 1].compared > 40
    assert off < 0.5
    assert together < 1.2 * claimed


@pytest.mark.long("half a minute of hovering; the default run has what a seam learns of stays")
def test_what_a_hovering_drone_tells_ends_with_how_well_its_distance_and_its_middle_are_known():
    sigmas = []
    for baseline in (0.0, 0.2):
        drone, *_ = hover_in_the_overlap(0.0, seconds=15.0, baseline=baseline)
        flow = optical_flow(np.array([[60.0, 240.0]]), CAMERA)[0]
        (seam,) = drone.rig._seams.values()
        sigmas.append(math.sqrt((flow @ seam._cov @ flow.T)[0, 0]))
    # px: a pixel of the middle of its box, and half of the parallax of 0.2 m.
    assert 0.9 < sigmas[0] < 1.6
    assert sigmas[1] > 4.0


@given(seed=st.integers(0, 2**32 - 1), stays=st.integers(1, 6))
@settings(max_examples=30, deadline=None)
def test_a_seam_learns_from_stays_no_more_than_is_in_them(seed, stays):
    rng = np.random.default_rng(seed)
    sigma = math.radians(1.0)
    truth = sigma * rng.normal(size=3)
    seam = Seam(np.eye(3), sigma)
    for number in range(stays):
        pixel, by = rng.uniform([20.0, 100.0], [120.0, 380.0]), rng.normal(0.0, 4.0, 2)
        s, shift = 0.5 * rng.normal(), rng.normal(size=2)
        for k in range(40):
            flow = seam.flow(pixel[None], CAMERA, to_second=True)[0]
            off = flow @ (truth - seam.found.angle) + by * s + shift
            z = pixel + off + 1.5 * rng.normal(size=2)
            seam.compare(
                number, SeamComparison(0.1 * k + 10.0 * number, pixel, z, 2.25 * np.eye(2), by), CAMERA
            )
        seam.end_stays(10.0 * number + 9.0)
    assert seam.compared > 30 * stays
    error = seam.found.angle - truth
    # Chi-square, three degrees of freedom: beyond 30 once in a million.
    assert error @ np.linalg.solve(seam._cov, error) < 30.0
    assert seam.found.sigma > 0.0


def test_two_pictures_agree_about_a_target_before_the_mounting_is_known():
    seam = Seam(np.eye(3), math.radians(1.0))
    pixel, by, rng = np.array([60.0, 240.0]), np.array([6.0, 0.0]), np.random.default_rng(1)
    assert seam.disagreement(7, 0.0) is None
    for k in range(50):
        # What is foretold takes along what is known of δ.
        known = seam.flow(pixel[None], CAMERA, to_second=True)[0] @ seam.found.angle
        z = pixel + np.array([9.0, -5.0]) - known + rng.normal(size=2)
        seam.compare(7, SeamComparison(0.1 * k, pixel, z, np.eye(2), by), CAMERA)
    known = seam.disagreement(7, 5.0)
    H = np.column_stack([seam.flow(pixel[None], CAMERA, to_second=True)[0], by, np.eye(2)])
    assert np.sqrt(np.diag(H @ known.cov @ H.T)).max() < 0.3
    assert seam.disagreement(7, 6.0) is None, "it has left"


@pytest.mark.long("half a minute of flight; test_several_cameras.py turns a camera over in the default run")
def test_a_camera_that_is_mounted_upside_down_is_said_and_the_others_go_on():
    poses = [looking(azimuth) for azimuth in (0.0, 80.0, 160.0)]
    rig = rig_of("mbm", *poses)
    drone = Drone(rig, poses, [[6.0, 2.0, -1.0], [5.0, 6.0, 0.8], [-3.0, 6.0, 0.9]])
    upside_down = Pose(poses[1].rotation @ rotation.exp([0.0, 0.0, math.pi]), poses[1].position)
    drone.poses = [poses[0], upside_down, poses[2]]
    for rate in (0.0, *[-0.8, 0.8] * 7):
        for k in range(60):
            drone.turn(rate, 0.033)
            drone.look(k % 3)
    assert {(one.first, one.second) for one in drone.news} == {(0, 1), (1, 2)}
    assert all(one.turn is None for one in drone.news)
    # What the first and the third show has a track each, where it is.
    for camera in (0, 2):
        pixels, inside = drone.seen_by(camera, drone.yaw)
        held = [track.mean[::2] for track in drone.tracks() if track.camera == camera]
        for pixel in pixels[inside]:
            assert min(np.linalg.norm(pixel - place) for place in held) < 4.0


@given(
    seed=st.integers(0, 2**32 - 1),
    to_second=st.booleans(),
    crossings=st.integers(30, 60),
)
@settings(max_examples=30, deadline=None)
def test_a_seam_finds_its_turn_within_what_it_says(seed, to_second, crossings):
    rng = np.random.default_rng(seed)
    told = rotation.exp(rng.normal(size=3))
    angle = math.radians(1.5) * rng.normal(size=3)
    seam = Seam(told, math.radians(1.5))
    for _ in range(crossings):
        pixel = rng.uniform([0.0, 0.0], [640.0, 480.0])
        true = rotation.exp(angle) @ told
        # Where the assumed turn foretells it, and where the true one shows it.
        ray = CAMERA.bearing_undistorted(pixel[None])[0]
        off = seam.second_from_first @ true.T if to_second else seam.second_from_first.T @ true
        foretold, _, ahead = CAMERA.project_undistorted((off @ ray)[None])
        if not ahead[0]:
            continue
        z = pixel + 1.5 * rng.normal(size=2)
        seam.update(foretold[0], 1.5**2 * np.eye(2), z, CAMERA, to_second=to_second, by=seam.angle)
    error = np.linalg.norm(seam.found.angle - angle)
    assert error < 5.0 * seam.found.sigma + math.radians(0.1)
    assert seam.found.sigma < math.radians(0.3)


@pytest.mark.parametrize("together", [1, 2, 3])
def test_those_that_cross_together_are_foretold_by_one_angle_and_tell_of_it_once_each(together):
    true = np.array([0.0, math.radians(1.0), 0.0])
    seam = Seam(np.eye(3), math.radians(1.0))
    by = seam.angle
    for v in np.linspace(120.0, 360.0, together):
        pixel = np.array([600.0, v])
        foretold, _, _ = CAMERA.project_undistorted(
            rotation.exp(true).T @ CAMERA.bearing_undistorted(pixel[None]).T[:, 0]
        )
        seam.update(foretold[0], np.eye(2), pixel, CAMERA, to_second=True, by=by)
    assert np.degrees(seam.angle[1]) == pytest.approx(1.0, abs=0.12)


def test_a_detection_of_something_else_teaches_a_seam_nothing():
    seam = Seam(np.eye(3), math.radians(0.5))
    elsewhere = np.array([400.0, 120.0])
    seam.update(np.array([300.0, 200.0]), np.eye(2), elsewhere, CAMERA, to_second=True, by=seam.angle)
    assert (seam.crossings, seam.refused) == (0, 1)
    np.testing.assert_array_equal(seam.second_from_first, np.eye(3))


def test_what_a_seam_adds_is_the_flow_of_what_is_not_known_of_it():
    sigma = math.radians(1.0)
    seam = Seam(rotation.exp([0.0, 1.2, 0.0]), sigma)
    pixel = np.array([[20.0, 240.0], [500.0, 400.0]])
    flow = optical_flow(pixel, CAMERA)
    for to_second in (True, False):
        added = seam.flow_cov(pixel, CAMERA, to_second=to_second)
        np.testing.assert_allclose(added, sigma**2 * flow @ flow.swapaxes(1, 2), rtol=0.05)
