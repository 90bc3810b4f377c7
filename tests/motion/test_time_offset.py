"""The camera's clock against the gyro's: found where the camera turns, unknown where it does not, used with care."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmtrack.benchmarks import time_offset
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.geodesy import STANDARD_GRAVITY_M_S2
from swarmtrack.geometry.pose import Pose
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.messages import Detections, ImuSample, Scan
from swarmtrack.motion.ego import EgoHistory
from swarmtrack.motion.gyro import GyroHistory
from swarmtrack.motion.mounting import Mounting
from swarmtrack.motion.priors import OFFSET_BLOCK_ERRORS_S, OFFSET_USED_SIGMA_S
from swarmtrack.motion.time_offset import CameraClock, OffsetEstimate, _agreed, to_use
from swarmtrack.onboard import Onboard, OnboardCamera
from swarmtrack.tracking import create_tracker

CAMERA = PinholeCamera(430.0, 430.0, 320.0, 240.0, 640, 480)
IMU_HZ, FPS = 200.0, 15.0
GYRO_NOISE = 2e-4 * math.sqrt(IMU_HZ)  # rad/s a sample
TARGETS = np.array([[-0.3, 0.1, 1.0], [0.25, -0.15, 1.0], [0.0, 0.2, 1.0]])


class Turning:
    """A camera that turns by sums of sinusoids: yaw about the world's y, then pitch about its own x."""

    def __init__(self, rng, size=0.15):
        self.f, self.phase = rng.uniform(0.2, 1.2, (2, 4)), rng.uniform(0.0, 2 * np.pi, (2, 4))
        self.a = np.array([[1.0], [0.4]]) * rng.uniform(0.2, 1.0, (2, 4)) * size

    def angles(self, t):
        """Yaw and pitch at times (n,), (2, n), and their rates."""
        w = 2 * np.pi * self.f[:, :, None]
        phase, a = w * t + self.phase[:, :, None], self.a[:, :, None]
        return (a * np.sin(phase)).sum(axis=1), (a * w * np.cos(phase)).sum(axis=1)

    def world_from_camera(self, t):
        yaw, pitch = self.angles(np.array([t]))[0][:, 0]
        return rotation.exp([0.0, yaw, 0.0]) @ rotation.exp([pitch, 0.0, 0.0])

    def rates(self, t):
        """(n, 3) rad/s in the camera's axes at times (n,)."""
        (_, pitch), (yaw_rate, pitch_rate) = self.angles(t)
        return np.stack([pitch_rate, np.cos(pitch) * yaw_rate, -np.sin(pitch) * yaw_rate], axis=1)


class Steady:
    """A camera that turns at a constant rate, or not at all, in a world with targets all around."""

    def __init__(self, rate):
        self._rate = rate

    def world_from_camera(self, t):
        return rotation.exp([0.0, self._rate * t, 0.0])

    def rates(self, t):
        return np.tile([0.0, self._rate, 0.0], (len(t), 1))


class Glances:
    """A camera that looks elsewhere, each time within 0.8 s, from the given times on: to 0.5 rad and back in turn."""

    TURN, LASTS = 0.5, 0.8

    def __init__(self, *begins):
        self._begins, self._turns = np.array(begins), self.TURN * (-1.0) ** np.arange(len(begins))

    def _progress(self, t):
        return np.clip((np.atleast_1d(t)[:, None] - self._begins) / self.LASTS, 0.0, 1.0)

    def world_from_camera(self, t):
        x = self._progress(t)
        yaw = (x**3 * (10.0 - 15.0 * x + 6.0 * x**2)) @ self._turns
        return rotation.exp([0.0, yaw[0], 0.0])

    def rates(self, t):
        x = self._progress(t)
        rate = (30.0 * x**2 * (1.0 - x) ** 2) @ self._turns / self.LASTS
        return np.stack([0.0 * rate, rate, 0.0 * rate], axis=1)


