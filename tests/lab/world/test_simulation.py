"""The simulated world, its sensors and its pictures; and `sim://`, which plays them in time."""

from __future__ import annotations

import asyncio
import dataclasses
import math

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from support.autopilot_flight import Listener
from swarmtrack.clock import ManualClock
from swarmtrack.errors import SourceError
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import Equidistant, PinholeCamera
from swarmtrack.geometry.geodesy import STANDARD_GRAVITY_M_S2
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.scenario import BODY_FROM_CAMERA, CAMERA
from swarmtrack.lab.sources import Simulation, open_simulation
from swarmtrack.lab.world.rendering import Optics, Renderer
from swarmtrack.lab.world.sensors import DetectorParameters, Imu, ImuParameters, detect, visible
from swarmtrack.lab.world.trajectory import (
    Facing,
    Handover,
    Hover,
    Lissajous,
    MinimumSnap,
    SteadyYaw,
    SwingingYaw,
    Together,
    Trajectory,
    attitude_and_rate,
    circle,
    wander,
)
from swarmtrack.lab.world.world import World
from swarmtrack.messages import Array, Frame, Image, ImuSample

NO_NOISE = Optics(exposure_s=0.0, noise=0.0)
FIGURE_EIGHT = Lissajous((0.0, 0.0, -3.0), (2.0, 1.5, 0.5), (0.2, 0.4, 0.3), (0.3, 0.0, 1.0))
WAYPOINTS = [(0.0, 0.0, -2.0), (3.0, 1.0, -3.0), (1.0, 4.0, -2.5), (0.0, 0.0, -2.0)]
PATHS = {
    "hover with drift": Together((Hover((1.0, 2.0, -2.0)), wander(np.random.default_rng(5)))),
    "figure of eight": FIGURE_EIGHT,
    "circle": circle((0.0, 0.0, -2.0), radius=3.0, period=6.0),
    "waypoints": MinimumSnap((0.0, 3.0, 6.0, 10.0), WAYPOINTS),
    "departure": Handover(Hover((0.0, 0.0, -2.0)), FIGURE_EIGHT, start=2.0, duration=4.0),
}
YAWS = {
    "turning": SteadyYaw(0.5, rate=2.0),
    "swinging": SwingingYaw(-1.0, peak_rate=2.0, period=1.4, start=1.0),
    "facing": Facing((20.0, -5.0, 0.0)),
}


# --- flight ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", PATHS.values(), ids=PATHS)
def test_each_derivative_of_a_path_integrates_to_the_one_before(path):
    h = 0.005
    t = np.arange(0.0, 10.0 + h / 2, h)
    flat = np.stack([path.derivatives(s) for s in t])
    middle = np.stack([path.derivatives(s + h / 2) for s in t[:-1]])
    for order in range(3):
        simpson = (h / 6 * (flat[:-1] + 4 * middle + flat[1:])[:, order + 1]).cumsum(axis=0)
        np.testing.assert_allclose(flat[1:, order], flat[0, order] + simpson, atol=1e-5)


def test_waypoints_are_met_on_time_and_the_flight_begins_and_ends_at_rest():
    path = PATHS["waypoints"]
    for t, point in zip((0.0, 3.0, 6.0, 10.0), WAYPOINTS, strict=True):
        np.testing.assert_allclose(path.derivatives(t)[0], point, atol=1e-9)
    for t in (-1.0, 0.0, 10.0, 12.0):
        np.testing.assert_allclose(path.derivatives(t)[1:], 0.0, atol=1e-7)


@pytest.mark.parametrize("path", PATHS.values(), ids=PATHS)
@pytest.mark.parametrize("yaw", YAWS.values(), ids=YAWS)
def test_integrating_the_body_rate_reproduces_the_attitude_for_ten_seconds(path, yaw):
    flight = Trajectory(path, yaw)
    h = 0.005
    attitude = flight.attitude(0.0)
    for t in np.arange(0, 2000) * h:
        attitude = attitude @ rotation.exp(h * flight.body_rate(t + h / 2))
    error = rotation.log(flight.attitude(10.0).T @ attitude)
    assert np.linalg.norm(error) < 1e-4


