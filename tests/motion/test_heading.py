"""How well the own heading is known: by whether the drone flies, and by steps against the gyro."""

import math

import numpy as np
import pytest

from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.messages import AutopilotRebooted, EgoPose, FlightState, HeadingNews, ImuSample
from swarmtrack.motion.ego import EgoHistory
from swarmtrack.motion.gyro import GyroHistory
from swarmtrack.motion.heading import HeadingBulletin, HeadingKnowledge, HeadingSigma, HeadingSteps
from swarmtrack.motion.mounting import Mounting
from swarmtrack.motion.priors import HEADING_ALIGNED_AFTER_S, HEADING_NEWS_PERIOD_S
from swarmtrack.onboard import Onboard, OnboardCamera
from swarmtrack.outputs.wording import describe
from swarmtrack.tracking import create_tracker

FORWARD = rotation.BODY_FROM_FORWARD_CAMERA
GROUND, FLIGHT = math.radians(3.0), math.radians(1.5)
GYRO_HZ, POSE_HZ = 200.0, 50.0


def level(yaw):
    return rotation.from_euler(0.0, 0.0, yaw)


def turning(rate, acceleration, until=math.inf):
    """Yaw [rad] at t of a drone that speeds up to a rate [rad/s], holds it and slows down again from `until` on."""
    ramp = rate / acceleration

    def ramped(t):
        t = max(t, 0.0)
        return 0.5 * acceleration * t * t if t < ramp else rate * (t - 0.5 * ramp)

    return lambda t: ramped(t - 2.0) - ramped(t - until)


def steps_of(attitude, *, seconds, step=lambda t: 0.0, noise=0.0, lag=0.0, pose_hz=50.0):
    """The steps found: (t, step). attitude: of t, truth; step [rad]: of t, on the heading that the autopilot tells;
    noise [rad]: of each attitude; lag [s] by which the gyro is older than its stamp."""
    rng = np.random.default_rng(1)
    gyro = GyroHistory()
    steps = HeadingSteps(gyro, FORWARD)
    found = []
    for k in range(int(seconds * GYRO_HZ)):
        t = k / GYRO_HZ
        turn = rotation.log(attitude(t - lag - 1e-3).T @ attitude(t - lag + 1e-3)) / 2e-3
        gyro.append(t, tuple(FORWARD.T @ turn))
        if k % int(GYRO_HZ / pose_hz) == 0:
            error = rotation.exp(noise * rng.standard_normal(3))
            pose = EgoPose(t, None, level(step(t)) @ attitude(t) @ error)
            found += [(t, size) for size in steps.add_pose(pose)]
    return found


def test_a_step_of_two_degrees_is_found_once_and_measured():
    found = steps_of(lambda t: level(0.3), seconds=20.0, step=lambda t: math.radians(-2.0) * (t > 10.0))
    assert [(pytest.approx(10.1, abs=0.1), pytest.approx(math.radians(-2.0), abs=1e-3))] == found


@pytest.mark.parametrize(
    ("degrees", "rate"),
    [(60.0, 0.8), (-90.0, 0.0), (150.0, 0.8), (178.0, 0.0), (-178.0, 0.8), (180.0, 0.0)],
)
def test_a_reset_is_measured_as_the_angle_that_it_is(degrees, rate):
    found = steps_of(
        lambda t: rotation.from_euler(0.2, -0.1, rate * t),
        seconds=20.0,
        step=lambda t: math.radians(degrees) * (t > 10.0),
    )
    assert [round(t) for t, _ in found] == [10]
    assert math.remainder(found[0][1] - math.radians(degrees), math.tau) == pytest.approx(0.0, abs=2e-3)


def test_a_step_is_found_in_the_noise_of_a_poor_attitude():
    found = steps_of(
        lambda t: level(0.3), seconds=20.0, step=lambda t: math.radians(2.5) * (t > 10.0), noise=0.004
    )
    assert len(found) == 1
    assert found[0][0] == pytest.approx(10.2, abs=0.2)
    assert found[0][1] == pytest.approx(math.radians(2.5), abs=math.radians(0.7))


def test_a_step_while_the_drone_turns_is_found():
    yaw = turning(1.2, 3.5)
    found = steps_of(
        lambda t: level(yaw(t)), seconds=12.0, step=lambda t: math.radians(2.0) * (t > 6.0), lag=0.011
    )
    assert len(found) == 1
    assert found[0][1] == pytest.approx(math.radians(2.0), abs=math.radians(0.2))


@pytest.mark.parametrize(("rate", "acceleration"), [(1.2, 3.5), (2.2, 11.0)], ids=["ArduPilot", "PX4"])
@pytest.mark.parametrize("lag", [-0.02, 0.0, 0.011, 0.02])
def test_a_turn_is_no_step_although_the_gyro_is_late(rate, acceleration, lag):
    yaw = turning(rate, acceleration, until=5.0)
    assert steps_of(lambda t: level(yaw(t)), seconds=9.0, lag=lag) == []


