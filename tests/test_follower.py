"""A follower is what its Onboard perceives, the law, and the axes of its autopilot."""

import math
from dataclasses import replace

import numpy as np
import pytest

from swarmtrack.benchmarks.relative_cost import CAMERA, IN_VIEW, SPAN_M, Hovering, places
from swarmtrack.follower import Engagement, Follower
from swarmtrack.formation.parameters import FormationParameters
from swarmtrack.formation.setpoint import NO_SWAY, Setpoint, Why
from swarmtrack.geometry import rotation
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import BODY_FROM_FORWARD_CAMERA
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.messages import Detections, EgoPose, IdClash, ImuSample, LeapNews, PeerDeparted
from swarmtrack.motion.ego import EgoHistory
from swarmtrack.motion.gyro import GyroHistory
from swarmtrack.motion.mounting import Mounting
from swarmtrack.motion.sway import sway
from swarmtrack.onboard import Onboard, OnboardCamera
from swarmtrack.relative.parameters import RelativeParameters
from swarmtrack.runtime.filed import coded_motion
from swarmtrack.team.identities import Identities
from swarmtrack.tracking import AGENT_PARAMETERS, DEFAULT_TRACKER, create_tracker

PARAMETERS = FormationParameters(
    drone_id=2, leader=1, slots={1: (0.0, 0.0, 0.0), 2: (-4.0, 3.0, -1.0)}, references=(1,), height=5.0
)


def onboard(drone_id=1, start=None, *, places_anybody=True):
    return Onboard(
        drone_id,
        cameras=[
            OnboardCamera(
                CAMERA,
                Mounting(Pose(BODY_FROM_FORWARD_CAMERA, np.zeros(3))),
                create_tracker(DEFAULT_TRACKER, camera=CAMERA, **AGENT_PARAMETERS),
            )
        ],
        gyro=GyroHistory(),
        ego=EgoHistory(start=start) if start else EgoHistory(origin=np.zeros(3)),
        identity=IdentityParameters(),
        relative=RelativeParameters(airframe_span_m=SPAN_M),
        places_anybody=places_anybody,
    )


def hover(drone, seconds=1.0, velocity=(0.0, 0.0, 0.0), yaw=0.0, t=0.0):
    """Poses and gyro samples of a drone that flies like that from the origin on; when the last came."""
    for k in range(round(seconds * 50.0)):
        t += 0.02
        turned = rotation.from_euler(0.0, 0.0, yaw)
        place = np.array(velocity) * (k + 1) * 0.02
        drone.tell(EgoPose(t=t, position=place, world_from_body=turned, attitude_sigma=0.001))
        drone.tell(ImuSample(t, np.zeros(3), np.full(3, np.nan)))
    return t


@pytest.fixture
def crowd(monkeypatch):
    """An Onboard that has seen five drones without names for some seconds."""
    made = Onboard.__init__

    def with_places(self, *args, **kwargs):
        made(self, *args, **kwargs, places_anybody=True)

    monkeypatch.setattr(Onboard, "__init__", with_places)
    return Hovering(announced=False)


def test_whoever_is_seen_has_a_place_by_its_size_without_a_name(crowd):
    found = crowd.onboard.anybody(crowd.t)
    tracks = {entry.track.id: entry for entry in crowd.tracks().tracks}
    assert len(found) == IN_VIEW
    assert {state.drone_id for state in found.values()} == {0}
    assert all(tracks[track].identity is None and tracks[track].relative is None for track in found)
    ways = np.array([state.position / np.linalg.norm(state.position) for state in found.values()])
    true = places(IN_VIEW) / np.linalg.norm(places(IN_VIEW), axis=1)[:, None]
    assert np.sort(ways[:, 1]) == pytest.approx(np.sort(true[:, 1]), abs=0.02)


def test_who_was_not_asked_to_finds_nobodys_place():
    assert Hovering(announced=False).onboard.anybody(1.0) == {}