class FirstStep:
    """A drone that stood still for 15 s and then flies sideways, brakes, and turns meanwhile, as ArduPilot does it.

    At most 2.5 m/s² and 5 m/s³, rolled as the acceleration needs; yaw at most 1.05 rad/s, with a lag of 1/6 s. One
    teammate ahead, 6 to 12 m away, still or slowly on its way.
    """

    STILL, SECONDS, DT = 15.0, 26.0, 0.005

    def __init__(self, rng):
        t = self._t = np.arange(int((self.STILL + 15.0) / self.DT)) * self.DT
        brakes = self.STILL + rng.uniform(3.5, 6.0)
        speed = np.where((t >= self.STILL) & (t < brakes), rng.choice([-1, 1]) * rng.uniform(1.5, 5.0), 0.0)
        heading = np.where(t >= self.STILL + rng.uniform(0.0, 1.5), rng.uniform(-1.2, 1.2), 0.0)
        states, a, v, x, r, yaw = [], 0.0, 0.0, 0.0, 0.0, 0.0
        for goal, nose in zip(speed.tolist(), heading.tolist(), strict=True):
            wanted = min(max(2.0 * (goal - v), -2.5), 2.5)
            a += min(max(wanted - a, -5.0 * self.DT), 5.0 * self.DT)
            v, x = v + a * self.DT, x + v * self.DT
            r += 6.0 * (min(max(1.5 * (nose - yaw), -1.05), 1.05) - r) * self.DT
            yaw += r * self.DT
            states.append((x, math.atan(a / STANDARD_GRAVITY_M_S2), yaw, r))
        self._x, self._roll, self._yaw, self._yaw_rate = np.array(states).T
        self._roll_rate = np.gradient(self._roll, self.DT)
        self._teammate = rng.uniform([-1.5, -0.5, 6.0], [1.5, 0.8, 12.0])
        self._drifts = rng.uniform(-0.3, 0.3) * rng.integers(2)

    def _at(self, t, values):
        return np.interp(t, self._t, values)

    def world_from_camera(self, t):
        yaw, roll = self._at(t, self._yaw), self._at(t, self._roll)
        return rotation.exp([0.0, yaw, 0.0]) @ rotation.exp([0.0, 0.0, roll])

    def rates(self, t):
        roll, yaw_rate = self._at(t, self._roll), self._at(t, self._yaw_rate)
        return np.stack(
            [np.sin(roll) * yaw_rate, np.cos(roll) * yaw_rate, self._at(t, self._roll_rate)], axis=1
        )

    def teammate(self, t):
        return (self._teammate - [self._at(t, self._x) - self._drifts * t, 0.0, 0.0])[None]


def targets_at(t):
    """Bearings (n, 3) in the world of targets that drift about slowly."""
    k = np.arange(3)
    sway = 0.02 * np.stack([np.sin(0.5 * t + k), np.cos(0.7 * t + 2 * k), 0.0 * k], axis=1)
    return TARGETS + sway


def targets_around(t):
    angle = np.arange(18) * 2 * np.pi / 18 + 0.003 * np.sin(0.5 * t)
    return np.stack([np.sin(angle), 0.1 * np.cos(3 * angle), np.cos(angle)], axis=1)


def pixels(motion, t, seen=targets_at):
    in_camera = seen(t) @ motion.world_from_camera(t)
    z, _, valid = CAMERA.project_undistorted(in_camera)
    return z[valid & CAMERA.contains(z)]


def play(
    motion, offset, seconds=20.0, *, seed=0, sigma=1.0, noise=GYRO_NOISE, p_detection=0.95, clutter=0.0, **how
):
    """Scans stamped wrong by `offset` through a CameraClock next to its gyro; returns it and the exposures.

    tell: called after each scan with what the clock has found.
    """
    rng, gyro = np.random.default_rng(seed), GyroHistory()
    clock = CameraClock(how.get("start", 0.0), estimates=how.get("estimates", True))
    times = np.arange(int((seconds + 1.1) * IMU_HZ)) / IMU_HZ
    rates = motion.rates(times) + noise * rng.standard_normal((len(times), 3))
    samples = iter(zip(times.tolist(), rates.tolist(), strict=True))
    exposures, fps, tell = [], how.get("fps", FPS), how.get("tell", lambda found: None)
    for k in range(int(seconds * fps)):
        exposed = 1.0 + k / fps
        while gyro.newest is None or gyro.newest < exposed + 0.02:
            gyro.append(*next(samples))
        z = pixels(motion, exposed, how.get("seen", targets_at))
        z = z[rng.random(len(z)) < p_detection]
        z = np.concatenate(
            [z + sigma * rng.standard_normal(z.shape), rng.uniform(0, 480, (rng.poisson(clutter), 2))]
        )
        stamp = exposed - offset
        exposures.append(clock.exposure(stamp, gyro))
        clock.add_scan(
            stamp, Scan(exposures[-1], rng.permutation(z), how.get("R", lambda z: None)(z)), CAMERA
        )
        tell(clock.found)
    return clock, np.array(exposures)


