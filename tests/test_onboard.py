"""Onboard as a whole: late scans, gaps, who is who. No loop, no thread, no mock."""

import numpy as np
import pytest

from swarmtrack.detection.expectation import PerceivedExpectation
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import Equidistant, PinholeCamera, RadTan
from swarmtrack.geometry.pose import Pose
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.messages import (
    Announcement,
    AutopilotRebooted,
    Detections,
    EgoPose,
    IdClash,
    ImuSample,
    PeerDeparted,
    PeerExpelled,
    RangeReport,
    ScanReport,
    SightingReport,
    VisualTurn,
)
from swarmtrack.motion.ego import EgoHistory
from swarmtrack.motion.gyro import GyroHistory
from swarmtrack.motion.mounting import Mounting
from swarmtrack.onboard import Onboard, OnboardCamera
from swarmtrack.relative.range_watch import RangeNews
from swarmtrack.tracking import TRACKERS, create_tracker

CAMERA = PinholeCamera(430.0, 430.0, 320.0, 240.0, 640, 480)
FORWARD = Pose(rotation.BODY_FROM_FORWARD_CAMERA, np.zeros(3))
START = Pose(np.eye(3), np.zeros(3))
NO_ACCEL = np.full(3, np.nan)


def onboard(tracker="kalman", camera=CAMERA, start=START, offset=0.0, measurement_sigma=2.0, **identity):
    return Onboard(
        1,
        cameras=[
            OnboardCamera(
                camera,
                Mounting(FORWARD, offset),
                create_tracker(
                    tracker, camera=camera, clutter_per_scan=0.5, measurement_sigma=measurement_sigma
                ),
            )
        ],
        gyro=GyroHistory(),
        ego=EgoHistory(start=start),
        identity=IdentityParameters(**identity),
    )


def seen(t, *pixels, sequence=0):
    n = len(pixels)
    centre = np.array(pixels, float).reshape(n, 2)
    return Detections(t, sequence, centre, np.full((n, 2), 30.0), np.full(n, 0.9))


def gyro_rate(t):
    return np.array([0.3 * np.sin(7 * t), 0.2, 1.5 * np.cos(5 * t)])


def flight(latency, tracker="kalman", imu_hz=200.0, fps=15.0, seconds=1.5):
    """One second and a half of a turning camera; detections reach Onboard `latency` s after their exposure."""
    drone = onboard(tracker)
    rng = np.random.default_rng(4)
    scans = [
        seen(0.003 + k / fps, *(np.array([[200.0, 200.0], [420.0, 260.0]]) + rng.normal(0, 2, (2, 2))))
        for k in range(int((seconds - 0.1) * fps))
    ]
    events = [
        (k / imu_hz, 0, ImuSample(k / imu_hz, gyro_rate(k / imu_hz), NO_ACCEL))
        for k in range(int((seconds + latency) * imu_hz))
    ]
    events += [(scan.t + latency, 1, scan) for scan in scans]
    for _, _, event in sorted(events, key=lambda e: e[:2]):
        drone.tell(event)
    return drone, scans


@pytest.mark.parametrize("tracker", TRACKERS)
@pytest.mark.parametrize("latency", [0.004, 0.15, 0.5, 1.9])
def test_a_late_scan_leaves_the_state_it_would_have_left_at_once(tracker, latency):
    at_once, scans = flight(0.0, tracker)
    late, _ = flight(latency, tracker)
    assert at_once.counters.scans == late.counters.scans == len(scans)
    for a, b in zip(at_once.events(), late.events(), strict=True):
        assert len(a.tracks.tracks) == len(b.tracks.tracks)
        for x, y in zip(a.tracks.tracks, b.tracks.tracks, strict=True):
            assert x.track.mean == pytest.approx(y.track.mean, abs=1e-9)
            assert x.track.cov == pytest.approx(y.track.cov, abs=1e-9)


def test_what_is_shown_now_is_the_last_scan_carried_on_by_the_gyro():
    drone, _ = flight(0.0)
    report = drone.events()[-1].tracks
    now = report.t + 0.04
    turn = drone.gyro.rotation(report.t, now).matrix
    was, shown = report.tracks[0].track, drone.tracks(now).tracks[0].track
    bearing = CAMERA.bearing_undistorted((was.mean[::2] + 0.04 * was.mean[1::2])[None])[0]
    assert shown.mean[::2] == pytest.approx(
        CAMERA.project_undistorted((turn @ bearing)[None])[0][0], abs=1e-6
    )


