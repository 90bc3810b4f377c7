"""The simulated PX4: rates, clock and flight as they were measured on one (px4.md), with pymavlink as the judge."""

from __future__ import annotations

import math
import struct
from collections import Counter

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega

from support.ground_station import Bench
from swarmtrack.geometry import rotation
from swarmtrack.geometry.geodesy import Geodetic, to_ned
from swarmtrack.lab.autopilots.firmware import ARDUCOPTER, PX4_FIRMWARE, FlightMode
from swarmtrack.lab.autopilots.pilot import GuidedPilot
from swarmtrack.lab.autopilots.px4 import SimulatedPx4
from swarmtrack.lab.autopilots.senses import NO_ERRORS, DroneSenses
from swarmtrack.lab.autopilots.truth import DroneTruth
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.scenario import SCENARIO_ORIGIN, FaultKind
from swarmtrack.lab.swarm.hardware import begin_fault
from swarmtrack.lab.world.guided import GuidedDrone
from swarmtrack.lab.world.response import SetPoint, advance, at_rest
from swarmtrack.lab.world.trajectory import Hover, attitude_and_rate
from swarmtrack.lab.world.world import World
from swarmtrack.messages import Array

ACCEPTED, REJECTED = ardupilotmega.MAV_RESULT_ACCEPTED, ardupilotmega.MAV_RESULT_TEMPORARILY_REJECTED
IMU = ardupilotmega.MAVLINK_MSG_ID_HIGHRES_IMU
OFFBOARD, AUTO, TAKEOFF, HOLD, RETURNING, LANDING = 6, 4, 2, 3, 5, 6


def hovering(**options) -> Bench:
    world = load_scenario("crossing", seed=3).world
    autopilot = SimulatedPx4(
        DroneSenses(world, 1, 0.0, earth=SCENARIO_ORIGIN),
        truth=DroneTruth(world, 1, 0.0, SCENARIO_ORIGIN),
        **options,
    )
    return Bench(autopilot)


def steps_ms(bench: Bench, hz: float, seconds: float = 4.0) -> list[int]:
    """From sample to sample of the IMU, as stamped, after it was asked for."""
    bench.companion.ask(IMU, hz, bench.now)
    bench.run(0.5)
    bench.companion.heard.clear()
    bench.run(seconds)
    stamps = np.array([m.time_usec for m in bench.companion.of("HIGHRES_IMU")])
    return np.rint(np.diff(stamps) * 1e-3).astype(int).tolist()


# px4.md, finding 1: Hz asked for and got, at 0.989 of real time.
@pytest.mark.parametrize(("asked", "got"), [(50, 49), (200, 124), (300, 241), (400, 241), (1000, 241)])
def test_in_lockstep_the_rates_are_those_that_were_measured(asked, got):
    bench = hovering(lockstep=True, skew=-0.011)
    steps = steps_ms(bench, asked)
    assert len(steps) / 4.0 == pytest.approx(got, rel=0.03)
    assert all(step % 4 == 0 for step in steps)


@pytest.mark.parametrize("asked", [200, 250])
def test_an_interval_of_integration_is_of_whole_samples_and_the_sender_leaves_some_out(asked):
    bench = hovering()
    bench.companion.ask(IMU, asked, bench.now)
    bench.run(4.0)
    stamps = [m.time_usec for m in bench.companion.of("HIGHRES_IMU")][asked:]
    # 800 Hz, three at a time.
    steps = Counter(np.diff(stamps).tolist())
    assert set(steps) == {3750, 7500}
    left_out = 1.0 - asked / (1e6 / 3750)
    assert steps[7500] / (len(stamps) - 1 + steps[7500]) == pytest.approx(left_out, abs=0.01)