def test_the_body_rate_is_the_derivative_of_the_attitude_to_a_microradian_a_second():
    flight = Trajectory(FIGURE_EIGHT, YAWS["swinging"])
    h = 1e-4
    for t in np.linspace(0.0, 10.0, 101):
        ends = [rotation.log(flight.attitude(t).T @ flight.attitude(t + s)) for s in (-2 * h, -h, h, 2 * h)]
        derivative = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * h)
        np.testing.assert_allclose(flight.body_rate(t), derivative, atol=1e-6)


def test_an_accelerometer_reads_one_g_upwards_in_hover_and_what_is_missing_in_a_fall():
    hover = Trajectory(Hover((0.0, 0.0, -2.0)), SteadyYaw(0.7))
    np.testing.assert_allclose(hover.specific_force(1.0), (0.0, 0.0, -STANDARD_GRAVITY_M_S2), atol=1e-12)

    class Falling:
        def derivatives(self, t: float) -> Array:
            a = 0.9 * STANDARD_GRAVITY_M_S2
            return np.array([[0, 0, a * t * t / 2], [0, 0, a * t], [0, 0, a], [0, 0, 0]])

    force = Trajectory(Falling(), SteadyYaw(0.7)).specific_force(1.0)
    np.testing.assert_allclose(force, (0.0, 0.0, -0.1 * STANDARD_GRAVITY_M_S2), atol=1e-12)
    with pytest.raises(ValueError, match="free fall"):
        attitude_and_rate(np.array([0.0, 0.0, STANDARD_GRAVITY_M_S2]), np.zeros(3), 0.0, 0.0)


def test_the_thrust_of_a_flying_quadrotor_lies_along_its_own_axis_and_its_nose_along_its_yaw():
    flight = Trajectory(FIGURE_EIGHT, SteadyYaw(0.3))
    for t in np.linspace(0.0, 10.0, 23):
        np.testing.assert_allclose(flight.specific_force(t)[:2], 0.0, atol=1e-12)
        nose = flight.attitude(t)[:, 0]
        assert math.atan2(nose[1], nose[0]) == pytest.approx(0.3)


# --- sensors ---------------------------------------------------------------------------------------


def test_gyro_noise_and_bias_are_those_asked_for():
    parameters = ImuParameters(rate_hz=400.0, gyro_noise_density=1e-3, gyro_bias_sigma=0.02)
    world = load_scenario("hover-triangle", seed=4).world
    imu = Imu(world, 1, parameters)
    error = np.stack([imu.sample(k).gyro - world.body_rate(1, imu.sample(k).t) for k in range(4000)])
    sigma = 1e-3 * math.sqrt(400.0)
    # 4000 samples know their mean to sigma / 63 and their sigma to 1.1 %: four times that on each axis.
    np.testing.assert_allclose(error.mean(axis=0), imu.gyro_bias, atol=4 * sigma / math.sqrt(4000))
    np.testing.assert_allclose(error.std(axis=0), sigma, rtol=0.045)
    neighbours = np.mean((error[1:] - imu.gyro_bias) * (error[:-1] - imu.gyro_bias), axis=0) / sigma**2
    assert np.abs(neighbours).max() < 0.07, "white: no correlation from one sample to the next"
    biases = np.stack([Imu(World(seed, world.drones), 1, parameters).gyro_bias for seed in range(300)])
    assert biases.std() == pytest.approx(0.02, rel=0.1)


def test_samples_are_the_same_bits_in_whatever_order_they_are_asked_for():
    forwards = Imu(load_scenario("hover-triangle", seed=9).world, 2)
    backwards = Imu(load_scenario("hover-triangle", seed=9).world, 2)
    first = [forwards.sample(k).gyro for k in range(50)]
    second = [backwards.sample(k).gyro for k in reversed(range(50))][::-1]
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(first[0], Imu(load_scenario("hover-triangle", seed=10).world, 2).sample(0).gyro)