def test_a_detector_is_told_where_the_tracks_will_be_when_the_camera_has_turned():
    """Yawing to the right by 0.2 rad/s: what was straight ahead is left of there half a second later."""
    drone = onboard()
    turning = np.array([0.0, 0.0, 0.2])  # forward, right, down: to the right
    fed = 0
    for k in range(12):
        while fed / 200.0 <= k / 15:
            drone.tell(ImuSample(fed / 200.0, np.zeros(3), NO_ACCEL))
            fed += 1
        drone.tell(seen(k / 15, (320.0, 240.0), sequence=k))
    last = 11 / 15
    while fed / 200.0 <= last + 0.55:
        drone.tell(ImuSample(fed / 200.0, turning, NO_ACCEL))
        fed += 1
    (box,) = PerceivedExpectation(drone).boxes(last + 0.5)
    assert box[:2] == pytest.approx([320.0 - 430.0 * np.tan(0.1), 240.0], abs=3.0)
    assert 3.0 < box[2] < 400.0
    assert box[4:] == pytest.approx([30.0, 30.0])


def test_boxes_told_to_the_detector_are_in_the_pixels_of_its_image():
    lens = RadTan((-0.25, 0.05, 0.0, 0.0))
    camera = PinholeCamera(430.0, 430.0, 320.0, 240.0, 640, 480, lens)
    drone = onboard(camera=camera)
    assert PerceivedExpectation(drone).boxes(0.0).shape == (0, 6)
    for k in range(8):
        drone.tell(seen(k / 15, (600.0, 440.0), sequence=k))
    (box,) = PerceivedExpectation(drone).boxes(8 / 15)
    assert box[:2] == pytest.approx([600.0, 440.0], abs=0.5)


def test_a_scan_older_than_the_history_or_the_last_scan_is_refused_and_counted():
    drone, scans = flight(0.0)
    drone.tell(scans[3])
    drone.tell(ImuSample(9.0, np.zeros(3), NO_ACCEL))
    drone.tell(seen(6.9, (100, 100)))
    assert drone.counters.late_scans == 2


def test_without_a_gyro_scans_are_tracked_at_once():
    drone = onboard()
    for k in range(6):
        drone.tell(seen(k / 15, (200, 200), sequence=k))
    assert [report.sequence for report in drone.events()] == list(range(6))
    assert drone.tracks(0.4).tracks[0].track.status == "confirmed"


def panned(drone, *, turn, gyro=None):
    """A pan to the right by 0.1 rad per frame, over a drone that stands still; turn: rad, what the images show."""
    for k in range(8):
        t = k / 10
        if gyro is not None:
            drone.tell(ImuSample(t, gyro, NO_ACCEL))
        if k:
            drone.tell(VisualTurn((k - 1) / 10, t, np.array([0.0, turn, 0.0]), 1e-6))
        drone.tell(seen(t, (320.0 + 430.0 * np.tan(0.3 - 0.1 * k), 240.0), sequence=k))
    return drone, {track.track.id for report in drone.events()[3:] for track in report.tracks.tracks}


def test_images_carry_tracks_through_a_pan_where_there_is_no_gyro():
    _, numbers = panned(onboard(), turn=0.1)
    assert len(numbers) == 1


def test_a_gyro_that_is_not_the_cameras_is_left_alone():
    drone = onboard()
    drone._uses_gyro = False
    drone, numbers = panned(drone, turn=0.1, gyro=np.array([0.0, 0.0, -1.0]))
    assert len(numbers) == 1
    assert drone.part_counters["visual_turns"] == 7


def test_a_gyro_that_fell_silent_holds_nothing_up():
    drone, _ = flight(0.0)
    scans = drone.counters.scans
    drone.tell(seen(2.0, (200, 200)))
    assert drone.counters.scans == scans + 1


def test_a_camera_that_fell_silent_shows_nothing_in_the_end():
    drone, scans = flight(0.0)
    last = scans[-1].t
    assert drone.tracks(last + 1.0).tracks
    assert drone.tracks(last + 60.0).tracks == ()
    assert drone.tracks(last + 60.0).scan_t == last


def test_detections_of_a_distorted_image_are_tracked_undistorted():
    camera = PinholeCamera(430.0, 430.0, 320.0, 240.0, 640, 480, RadTan((-0.28, 0.07, 0.0, 0.0)))
    drone = onboard(camera=camera)
    for k in range(5):
        drone.tell(seen(k / 15, (100, 80)))
    truth = camera.undistort(np.array([[100.0, 80.0]]))[0]
    assert np.linalg.norm(truth - [100, 80]) > 5.0
    assert drone.tracks(4 / 15).tracks[0].track.mean[::2] == pytest.approx(truth, abs=0.5)