def test_the_kick_of_roll_into_an_acceleration_is_no_step():
    """As PX4 does it: 43° at 3.8 rad/s, while the drone turns."""
    roll, yaw = turning(3.8, 25.0, until=2.2), turning(1.2, 3.5)
    assert roll(5.0) > math.radians(40.0)
    assert steps_of(lambda t: rotation.from_euler(roll(t), 0.0, yaw(t)), seconds=5.0, lag=0.011) == []


@pytest.mark.parametrize(
    "seconds", [50.0, pytest.param(240.0, marks=pytest.mark.long("four minutes, not one"))]
)
@pytest.mark.parametrize(
    "noise", [0.005, pytest.param(0.001, marks=pytest.mark.long("a fifth of the noise"))]
)
def test_noise_is_no_step(noise, seconds):
    assert steps_of(lambda t: level(1.0), seconds=seconds, noise=noise) == []


@pytest.mark.parametrize(
    "pose_hz", [5.0, pytest.param(50.0, marks=pytest.mark.long("ten times as many poses"))]
)
def test_a_gyro_that_is_off_and_one_of_the_wrong_scale_find_no_step(pose_hz):
    drifting = steps_of(lambda t: level(0.0), seconds=30.0, step=lambda t: 0.019 * t, pose_hz=pose_hz)
    yaw = turning(1.2, 3.5)
    scaled = steps_of(lambda t: level(yaw(t)), seconds=30.0, step=lambda t: 0.016 * yaw(t), pose_hz=pose_hz)
    assert drifting == scaled == []


def test_without_a_gyro_nothing_is_found_and_nothing_grows():
    steps = HeadingSteps(GyroHistory(), FORWARD)
    for k in range(5000):
        assert steps.add_pose(EgoPose(k / POSE_HZ, None, level(0.1 * (k > 2000)))) == []
    assert len(steps._waiting) < 50


# --- what is known ---


def knowledge(*states):
    known = HeadingKnowledge(HeadingSigma(GROUND, FLIGHT))
    for t, since in states:
        known.fly(FlightState(t, since))
    return known


def test_on_the_ground_and_at_first_in_flight_the_heading_is_less_sure():
    known = knowledge((0.0, None), (30.0, 30.0))
    assert known.sigma(30.0 + HEADING_ALIGNED_AFTER_S - 0.1) == GROUND
    assert known.sigma(30.0 + HEADING_ALIGNED_AFTER_S) == FLIGHT
    known.fly(FlightState(80.0, None))
    assert known.sigma(80.0) == GROUND


def test_the_step_of_the_alignment_ends_the_waiting_but_one_on_the_ground_does_not():
    known = knowledge((0.0, None))
    known.step(5.0, 0.05)
    known.fly(FlightState(30.0, 30.0))
    assert known.sigma(31.0) == GROUND
    known.step(32.0, 0.05)
    assert known.sigma(32.0) == FLIGHT


@pytest.mark.parametrize("degrees", [20.0, -90.0, 150.0])
def test_a_reset_in_flight_is_doubted_until_it_is_taken_back_or_the_drone_lands(degrees):
    by = math.radians(degrees)
    known = knowledge((0.0, None), (30.0, 30.0))
    known.step(60.0, by)
    assert known.sigma(1e4) >= 0.5 * abs(by)
    assert not known.is_aligned(1e4)
    known.step(70.0, -by + 0.02)
    assert known.sigma(70.0) == FLIGHT
    known.step(80.0, by)
    known.fly(FlightState(90.0, None))
    assert known.sigma(90.0) == GROUND
    known.fly(FlightState(100.0, 95.0))
    assert known.sigma(1e4) == FLIGHT


def test_two_resets_by_most_of_a_turn_are_one_by_what_is_left_of_it():
    known = knowledge((0.0, 0.0))
    known.step(60.0, math.radians(170.0))
    known.step(70.0, math.radians(150.0))
    assert known.doubt == pytest.approx(math.radians(20.0))


def test_an_estimator_that_finds_its_heading_on_the_ground_is_not_doubted():
    known = knowledge((0.0, None))
    known.step(5.0, 2.0)
    known.fly(FlightState(30.0, 30.0))
    assert known.sigma(1e4) == FLIGHT


def test_who_was_found_flying_is_aligned_and_a_reboot_in_the_air_begins_again():
    known = knowledge((0.0, -math.inf))
    assert known.sigma(0.0) == FLIGHT
    known.restart(50.0)
    assert known.sigma(50.0 + HEADING_ALIGNED_AFTER_S - 1.0) == GROUND
    assert known.sigma(50.0 + HEADING_ALIGNED_AFTER_S) == FLIGHT