@pytest.mark.parametrize("offset", [-0.08, -0.013, 0.0, 0.055, 0.08])
def test_without_noise_the_offset_is_found_to_a_third_of_a_millisecond(offset):
    clock, _ = play(Turning(np.random.default_rng(1)), offset, sigma=0.0, noise=0.0, p_detection=1.0)
    assert clock.found.offset_s == pytest.approx(offset, abs=3e-4)


def test_errors_are_as_large_as_the_sigma_says():
    found = []
    for seed in range(15):
        offset = (-0.08, 0.08, 0.02)[seed % 3]
        clock, _ = play(Turning(np.random.default_rng(seed)), offset, 12.0, seed=seed)
        found.append((clock.found.offset_s - offset, clock.found.sigma_s))
    error, sigma = np.array(found).T
    assert math.sqrt(np.mean(error**2)) < 2e-3
    # The mean of 15 squares of unit normals lies between 0.23 and 2.5 in 99.8 % of all cases. Here blocks err by their
    # noise alone. Six cannot prove it: what they might err beyond it makes σ larger by a sixth. And targets that
    # sway smoothly are easier to follow than what the filters allow for.
    assert 0.23 * 0.55 < np.mean((error / sigma) ** 2) < 2.5
    assert np.median(sigma) < OFFSET_USED_SIGMA_S


@pytest.mark.parametrize("rate", [0.0, 0.4])
def test_a_camera_that_stands_still_or_turns_steadily_claims_nothing(rate):
    for seed in range(3):
        clock, _ = play(Steady(rate), 0.04, 20.0, seed=seed, seen=targets_around)
        assert clock.found is None or clock.found.sigma_s > 10 * OFFSET_USED_SIGMA_S
        assert clock.used_s == 0.0


@pytest.mark.parametrize(
    "seeds",
    [range(12), pytest.param(range(12, 100), marks=pytest.mark.long("more seeds, a narrower interval"))],
)
def test_quiet_time_teaches_nothing_that_the_first_step_sideways_turns_into_a_wrong_offset(seeds):
    """Fifteen still seconds are explained by any offset; the roll into the first step comes with the very acceleration
    of the bearings that another offset would explain."""
    for seed in seeds:
        step, offset, said = FirstStep(np.random.default_rng(seed)), (-0.06, 0.01, 0.05)[seed % 3], []
        play(step, offset, step.SECONDS, seed=seed, sigma=0.5, fps=6.0, seen=step.teammate, tell=said.append)
        sure = [found for found in said if found and found.sigma_s < OFFSET_USED_SIGMA_S]
        assert all(abs(found.offset_s - offset) < 3.0 * found.sigma_s for found in sure)


@pytest.mark.parametrize(
    "begins",
    [
        *np.arange(5.0, 7.0, 0.5),
        *(
            pytest.param(t, marks=pytest.mark.long("between those of the default run"))
            for t in np.arange(5.25, 7.0, 0.5)
        ),
    ],
)
def test_what_one_manoeuvre_says_is_not_used_and_what_two_say_is(begins):
    """Whether a block of evidence ends before the turn, after it or within it."""
    once, _ = play(Glances(begins), 0.06, 12.0, seed=1)
    assert once.used_s == 0.0
    twice, _ = play(Glances(begins, begins + 4.3, begins + 8.6), 0.06, 18.0, seed=1)
    assert twice.used_s == pytest.approx(0.06, abs=5e-3)