def test_a_pixel_at_the_border_of_a_fisheye_s_image_counts_for_as_many_as_it_covers():
    camera = PinholeCamera(300.0, 300.0, 320.0, 240.0, 640, 480, Equidistant((0.0, 0.0, 0.0, 0.0)))
    for seed in range(5):
        drone = onboard(camera=camera, measurement_sigma=1.5)
        rng = np.random.default_rng(seed)
        for k in range(60):
            drone.tell(seen(k / 15, rng.normal((30.0, 30.0), 1.5)))
        (entry,) = drone.tracks(59 / 15).tracks
        assert entry.track.id == 1


def test_the_time_offset_moves_the_exposure_onto_the_imu_s_clock():
    drone = onboard(offset=0.030)
    drone.tell(seen(1.0, (200, 200)))
    assert drone.tracks(1.1).scan_t == pytest.approx(1.030)


def announced(drone_id, position, t=0.0, boot="0000000a", sequence=0):
    return Announcement(
        drone_id, boot, sequence, t, 0.0, np.array(position, float), np.eye(3), 0.01 * np.eye(3)
    )


def identities(drone, t):
    return {entry.identity for entry in drone.tracks(t).tracks if entry.track.status == "confirmed"}


def watch(drone, pixels, *, start=0, scans=8):
    for k in range(start, start + scans):
        drone.tell(seen(k / 15, *pixels))
    return (start + scans - 1) / 15


def test_teammates_are_named_by_where_they_said_they_are():
    drone = onboard()
    drone.tell(announced(2, [6.0, -1.0, 0.0]))  # left of the view: north 6 m, west 1 m
    drone.tell(announced(3, [6.0, 1.0, -0.5]))
    left, right = (320 - 430 / 6, 240.0), (320 + 430 / 6, 240 - 430 * 0.5 / 6)
    t = watch(drone, [right, left])
    by_place = {round(e.track.mean[0]): e.identity for e in drone.tracks(t).tracks}
    assert by_place == {round(left[0]): 2, round(right[0]): 3}


def test_names_are_withheld_while_the_camera_turns_unmeasured():
    drone = onboard()
    drone.tell(announced(2, [6.0, -1.0, 0.0]))
    drone.tell(announced(3, [6.0, 1.0, 0.0]))
    stated = {}
    for k in range(120):
        t = k / 15
        if not 4.0 < t < 7.0:
            for j in range(10):
                drone.tell(ImuSample(t + j / 150, np.zeros(3), NO_ACCEL))
        v = 240.0 + 150.0 * np.clip(t - 1.0, 0.0, 1.0)  # they fly to where nobody would look for them
        drone.tell(seen(t, (320 - 430 / 6, v), (320 + 430 / 6, v)))
        stated[k] = identities(drone, t)
    assert stated[59] == stated[64] == {2, 3}  # so soon nothing can have turned far
    assert {None} in [stated[k] for k in range(75, 90)]  # until their places tell them apart again
    assert stated[119] == {None}  # the places are too old to tell


def metres(drone):
    """By name, what the last scan's report says in metres."""
    reports = [event for event in drone.events() if isinstance(event, ScanReport)]
    return {e.identity: e.relative for e in reports[-1].tracks.tracks}


def test_teammates_have_a_place_in_metres_from_their_names_on_and_strangers_none():
    drone = onboard()
    drone.tell(announced(2, [6.0, -1.0, 0.0]))
    t = watch(drone, [(320 - 430 / 6, 240.0), (600.0, 60.0)])
    found = metres(drone)
    assert found[None] is None
    state = found[2]
    assert (state.drone_id, state.t) == (2, t)
    off = state.position - [6.0, -1.0, 0.0]
    assert np.linalg.norm(off) < 0.3
    assert off @ np.linalg.solve(state.cov[:3, :3], off) < 12.0
    assert "announcement" in state.sources


def test_a_place_in_metres_ends_when_the_name_does():
    drone = onboard()
    drone.tell(announced(2, [6.0, -1.0, 0.0]))
    watch(drone, [(320 - 430 / 6, 240.0)])
    assert metres(drone)[2] is not None
    drone.tell(PeerExpelled(2))
    watch(drone, [(320 - 430 / 6, 240.0)], start=8, scans=1)
    assert metres(drone) == {None: None}


