"""A drone with several cameras (onboard.py): names, metres and reports go round it as if it had one."""

import itertools
import math

import numpy as np
import pytest

from swarmtrack.cameras.picture_turn import UPSIDE_DOWN, MountingNews
from swarmtrack.cameras.seams import SeamNews
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.messages import Announcement, Detections, EgoPose, ImuSample, PoseWanted, ScanReport
from swarmtrack.motion.ego import EgoHistory
from swarmtrack.motion.gyro import GyroHistory
from swarmtrack.motion.mounting import Mounting
from swarmtrack.onboard import Onboard, OnboardCamera
from swarmtrack.relative.parameters import RelativeParameters
from swarmtrack.tracking import AGENT_PARAMETERS, TRACKERS, create_trackers

CAMERA = PinholeCamera(320.0, 320.0, 319.5, 239.5, 640, 480)
SPAN = 0.45
PLACES = {2: np.array([6.0, 1.0, -3.0]), 3: np.array([2.0, 7.0, -2.2]), 4: np.array([-5.0, -4.0, -2.8])}
HERE = np.array([0.0, 0.0, -2.5])
SAMPLES_PER_SCAN = 12
ALL_ROUND = (0.0, 90.0, 180.0, 270.0)
OF_ALL_TRACKERS = [
    pytest.param(
        name,
        marks=()
        if name in ("kalman", "mbm")
        else pytest.mark.long("the default run has the simplest tracker and the one that flies"),
    )
    for name in TRACKERS
]


def looking(azimuth_deg, place=(0.0, 0.0, 0.0)):
    turned = rotation.from_euler(0.0, 0.0, math.radians(azimuth_deg))
    return Pose(turned @ rotation.BODY_FROM_FORWARD_CAMERA, turned @ np.array([0.1, 0.0, 0.0]) + place)