def test_a_drone_behind_another_is_not_visible_and_the_nearer_one_is():
    camera, body_from_camera = CAMERA, BODY_FROM_CAMERA
    still = {
        drone: Trajectory(Hover((x, y, -2.0)), SteadyYaw())
        for drone, x, y in ((1, 0, 0), (2, 3, 0), (3, 7, 0))
    }
    assert list(visible(World(0, still), 1, camera, body_from_camera, 0.0)) == [2]
    still[3] = Trajectory(Hover((7.0, 1.0, -2.0)), SteadyYaw())
    assert list(visible(World(0, still), 1, camera, body_from_camera, 0.0)) == [2, 3]
    still[2] = Trajectory(Hover((-3.0, 0.0, -2.0)), SteadyYaw())
    assert list(visible(World(0, still), 1, camera, body_from_camera, 0.0)) == [3]


def test_the_stand_in_detector_misses_errs_and_invents_as_often_as_it_says():
    scenario = load_scenario("crossing", seed=1)
    boxes = visible(scenario.world, 1, scenario.camera, scenario.body_from_camera, 0.0)
    parameters = DetectorParameters(p_detection=0.8, centre_sigma=2.0, clutter_per_frame=1.5)
    rng = np.random.default_rng(0)
    found, clutter = [], 0
    for sequence in range(2000):
        detections = detect(boxes, scenario.camera, parameters, rng, t=0.0, sequence=sequence)
        true = np.stack(list(boxes.values()))[:, :2]
        nearest = detections.centre[:, None] - true
        hit = np.linalg.norm(nearest, axis=2).min(axis=1, initial=np.inf) < 12.0
        found += [d[np.linalg.norm(d, axis=1).argmin()] for d in nearest[hit]]
        clutter += int((~hit).sum())
    assert len(found) / 2000 == pytest.approx(0.8 * len(boxes), rel=0.03)
    assert np.std(found) == pytest.approx(2.0, rel=0.05)
    assert clutter / 2000 == pytest.approx(1.5, rel=0.06)
    assert (
        len(detect({}, scenario.camera, DetectorParameters(clutter_per_frame=0.0), rng, t=0.0, sequence=0))
        == 0
    )


def test_of_two_drones_that_overlap_heavily_one_box_around_both_is_found_as_often_as_said():
    near, far, aside = (
        np.array(box, float) for box in ((300, 240, 80, 30), (330, 240, 60, 24), (500, 240, 60, 24))
    )
    parameters = DetectorParameters(p_detection=1.0, centre_sigma=0.0, size_sigma=0.0, clutter_per_frame=0.0)
    rng = np.random.default_rng(3)
    merged = 0
    for sequence in range(2000):
        found = detect({2: near, 3: far, 4: aside}, CAMERA, parameters, rng, t=0.0, sequence=sequence)
        boxes = sorted(map(tuple, np.column_stack([found.centre, found.size])))
        merged += len(boxes) == 2
        around_both = (310.0, 240.0, 100.0, 30.0)  # from 260 to 360, as high as the nearer one
        assert boxes == [*([around_both] if len(boxes) == 2 else [tuple(near), tuple(far)]), tuple(aside)]
    assert merged / 2000 == pytest.approx(parameters.p_merged, rel=0.1)
    never = dataclasses.replace(parameters, p_merged=0.0)
    assert all(len(detect({2: near, 3: far}, CAMERA, never, rng, t=0.0, sequence=k)) == 2 for k in range(100))


# --- pictures --------------------------------------------------------------------------------------


def changed(renderer: Renderer, drone: int, t: float) -> tuple[Array, NDArray[np.bool_]]:
    """Where drone 1's picture differs because `drone` is in it: weights (h, w), and the clear changes among them."""
    with_it = renderer.image(1, t, 7, targets=(drone,)).astype(float)
    without = renderer.image(1, t, 7, targets=()).astype(float)
    difference = np.abs(with_it - without).sum(axis=2)
    return difference, difference > 20.0