def test_what_blocks_agree_on_is_as_far_off_as_its_sigma_says():
    """Of flights as the estimator imagines them: a τ of its own prior, and blocks that err by it and by their noise."""
    rng, ratios = np.random.default_rng(0), []
    for _ in range(1500):
        blocks, tau = rng.integers(2, 20), rng.choice(OFFSET_BLOCK_ERRORS_S)
        noise = 10.0 ** rng.uniform(-3.5, -1.5, blocks)
        said = 0.02 + rng.normal(0.0, np.hypot(noise, tau))
        offset, variance = _agreed(noise**-2.0, -said / noise**2, np.ones(blocks))
        ratios.append((offset - 0.02) ** 2 / variance)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.12)


def test_blocks_that_agree_are_believed_and_blocks_that_do_not_are_not():
    curvature, fresh = 1.0 / np.full(2, 0.5e-3) ** 2, np.ones(2)
    # Slopes of a parabola's surprise at 0 whose least is at the offsets.
    agreed, variance = _agreed(curvature, -curvature * [20e-3, 20.5e-3], fresh)
    assert agreed == pytest.approx(20.25e-3)
    assert variance < OFFSET_USED_SIGMA_S**2
    apart, variance = _agreed(curvature, -curvature * [60e-3, 20e-3], fresh)
    assert apart == pytest.approx(40e-3)
    assert variance > (10e-3) ** 2
    assert _agreed(curvature[:1], -curvature[:1] * [20e-3], fresh[:1])[1] > (2 * OFFSET_USED_SIGMA_S) ** 2


@pytest.mark.parametrize(
    ("offset_s", "sigma_s", "then"),
    [
        (0.010, 1e-3, 0.010),
        (0.0595, 1e-3, 0.06),
        # 2.5 of the present σ off, then 4.4 and 12.
        (0.040, 8e-3, 0.06),
        (0.025, 8e-3, 0.0),
        (0.010, 4e-3, 0.0),
        # 3.2 σ off, but what was told at the start is farther off.
        (0.034, 8e-3, 0.06),
    ],
)
def test_what_is_used_goes_back_as_soon_as_it_is_contradicted_by_three_of_the_present_sigma(
    offset_s, sigma_s, then
):
    assert to_use(OffsetEstimate(offset_s, sigma_s), used_s=0.06, start_s=0.0) == then


def test_clutter_and_misses_cost_little():
    motion = Turning(np.random.default_rng(3))
    clock, _ = play(motion, 0.06, 30.0, p_detection=0.7, clutter=3.0)
    assert clock.found.sigma_s < OFFSET_USED_SIGMA_S
    assert clock.found.offset_s == pytest.approx(0.06, abs=3e-3)


@pytest.mark.parametrize("factor", [1 / 16, 16.0])
def test_a_variance_that_is_told_wrong_by_16_changes_little(factor):
    motion = Turning(np.random.default_rng(4))
    told = play(motion, -0.06, R=lambda z: np.tile(factor * np.eye(2), (len(z), 1, 1)))[0].found
    plain = play(motion, -0.06)[0].found
    assert told.offset_s == pytest.approx(plain.offset_s, abs=1e-3)
    assert 0.5 < told.sigma_s / plain.sigma_s < 2.0


def test_exposures_stay_in_order_while_the_offset_is_taken_up_and_end_up_right():
    for offset in (-0.08, 0.08):
        _, exposures = play(Turning(np.random.default_rng(5)), offset)
        assert np.diff(exposures).min() > 0.85 / FPS
        assert exposures[-1] == pytest.approx(1.0 + (len(exposures) - 1) / FPS, abs=3e-3)


def test_a_good_calibration_is_left_alone():
    clock, _ = play(Turning(np.random.default_rng(6)), 0.0302, start=0.030)
    assert clock.found.sigma_s < OFFSET_USED_SIGMA_S
    assert clock.used_s == 0.030