class Flight:
    """Drone 1 hovers, and yaws; its teammates hover around it."""

    def __init__(
        self,
        azimuths,
        seed=1,
        compass=0.0,
        tracker="mbm",
        answered=False,
        samples_per_scan=SAMPLES_PER_SCAN,
    ):
        """compass rad: by how much the autopilot's heading is off; answered: whoever is asked says where it is.
        samples_per_scan: of the gyro, from one scan to that of the next camera."""
        self.compass, self.answered = compass, answered
        self.samples_per_scan = samples_per_scan
        self.poses = [looking(azimuth) for azimuth in azimuths]
        cameras = [CAMERA] * len(self.poses)
        trackers = create_trackers(tracker, cameras=cameras, **AGENT_PARAMETERS)
        self.drone = Onboard(
            1,
            cameras=[
                OnboardCamera(CAMERA, Mounting(pose, sigma=math.radians(0.5)), tracker)
                for pose, tracker in zip(self.poses, trackers, strict=True)
            ],
            gyro=GyroHistory(),
            ego=EgoHistory(origin=HERE),
            identity=IdentityParameters(),
            relative=RelativeParameters(airframe_span_m=SPAN),
            start_sigma_m=0.1,
        )
        self.chance = np.random.default_rng(seed)
        self.t = self.yaw = 0.0
        self.silent: set[int] = set()
        """Cameras that have died."""
        self.stuck: set[int] = set()
        """Cameras that show what they showed last."""
        self.shown: dict[int, tuple] = {}
        """By camera, what it showed last."""
        self.late: dict[int, float] = {}
        """By camera: s by which its scans were exposed before those that come with them."""
        self.rate = 0.0
        self.number = 0
        self.reports = []
        self.news = []
        self.mounting_news = []
        self.wanted = 0
        for drone_id in PLACES:
            self.announce(drone_id)

    def announce(self, drone_id):
        place = PLACES[drone_id]
        self.drone.tell(
            Announcement(
                drone_id, "0000000a", 1 + self.wanted, self.t, 0.0, place, np.eye(3), 0.01 * np.eye(3)
            )
        )

    def fly(self, rate, seconds, hz=200):
        n, self.rate = len(self.poses), rate
        for k in range(round(seconds * hz)):
            self.t += 1.0 / hz
            self.yaw += rate / hz
            self.drone.tell(ImuSample(self.t, np.array([0.0, 0.0, rate]), np.full(3, np.nan)))
            if k % 10 == 0:
                said = rotation.from_euler(0.0, 0.0, self.yaw + self.compass)
                self.drone.tell(EgoPose(self.t, np.zeros(3), said))
            if k % self.samples_per_scan == 0:
                if self.number % n not in self.silent:
                    self.look(self.number % n)
                self.number += 1
            for event in self.drone.events():
                if isinstance(event, ScanReport):
                    self.reports.append((event, self.yaw - self.rate * (self.t - event.tracks.t)))
                if isinstance(event, PoseWanted):
                    self.wanted += 1
                    if self.answered:
                        self.announce(event.drone_id)
                if isinstance(event, SeamNews):
                    self.news.append(event)
                if isinstance(event, MountingNews):
                    self.mounting_news.append(event)

    def seen_by(self, camera, turned):
        pose = Pose(turned, HERE) @ self.poses[camera]
        places = np.array(list(PLACES.values()))
        pixel, _, ahead = CAMERA.project_undistorted(pose.inverse().transform(places))
        return pixel, ahead & (pixel > 0.0).all(axis=1) & (pixel < [639.0, 479.0]).all(axis=1)

    def look(self, camera):
        late = self.late.get(camera, 0.0)
        turned = rotation.from_euler(0.0, 0.0, self.yaw - self.rate * late)
        pixel, inside = self.seen_by(camera, turned)
        z = pixel[inside] + 1.5 * self.chance.standard_normal((int(inside.sum()), 2))
        width = SPAN * CAMERA.fx / np.linalg.norm(np.array(list(PLACES.values())) - HERE, axis=1)[inside]
        n = len(z)
        size = np.column_stack([1.14 * width, 0.5 * width])
        if camera not in self.stuck:
            self.shown[camera] = z, size, np.full(n, 0.9)
        self.drone.tell(Detections(self.t - late, self.number, *self.shown[camera], camera=camera))

    def entries(self, since=0.0):
        """Each track of each report, its name, and who is nearest to it in its own camera's picture."""
        ids = list(PLACES)
        for report, yaw in self.reports:
            if report.tracks.t < since:
                continue
            turned = rotation.from_euler(0.0, 0.0, yaw)
            for entry in report.tracks.tracks:
                pixel, _ = self.seen_by(entry.track.camera, turned)
                away = np.linalg.norm(pixel - entry.track.mean[::2], axis=1)
                yield report, entry, ids[int(np.nanargmin(away))], float(np.nanmin(away))


@pytest.mark.parametrize(
    "azimuths",
    [
        (-40.0, 40.0),
        *(
            pytest.param(azimuths, marks=pytest.mark.long("one and four cameras, not two"))
            for azimuths in [(0.0,), ALL_ROUND]
        ),
    ],
)
def test_names_stay_with_their_drones_while_these_cross_from_camera_to_camera(azimuths):
    flight = Flight(azimuths)
    flight.fly(0.0, 2.0)
    flight.fly(0.7, 6.0)
    flight.fly(-0.7, 6.0)
    wrong = [
        (entry.identity, nearest)
        for _, entry, nearest, _ in flight.entries()
        if entry.identity is not None and entry.identity != nearest
    ]
    assert wrong == []
    # Nobody is asked again and again because another camera does not see it.
    assert flight.wanted <= 12