@pytest.mark.parametrize(
    ("sigma", "height", "flies"), [(0.1, 1.9, False), (0.1, 2.1, True), (0.9, 4.0, False)]
)
def test_an_autopilot_that_does_not_say_whether_it_flies_does_once_it_has_left(sigma, height, flies):
    known = knowledge()
    known.add_pose(EgoPose(0.0, np.zeros(3), np.eye(3), sigma))
    known.add_pose(EgoPose(1.0, np.array([0.0, 0.0, -height]), np.eye(3), sigma))
    assert known.is_aligned(1.0 + HEADING_ALIGNED_AFTER_S) is flies


def test_whoever_says_that_it_stands_is_believed_wherever_it_is():
    known = knowledge((0.0, None))
    for t in range(3):
        known.add_pose(EgoPose(float(t), np.array([100.0 * t, 0.0, 0.0]), np.eye(3)))
    assert not known.is_aligned(1e6)


# --- what is news ---


def test_the_team_hears_of_a_step_at_once_and_of_the_next_one_when_it_is_due():
    bulletin = HeadingBulletin()
    assert bulletin.news(1.0, [0.03], is_aligned=False) == HeadingNews(1.0, 0.03)
    assert bulletin.news(2.0, [0.04], is_aligned=False) is None
    assert bulletin.news(3.0, [], is_aligned=False) is None
    assert bulletin.news(1.0 + HEADING_NEWS_PERIOD_S, [], is_aligned=False) == HeadingNews(2.0, 0.04)
    assert bulletin.news(99.0, [], is_aligned=False) is None


def test_the_alignment_is_news_once_but_not_of_a_drone_that_was_aligned_at_first():
    assert HeadingBulletin().news(1.0, [], is_aligned=True) is None
    bulletin = HeadingBulletin()
    said = [bulletin.news(float(t), [], is_aligned=t > 20) for t in range(100)]
    assert [news for news in said if news] == [HeadingNews(21.0, 0.0)]


# --- the pose in the team frame ---


def fly_level(history, yaw_of, *, seconds, north_of=lambda t: 0.0):
    for k in range(int(seconds * POSE_HZ)):
        t = k / POSE_HZ
        history.append(EgoPose(t, np.array([north_of(t), 0.0, -2.0]), level(yaw_of(t))))


def test_the_error_of_the_heading_is_about_the_vertical_and_that_of_the_tilt_is_not():
    history = EgoHistory(heading=HeadingSigma(GROUND, FLIGHT))
    history.append(EgoPose(0.0, np.zeros(3), rotation.from_euler(0.3, -0.2, 2.0), attitude_sigma=0.02))
    np.testing.assert_allclose(history.at(0.0).attitude_cov, np.diag([0.02**2, 0.02**2, GROUND**2]))
    history.fly(FlightState(0.0, -math.inf))
    for t in (0.1, 0.2):
        history.append(EgoPose(t, np.zeros(3), np.eye(3), attitude_sigma=0.02))
    assert history.at(0.15).attitude_sigma == pytest.approx(FLIGHT)
    # Between two poses, and beyond the last, nothing is surer than they are.
    assert history.at(0.05).attitude_sigma == pytest.approx(GROUND)
    assert history.at(1.0).attitude_sigma > GROUND


def test_a_step_does_not_turn_a_drone_whose_heading_was_measured_nor_move_it():
    history = EgoHistory(start=Pose(level(1.0), np.array([5.0, 0.0, -2.0])))
    fly_level(history, lambda t: 0.2, seconds=2.0)
    before = history.at(1.9)
    history.append(EgoPose(2.0, np.array([0.0, 0.0, -2.0]), level(0.2 + 0.035)))
    history.step_heading(2.1, 0.035)
    history.append(EgoPose(2.1, np.array([0.0, 0.0, -2.0]), level(0.2 + 0.035)))
    after = history.at(2.1)
    np.testing.assert_allclose(after.world_from_body, before.world_from_body, atol=1e-12)
    np.testing.assert_allclose(after.position, before.position, atol=1e-12)


def test_a_jump_that_was_mended_where_it_was_seen_is_not_mended_again_by_the_gyro():
    history = EgoHistory(start=Pose(level(1.0), np.zeros(3)))
    fly_level(history, lambda t: 1.5 * (t > 1.0), seconds=1.1)
    assert history.heading_jumps == 1
    history.step_heading(1.1, 1.5)
    history.append(EgoPose(1.1, np.zeros(3), level(1.5)))
    np.testing.assert_allclose(history.at(1.1).world_from_body, level(1.0), atol=1e-12)