def test_where_two_say_that_they_are_one_drone_is_not_where_it_is():
    """After a clash its place is what it says again, not what either said before."""
    drone = onboard()
    drone.tell(announced(2, [6.0, -1.0, 0.0]))
    watch(drone, [(320 - 430 / 6, 240.0)])
    assert metres(drone)[2] is not None
    drone.tell(IdClash(2, ("0000000a", "0000000b"), ours=False))
    watch(drone, [(320 - 430 / 6, 240.0)], start=8, scans=2)
    assert metres(drone) == {None: None}
    drone.tell(PeerDeparted(2, "0000000b"))
    drone.tell(announced(2, [5.0, -5.0 / 6, 0.0], t=0.7, sequence=1))
    watch(drone, [(320 - 430 / 6, 240.0)], start=10, scans=8)
    found = metres(drone)
    assert np.linalg.norm(found[2].position) == pytest.approx(5.07, abs=0.3)


def test_scans_and_disagreements_leave_by_one_way_and_once():
    """A teammate says that it stands elsewhere than we see it."""
    drone = onboard()
    drone.tell(announced(2, [6.0, -1.0, 0.0]))
    t = watch(drone, [(320 - 430 / 6, 240.0)])
    reports = drone.events()
    assert [type(event) for event in reports] == [ScanReport] * 8
    assert drone.events() == ()
    drone.tell(SightingReport(2, "0000000a", 1, t, 0.0, np.array([0.0, 6.0, 0.0]), 0.01, (1,), ()))
    (disagreement,) = drone.events()
    assert (disagreement.observer, disagreement.drone_id) == (2, 2)
    assert drone.events() == ()


def test_a_stranger_far_from_every_announced_pose_stays_unknown():
    drone = onboard()
    drone.tell(announced(2, [6.0, -1.0, 0.0]))
    t = watch(drone, [(320 - 430 / 6, 240.0), (600.0, 60.0)])
    assert identities(drone, t) == {2, None}


def test_two_drones_that_project_onto_one_spot_stay_unknown():
    drone = onboard()
    drone.tell(announced(2, [6.0, 0.00, 0.0]))
    drone.tell(announced(3, [8.0, 0.01, 0.0]))
    t = watch(drone, [(318.0, 240.0), (324.0, 240.0)])
    assert identities(drone, t) == {None}


def test_the_paper_s_profile_gives_one_id_twice_where_ours_says_unknown():
    spots = [(318.0, 240.0), (330.0, 250.0)]
    paper, ours = onboard(profile="paper"), onboard()
    for drone in (paper, ours):
        drone.tell(announced(2, [6.0, 0.0, 0.0]))
    duplicates = [e.identity for e in paper.tracks(watch(paper, spots)).tracks]
    assert duplicates == [2, 2]
    assert [e.identity for e in ours.tracks(watch(ours, spots)).tracks].count(2) <= 1


def test_an_identity_stays_with_its_track_when_the_drone_flies_off():
    drone = onboard()
    drone.tell(announced(2, [6.0, 0.0, 0.0]))
    for k in range(60):
        drone.tell(seen(k / 15, (320.0 + 4 * max(k - 10, 0), 240.0)))
    assert identities(drone, 59 / 15) == {2}


def test_a_new_boot_is_identified_anew_and_an_old_announcement_changes_nothing():
    drone = onboard()
    drone.tell(announced(2, [6.0, 0.0, 0.0], sequence=1))
    drone.tell(announced(2, [6.0, 3.0, 0.0], sequence=0))
    assert drone.counters.announcements_refused == 1
    t = watch(drone, [(320.0, 240.0)])
    assert identities(drone, t) == {2}
    drone.tell(announced(2, [6.0, 20.0, 0.0], boot="0000000b", t=t))
    t = watch(drone, [(320.0, 240.0)], start=8)
    assert identities(drone, t) == {None}


def test_the_local_frame_of_the_autopilot_is_moved_to_where_the_drone_starts():
    facing_east = Pose(rotation.from_euler(0.0, 0.0, np.pi / 2), np.array([10.0, 20.0, -1.5]))
    drone = onboard(start=facing_east)
    for t, north in ((0.0, 0.0), (1.0, 2.0)):  # its own frame: facing north, then 2 m ahead
        drone.tell(EgoPose(t, np.array([north, 0.0, 0.0]), np.eye(3)))
    assert drone.ego_pose(0.5).position == pytest.approx([10.0, 21.0, -1.5])
    # Along the way as sure as the autopilot is, across it less: the way was turned along with a heading to 3°.
    across = 0.1**2 + (2.0 * np.radians(3.0)) ** 2
    assert drone.ego_pose(1.0).position_cov == pytest.approx(np.diag([across, 0.1**2, 0.1**2]))
    assert drone.ego_pose(1.0).world_from_body @ [1, 0, 0] == pytest.approx([0.0, 1.0, 0.0])


