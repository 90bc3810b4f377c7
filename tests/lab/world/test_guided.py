"""A simulated drone is flown by MAVLink commands: foreign software commands it and judges where it went."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega

from support.ground_station import Bench
from swarmtrack.geometry import rotation
from swarmtrack.lab.autopilots.autopilot import SimulatedArduPilot
from swarmtrack.lab.autopilots.firmware import ARDUCOPTER
from swarmtrack.lab.autopilots.pilot import PHASE_TRANSITIONS, GuidedPilot, Phase, PilotEvent
from swarmtrack.lab.autopilots.senses import FINDS_ITSELF_S, NO_ERRORS, DroneSenses, LastingErrors
from swarmtrack.lab.autopilots.truth import DroneTruth
from swarmtrack.lab.scenarios.scenario import SCENARIO_ORIGIN, FaultKind
from swarmtrack.lab.swarm.hardware import begin_fault, end_fault
from swarmtrack.lab.world.guided import GuidedDrone
from swarmtrack.lab.world.response import Triple
from swarmtrack.lab.world.trajectory import Hover, Path, wander
from swarmtrack.lab.world.world import World
from swarmtrack.messages import Array

ACCEPTED, FAILED = ardupilotmega.MAV_RESULT_ACCEPTED, ardupilotmega.MAV_RESULT_FAILED
STABILIZE, GUIDED, LOITER, RTL, LAND, BRAKE = 0, 4, 5, 6, 9, 17
START, YAW = (4.0, -2.0, 0.0), 0.3
STILL_AIR = Hover((0.0, 0.0, 0.0))


class GuidedBench(Bench):
    """An ArduCopter on the ground, and who commands it.

    fix_at: when its GPS knows the place; flies_by: which of its senses' errors move it, by default none.
    """

    def __init__(
        self,
        *,
        fix_at: float = 0.0,
        sway: Path = STILL_AIR,
        now: float = 0.0,
        flies_by: Callable[[LastingErrors], LastingErrors] = lambda own: NO_ERRORS,
    ) -> None:
        self.drone = GuidedDrone(START, YAW, ARDUCOPTER.response, sway)
        world = World(3, {1: self.drone})
        senses = DroneSenses(world, 1, 0.0, earth=SCENARIO_ORIGIN)
        self.errors = flies_by(senses.lasting_errors)
        self.pilot = GuidedPilot(
            self.drone,
            ARDUCOPTER,
            epoch=0.0,
            origin=SCENARIO_ORIGIN,
            located=lambda t: t >= fix_at and senses.is_located(t),
            errors=self.errors,
        )
        autopilot = SimulatedArduPilot(
            senses, truth=DroneTruth(world, 1, 0.0, SCENARIO_ORIGIN), pilot=self.pilot, boot_at=-40.0
        )
        super().__init__(autopilot, now)
        self.both_say_hello()

    def climb(self, height: float = 5.0) -> None:
        """Up, and at rest there."""
        assert [self.mode(GUIDED), self.arm(), self.take_off(height)] == [ACCEPTED] * 3
        self.until(lambda: self.drone.state(self.now).position[2] < -height - self.errors.local[2] + 0.05)
        self.run(4.0)

    def local(self) -> Array:
        """Where it truly is from its start, (3,) m."""
        return np.subtract(self.drone.state(self.now).position, START)


def test_it_neither_arms_nor_is_guided_before_it_knows_where_it_is_and_says_why():
    bench = GuidedBench(fix_at=5.0)
    assert bench.mode(GUIDED) == FAILED
    assert bench.arm() == FAILED
    assert any("requires position" in text for text in bench.texts)
    assert any("Position" in text for text in bench.texts)
    bench.run(5.0)
    assert bench.mode(GUIDED) == ACCEPTED
    assert bench.arm() == ACCEPTED


def test_heartbeats_say_mode_arming_and_flight_as_they_are():
    bench = GuidedBench()

    def heartbeat() -> tuple[bool, int, int]:
        bench.run(1.1)
        m = [m for m in bench.ground.of("HEARTBEAT") if m.get_srcComponent() == 1][-1]
        return bool(m.base_mode & 128), m.custom_mode, m.system_status

    standby, active = ardupilotmega.MAV_STATE_STANDBY, ardupilotmega.MAV_STATE_ACTIVE
    assert heartbeat() == (False, STABILIZE, standby)
    bench.mode(GUIDED)
    assert heartbeat() == (False, GUIDED, standby)
    bench.arm()
    assert heartbeat() == (True, GUIDED, standby), "ArduPilot, armed on the ground"
    bench.take_off(3.0)
    assert heartbeat() == (True, GUIDED, active)
    bench.run(5.0)
    bench.land()
    assert heartbeat() == (True, LAND, active)
    bench.until(lambda: not bench.pilot.armed)
    assert heartbeat() == (False, LAND, standby)
    assert bench.arm() == FAILED, "LAND is no mode to arm in"


def test_a_take_off_needs_guided_and_arming_and_ends_at_its_height():
    bench = GuidedBench()
    assert bench.take_off(5.0) == FAILED
    bench.mode(GUIDED)
    assert bench.take_off(5.0) == FAILED
    bench.arm()
    assert bench.take_off(5.0) == ACCEPTED
    seconds = bench.until(lambda: bench.local()[2] < -4.9)
    assert 3.0 < seconds < 8.0
    bench.run(5.0)
    np.testing.assert_allclose(bench.local(), (0.0, 0.0, -5.0), atol=0.05)
    assert bench.drone.state(bench.now).yaw == pytest.approx(YAW)
    assert bench.take_off(8.0) == FAILED, "it flies already"
    assert bench.arm(False) == FAILED, "and does not stop its motors in the air"


def test_armed_without_a_take_off_it_disarms_by_itself():
    bench = GuidedBench()
    bench.mode(GUIDED)
    bench.arm()
    assert bench.until(lambda: not bench.pilot.armed) == pytest.approx(10.0, abs=0.3)


def test_set_points_move_it_in_guided_flight_alone():
    bench = GuidedBench()
    bench.keep_telling(1.0, velocity=(2.0, 0.0, -1.0))
    bench.mode(GUIDED)
    bench.arm()
    bench.keep_telling(2.0, velocity=(2.0, 0.0, -1.0))
    np.testing.assert_array_equal(bench.local(), 0.0)
    bench.take_off(4.0)
    bench.run(10.0)
    bench.mode(LOITER)
    bench.keep_telling(3.0, velocity=(2.0, 0.0, 0.0))
    np.testing.assert_allclose(bench.local(), (0.0, 0.0, -4.0), atol=0.05)


# sitl.md, section 7
@pytest.mark.parametrize(
    ("speed", "times", "overshoot"),
    [(1.0, (0.32, 0.72, 1.3), 0.0), (2.0, (0.41, 0.90, 1.5), 0.01), (4.0, (0.52, 1.35, 2.0), 0.01)],
)
@pytest.mark.parametrize("axis", [0, 1])
def test_a_commanded_velocity_is_reached_as_arducopter_reached_it(axis, speed, times, overshoot):
    bench = GuidedBench()
    bench.climb()
    bench.ground.ask(ardupilotmega.MAVLINK_MSG_ID_SIM_STATE, 50.0, bench.now)
    velocity = [0.0, 0.0, 0.0]
    velocity[axis] = speed
    bench.ground.heard.clear()
    bench.keep_telling(5.0, velocity=tuple(velocity), yaw_rate=0.0)
    told = bench.ground.of("SIM_STATE")
    share = np.array([(m.vn, m.ve)[axis] for m in told]) / speed
    t = 0.02 * np.arange(len(share))
    reached = [float(t[np.argmax(share >= part)]) for part in (0.10, 0.63, 0.90)]
    # The table's own steps are 0.02 s, and a set point is heard up to as much later.
    assert reached == pytest.approx(times, rel=0.15, abs=0.04)
    assert share.max() - 1.0 == pytest.approx(overshoot, abs=0.035)


@pytest.mark.parametrize(("told", "got"), [(0.3, 0.3), (1.0, 1.0), (2.0, 1.05)])
def test_a_commanded_yaw_rate_is_limited_and_overshoots_as_arducopters_does(told, got):
    bench = GuidedBench()
    bench.climb()
    bench.ground.ask(ardupilotmega.MAVLINK_MSG_ID_SIM_STATE, 50.0, bench.now)
    bench.ground.heard.clear()
    bench.keep_telling(4.0, velocity=(0.0, 0.0, 0.0), yaw_rate=told)
    rates = np.array([m.zgyro for m in bench.ground.of("SIM_STATE")])
    assert rates[-25:].mean() == pytest.approx(got, rel=0.03)
    assert rates.max() == pytest.approx(1.2 * got, rel=0.03)


def test_silence_keeps_the_last_velocity_for_three_seconds_and_then_brakes():
    bench = GuidedBench()
    bench.climb()
    bench.keep_telling(4.0, velocity=(2.0, 0.0, 0.0))
    bench.run(2.8)
    assert bench.drone.state(bench.now).velocity[0] == pytest.approx(2.0, rel=0.03)
    bench.run(3.0)
    assert abs(bench.drone.state(bench.now).velocity[0]) < 0.1


def test_a_go_to_turns_the_nose_to_the_way_point_unless_it_says_where_to_look():
    bench = GuidedBench()
    bench.climb()
    bench.set_point(position=(0.0, 8.0, -5.0))
    bench.run(12.0)
    np.testing.assert_allclose(bench.local(), (0.0, 8.0, -5.0), atol=0.1)
    assert bench.drone.state(bench.now).yaw == pytest.approx(math.pi / 2.0, abs=0.05)
    bench.set_point(position=(0.0, 0.0, -5.0), yaw=math.pi / 2.0)
    bench.run(12.0)
    np.testing.assert_allclose(bench.local(), (0.0, 0.0, -5.0), atol=0.1)
    assert bench.drone.state(bench.now).yaw == pytest.approx(math.pi / 2.0, abs=0.05)


def test_offsets_begin_where_the_drone_is_and_those_of_the_body_follow_its_nose():
    bench = GuidedBench()
    bench.climb()
    bench.set_point(position=(3.0, 0.0, 0.0), frame=ardupilotmega.MAV_FRAME_BODY_OFFSET_NED)
    bench.run(10.0)
    ahead = np.array((3.0 * math.cos(YAW), 3.0 * math.sin(YAW), -5.0))
    np.testing.assert_allclose(bench.local(), ahead, atol=0.1)
    bench.set_point(position=(0.0, 2.0, -1.0), frame=ardupilotmega.MAV_FRAME_LOCAL_OFFSET_NED)
    bench.run(10.0)
    np.testing.assert_allclose(bench.local(), np.add(ahead, (0.0, 2.0, -1.0)), atol=0.15)
    yaw = bench.drone.state(bench.now).yaw
    bench.keep_telling(4.0, velocity=(1.0, 0.0, 0.0), frame=ardupilotmega.MAV_FRAME_BODY_NED)
    speed = np.array(bench.drone.state(bench.now).velocity)
    np.testing.assert_allclose(speed, (math.cos(yaw), math.sin(yaw), 0.0), atol=0.05)


@pytest.mark.parametrize("mode", [LOITER, BRAKE])
def test_a_mode_that_holds_stops_it_where_it_is(mode):
    bench = GuidedBench()
    bench.climb()
    bench.keep_telling(4.0, velocity=(2.0, 0.0, 0.0))
    assert bench.mode(mode) == ACCEPTED
    bench.run(4.0)
    assert abs(bench.drone.state(bench.now).velocity[0]) < 0.05
    there = bench.local()
    bench.run(3.0)
    np.testing.assert_allclose(bench.local(), there, atol=0.1)


def test_a_place_on_the_earth_is_flown_to_by_both_of_its_messages():
    bench = GuidedBench()
    bench.climb()
    lat, lon = (round(1e7 * math.degrees(angle)) for angle in SCENARIO_ORIGIN[:2])
    frame = ardupilotmega.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT
    ignore = 0b110111111000
    bench.ground.send(
        ardupilotmega.MAVLink_set_position_target_global_int_message(
            0, 1, 1, frame, ignore, lat, lon, 6.0, 0, 0, 0, 0, 0, 0, 0, 0
        ),
        bench.now,
    )
    bench.run(12.0)
    np.testing.assert_allclose(bench.drone.state(bench.now).position, (0.0, 0.0, -6.0), atol=0.1)
    to = ardupilotmega.MAVLink_command_int_message(
        1, 1, frame, ardupilotmega.MAV_CMD_DO_REPOSITION, 0, 0, -1, 1, 0, math.nan, lat + 450, lon, 4.0
    )
    bench.ground.send(to, bench.now)
    bench.run(12.0)
    np.testing.assert_allclose(bench.drone.state(bench.now).position, (5.0, 0.0, -4.0), atol=0.1)
    assert bench.ground.of("COMMAND_ACK")[-1].result == ACCEPTED


def test_a_commanded_heading_is_turned_to_and_kept():
    bench = GuidedBench()
    bench.climb()
    assert bench.order(ardupilotmega.MAV_CMD_CONDITION_YAW, 90.0, 30.0, 1.0, 0.0) == ACCEPTED
    bench.run(5.0)
    assert bench.drone.state(bench.now).yaw == pytest.approx(math.pi / 2.0, abs=0.02)
    bench.order(ardupilotmega.MAV_CMD_CONDITION_YAW, -45.0, 30.0, 1.0, 1.0)
    bench.run(5.0)
    assert bench.drone.state(bench.now).yaw == pytest.approx(math.pi / 4.0, abs=0.02)
    np.testing.assert_allclose(bench.local(), (0.0, 0.0, -5.0), atol=0.1)


# ── by its own estimate ──────────────────────────────────────────────────────────────────────────────────────────────


def off_by(
    heading: float = 0.0, local: Triple = (0.0, 0.0, 0.0), earth: Triple = (0.0, 0.0, 0.0)
) -> Callable[[LastingErrors], LastingErrors]:
    return lambda own: LastingErrors(lambda t: heading, local, earth)


def test_what_it_says_of_itself_is_what_it_was_told_and_where_it_is_is_off_by_its_errors():
    bench = GuidedBench(flies_by=lambda own: own)
    bench.climb()
    bench.run(25.0)
    bench.set_point(position=(3.0, 6.0, -5.0), yaw=1.0)
    bench.run(15.0)
    asked = (
        ardupilotmega.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        ardupilotmega.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
    )
    for message in asked:
        bench.ground.ask(message, 50.0, bench.now)
    bench.run(2.0)
    says = np.mean([(m.x, m.y, m.z) for m in bench.ground.of("LOCAL_POSITION_NED")], axis=0)
    attitude = [(m.q1, m.q2, m.q3, m.q4) for m in bench.ground.of("ATTITUDE_QUATERNION")]
    heading = np.mean([rotation.to_euler(rotation.from_quaternion(np.array(q)))[2] for q in attitude])
    np.testing.assert_allclose(says, (3.0, 6.0, -5.0), atol=0.02)
    assert heading == pytest.approx(1.0, abs=0.005)
    off = bench.errors.heading(bench.now)
    assert abs(off) > 0.005, "or it proves nothing"
    assert abs(bench.errors.local[2]) > 0.04
    np.testing.assert_allclose(bench.local() + bench.errors.local, (3.0, 6.0, -5.0), atol=0.01)
    assert bench.drone.state(bench.now).yaw == pytest.approx(1.0 - off, abs=0.002)


def test_an_error_of_the_heading_turns_its_nose_and_what_is_told_ahead_of_it_but_not_its_way_north():
    bench = GuidedBench(flies_by=off_by(heading=0.1))
    bench.climb()
    assert bench.drone.state(bench.now).yaw == pytest.approx(YAW)
    bench.set_point(position=(0.0, 8.0, -5.0))
    bench.run(12.0)
    np.testing.assert_allclose(bench.local(), (0.0, 8.0, -5.0), atol=0.1)
    assert bench.drone.state(bench.now).yaw == pytest.approx(math.pi / 2.0 - 0.1, abs=0.05)
    bench.order(ardupilotmega.MAV_CMD_CONDITION_YAW, 45.0, 30.0, 1.0, 0.0)
    bench.keep_telling(5.0, velocity=(1.0, 0.0, 0.0), yaw=0.0)
    np.testing.assert_allclose(bench.drone.state(bench.now).velocity, (1.0, 0.0, 0.0), atol=0.02)
    assert bench.drone.state(bench.now).yaw == pytest.approx(-0.1, abs=0.01)
    bench.keep_telling(5.0, velocity=(1.0, 0.0, 0.0), frame=ardupilotmega.MAV_FRAME_BODY_NED)
    np.testing.assert_allclose(bench.drone.state(bench.now).velocity, (1.0, 0.0, 0.0), atol=0.02)


def test_when_its_heading_steps_it_turns_to_the_heading_that_it_was_told_and_without_one_it_stays():
    step_at = 20.0
    noses = []
    for told in (True, False):
        bench = GuidedBench(
            flies_by=lambda own: own._replace(heading=lambda t: 0.05 if t < step_at else -0.02)
        )
        bench.climb()
        if told:
            bench.order(ardupilotmega.MAV_CMD_CONDITION_YAW, 90.0, 30.0, 1.0, 0.0)
        bench.run(step_at - 1.0 - bench.now)
        before = bench.drone.state(bench.now).yaw
        bench.run(5.0)
        noses.append((before, bench.drone.state(bench.now).yaw))
    assert noses[0] == pytest.approx((math.pi / 2.0 - 0.05, math.pi / 2.0 + 0.02), abs=0.002)
    assert noses[1] == pytest.approx((YAW, YAW), abs=1e-6)


def test_a_place_on_the_earth_is_where_its_gps_says_and_a_height_above_home_where_its_local_frame_does():
    bench = GuidedBench(flies_by=off_by(local=(0.0, 0.0, 0.1), earth=(0.8, -0.5, 1.5)))
    bench.climb()
    assert bench.local()[2] == pytest.approx(-5.1, abs=0.03)
    lat, lon = (round(1e7 * math.degrees(angle)) for angle in SCENARIO_ORIGIN[:2])
    frames = ardupilotmega.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT, ardupilotmega.MAV_FRAME_GLOBAL_INT
    for frame, height, down in zip(frames, (6.0, SCENARIO_ORIGIN.height + 6.0), (-6.1, -7.5), strict=True):
        bench.ground.send(
            ardupilotmega.MAVLink_set_position_target_global_int_message(
                0, 1, 1, frame, 0b110111111000, lat, lon, height, 0, 0, 0, 0, 0, 0, 0, 0
            ),
            bench.now,
        )
        bench.run(15.0)
        np.testing.assert_allclose(bench.drone.state(bench.now).position, (-0.8, 0.5, down), atol=0.1)


def test_it_lands_where_it_is_stands_still_there_and_can_fly_again():
    bench = GuidedBench(sway=wander(np.random.default_rng(1)))
    bench.climb()
    bench.set_point(position=(3.0, 1.0, -5.0))
    bench.run(8.0)
    assert bench.land() == ACCEPTED
    bench.until(lambda: not bench.pilot.armed)
    resting = [bench.drone.motion(bench.now - s) for s in (0.0, 0.5)]
    np.testing.assert_array_equal(resting[0].position, resting[1].position)
    np.testing.assert_allclose(resting[0].position - START, (3.0, 1.0, 0.0), atol=0.1)
    np.testing.assert_array_equal(resting[0].body_rate, 0.0)
    bench.climb(3.0)
    assert bench.local()[2] == pytest.approx(-3.0, abs=0.05)


def test_a_battery_that_fails_takes_it_up_home_and_down_whoever_steers_until_its_pilot_takes_it():
    bench = GuidedBench()
    bench.climb()
    bench.set_point(position=(6.0, 3.0, -5.0))
    bench.run(8.0)
    begin_fault(FaultKind.LOW_BATTERY, bench.autopilot, bench.now)
    heights = []
    while bench.pilot.armed:
        # An agent that goes on is not obeyed.
        bench.keep_telling(0.5, velocity=(2.0, 0.0, 0.0))
        assert bench.pilot.mode.custom == RTL
        heights.append(-bench.local()[2])
    assert any("Battery" in text for text in bench.texts)
    assert max(heights) == pytest.approx(15.0, abs=0.6)
    np.testing.assert_allclose(bench.local(), 0.0, atol=0.6)
    assert bench.arm() == FAILED
    bench.climb()
    begin_fault(FaultKind.LOW_BATTERY, bench.autopilot, bench.now)
    bench.run(3.0)
    assert bench.mode(LOITER) == ACCEPTED
    bench.run(4.0)
    here = bench.local()
    bench.run(2.0)
    np.testing.assert_allclose(bench.local(), here, atol=0.05)


def test_without_a_position_none_is_told_and_it_lands_where_it_is():
    bench = GuidedBench()
    bench.climb()
    bench.ground.ask(ardupilotmega.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 10.0, bench.now)
    bench.ground.ask(ardupilotmega.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, 10.0, bench.now)
    bench.run(1.0)
    begin_fault(FaultKind.POSITION_LOSS, bench.autopilot, bench.now)
    bench.ground.heard.clear()
    bench.run(0.9)
    assert bench.pilot.mode.custom == GUIDED
    bench.run(3.0)
    assert bench.pilot.mode.custom == LAND
    assert bench.ground.of("LOCAL_POSITION_NED") == []
    assert len(bench.ground.of("ATTITUDE_QUATERNION")) == pytest.approx(39, abs=2)
    assert bench.mode(GUIDED) == FAILED
    end_fault(FaultKind.POSITION_LOSS, bench.autopilot, bench.now)
    bench.run(1.0)
    assert len(bench.ground.of("LOCAL_POSITION_NED")) == pytest.approx(10, abs=2)
    assert bench.mode(GUIDED) == ACCEPTED


def test_its_past_stays_as_it_was_seen():
    """A frame is drawn after its exposure, and a judge looks back: both must see what the sensors saw."""
    bench = GuidedBench(sway=wander(np.random.default_rng(2)))
    bench.climb()
    bench.set_point(position=(5.0, 5.0, -6.0))
    seen = []
    for _ in range(100):
        bench.run(0.05)
        seen.append((bench.now - 0.013, bench.drone.motion(bench.now - 0.013)))
    bench.land()
    bench.run(2.0)
    for t, motion in seen:
        again = bench.drone.motion(t)
        for before, after in zip(motion, again, strict=True):
            np.testing.assert_array_equal(before, after)


def test_its_gyro_is_the_derivative_of_its_attitude_and_its_velocity_of_its_place():
    bench = GuidedBench(sway=wander(np.random.default_rng(4)))
    bench.climb(2.0)
    began = bench.now
    bench.set_point(position=(6.0, -6.0, -4.0))
    bench.run(6.0)
    h = 1e-3
    times = np.arange(began, began + 5.0, h)
    motions = [bench.drone.motion(t) for t in times]
    attitude, position = motions[0].attitude, motions[0].position
    for before, after in itertools.pairwise(motions):
        attitude = attitude @ rotation.exp(h * (before.body_rate + after.body_rate) / 2.0)
        position = position + h * (before.velocity + after.velocity) / 2.0
    assert max(np.linalg.norm(motion.body_rate) for motion in motions) > 0.8
    assert np.linalg.norm(rotation.log(attitude.T @ motions[-1].attitude)) < 2e-3
    np.testing.assert_allclose(position, motions[-1].position, atol=1e-3)


def test_in_the_air_it_sways_and_on_the_ground_it_does_not():
    bench = GuidedBench(sway=wander(np.random.default_rng(5), amplitude=0.05))
    bench.run(2.0)
    np.testing.assert_array_equal(bench.drone.position(bench.now), START)
    bench.climb()
    places = np.array([bench.drone.position(bench.now - s) for s in np.linspace(0.0, 3.0, 30)])
    assert 0.005 < places.std(axis=0).max() < 0.2


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_set_point_that_is_no_number_is_not_flown(bad):
    bench = GuidedBench()
    bench.climb()
    bench.set_point(position=(bad, 0.0, -5.0))
    bench.set_point(velocity=(0.0, bad, 0.0))
    bench.set_point(position=(1.0, 1.0, -5.0), frame=ardupilotmega.MAV_FRAME_LOCAL_FRD)
    bench.run(3.0)
    np.testing.assert_allclose(bench.local(), (0.0, 0.0, -5.0), atol=0.05)


def test_what_it_cannot_do_is_answered_and_a_command_for_another_is_not():
    bench = GuidedBench()
    assert bench.order(ardupilotmega.MAV_CMD_DO_PARACHUTE, 2.0) == ardupilotmega.MAV_RESULT_UNSUPPORTED
    assert bench.mode(77) == FAILED
    heard = len(bench.ground.of("COMMAND_ACK"))
    bench.ground.command(ardupilotmega.MAV_CMD_COMPONENT_ARM_DISARM, 1.0, now=bench.now, system=9)
    bench.run(0.1)
    assert len(bench.ground.of("COMMAND_ACK")) == heard
    assert not bench.pilot.armed


def test_it_reboots_on_command_on_the_ground_and_not_in_the_air():
    bench = GuidedBench()
    reboot = ardupilotmega.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN
    assert bench.order(reboot, 1.0) == ACCEPTED
    bench.run(1.0)
    assert bench.autopilot.stamp(bench.now) == pytest.approx(0.5, abs=0.1)
    bench.both_say_hello()
    bench.run(FINDS_ITSELF_S)
    bench.climb()
    assert bench.order(reboot, 1.0) == ardupilotmega.MAV_RESULT_DENIED


def test_every_phase_is_reached_from_the_ground_and_leads_back_and_no_motor_stops_in_the_air():
    def reached(phase: Phase) -> set[Phase]:
        found = {phase}
        while more := {after for (before, _), after in PHASE_TRANSITIONS.items() if before in found} - found:
            found |= more
        return found

    assert reached(Phase.ON_GROUND) == set(Phase)
    assert all(Phase.ON_GROUND in reached(phase) for phase in Phase)
    disarmed = {before for (before, event) in PHASE_TRANSITIONS if event is PilotEvent.DISARM}
    assert not disarmed & {Phase.CLIMBING, Phase.FLYING, Phase.LANDING}
