"""The simulated autopilot as foreign software meets it: pymavlink on each of its ports, in simulated time."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega

from support.ground_station import GROUND_STATION, Bench
from swarmtrack.geometry import rotation
from swarmtrack.geometry.geodesy import Geodetic, to_ned
from swarmtrack.lab.autopilots.autopilot import SimulatedArduPilot
from swarmtrack.lab.autopilots.pilot import OnItsPath
from swarmtrack.lab.autopilots.senses import DroneSenses
from swarmtrack.lab.autopilots.truth import DroneTruth
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.scenario import SCENARIO_ORIGIN
from swarmtrack.lab.world.world import World


@pytest.fixture
def world() -> World:
    return load_scenario("crossing", seed=3).world


def flying(world: World, drone_id: int = 1) -> SimulatedArduPilot:
    return SimulatedArduPilot(
        DroneSenses(world, drone_id, 0.0, earth=SCENARIO_ORIGIN),
        truth=DroneTruth(world, drone_id, 0.0, SCENARIO_ORIGIN),
        boot_at=-40.0,
    )


# ── ports ────────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_each_port_has_streams_of_its_own_and_an_answer_goes_to_who_asked(world):
    bench = Bench(flying(world))
    bench.both_say_hello()
    bench.companion.ask(ardupilotmega.MAVLINK_MSG_ID_HIGHRES_IMU, 200.0, bench.now)
    bench.ground.ask(ardupilotmega.MAVLINK_MSG_ID_HIGHRES_IMU, 10.0, bench.now)
    bench.ground.ask(ardupilotmega.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 4.0, bench.now)
    bench.run(5.0)
    assert len(bench.companion.of("HIGHRES_IMU")) == pytest.approx(1000, abs=2)
    assert len(bench.ground.of("HIGHRES_IMU")) == pytest.approx(50, abs=2)
    assert len(bench.ground.of("LOCAL_POSITION_NED")) == pytest.approx(20, abs=2)
    assert bench.companion.of("LOCAL_POSITION_NED") == []
    assert len(bench.companion.of("COMMAND_ACK")) == 1
    assert len(bench.ground.of("COMMAND_ACK")) == 2


def test_each_port_counts_its_own_frames_without_a_gap(world):
    bench = Bench(flying(world))
    bench.companion.ask(ardupilotmega.MAVLINK_MSG_ID_HIGHRES_IMU, 200.0, bench.now)
    bench.ground.ask(ardupilotmega.MAVLINK_MSG_ID_HIGHRES_IMU, 50.0, bench.now)
    bench.run(3.0)
    for peer in (bench.companion, bench.ground):
        numbers = [m.get_seq() for m in peer.heard]
        assert len(numbers) > 100
        assert all((after - before) % 256 == 1 for before, after in itertools.pairwise(numbers))


def test_what_the_companion_says_to_all_is_heard_at_the_other_port_as_it_was_sent(world):
    bench = Bench(flying(world))
    text = ardupilotmega.MAVLink_statustext_message(5, b"swarmtrack: ready, drone 1")
    bench.companion.send(text, bench.now)
    bench.run(0.1)
    assert bench.ground.of("STATUSTEXT") == [], "nobody has spoken there yet"
    bench.both_say_hello()
    bench.both_say_hello()
    bench.companion.send(text, bench.now)
    bench.run(0.1)
    (heard,) = bench.ground.of("STATUSTEXT")
    assert (heard.get_srcSystem(), heard.get_srcComponent(), heard.text) == (
        1,
        191,
        "swarmtrack: ready, drone 1",
    )
    assert {m.get_srcComponent() for m in bench.ground.of("HEARTBEAT")} == {1, 191}
    assert bench.companion.of("STATUSTEXT") == []


def test_what_is_addressed_to_the_other_side_is_handed_on_and_what_is_for_the_autopilot_is_not(world):
    bench = Bench(flying(world))
    bench.both_say_hello()
    bench.run(0.1)
    request = ardupilotmega.MAVLink_command_long_message(1, 191, 512, 0, *[0.0] * 7)
    bench.ground.send(request, bench.now)
    bench.ground.ask(ardupilotmega.MAVLINK_MSG_ID_HIGHRES_IMU, 10.0, bench.now)
    bench.run(0.1)
    assert [m.target_component for m in bench.companion.of("COMMAND_LONG")] == [191]
    assert len(bench.ground.of("COMMAND_ACK")) == 1, "of its own command; the companion answers the other"
    ack = ardupilotmega.MAVLink_command_ack_message(
        512, 0, target_system=GROUND_STATION, target_component=190
    )
    bench.companion.send(ack, bench.now)
    bench.run(0.1)
    assert bench.ground.of("COMMAND_ACK")[-1].get_srcComponent() == 191


def test_a_time_is_told_to_who_asked_for_it_and_the_question_is_everybodys(world):
    bench = Bench(flying(world), now=2.0)
    bench.both_say_hello()
    bench.run(0.1)
    bench.ground.send(ardupilotmega.MAVLink_timesync_message(0, 77), bench.now)
    bench.run(0.1)
    (answer,) = bench.ground.of("TIMESYNC")
    assert (answer.ts1, answer.tc1 * 1e-9) == (77, pytest.approx(42.1))
    assert [(m.ts1, m.tc1) for m in bench.companion.of("TIMESYNC")] == [(77, 0)]


def test_a_reboot_forgets_the_streams_of_both_ports(world):
    bench = Bench(flying(world))
    for peer in (bench.companion, bench.ground):
        peer.ask(ardupilotmega.MAVLINK_MSG_ID_HIGHRES_IMU, 50.0, bench.now)
    bench.run(1.0)
    bench.autopilot.reboot(bench.now)
    for peer in (bench.companion, bench.ground):
        peer.heard.clear()
    bench.run(1.5)
    for peer in (bench.companion, bench.ground):
        assert {m.get_type() for m in peer.heard} == {"HEARTBEAT"}


def test_a_ground_station_asks_for_groups_of_messages_too(world):
    bench = Bench(flying(world))
    request = ardupilotmega.MAVLink_request_data_stream_message
    bench.ground.send(request(1, 1, ardupilotmega.MAV_DATA_STREAM_POSITION, 4, 1), bench.now)
    bench.run(2.0)
    assert {m.get_type() for m in bench.ground.heard} == {
        "HEARTBEAT",
        "GLOBAL_POSITION_INT",
        "LOCAL_POSITION_NED",
    }
    assert len(bench.ground.of("LOCAL_POSITION_NED")) == pytest.approx(8, abs=1)
    bench.ground.send(request(1, 1, ardupilotmega.MAV_DATA_STREAM_ALL, 2, 1), bench.now)
    bench.run(2.0)
    kinds = {m.get_type() for m in bench.ground.heard}
    assert {"ATTITUDE", "RAW_IMU", "GPS_RAW_INT", "EXTENDED_SYS_STATE"} <= kinds
    assert {m.get_type() for m in bench.companion.heard} == {"HEARTBEAT"}
    bench.ground.send(request(1, 1, ardupilotmega.MAV_DATA_STREAM_ALL, 2, 0), bench.now)
    bench.ground.heard.clear()
    bench.run(2.0)
    assert {m.get_type() for m in bench.ground.heard} == {"HEARTBEAT"}


# ── truth ────────────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("port", ["companion", "ground"])
def test_sim_state_tells_the_true_pose_to_a_centimetre_with_the_stamp_of_the_attitude_beside_it(world, port):
    bench = Bench(flying(world), now=10.0)
    peer = getattr(bench, port)
    peer.ask(ardupilotmega.MAVLINK_MSG_ID_SIM_STATE, 50.0, bench.now)
    peer.ask(ardupilotmega.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, 50.0, bench.now)
    bench.run(6.0)
    told = [m for m in peer.heard if m.get_type() in ("SIM_STATE", "ATTITUDE_QUATERNION")]
    pairs = list(zip(told[::2], told[1::2], strict=True))
    assert len(pairs) == pytest.approx(300, abs=2)
    drone = world.drones[1]
    errors = []
    for true, estimate in pairs:
        assert (true.get_type(), estimate.get_type()) == ("SIM_STATE", "ATTITUDE_QUATERNION")
        motion = drone.motion(estimate.time_boot_ms * 1e-3 - 40.0)
        place = Geodetic.from_degrees(1e-7 * true.lat_int, 1e-7 * true.lon_int, true.alt)
        np.testing.assert_allclose(to_ned(place, SCENARIO_ORIGIN), motion.position, atol=0.015)
        np.testing.assert_allclose((true.vn, true.ve, true.vd), motion.velocity, atol=1e-5)
        np.testing.assert_allclose((true.xgyro, true.ygyro, true.zgyro), motion.body_rate, atol=1e-5)
        q = np.array((true.q1, true.q2, true.q3, true.q4))
        np.testing.assert_allclose(rotation.from_quaternion(q), motion.attitude, atol=1e-5)
        roll, pitch, yaw = rotation.to_euler(motion.attitude)
        np.testing.assert_allclose((true.roll, true.pitch, true.yaw), (roll, pitch, yaw), atol=1e-5)
        estimated = np.array((estimate.q1, estimate.q2, estimate.q3, estimate.q4))
        errors.append(rotation.log(motion.attitude.T @ rotation.from_quaternion(estimated)))
    assert np.linalg.norm(errors, axis=1).max() > 1e-3, "the attitude is an estimate, the truth is not"


def test_an_autopilot_without_a_simulator_around_it_knows_no_truth(world):
    bench = Bench(SimulatedArduPilot(DroneSenses(world, 1, 0.0)))
    bench.companion.ask(ardupilotmega.MAVLINK_MSG_ID_SIM_STATE, 50.0, bench.now)
    bench.run(0.5)
    (ack,) = bench.companion.of("COMMAND_ACK")
    assert ack.result == ardupilotmega.MAV_RESULT_DENIED
    assert bench.companion.of("SIM_STATE") == []


def test_a_single_message_comes_on_request(world):
    bench = Bench(flying(world), now=10.0)
    bench.ground.command(
        ardupilotmega.MAV_CMD_REQUEST_MESSAGE, ardupilotmega.MAVLINK_MSG_ID_GPS_RAW_INT, now=10.0
    )
    bench.run(0.5)
    (fix,) = bench.ground.of("GPS_RAW_INT")
    assert fix.lat * 1e-7 == pytest.approx(math.degrees(SCENARIO_ORIGIN.latitude), abs=1e-3)
    assert [m.result for m in bench.ground.of("COMMAND_ACK")] == [ardupilotmega.MAV_RESULT_ACCEPTED]


# ── parameters ───────────────────────────────────────────────────────────────────────────────────────────────────────


def parameters_told(bench: Bench, message: Any) -> list[tuple[str, float, int, int]]:
    bench.ground.heard.clear()
    bench.ground.send(message, bench.now)
    bench.run(0.05)
    assert bench.companion.of("PARAM_VALUE") == []
    return [(m.param_id, m.param_value, m.param_type, m.param_index) for m in bench.ground.of("PARAM_VALUE")]


def test_a_parameter_is_told_by_name_or_by_number_to_who_asked_and_an_unknown_one_is_passed_over(world):
    bench = Bench(flying(world))
    read = ardupilotmega.MAVLink_param_request_read_message
    whole, real = ardupilotmega.MAV_PARAM_TYPE_INT32, ardupilotmega.MAV_PARAM_TYPE_REAL32
    assert parameters_told(bench, read(1, 1, b"INS_GYRO_FILTER", -1)) == [
        ("INS_GYRO_FILTER", 20.0, whole, 65535)
    ]
    assert parameters_told(bench, read(1, 1, b"GUID_TIMEOUT", -1)) == [("GUID_TIMEOUT", 3.0, real, 65535)]
    everything = parameters_told(bench, ardupilotmega.MAVLink_param_request_list_message(1, 1))
    assert [index for *_, index in everything] == list(range(len(everything)))
    assert parameters_told(bench, read(1, 1, b"", 2)) == [everything[2]]
    for unknown in (read(1, 1, b"IMU_GYRO_CUTOFF", -1), read(1, 1, b"", 99), read(7, 1, b"GUID_TIMEOUT", -1)):
        assert parameters_told(bench, unknown) == []


def test_a_parameter_is_not_written_and_the_attempt_is_counted(world):
    bench = Bench(flying(world))
    write = ardupilotmega.MAVLink_param_set_message(1, 1, b"INS_GYRO_FILTER", 80.0, 9)
    assert parameters_told(bench, write) == []
    assert bench.autopilot.parameters.written == 1
    read = ardupilotmega.MAVLink_param_request_read_message(1, 1, b"INS_GYRO_FILTER", -1)
    assert [value for _, value, *_ in parameters_told(bench, read)] == [20.0]


# ── a flight by plan ─────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_drone_that_takes_off_by_plan_is_armed_before_and_flies_from_then_on(world):
    bench = Bench(SimulatedArduPilot(DroneSenses(world, 1, 0.0), pilot=OnItsPath(takes_off_at=6.0)))
    bench.companion.ask(ardupilotmega.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, 1.0, bench.now)
    told = {}
    for second in range(10):
        bench.run(1.0)
        beat, state = bench.companion.of("HEARTBEAT")[-1], bench.companion.of("EXTENDED_SYS_STATE")[-1]
        told[second] = (bool(beat.base_mode & 128), beat.system_status, state.landed_state)
    standby, active = ardupilotmega.MAV_STATE_STANDBY, ardupilotmega.MAV_STATE_ACTIVE
    ground, air = ardupilotmega.MAV_LANDED_STATE_ON_GROUND, ardupilotmega.MAV_LANDED_STATE_IN_AIR
    assert (told[1], told[4], told[8]) == (
        (False, standby, ground),
        (True, standby, ground),
        (True, active, air),
    )