@pytest.mark.parametrize(
    "azimuths",
    [
        (20.0, -60.0),
        *(
            pytest.param(azimuths, marks=pytest.mark.long("three and four cameras, not two"))
            for azimuths in [(-25.0, 55.0, 135.0), (0.0, 90.0, 180.0, 270.0)]
        ),
    ],
)
def test_a_camera_that_is_upside_down_is_said_soon_and_the_others_go_on(azimuths):
    flight = Flight(azimuths, answered=True)
    true = flight.poses[1]
    flight.poses[1] = Pose(true.rotation @ UPSIDE_DOWN, true.position)
    flight.fly(0.0, 2.0)
    for _ in range(2):
        flight.fly(0.7, 5.0)
        flight.fly(-0.7, 5.0)
    (said,) = flight.mounting_news
    assert (said.camera, said.fits, said.like) == (1, False, None)
    turning = [report.tracks.t for report, entry, *_ in flight.entries(since=2.0) if entry.track.camera == 1]
    shown = sorted({t for t in turning if t < said.t})
    # s in which it showed anybody, while the drone turned.
    assert sum(min(b - a, 0.2) for a, b in itertools.pairwise(shown)) < 5.0
    # What its crossings said of seams is what it says itself.
    assert flight.news == []
    entries = list(flight.entries())
    wrong = [entry for _, entry, nearest, _ in entries if entry.identity not in (None, nearest)]
    assert len(wrong) < 0.01 * len(entries)
    after = [(report.tracks.t - said.t, entry, nearest) for report, entry, nearest, _ in entries]
    assert [e for t, e, nearest in after if t > 0.0 and e.identity not in (None, "foreign", nearest)] == []
    assert {entry.identity for t, entry, _ in after if t > 0.0 and entry.track.camera == 1} == {None}
    # The others go on giving names, but for the second in which a drone that comes back is asked where it is.
    others = [entry.identity == nearest for t, entry, nearest in after if entry.track.camera != 1 and t > 3.0]
    assert np.mean(others) > 0.7


@pytest.mark.long("half a minute of flight; the default run has the camera that does not fit")
def test_a_camera_that_is_right_after_all_gives_names_again():
    flight = Flight((-40.0, 40.0))
    true = flight.poses[1]
    flight.poses[1] = Pose(true.rotation @ UPSIDE_DOWN, true.position)
    for rate in (0.7, -0.7, 0.7):
        flight.fly(rate, 2.0)
    flight.poses[1] = true
    for rate in (-0.7, 0.7) * 6:
        flight.fly(rate, 2.0)
    assert [(news.camera, news.fits) for news in flight.mounting_news] == [(1, False), (1, True)]
    since = flight.mounting_news[1].t
    flight.fly(0.0, 5.0)
    named = {entry.identity for _, entry, _, _ in flight.entries(since=since) if entry.track.camera == 1}
    assert named - {None}


def test_the_only_camera_of_a_drone_may_be_upside_down_too():
    flight = Flight((0.0,))
    flight.poses[0] = Pose(flight.poses[0].rotation @ UPSIDE_DOWN, flight.poses[0].position)
    for rate in (0.0, 0.5, -0.5, 0.5, -0.5):
        flight.fly(rate, 1.5)
    (said,) = flight.mounting_news
    assert (said.camera, said.fits, said.like) == (0, False, None)
    assert flight.drone.sighting_report("0000000b", 1) is None
    assert [entry for _, entry, _, _ in flight.entries(since=said.t) if entry.identity is not None] == []


def test_all_around_everybody_has_a_name_all_the_time():
    flight = Flight(ALL_ROUND)
    flight.fly(0.0, 2.0)
    flight.fly(0.7, 8.0)
    by_scan = {}
    for report, entry, _, _ in flight.entries(since=1.5):
        by_scan.setdefault(report.tracks.t, []).append(entry.identity)
    complete = [sorted(filter(None, names)) == [2, 3, 4] for names in by_scan.values()]
    assert np.mean(complete) > 0.97
    cameras = {entry.track.camera for _, entry, _, _ in flight.entries(since=1.5)}
    assert cameras == {0, 1, 2, 3}


def test_metres_are_from_the_first_camera_whichever_sees_the_teammate():
    flight = Flight(ALL_ROUND)
    flight.fly(0.0, 2.0)
    flight.fly(0.5, 4.0)
    found = 0
    for report, entry, nearest, _ in flight.entries(since=2.0):
        if entry.relative is None:
            continue
        yaw = next(yaw for other, yaw in flight.reports if other is report)
        camera = Pose(rotation.from_euler(0.0, 0.0, yaw), HERE) @ flight.poses[0]
        away = PLACES[nearest] - camera.position
        assert entry.relative.drone_id == nearest
        sigma = math.sqrt(float(np.trace(entry.relative.cov[:3, :3])))
        assert np.linalg.norm(entry.relative.position - away) < 4.0 * sigma + 0.1
        found += 1
    assert found > 100