@pytest.mark.parametrize(
    ("rate", "asked", "got"), [(200, 200, 200), (250, 250, 250), (200, 400, 200), (400, 400, 400)]
)
def test_on_a_real_clock_it_sends_what_is_asked_up_to_the_rate_of_its_samples(rate, asked, got):
    bench = hovering()
    bench.autopilot.parameters.values["IMU_INTEG_RATE"] = rate
    assert len(steps_ms(bench, asked)) / 4.0 == pytest.approx(got, abs=1.0)


def test_it_streams_unasked_and_goes_back_to_that_on_request():
    bench = hovering()
    bench.run(2.0)
    kinds = Counter(m.get_type() for m in bench.companion.heard)
    assert kinds["HIGHRES_IMU"] == pytest.approx(100, abs=2)
    assert kinds["ATTITUDE_QUATERNION"] == pytest.approx(100, abs=2)
    assert bench.ground.of("HIGHRES_IMU") == []
    bench.companion.ask(IMU, 200.0, bench.now)
    bench.run(1.0)
    bench.companion.command(ardupilotmega.MAV_CMD_SET_MESSAGE_INTERVAL, IMU, 0.0, now=bench.now)
    bench.companion.heard.clear()
    bench.run(2.0)
    assert len(bench.companion.of("HIGHRES_IMU")) == pytest.approx(100, abs=2)
    bench.companion.command(ardupilotmega.MAV_CMD_SET_MESSAGE_INTERVAL, IMU, -1.0, now=bench.now)
    bench.run(0.1)
    bench.companion.heard.clear()
    bench.run(1.0)
    assert bench.companion.of("HIGHRES_IMU") == []


def test_its_clock_runs_slow_where_the_simulator_cannot_follow():
    bench = hovering(lockstep=True, skew=-0.011)
    bench.run(10.0)
    bench.ground.send(ardupilotmega.MAVLink_timesync_message(0, 5), bench.now)
    bench.run(0.1)
    assert bench.ground.of("TIMESYNC")[-1].tc1 * 1e-9 == pytest.approx(9.89, abs=0.002)


def test_whole_parameters_come_as_bits():
    bench = hovering()

    def told(name: str) -> tuple[float, int]:
        bench.ground.heard.clear()
        bench.ground.send(
            ardupilotmega.MAVLink_param_request_read_message(1, 1, name.encode(), -1), bench.now
        )
        bench.run(0.05)
        (m,) = bench.ground.of("PARAM_VALUE")
        return m.param_value, m.param_type

    value, kind = told("IMU_INTEG_RATE")
    assert kind == ardupilotmega.MAV_PARAM_TYPE_INT32
    assert struct.unpack("<i", struct.pack("<f", value)) == (250,)
    assert told("IMU_GYRO_CUTOFF") == (40.0, ardupilotmega.MAV_PARAM_TYPE_REAL32)


def test_its_truth_is_not_stamped():
    bench = hovering()
    bench.ground.ask(ardupilotmega.MAVLINK_MSG_ID_HIL_STATE_QUATERNION, 50.0, bench.now)
    bench.ground.ask(ardupilotmega.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, 50.0, bench.now)
    bench.ground.ask(ardupilotmega.MAVLINK_MSG_ID_SIM_STATE, 50.0, bench.now)
    bench.run(6.0)
    drone = load_scenario("crossing", seed=3).world.drones[1]
    told = bench.ground.of("HIL_STATE_QUATERNION")
    assert len(told) == pytest.approx(300, abs=3)
    assert not any(m.time_usec for m in told)
    # Of the same turn of its main loop.
    beside = bench.ground.of("ATTITUDE_QUATERNION")[-len(told) :]
    for m, estimate in zip(told, beside, strict=True):
        motion = drone.motion(estimate.time_boot_ms * 1e-3)
        place = Geodetic.from_degrees(1e-7 * m.lat, 1e-7 * m.lon, 1e-3 * m.alt)
        np.testing.assert_allclose(to_ned(place, SCENARIO_ORIGIN), motion.position, atol=0.015)
        np.testing.assert_allclose((m.vx, m.vy, m.vz), 1e2 * motion.velocity, atol=0.51)
        attitude = rotation.from_quaternion(np.array(m.attitude_quaternion))
        # The stamp beside it is in whole milliseconds.
        np.testing.assert_allclose(attitude, motion.attitude, atol=1e-4)
    assert bench.ground.of("SIM_STATE") == []
    assert bench.ground.of("COMMAND_ACK")[-1].result == ardupilotmega.MAV_RESULT_FAILED