@pytest.mark.parametrize("t", [0.0, 9.0, 13.3])
@pytest.mark.parametrize("fisheye", [False, True])
def test_each_drone_is_drawn_where_the_camera_model_projects_it_and_as_large(t, fisheye):
    scenario = load_scenario("crossing", seed=2)
    camera = scenario.camera
    if fisheye:
        camera = PinholeCamera(300.0, 300.0, 319.5, 239.5, 640, 480, Equidistant((-0.01, 0.0, 0.0, 0.0)))
    renderer = Renderer(scenario.world, camera, scenario.body_from_camera)
    boxes = visible(scenario.world, 1, camera, scenario.body_from_camera, t)
    assert len(boxes) >= 2
    for drone, box in boxes.items():
        camera_from_body = (
            scenario.world.pose(1, t) @ scenario.body_from_camera
        ).inverse() @ scenario.world.pose(drone, t)
        centre = camera.project(camera_from_body.position[None])[0][0]
        weight, clear = changed(renderer, drone, t)
        v, u = np.indices(weight.shape)
        drawn = np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()
        assert np.linalg.norm(drawn - centre) < 4.0
        low, high = np.argwhere(clear).min(axis=0)[::-1], np.argwhere(clear).max(axis=0)[::-1] + 1
        np.testing.assert_allclose((low + high - 1) / 2.0, box[:2], atol=3.5)
        np.testing.assert_allclose(high - low, box[2:], atol=7.0)


def test_a_nearer_drone_is_drawn_over_a_farther_one():
    still = {drone: Trajectory(Hover((x, 0, -2.0)), SteadyYaw()) for drone, x in ((1, 0), (2, 3), (3, 4))}
    renderer = Renderer(
        World(0, still),
        CAMERA,
        BODY_FROM_CAMERA,
        NO_NOISE,
    )
    both, front = renderer.image(1, 0.0, 0), renderer.image(1, 0.0, 0, targets=(2,))
    middle = (slice(236, 244), slice(316, 324))  # the front drone's solid body
    np.testing.assert_array_equal(both[middle], front[middle])
    assert not np.array_equal(both, front)


def test_the_same_seed_draws_the_same_picture_and_another_seed_another():
    pictures = [
        Renderer(s.world, s.camera, s.body_from_camera).image(1, 5.0, 75)
        for s in (
            load_scenario("hover-triangle", seed=6),
            load_scenario("hover-triangle", seed=6),
            load_scenario("hover-triangle", seed=7),
        )
    ]
    np.testing.assert_array_equal(pictures[0], pictures[1])
    assert not np.array_equal(pictures[0], pictures[2])


class Sideways:
    """Accelerating steadily to the east: a constant bank."""

    def __init__(self, acceleration: float) -> None:
        self.acceleration = acceleration

    def derivatives(self, t: float) -> Array:
        a = self.acceleration
        return np.array([[0, a * t * t / 2, -50.0], [0, a * t, 0], [0, a, 0], [0, 0, 0]])


def horizon_angle(image: Image) -> float:
    """Slope [rad] in the image of the line between bright sky and dark ground."""
    columns = np.arange(40, 600, 20)
    smooth = cv2.GaussianBlur(image[:, :, 0], (0, 0), 5.0).astype(float)
    rows = [np.diff(smooth[:, u]).argmin() for u in columns]
    # The median of all slopes (Theil, 1950): where a white house stands, its foot is the sharper edge.
    one, other = np.triu_indices(len(columns), 1)
    return math.atan(
        np.median(
            np.diff([np.take(rows, one), np.take(rows, other)], axis=0) / (columns[other] - columns[one])
        )
    )


def test_the_horizon_rolls_against_the_observer():
    angles = {}
    for acceleration in (0.0, 2.0, -3.0):
        world = World(1, {1: Trajectory(Sideways(acceleration), SteadyYaw(0.0))})
        renderer = Renderer(world, CAMERA, BODY_FROM_CAMERA, NO_NOISE)
        angles[acceleration] = horizon_angle(renderer.image(1, 0.0, 0))
    for acceleration in (2.0, -3.0):
        roll = math.atan2(
            acceleration, STANDARD_GRAVITY_M_S2
        )  # to the right for an acceleration to the right
        # Against the level flight's: the skyline itself is a little slanted by its hills.
        assert angles[acceleration] - angles[0.0] == pytest.approx(-roll, abs=0.04)