def test_an_autopilot_without_a_position_still_gives_the_attitude_at_the_start():
    drone = onboard(start=Pose(np.eye(3), np.array([1.0, 2.0, -1.5])))
    tilted = rotation.from_euler(0.1, 0.0, 0.0)
    drone.tell(EgoPose(0.0, None, tilted))
    assert drone.ego_pose(0.0).position == pytest.approx([1.0, 2.0, -1.5])
    assert drone.ego_pose(0.0).world_from_body == pytest.approx(tilted)
    drone.tell(EgoPose(0.1, np.array([50.0, 0.0, 0.0]), tilted))  # its EKF has found an origin, elsewhere
    assert drone.ego_pose(0.1).position == pytest.approx([1.0, 2.0, -1.5])


def test_a_drone_that_waits_on_its_pad_is_named_however_old_its_announcement():
    for age in (10.0, 300.0):
        drone = onboard()
        drone.tell(announced(2, [6.0, -1.0, 0.0], t=-age))
        drone.tell(announced(3, [6.0, 1.0, 0.0], t=-age))
        t = watch(drone, [(320 - 430 / 6, 240.0), (320 + 430 / 6, 240.0)])
        assert identities(drone, t) == {2, 3}


def test_an_autopilot_that_reboots_in_flight_goes_on_from_where_the_drone_was():
    drone = onboard(start=Pose(np.eye(3), np.zeros(3)))
    for k in range(50):
        drone.tell(EgoPose(0.1 * k, np.array([2.0 * k, 0.0, 0.0]), np.eye(3)))
    drone.tell(AutopilotRebooted())
    drone.tell(EgoPose(8.0, np.array([0.0, 0.0, 0.0]), np.eye(3)))
    assert drone.ego_pose(8.0).position == pytest.approx([98.0, 0.0, 0.0])


def test_a_heading_that_is_found_after_boot_does_not_turn_the_team_frame():
    drone = onboard(start=Pose(rotation.from_euler(0.0, 0.0, 0.5), np.array([1.0, 2.0, 0.0])))
    for k, yaw in enumerate([0.0, 0.0, 1.5, 1.5]):
        drone.tell(EgoPose(0.02 * k, np.zeros(3), rotation.from_euler(0.0, 0.0, yaw)))
    ego = drone.ego_pose(0.06)
    assert rotation.to_euler(ego.world_from_body)[2] == pytest.approx(0.5)
    assert ego.position == pytest.approx([1.0, 2.0, 0.0])
    drone.tell(EgoPose(1.08, np.array([0.0, 1.0, 0.0]), rotation.from_euler(0.0, 0.0, 1.5)))
    assert drone.ego_pose(1.08).position == pytest.approx([1.0 + np.sin(1.0), 2.0 + np.cos(1.0), 0.0])


def test_pixels_of_an_earlier_frame_are_those_of_the_same_directions_however_the_camera_turned():
    camera = PinholeCamera(430.0, 430.0, 320.0, 240.0, 640, 480, RadTan((-0.2, 0.05, 0.0, 0.0)))
    drone = onboard(camera=camera, offset=0.02)
    rate = np.array([0.4, -0.3, 1.2])  # body axes
    for k in range(101):
        drone.tell(ImuSample(k / 200.0, rate, NO_ACCEL))
    directions = rotation.exp(np.array([[0.0, 0.1, 0.0], [0.1, -0.2, 0.0], [0.0, 0.0, 0.3]])) @ [
        0.0,
        0.0,
        1.0,
    ]
    in_camera = rotation.BODY_FROM_FORWARD_CAMERA.T @ rate
    then_from_now = rotation.exp(in_camera * 0.1)
    pixels, _, _ = camera.project(directions)
    expected, _, _ = camera.project(directions @ then_from_now.T)
    found = PerceivedExpectation(drone).pixels_at(0.3, 0.4)(pixels)
    assert np.abs(found - expected).max() < 1e-3
    assert np.abs(found - pixels).max() > 30.0