def test_a_step_stays_a_step_where_the_heading_is_the_autopilots_own():
    history = EgoHistory(absolute=True)
    fly_level(history, lambda t: 0.2, seconds=1.0)
    history.step_heading(1.0, 0.035)
    history.append(EgoPose(1.0, np.zeros(3), level(0.235)))
    np.testing.assert_allclose(history.at(1.0).world_from_body, level(0.235))


def test_a_local_frame_may_be_turned():
    """Its first axis points east: who flies along it flies east, and who looks along it looks east."""
    history = EgoHistory(origin=np.array([10.0, 20.0, 0.0]), origin_yaw=math.radians(90.0))
    fly_level(history, lambda t: 0.1, seconds=2.0, north_of=lambda t: 3.0 * t)
    pose = history.at(1.0)
    np.testing.assert_allclose(pose.position, [10.0, 23.0, -2.0], atol=1e-9)
    np.testing.assert_allclose(pose.world_from_body, level(math.radians(90.0) + 0.1), atol=1e-9)
    np.testing.assert_allclose(history.velocity(1.0)[0], [0.0, 3.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(history.team_from_local @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)
    # A rebooted estimator begins again, and looks along its first axis again.
    history.restart()
    history.append(EgoPose(2.0, np.zeros(3), level(0.1)))
    np.testing.assert_allclose(history.at(2.0).world_from_body, level(math.radians(90.0) + 0.1), atol=1e-9)


def test_the_height_has_a_sigma_of_its_own():
    history = EgoHistory(absolute=True)
    history.append(EgoPose(0.0, np.zeros(3), np.eye(3), position_sigma=0.9, vertical_sigma=1.8))
    np.testing.assert_allclose(history.at(0.0).position_cov, np.diag([0.81, 0.81, 3.24]))
    assert history.at(0.0).position_sigma == 1.8


# --- the whole drone ---


def test_a_drone_tells_of_its_alignment_and_is_surer_after_it():
    camera = PinholeCamera(430.0, 430.0, 320.0, 240.0, 640, 480)
    drone = Onboard(
        1,
        cameras=[
            OnboardCamera(
                camera, Mounting(Pose(FORWARD, np.zeros(3))), create_tracker("kalman", camera=camera)
            )
        ],
        gyro=GyroHistory(),
        ego=EgoHistory(),
        identity=IdentityParameters(),
    )
    news = []
    for k in range(int(12.0 * GYRO_HZ)):
        t = k / GYRO_HZ
        drone.tell(ImuSample(t, np.zeros(3), np.zeros(3)))
        if k % 200 == 0:
            drone.tell(FlightState(t, 4.0 if t >= 4.0 else None))
        if k % 4 == 0:
            yaw = math.radians(2.0) * (t < 6.0)
            drone.tell(EgoPose(t, np.array([0.0, 0.0, -2.0]), level(yaw)))
        news += [event for event in drone.events() if isinstance(event, HeadingNews)]
        if t == 5.0:
            assert drone.ego_pose(t).attitude_sigma == pytest.approx(GROUND)
    assert [round(math.degrees(one.step), 1) for one in news] == [-2.0]
    assert drone.part_counters["heading_steps"] == 1
    assert drone.ego_pose(11.9).attitude_sigma == pytest.approx(FLIGHT)
    assert not drone.own_flight(11.9).doubted
    drone.tell(AutopilotRebooted())
    drone.tell(EgoPose(12.0, np.array([0.0, 0.0, -2.0]), level(0.0)))
    assert drone.ego_pose(12.0).attitude_sigma == pytest.approx(GROUND)


def test_a_reset_in_flight_is_told_as_its_angle_and_doubted():
    camera = PinholeCamera(430.0, 430.0, 320.0, 240.0, 640, 480)
    mounted = OnboardCamera(
        camera, Mounting(Pose(FORWARD, np.zeros(3))), create_tracker("kalman", camera=camera)
    )
    drone = Onboard(
        1,
        cameras=[mounted],
        gyro=GyroHistory(),
        ego=EgoHistory(absolute=True),
        identity=IdentityParameters(),
    )
    drone.tell(FlightState(0.0, -math.inf))
    news = []
    for k in range(int(4.0 * GYRO_HZ)):
        t = k / GYRO_HZ
        drone.tell(ImuSample(t, np.zeros(3), np.zeros(3)))
        if k % 4 == 0:
            drone.tell(EgoPose(t, np.array([0.0, 0.0, -2.0]), level(math.radians(150.0) * (t > 2.0))))
        news += [event for event in drone.events() if isinstance(event, HeadingNews)]
    (found,) = news
    assert math.degrees(found.step) == pytest.approx(150.0, abs=0.1)
    assert "reset by +150.0° against the gyro: the old one or the new one is wrong" in describe(found)
    assert "known to ±75°" in describe(found)
    assert math.degrees(drone.ego_pose(3.9).attitude_sigma) >= 75.0
    assert drone.own_flight(3.9).doubted