@pytest.mark.parametrize(
    "late", [0.12, pytest.param(0.08, marks=pytest.mark.long("less late than in the default run"))]
)
def test_metres_are_as_good_where_one_camera_is_late(late):
    """Its scans come after those of the other that were exposed later."""
    sigmas = {}
    for seconds in (0.0, late):
        flight = Flight((-40.0, 40.0))
        flight.late[1] = seconds
        flight.fly(0.0, 3.0)
        flight.fly(0.3, 3.0)
        named = [entry for _, entry, _, _ in flight.entries(since=2.0) if isinstance(entry.identity, int)]
        placed = [entry.relative for entry in named if entry.relative is not None]
        assert len(placed) > 0.99 * len(named) > 100
        sigmas[seconds] = np.median([state.range_sigma_log for state in placed])
    assert sigmas[late] < 1.1 * sigmas[0.0]


@pytest.mark.parametrize(
    "detector_hz", [10.0, pytest.param(16.7, marks=pytest.mark.long("once more at another rate"))]
)
def test_a_report_of_sightings_tells_of_all_cameras(detector_hz):
    flight = Flight(ALL_ROUND, samples_per_scan=round(200.0 / detector_hz))
    flight.fly(0.0, 3.0)
    for _ in range(10):
        flight.fly(0.0, 0.33)
        report = flight.drone.sighting_report("0000000b", 1)
        assert sorted(sighting.drone_id for sighting in report.sightings) == [2, 3, 4]
        for sighting in report.sightings:
            away = PLACES[sighting.drone_id] - report.position
            assert sighting.direction @ away / np.linalg.norm(away) > math.cos(math.radians(1.5))


@pytest.mark.parametrize(
    ("tracker", "late"),
    [
        ("kalman", 0.08),
        ("mbm", 0.2),
        *(
            pytest.param(*of, marks=pytest.mark.long("each tracker and each delay is in the default run"))
            for of in [("kalman", 0.2), ("mbm", 0.08)]
        ),
    ],
)
def test_what_is_reported_of_a_late_camera_s_scan_has_a_variance(tracker, late):
    """The other camera's tracks have to be carried back to it."""
    flight = Flight((-40.0, 40.0), tracker=tracker)
    flight.late[1] = late
    flight.fly(0.0, 3.0)
    flight.fly(0.8, 2.0)
    flight.fly(-0.8, 2.0)
    least = [
        np.linalg.eigvalsh(entry.track.cov)[0]
        for report, _ in flight.reports
        for entry in report.tracks.tracks
    ]
    assert len(least) > 100
    assert min(least) > 0.0


def test_a_report_of_sightings_tells_of_nobody_whom_its_camera_does_not_show_any_more(monkeypatch):
    flight = Flight(ALL_ROUND)
    flight.fly(0.0, 3.0)
    monkeypatch.delitem(PLACES, 3)
    flight.fly(0.0, 0.5)
    report = flight.drone.sighting_report("0000000b", 1)
    assert sorted(sighting.drone_id for sighting in report.sightings) == [2, 4]


@pytest.mark.parametrize("first", [0.0, 90.0])
def test_a_follower_turns_its_first_camera(first):
    """As `fields_of_view` has it when a formation is checked."""
    flight = Flight((first, 45.0))
    flight.fly(0.0, 1.0)
    assert math.degrees(flight.drone.own_flight(flight.t).heading) == pytest.approx(first, abs=1.0)


def test_a_scan_waits_for_the_gyro_whichever_camera_it_is_of_and_those_that_wait_are_tracked_in_their_order():
    flight = Flight((-40.0, 40.0))
    flight.fly(0.0, 1.0)
    before = len(flight.reports)
    t = flight.t
    for camera, late in ((1, 0.004), (0, 0.012)):
        flight.drone.tell(
            Detections(t + late, 900 + camera, np.empty((0, 2)), np.empty((0, 2)), np.empty(0), camera=camera)
        )
    flight.fly(0.0, 0.05)
    times = [report.tracks.t for report, _ in flight.reports[before:]]
    assert {round(t + 0.004, 6), round(t + 0.012, 6)} <= {round(time, 6) for time in times}
    assert times == sorted(times)