def test_the_own_flight_is_what_the_autopilot_says_and_how_old_that_is():
    drone = onboard()
    assert drone.own_flight(0.0) is None
    t = hover(drone, velocity=(1.0, 0.0, 0.0), yaw=math.pi / 2)
    own = drone.own_flight(t + 0.1)
    assert own.position == pytest.approx((1.1, 0.0, 0.0), abs=1e-6)
    assert own.velocity == pytest.approx((1.0, 0.0, 0.0), abs=1e-6)
    assert own.heading == pytest.approx(math.pi / 2)
    assert (own.pose_age, own.gyro_age) == (pytest.approx(0.1), pytest.approx(0.1))
    assert own.scan_ages == (math.inf,)
    assert not own.clash
    assert not own.doubted


@pytest.mark.parametrize("doubts", [False, True])
def test_whose_own_place_leaps_goes_on_from_where_it_was_unless_it_doubts_that(doubts, monkeypatch):
    drone = onboard()
    t = hover(drone, velocity=(1.0, 0.0, 0.0))
    monkeypatch.setattr(Identities, "_doubt", lambda self, t: setattr(self, "self_doubt", doubts))
    drone.tell(Detections(t - 0.1, 1, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)))
    for k in range(1, 11):
        drone.tell(EgoPose(t + 0.02 * k, np.array([t + 0.02 * k, 10.0, 0.0]), np.eye(3)))
    own = drone.own_flight(t + 0.2)
    said = [event.off_m for event in drone.events() if isinstance(event, LeapNews)]
    assert said == ([] if doubts else [pytest.approx(10.0)])
    assert own.position == pytest.approx((t + 0.2, 10.0 if doubts else 0.0, 0.0), abs=0.05)
    assert own.velocity == pytest.approx((1.0, 0.0, 0.0), abs=0.05)
    assert own.leap_age == (pytest.approx(0.18) if doubts else math.inf)


def test_the_same_picture_again_and_again_is_none():
    drone = onboard()
    t = hover(drone)
    centre, size, score = np.array([[300.0, 240.0]]), np.array([[30.0, 12.0]]), np.array([0.8])

    def looks(k, shift=0.0):
        drone.tell(Detections(0.1 * k, k, centre + shift, size, score))
        (age,) = drone.own_flight(t).scan_ages
        return age

    assert looks(1, shift=0.01) == pytest.approx(t - 0.1)
    assert looks(2) == pytest.approx(t - 0.2)
    assert [looks(k) for k in (3, 4, 5)] == pytest.approx([t - 0.2] * 3)
    # By a thousandth of a pixel: a camera that lives.
    assert looks(6, shift=1e-3) == pytest.approx(t - 0.6)


def test_whose_camera_is_stuck_tells_the_team_nobody_that_it_shows(monkeypatch):
    pictures = []
    tell = Onboard.tell

    def told(self, event):
        if isinstance(event, Detections):
            pictures.append(event)
        tell(self, event)

    monkeypatch.setattr(Onboard, "tell", told)
    drone = Hovering(announced=True).onboard
    assert len(drone.sighting_report("0000000a", 1).sightings) == IN_VIEW
    last, seen = pictures[-1], []
    for k in range(1, 13):
        t = last.t + 0.1 * k
        drone.tell(ImuSample(t, np.zeros(3), np.full(3, np.nan)))
        drone.tell(EgoPose(t, np.zeros(3), np.eye(3)))
        drone.tell(replace(last, t=t, sequence=last.sequence + k))
        report = drone.sighting_report("0000000a", 1 + k)
        assert report.t == pytest.approx(t)
        seen.append(len(report.sightings))
    # One second of the same may be chance.
    assert seen[:5] == [IN_VIEW] * 5
    assert seen[-2:] == [0, 0]


def test_to_see_nobody_again_and_again_is_no_stuck_camera():
    drone = onboard()
    t = hover(drone)
    for k in (1, 2, 3):
        drone.tell(Detections(0.1 * k, k, np.empty((0, 2)), np.empty((0, 2)), np.empty(0)))
    assert drone.own_flight(t).scan_ages == pytest.approx((t - 0.3,))