def test_who_does_not_want_it_gets_the_offset_that_was_told():
    clock, exposures = play(Turning(np.random.default_rng(7)), 0.08, 8.0, start=0.01, estimates=False)
    assert clock.found is None
    assert exposures[-1] == pytest.approx(1.0 + (len(exposures) - 1) / FPS - 0.07)


def feed(clock, gyro, motion, times, offset, seed=0):
    rng, newest = np.random.default_rng(seed), gyro.newest or 0.0
    for exposed in times:
        due = np.arange(newest + 1 / IMU_HZ, exposed + 0.025, 1 / IMU_HZ)
        for t, rate in zip(due.tolist(), motion.rates(due).tolist(), strict=True):
            gyro.append(t, rate)
            newest = t
        z = pixels(motion, exposed)
        clock.exposure(exposed - offset, gyro)
        clock.add_scan(exposed - offset, Scan(exposed, z + rng.standard_normal(z.shape)), CAMERA)


def test_gaps_repeated_stamps_and_a_gyro_that_starts_anew_are_survived():
    motion, clock, gyro = Turning(np.random.default_rng(8)), CameraClock(0.0), GyroHistory()
    feed(clock, gyro, motion, 1.0 + np.arange(150) / FPS, 0.05)
    feed(clock, gyro, motion, [11.0, 11.0, 10.5], 0.05)  # twice the same, and an old one
    feed(clock, gyro, motion, 14.0 + np.arange(150) / FPS, 0.05)  # nothing for three seconds
    for k in range(400):  # a gyro that is silent for two seconds, and one whose stamps jump back
        gyro.append(26.0 + k / IMU_HZ, (0.0, 0.0, 0.0))
    gyro.append(20.0, (0.0, 0.0, 0.0))
    feed(clock, gyro, motion, 24.0 + np.arange(150) / FPS, 0.05)
    assert gyro.restarts == 1
    assert clock.found.offset_s == pytest.approx(0.05, abs=4e-3)


@given(st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(-1e300, 1e300), st.floats(-1e9, 1e9)), max_size=30))
@settings(max_examples=50)
def test_no_stamp_pixel_or_variance_is_more_than_it_can_bear(scans):
    motion, clock, gyro = Turning(np.random.default_rng(9)), CameraClock(0.0), GyroHistory()
    feed(clock, gyro, motion, 1.0 + np.arange(30) / FPS, 0.0)
    for t, u, variance in scans:
        z = np.array([[u, 240.0], [u, 240.0], [320.0, np.nan]])
        exposure = clock.exposure(t, gyro)
        assert math.isfinite(exposure)
        with np.errstate(all="ignore"):
            clock.add_scan(t, Scan(exposure, z, np.tile(variance * np.eye(2), (3, 1, 1))), CAMERA)
    assert clock.found is None or math.isfinite(clock.found.sigma_s)


# --- in Onboard -----------------------------------------------------------------------------------


def onboard(**mounting):
    return Onboard(
        1,
        cameras=[
            OnboardCamera(
                CAMERA,
                Mounting(Pose(np.eye(3), np.zeros(3)), **mounting),
                create_tracker("kalman", camera=CAMERA),
            )
        ],
        gyro=GyroHistory(),
        ego=EgoHistory(),
        identity=IdentityParameters(),
    )


def events(motion, offset, latency, seconds):
    rng = np.random.default_rng(10)
    times = np.arange(int((seconds + latency) * IMU_HZ)) / IMU_HZ
    arrivals = [
        (t, 0, ImuSample(t, rate, np.full(3, np.nan)))
        for t, rate in zip(times.tolist(), motion.rates(times), strict=True)
    ]
    for k in range(int((seconds - 1.0) * FPS)):
        t = 1.0 + k / FPS
        z = pixels(motion, t)
        n = len(z)
        z = z + rng.standard_normal(z.shape)
        scan = Detections(t - offset, k, z, np.full((n, 2), 30.0), np.full(n, 0.9))
        arrivals.append((t + latency, 1, scan))
    return [event for _, _, event in sorted(arrivals, key=lambda arrival: arrival[:2])]


def reports_of(drone, happened):
    found = []
    for event in happened:
        drone.tell(event)
        found += drone.events()
    return found