@pytest.mark.parametrize(
    "azimuths", [ALL_ROUND, pytest.param((0.0, 90.0), marks=pytest.mark.long("two cameras, not four"))]
)
def test_a_compass_that_is_25_degrees_off_is_doubted_and_names_nobody_wrongly(azimuths):
    flight = Flight(azimuths, compass=math.radians(25.0))
    flight.fly(0.0, 5.0)
    wrong = [
        (entry.identity, nearest)
        for _, entry, nearest, _ in flight.entries()
        if isinstance(entry.identity, int) and entry.identity != nearest
    ]
    assert wrong == []
    assert flight.drone.self_doubt


@pytest.mark.parametrize("tracker", OF_ALL_TRACKERS)
def test_what_a_camera_showed_that_has_died_ends_within_a_second_while_the_others_go_on(tracker):
    flight = Flight((0.0, 90.0), tracker=tracker)
    flight.fly(0.0, 4.0)
    shown = {
        entry.track.camera for entry in flight.drone.tracks(flight.t).tracks if entry.identity is not None
    }
    assert shown == {0, 1}
    flight.silent.add(1)
    # As long as a track coasts that a camera misses, and the others' next scans.
    flight.fly(0.0, 1.0 + 0.15)
    assert {entry.identity for entry in flight.drone.tracks(flight.t).tracks} == {2}
    assert [entry.track.camera for entry in flight.reports[-1][0].tracks.tracks] == [0]
    flight.fly(0.0, 0.5)
    flight.silent.clear()
    flight.fly(0.0, 3.0)
    assert {entry.identity for entry in flight.drone.tracks(flight.t).tracks} == {2, 3}


@pytest.mark.parametrize("tracker", OF_ALL_TRACKERS)
def test_a_camera_that_is_stuck_does_not_hold_back_what_another_one_sees_too(tracker):
    flight = Flight((-20.0, 20.0), tracker=tracker)
    flight.fly(0.0, 3.0)
    # Drone 2 is in both pictures.
    assert all(flight.seen_by(camera, np.eye(3))[1][0] for camera in (0, 1))
    (before,) = [e.track.id for e in flight.drone.tracks(flight.t).tracks if e.identity == 2]
    flight.stuck.add(1)
    began = flight.t
    for rate in (0.3, -0.3, 0.3, -0.3):
        flight.fly(rate, 1.0)
    of_it = [
        (entry, away)
        for report, entry, nearest, away in flight.entries(since=began + 0.2)
        if entry.track.id == before
    ]
    assert {entry.track.camera for entry, _ in of_it} == {0}
    assert max(away for _, away in of_it) < 6.0
    assert {entry.identity for entry, _ in of_it} == {2}
    # Nobody is where the stuck camera shows them.
    assert {entry.track.camera for entry in flight.drone.tracks(flight.t).tracks} == {0}
    assert flight.drone.counters.stuck_scans > 20
    flight.stuck.clear()
    began = flight.t
    flight.fly(0.0, 1.0)
    again = [entry for _, entry, _, _ in flight.entries(since=began)]
    assert {(entry.identity, entry.track.camera) for entry in again} == {(2, 0), (2, 1)}


def test_how_long_ago_a_camera_showed_anything_new_is_told_of_each():
    flight = Flight((0.0, 90.0))
    flight.fly(0.0, 1.0)
    flight.silent.add(1)
    stuck = np.array([[300.0, 240.0]]), np.array([[30.0, 12.0]]), np.array([0.8])
    began = flight.t
    for k in range(10):
        flight.fly(0.0, 0.12)
        flight.drone.tell(Detections(flight.t, 900 + k, *stuck, camera=1))
    flight.fly(0.0, 0.06)
    alive, stands = flight.drone.own_flight(flight.t).scan_ages
    assert alive < 0.15
    assert stands == pytest.approx(flight.t - began - 0.12)