# ── flight ───────────────────────────────────────────────────────────────────────────────────────────────────────────


class Px4Bench(Bench):
    """A PX4 on the ground, and who commands it."""

    def __init__(self) -> None:
        self.drone = GuidedDrone((0.0, 0.0, 0.0), 0.0, PX4_FIRMWARE.response, Hover((0.0, 0.0, 0.0)))
        world = World(3, {1: self.drone})
        self.pilot = GuidedPilot(
            self.drone,
            PX4_FIRMWARE,
            epoch=0.0,
            origin=SCENARIO_ORIGIN,
            located=lambda t: True,
            errors=NO_ERRORS,
        )
        super().__init__(
            SimulatedPx4(
                DroneSenses(world, 1, 0.0), truth=DroneTruth(world, 1, 0.0, SCENARIO_ORIGIN), pilot=self.pilot
            )
        )
        self.both_say_hello()

    @property
    def told_mode(self) -> tuple[int, int]:
        """Of the last heartbeat."""
        custom = [m for m in self.ground.of("HEARTBEAT") if m.get_srcComponent() == 1][-1].custom_mode
        return custom >> 16 & 0xFF, custom >> 24

    def climb(self) -> None:
        self.keep_telling(0.5, position=(0.0, 0.0, -5.0), yaw=0.0)
        assert [self.mode(OFFBOARD), self.arm()] == [ACCEPTED] * 2
        self.keep_telling(8.0, position=(0.0, 0.0, -5.0), yaw=0.0)
        assert self.drone.state(self.now).position[2] == pytest.approx(-5.0, abs=0.1)


def test_offboard_needs_set_points_beforehand_lifts_off_by_them_and_holds_without():
    bench = Px4Bench()
    assert bench.mode(OFFBOARD) == REJECTED
    assert any("Offboard" in text for text in bench.texts)
    bench.climb()
    bench.keep_telling(3.0, velocity=(2.0, 0.0, 0.0))
    assert bench.told_mode == (OFFBOARD, 0)
    assert bench.drone.state(bench.now).velocity[0] > 1.0
    bench.run(2.5)
    assert bench.told_mode == (3, 0)  # POSCTL, as COM_OBL_RC_ACT has it
    assert any("Failsafe" in text for text in bench.texts)
    bench.run(6.0)
    assert abs(bench.drone.state(bench.now).velocity[0]) < 0.3


def test_a_take_off_begins_when_it_is_armed_and_a_landing_disarms():
    bench = Px4Bench()
    assert bench.take_off(SCENARIO_ORIGIN.height + 4.0) == ACCEPTED
    bench.run(1.1)
    assert bench.told_mode == (AUTO, TAKEOFF)
    assert bench.arm() == ACCEPTED
    bench.run(8.0)
    assert bench.drone.state(bench.now).position[2] == pytest.approx(-4.0, abs=0.1)
    assert bench.told_mode == (AUTO, HOLD)
    assert bench.land() == ACCEPTED
    bench.run(1.1)
    assert bench.told_mode == (AUTO, LANDING)
    bench.until(lambda: not bench.pilot.armed)
    assert bench.drone.state(bench.now).position == pytest.approx((0.0, 0.0, 0.0), abs=0.05)