def test_a_camera_without_a_gyro_is_taken_to_stand_still_and_one_whose_gyro_fell_silent_is_not():
    pixels = np.array([[100.0, 100.0], [500.0, 300.0]])
    assert np.allclose(PerceivedExpectation(onboard()).pixels_at(0.0, 0.1)(pixels), pixels)
    drone = onboard()
    for k in range(11):
        drone.tell(ImuSample(k / 200.0, np.zeros(3), NO_ACCEL))
    assert PerceivedExpectation(drone).pixels_at(0.9, 1.0) is None


def test_a_place_asked_for_later_has_moved_on_with_the_own_camera():
    """This drone flies north at 2 m/s towards one that stands; its autopilot then says nothing for 0.3 s."""
    drone = onboard()
    drone.tell(announced(2, [20.0, -1.0, 0.0]))
    for k in range(25):
        t = k / 10
        drone.tell(EgoPose(t, np.array([2.0 * t, 0.0, 0.0]), np.eye(3)))
        drone.tell(seen(t, (320.0 - 430.0 / (20.0 - 2.0 * t), 240.0)))
    then = metres(drone)[2]
    (later,) = (entry.relative for entry in drone.tracks(2.7).tracks)
    assert (later.drone_id, then.t, later.t) == (2, 2.4, 2.7)
    # Against each other, as the last scan said; had the own camera stood still meanwhile, 0.6 m more.
    assert later.position - then.position == pytest.approx(0.3 * then.velocity, abs=0.1)
    assert np.linalg.eigvalsh(later.cov).min() > 0.0


def test_a_place_asked_for_later_ends_with_the_name_too():
    drone = onboard()
    drone.tell(announced(2, [6.0, -1.0, 0.0]))
    t = watch(drone, [(320 - 430 / 6, 240.0)])
    assert drone.tracks(t).tracks[0].relative is not None
    for k in range(8, 60):
        drone.tell(seen(k / 15))  # it is not seen any more: its name goes before its track
        last = drone.tracks(k / 15).tracks
        if not last or last[0].identity is None:
            break
    assert [entry.relative for entry in last if entry.identity is None] == [None]


def ranged_flight(distance_of, *, of=1, seconds=4.0):
    """Drone 2 hovers 6.08 m away; the radio of drone `of` says distance_of(t), ten times per second."""
    drone, events = onboard(), []
    drone.tell(announced(2, [6.0, -1.0, 0.0]))
    for k in range(round(15 * seconds)):
        drone.tell(seen(k / 15, (320 - 430 / 6, 240.0)))
        if k % 3 == 2 and distance_of is not None:
            t = k / 15 + 0.01
            drone.tell(RangeReport(of, 2, t, 0.001, distance_of(t), 0.1))
        events += drone.events()
    state = [e for e in events if isinstance(e, ScanReport)][-1].tracks.tracks[0].relative
    return drone, state, [e for e in events if isinstance(e, RangeNews)]


def test_the_own_radio_makes_a_distance_sure():
    _, unranged, _ = ranged_flight(None)
    drone, state, news = ranged_flight(lambda t: 37.0**0.5)
    assert "range" in state.sources
    assert state.range_sigma_log < 0.5 * unranged.range_sigma_log
    assert np.linalg.norm(state.position) == pytest.approx(37.0**0.5, abs=0.1)
    assert news == []
    assert drone.part_counters["relative_refused"] == 0


def test_a_radio_that_lies_changes_no_bit_and_is_counted_and_said_once():
    _, honest, _ = ranged_flight(None)
    drone, state, news = ranged_flight(lambda t: 206.0)
    assert (state.position == honest.position).all()
    assert (state.cov == honest.cov).all()
    assert drone.part_counters["relative_refused"] > 10
    (one,) = news
    assert (one.drone_id, one.distance) == (2, 206.0)


def test_what_another_drone_s_radio_measures_is_not_ours():
    _, honest, _ = ranged_flight(None)
    _, state, _ = ranged_flight(lambda t: 37.0**0.5, of=3)
    assert (state.position == honest.position).all()
    assert state.sources == honest.sources


def test_the_ground_is_where_the_range_finder_found_it_for_a_second_however_the_drone_climbs():
    drone = onboard()
    for k in range(26):
        t = 0.02 * k
        climbed = np.array([0.0, 0.0, -3.0 - t])
        drone.tell(EgoPose(t, climbed, np.eye(3), ground=3.2 if k == 0 else None))
    assert drone.own_flight(0.5).ground == pytest.approx(3.7, abs=0.05)
    assert drone.own_flight(1.1).ground is None
    assert onboard().own_flight(0.0).ground is None