def test_scenery_moves_as_a_far_point_does_when_the_observer_turns():
    scenario = load_scenario("yawing-observer", seed=5)
    renderer = Renderer(scenario.world, scenario.camera, scenario.body_from_camera, NO_NOISE)
    t, later = 4.75, 4.77  # fast yaw
    before, after = (renderer.image(1, s, 0, targets=()) for s in (t, later))
    then, now = ((scenario.world.pose(1, s) @ scenario.body_from_camera).rotation for s in (t, later))
    camera = scenario.camera
    warped = cv2.warpPerspective(before, camera.K @ now.T @ then @ np.linalg.inv(camera.K), (640, 480))
    middle = (slice(100, 260), slice(80, 560))
    still = np.abs(after[middle].astype(float) - before[middle]).mean()
    turned = np.abs(after[middle].astype(float) - warped[middle]).mean()
    assert turned < 0.25 * still


def test_a_drone_too_near_or_behind_is_left_out_and_breaks_nothing():
    camera, body_from_camera = CAMERA, BODY_FROM_CAMERA
    for place in ((0.15, 0.0, -2.0), (-3.0, 0.0, -2.0), (0.5, 3.0, -2.0), (0.35, 0.3, -2.0)):
        drones = {1: Trajectory(Hover((0, 0, -2)), SteadyYaw()), 2: Trajectory(Hover(place), SteadyYaw())}
        assert Renderer(World(0, drones), camera, body_from_camera).image(1, 0.0, 0).shape == (480, 640, 3)


# --- sim:// ----------------------------------------------------------------------------------------


class FastForward:
    """Sleeps by setting the clock, `late` seconds too far."""

    def __init__(self, clock: ManualClock, late: float = 0.0) -> None:
        self.clock = clock
        self.late = late

    async def __call__(self, seconds: float) -> None:
        self.clock.set(self.clock.now() + seconds + self.late)
        await asyncio.sleep(0)


class PunctualListener(Listener):
    """behind: by how much each IMU sample came late [s]."""

    def __init__(self, clock: ManualClock) -> None:
        super().__init__()
        self.clock = clock
        self.behind: list[float] = []

    def on_imu(self, sample: ImuSample) -> None:
        super().on_imu(sample)
        self.behind.append(self.clock.now() - sample.t)

    def on_autopilot_reboot(self) -> None:
        raise AssertionError("a simulated autopilot does not reboot")


def simulation(query: str, start: float = 1000.0, late: float = 0.0) -> tuple[Simulation, ManualClock]:
    clock = ManualClock(start)
    return open_simulation(f"sim://hover-triangle?{query}", None, clock, FastForward(clock, late)), clock


async def test_frames_carry_their_exposure_and_come_a_latency_later():
    sim, clock = simulation("fps=10&latency_ms=80&seconds=1")
    frames: list[Frame] = []
    async for frame in sim.camera.frames():
        assert clock.now() == pytest.approx(frame.t + 0.08)
        frames.append(frame)
    np.testing.assert_allclose([frame.t for frame in frames], 1000.0 + np.arange(10) / 10)
    assert [frame.sequence for frame in frames] == list(range(10))
    assert frames[0].image.shape == (480, 640, 3)


async def test_a_busy_consumer_gets_the_newest_frame_and_the_skipped_ones_are_counted():
    sim, clock = simulation("fps=10&latency_ms=30&seconds=3")
    sequences = []
    async for frame in sim.camera.frames():
        sequences.append(frame.sequence)
        clock.set(clock.now() + 0.45)
    assert np.diff(sequences).max() >= 4
    # Never older than one period beyond the latency: 0.48 s after exposure k, k + 4 is the newest delivered.
    assert sequences[1] == sequences[0] + 4
    counters = dict(sim.camera.status().counters)
    assert counters["dropped"] == sequences[-1] + 1 - len(sequences)


async def test_a_camera_reports_finite_numbers_from_the_start_and_yields_nothing_once_closed():
    sim, _ = simulation("fps=10")
    for status in (sim.camera.status(), sim.autopilot.status()):
        assert all(math.isfinite(value) for _, value in status.counters)
    frames = sim.camera.frames()
    assert (await anext(frames)).sequence == 0
    await sim.camera.close()
    assert [frame async for frame in frames] == []
    assert [frame async for frame in sim.camera.frames()] == []