def test_a_house_that_looks_as_near_as_a_drone_is_in_nobodys_way_once_its_parallax_is_known():
    """The drone flies to and fro, and sees a drone at 6 m, and a part of a house at 30 m that looks 5 m away."""
    drone, chance = onboard(), np.random.default_rng(2)
    there, width_m = np.array([[30.0, 4.0, 1.0], [6.0, -1.5, 0.5]]), np.array([30.0 / 5.0, 1.0]) * SPAN_M

    def in_the_way(t):
        return sorted(round(float(state.position[0])) for state in drone.anybody(t).values())

    told = {}
    for k in range(1, 1251):
        t = 0.02 * k
        here = np.array([0.0, 1.2 * math.sin(0.7 * t), 0.0])
        drone.tell(EgoPose(t=t, position=here, world_from_body=np.eye(3), attitude_sigma=0.002))
        drone.tell(ImuSample(t, np.zeros(3), np.full(3, np.nan)))
        if k % 7 == 0:
            pixels, _, _ = CAMERA.project((there - here) @ BODY_FROM_FORWARD_CAMERA)
            width = CAMERA.fx * width_m / there[:, 0] * np.exp(0.05 * chance.standard_normal(2))
            size = np.stack([width, 0.4 * width], axis=1)
            seen = pixels + chance.standard_normal((2, 2))
            drone.tell(Detections(t, k, seen, size, np.full(2, 0.9)))
            told[k] = in_the_way(t)
    assert [len(told[k]) for k in (98, 1246)] == [2, 1]
    # By its size it is nearer than the drone is.
    assert told[98][0] <= 6
    assert told[1246] == pytest.approx([6], abs=1)


def test_another_process_that_speaks_as_this_drone_is_a_clash_until_it_is_gone():
    drone = onboard(7)
    t = hover(drone)
    drone.tell(IdClash(7, ("0000000a", "0000000b"), ours=True))
    assert drone.own_flight(t).clash
    drone.tell(PeerDeparted(8, "0000000b"))
    assert drone.own_flight(t).clash
    drone.tell(PeerDeparted(7, "0000000b"))
    assert not drone.own_flight(t).clash


def test_what_is_sent_is_in_the_axes_of_the_autopilot():
    """Its config says that it looks east, while its autopilot believes that it looks north."""
    start = Pose(rotation.from_euler(0.0, 0.0, math.pi / 2), np.array([-4.0, 3.0, -6.0]))
    drone = onboard(2, start=start)
    t = hover(drone, yaw=0.0)
    follower = Follower(PARAMETERS)
    follower.formation.command = lambda states, own, tracks, t: _north(t)
    told = follower.command(drone, drone.tracks(t), Engagement(1))
    # The team's north is to its left, which its autopilot calls west.
    assert told.velocity == pytest.approx((0.0, -1.0, 0.2), abs=1e-6)
    assert told.setpoint.velocity == (1.0, 0.0, 0.2)


def _north(t):
    return Setpoint(t, (1.0, 0.0, 0.2), 0.1, Why.FOLLOW, "")


def test_nobody_is_told_to_fly_until_it_is_engaged_and_each_engagement_begins_anew():
    drone = onboard(2)
    t = hover(drone, velocity=(0.5, 0.0, 0.0))
    follower = Follower(PARAMETERS)
    told = follower.command(drone, drone.tracks(t), Engagement(0))
    assert (told.velocity, told.yaw_rate, told.setpoint.why) == ((0.0, 0.0, 0.0), 0.0, Why.NOT_ENGAGED)
    begun = []
    follower.formation.engage = lambda: begun.append(1)
    for number in (1, 1, 1, 0, 2, 2):
        follower.command(drone, drone.tracks(t), Engagement(number))
    assert len(begun) == 3


def test_an_autopilot_whose_clock_is_not_known_holds():
    drone = onboard(2)
    t = hover(drone)
    told = Follower(PARAMETERS).command(drone, drone.tracks(t), Engagement(1, clock_known=False))
    assert told.setpoint.why is Why.CLOCK


def test_the_own_code_is_swayed_by_while_it_lasts_and_is_nobody_elses():
    drone = onboard(drone_id=2)
    drone.tell(coded_motion(2, (1, 2, 3), begin=1.0))
    for t in (0.5, 3.0, 5.2, 9.5):
        hover(drone, seconds=0.1, t=t - 0.1)
        own = drone.own_flight(t)
        down, speed = sway(2, (1, 2, 3), t - 1.0)[:2, 2].tolist()
        assert own.sways.down == pytest.approx(down, abs=5e-3)
        assert own.sways.speed == pytest.approx(speed, abs=0.05)
    assert own.sways == NO_SWAY