def states(reports):
    return [[(e.track.id, e.track.t, *e.track.mean) for e in report.tracks.tracks] for report in reports]


def test_the_offset_in_use_does_not_depend_on_how_late_the_scans_come():
    motion = Turning(np.random.default_rng(11))
    at_once, late = onboard(), onboard()
    a = reports_of(at_once, events(motion, 0.06, 0.0, 16.0))
    b = reports_of(late, events(motion, 0.06, 0.5, 16.0))
    assert at_once.cameras[0].clock.used_s > 0.05
    assert at_once.counters.late_scans == late.counters.late_scans == 0
    assert len(a) == len(b)
    for x, y in zip(states(a), states(b), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-9)


def test_the_same_flight_again_gives_the_same_bits():
    happened = events(Turning(np.random.default_rng(12)), -0.05, 0.05, 12.0)
    assert states(reports_of(onboard(), happened)) == states(reports_of(onboard(), happened))


def test_a_camera_that_is_stamped_wrong_is_tracked_as_well_as_one_that_is_right():
    """What is shown between the scans, for now: the whole point of the gyro."""
    motion = Turning(np.random.default_rng(13), size=0.25)

    def error(offset, **mounting):
        drone, squares = onboard(**mounting), []
        for event in events(motion, offset, 0.05, 20.0):
            reports_of(drone, [event])
            if isinstance(event, ImuSample) and event.t > 14.0 and round(event.t * IMU_HZ) % 7 == 0:
                truth = pixels(motion, event.t)
                shown = [
                    e.track.mean[::2] for e in drone.tracks(event.t).tracks if e.track.status == "confirmed"
                ]
                if len(truth) and shown:
                    near = np.linalg.norm(np.array(shown)[:, None] - truth, axis=2).min(axis=1)
                    squares += np.minimum(near, 50.0).tolist()
        return math.sqrt(np.mean(np.square(squares)))

    right, found = error(0.0), error(0.08)
    wrong = error(0.08, estimate_time_offset=False)
    assert found < 1.2 * right
    assert wrong > 2.0 * found


def test_the_config_s_offset_is_where_the_search_begins():
    motion, drone = Turning(np.random.default_rng(14)), onboard(time_offset_s=0.2)
    reports_of(drone, events(motion, 0.26, 0.02, 14.0))
    assert drone.cameras[0].clock.found.offset_s == pytest.approx(0.26, abs=3e-3)
    assert drone.cameras[0].clock.used_s == pytest.approx(0.26, abs=5e-3)


def test_what_lies_beyond_the_search_is_unknown_and_changes_nothing():
    motion, drone = Turning(np.random.default_rng(15)), onboard()
    reports_of(
        drone,
        [replace(e, t=e.t - 0.3) if isinstance(e, Detections) else e for e in events(motion, 0, 0.3, 14.0)],
    )
    assert drone.cameras[0].clock.found is None or drone.cameras[0].clock.found.sigma_s > OFFSET_USED_SIGMA_S
    assert drone.cameras[0].clock.used_s == 0.0


@pytest.mark.long("four flights for a table; the default run has such tables of other benchmarks")
def test_the_benchmark_writes_what_it_found(tmp_path, monkeypatch):
    chosen = {name: time_offset.CONDITIONS[name] for name in ("fast-yaw", "standing still")}
    for name, value in (("CONDITIONS", chosen), ("FIRST", "fast-yaw"), ("SECONDS", 12.0)):
        monkeypatch.setattr(time_offset, name, value)
    result = time_offset.BENCH.publish(tmp_path, seeds=2)
    turning, still = (result["by_condition"][name] for name in ("fast-yaw", "standing still"))
    assert turning["rms_ms"]["value"] < 2.0
    assert (turning["sure"], still["sure"], still["claimed"]) == (1.0, 0.0, 0.0)
    assert turning["bias"]["worst_rad_s"] < 2e-3
    assert json.loads((tmp_path / "offset.json").read_text(encoding="utf-8"))["seeds"] == 2
    assert "fast-yaw" in (tmp_path / "offset.md").read_text(encoding="utf-8")
    assert (tmp_path / "offset.png").stat().st_size > 1000