async def test_two_runs_of_a_seed_deliver_the_same_frames_and_samples_bit_for_bit():
    runs = []
    for _ in range(2):
        sim, clock = simulation("seed=5&fps=5&seconds=0.5")
        listener = PunctualListener(clock)
        images = [frame.image async for frame in sim.camera.frames()]
        sim, clock = simulation("seed=5&seconds=0.5")
        listener = PunctualListener(clock)
        await sim.autopilot.run(listener)
        runs.append((np.stack(images), np.stack([s.gyro for s in listener.imu]), listener.poses[-1].position))
    for one, other in zip(*runs, strict=True):
        np.testing.assert_array_equal(one, other)


async def test_imu_samples_arrive_in_order_and_complete_however_late_the_loop_wakes():
    sim, clock = simulation("imu_hz=200&seconds=2", late=0.1)
    listener = PunctualListener(clock)
    await sim.autopilot.run(listener)
    np.testing.assert_allclose(
        [sample.t for sample in listener.imu], 1000.0 - ImuParameters().delay_s + np.arange(400) / 200
    )
    assert len(listener.poses) == 100
    assert min(listener.behind) > -1e-5, "no sample from the future"
    assert max(listener.behind) < 0.11 + ImuParameters().delay_s


async def test_ego_poses_start_at_the_autopilots_own_origin():
    sim, clock = simulation("drone=2&seconds=1")
    listener = PunctualListener(clock)
    await sim.autopilot.run(listener)
    assert np.linalg.norm(listener.poses[0].position) < 0.15
    assert np.linalg.norm(sim.initial_pose.position) > 2.0


def test_teammates_announce_where_they_start_within_what_they_claim():
    sim, _ = simulation("drone=2&seed=8")
    announcements = sim.teammates_announcements()
    assert [a.drone_id for a in announcements] == [1, 3]
    for announcement in announcements:
        truth = load_scenario("hover-triangle", seed=8).initial_poses[announcement.drone_id]
        error = announcement.position - truth.position
        # Chi-square, 3 DOF, 0.1 %.
        assert 0.0 < error @ np.linalg.solve(announcement.position_cov, error) < 16.3
        assert announcement.t == 1000.0
        assert len(announcement.boot) == 8


async def test_agents_with_one_epoch_fly_in_one_world():
    first, _ = simulation("drone=1&epoch_s=1000&seconds=5", start=1000.0)
    second, _ = simulation("drone=1&epoch_s=1000&seconds=5", start=1003.0)
    frames = first.camera.frames(), second.camera.frames()
    late = await anext(frames[1])
    assert late.t == pytest.approx(1003.0)
    async for frame in frames[0]:
        if frame.sequence == late.sequence:
            np.testing.assert_array_equal(frame.image, late.image)
            return
    pytest.fail("the frame of the late agent was never exposed for the early one")


@pytest.mark.parametrize(
    ("address", "complaint"),
    [
        ("sim://nowhere", 'scenario "nowhere", expected one of'),
        ("v4l2:///dev/video0", "scheme 'v4l2'"),
        ("sim://hover-triangle?sed=1", "did you mean 'seed'"),
        ("sim://hover-triangle?fps=fast", "fps: 'fast', expected a number"),
        ("sim://hover-triangle?fps=0", "fps: 0, expected 0.1 to 1000"),
        ("sim://hover-triangle?latency_ms=nan", "expected a finite number"),
        ("sim://hover-triangle?seed=1.5", "expected a whole number"),
        ("sim://hover-triangle?drone=9", "drone 9 does not fly in it, expected one of 1, 2, 3"),
        ("sim://hover-triangle?seconds=-1", "expected more than 0"),
    ],
)
def test_an_address_that_cannot_fly_is_refused_with_the_reason(address, complaint):
    with pytest.raises(SourceError, match=complaint):
        open_simulation(address, None, ManualClock())


def test_an_address_for_another_drone_than_the_config_says_is_refused():
    with pytest.raises(SourceError, match="expected 1 as in the config"):
        open_simulation("sim://hover-triangle?drone=2", 1, ManualClock())