# px4.md: velocity 0 → 5 m/s, of which it had 4.05 after 4 s, and from there to 0: times to 10, 50, 63, 80, 90 %
def test_steps_of_velocity_take_the_time_that_px4_took():
    bench = Px4Bench()
    bench.climb()
    bench.ground.ask(ardupilotmega.MAVLINK_MSG_ID_HIL_STATE_QUATERNION, 50.0, bench.now)
    bench.run(0.1)
    bench.ground.heard.clear()
    bench.keep_telling(4.0, velocity=(5.0, 0.0, 0.0), yaw=0.0)
    bench.keep_telling(4.0, velocity=(0.0, 0.0, 0.0), yaw=0.0)
    speed = 1e-2 * np.array([m.vx for m in bench.ground.of("HIL_STATE_QUATERNION")])
    start, brake = speed[:200], speed[200:]

    def times(share: Array, *parts: float) -> list[float]:
        return [0.02 * float(np.argmax(share >= part)) for part in parts]

    assert times(start / 5.0, 0.10, 0.50, 0.63, 0.80) == pytest.approx(
        (0.27, 0.69, 1.07, 3.6), rel=0.15, abs=0.04
    )
    assert start[-1] == pytest.approx(4.05, abs=0.1)
    assert times(1.0 - brake / start[-1], 0.10, 0.50, 0.63, 0.80, 0.90) == pytest.approx(
        (0.24, 0.52, 0.68, 1.2, 3.2), rel=0.15, abs=0.04
    )


def test_it_turns_at_2_7_rad_per_second_and_keeps_its_heading_on_the_way_to_a_place():
    bench = Px4Bench()
    bench.climb()
    bench.ground.ask(ardupilotmega.MAVLINK_MSG_ID_HIL_STATE_QUATERNION, 50.0, bench.now)
    bench.keep_telling(4.0, position=(0.0, 0.0, -5.0), yaw=math.pi / 2.0)
    assert max(m.yawspeed for m in bench.ground.of("HIL_STATE_QUATERNION")) == pytest.approx(2.7, rel=0.05)
    assert bench.drone.state(bench.now).yaw == pytest.approx(math.pi / 2.0, abs=0.02)
    bench.keep_telling(6.0, position=(6.0, 0.0, -5.0))
    assert bench.drone.state(bench.now).yaw == pytest.approx(math.pi / 2.0, abs=0.02)


def test_it_rolls_and_turns_three_times_as_fast_as_an_arducopter():
    """From 5 m/s to one side to 5 m/s to the other; and half round."""
    peaks = []
    for response in (PX4_FIRMWARE.response, ARDUCOPTER.response):
        state, rates = at_rest(0.0, (0.0, 0.0, -5.0), 0.0), []
        while state.t < 12.0:
            east = 5.0 if state.t < 4.0 else -5.0
            told = SetPoint(state.t, velocity=(0.0, east, 0.0), yaw=0.0 if state.t < 8.0 else 3.0)
            state = advance(state, told, response)
            thrust, jerk = np.array(state.thrust), np.array(state.thrust_jerk)
            rates.append(attitude_and_rate(thrust, jerk, state.yaw, state.yaw_rate)[1])
        peaks.append(np.abs(rates).max(axis=0)[[0, 2]])
    assert peaks[0] == pytest.approx([4.2, 2.7], rel=0.05)
    assert (peaks[0] > 2.0 * peaks[1]).all()


def test_a_failsafe_changes_the_mode_and_not_the_intention():
    bench = Px4Bench()
    bench.climb()
    begin_fault(FaultKind.LOW_BATTERY, bench.autopilot, bench.now)
    bench.keep_telling(2.0, velocity=(0.0, 0.0, 0.0))
    assert bench.told_mode == (AUTO, RETURNING)
    assert bench.pilot.intended == PX4_FIRMWARE.modes[FlightMode.GUIDED]
    assert bench.drone.state(bench.now).velocity[2] < -0.5


def test_it_does_not_know_arducopters_command_to_turn():
    bench = Px4Bench()
    bench.climb()
    turn = bench.order(ardupilotmega.MAV_CMD_CONDITION_YAW, 90.0, 30.0, 1.0, 0.0)
    assert turn == ardupilotmega.MAV_RESULT_UNSUPPORTED
