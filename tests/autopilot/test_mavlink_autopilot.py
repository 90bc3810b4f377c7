"""The autopilot's state machine in simulated time, on real sockets, and on recordings of real autopilots."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import os
import random
import re
import tty
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega, common

from support.autopilot_flight import Flight, Listener, RealFlight
from support.fake_autopilot import FakeAutopilot, FakePx4, imu_report, serve_udp
from support.patience import PATIENCE
from support.places import SHARED
from support.ports import free_port
from swarmtrack.autopilot import links
from swarmtrack.autopilot.address import LinkAddress
from swarmtrack.autopilot.engagement import PilotEngagement
from swarmtrack.autopilot.global_position import GlobalPosition
from swarmtrack.autopilot.mavlink_autopilot import MavlinkAutopilot
from swarmtrack.autopilot.pilot_switch import PilotSwitch
from swarmtrack.autopilot.tlog import records
from swarmtrack.clock import ManualClock
from swarmtrack.diagnosis.sources import AutopilotFacts, check_autopilot
from swarmtrack.errors import SourceError
from swarmtrack.geometry.geodesy import Geodetic
from swarmtrack.lab.autopilots.autopilot import SimulatedArduPilot
from swarmtrack.lab.autopilots.channel import Channel

SHARED = SHARED / "mavlink"
TIMEOUT = 180.0  # s: ends a hang, and says nothing of speed
KEY = bytes(range(32))


async def test_gyro_and_pose_arrive_at_the_rates_asked_in_our_time():
    q = np.array((math.cos(0.5), 0.0, 0.0, math.sin(0.5)))  # yaw 1 rad
    autopilot = FakeAutopilot(boot_at=60.0, skew=90e-6)
    autopilot.q, autopilot.velocity = q, np.array((10.0, 0.0, 0.0))
    async with Flight(autopilot) as flight:
        flight.fly(20.0)
        status = flight.unit.status()
        assert status.ok
        assert "streaming: IMU 200 Hz asked, 200 Hz got from HIGHRES_IMU" in status.text
        assert flight.count["imu_rate_hz"] == pytest.approx(200.0, abs=1.0)
        assert flight.count["imu_lost"] == flight.count["gaps"] == 0
        assert flight.count["clock_skew_ppm"] == pytest.approx(-90, abs=15)
        last = flight.listener.imu[-1]
        np.testing.assert_allclose(last.gyro, autopilot.gyro, rtol=1e-6)
        np.testing.assert_allclose(last.accel, autopilot.accel, rtol=1e-6)
        assert last.t + last.gyro_delay == pytest.approx(flight.clock.now(), abs=6e-3)
        steps = np.diff([s.t for s in flight.listener.imu])
        assert np.abs(steps - 5e-3).max() < 0.02 * 5e-3 + 1e-6  # smooth: within the slew bound
        pose = flight.listener.poses[-1]
        np.testing.assert_allclose(pose.world_from_body @ (1, 0, 0), (math.cos(1), math.sin(1), 0), atol=1e-6)
        assert autopilot.companion_heartbeats >= 20
        assert autopilot.signing_setups == 0


async def test_positions_are_carried_to_the_time_of_the_attitude():
    autopilot = FakeAutopilot()
    async with Flight(autopilot) as flight:
        flight.fly(3.0)
        stamp = int(autopilot.stamp(flight.clock.now()) * 1e3) + 1
        message = common.MAVLink_local_position_ned_message(stamp, 5, 6, -7, 8, 0, 0)
        autopilot.offered = ()
        before = len(flight.listener.poses)
        flight.unit.received(flight.clock.now(), autopilot.frame(message))
        attitude = common.MAVLink_attitude_quaternion_message(stamp + 100, 1, 0, 0, 0, 0, 0, 0)
        flight.unit.received(flight.clock.now() + 0.1, autopilot.frame(attitude))
        assert len(flight.listener.poses) == before + 1
        np.testing.assert_allclose(flight.listener.poses[-1].position, (5 + 8 * 0.1, 6, -7), atol=1e-6)


async def test_a_denied_rate_is_lowered_until_granted_and_remembered_after_a_reboot():
    autopilot = FakeAutopilot(boot_at=60.0)
    async with Flight(autopilot, imu_rate_hz=500.0) as flight:
        flight.fly(8.0)
        imu = [
            interval
            for message, interval in autopilot.commands
            if message == common.MAVLINK_MSG_ID_HIGHRES_IMU
        ]
        # 400 Hz is too fast as well
        np.testing.assert_allclose(1e6 / np.array(imu), [500, 400, 320], rtol=1e-3)
        assert "IMU 500 Hz asked, 333 Hz got" in flight.text  # whole milliseconds: 3.125 became 3
        autopilot.commands.clear()
        autopilot.reboot(flight.clock.now())
        flight.fly(4.0)
        imu = [
            interval
            for message, interval in autopilot.commands
            if message == common.MAVLINK_MSG_ID_HIGHRES_IMU
        ]
        assert set(imu) == {3125}


async def test_a_reboot_is_survived_counted_and_followed_by_new_requests():
    autopilot = FakeAutopilot(boot_at=60.0)
    async with Flight(autopilot) as flight:
        flight.fly(5.0)
        autopilot.reboot(flight.clock.now())
        flight.fly(8.0)
        assert flight.count["reboots"] == 1
        assert flight.unit.status().ok
        last = flight.listener.imu[-1]
        assert last.t + last.gyro_delay == pytest.approx(flight.clock.now(), abs=6e-3)
        assert (np.diff([s.t for s in flight.listener.imu]) > 0).all()


async def test_a_stream_that_was_slowed_down_by_others_is_asked_for_again():
    autopilot = FakeAutopilot()
    async with Flight(autopilot) as flight:
        flight.fly(8.0)
        autopilot.set_interval(common.MAVLINK_MSG_ID_HIGHRES_IMU, 40_000, flight.clock.now())
        flight.fly(5.0)
        assert flight.count["imu_rate_hz"] == pytest.approx(200.0, abs=1.0)


def rates_asked(autopilot: FakeAutopilot) -> list[float]:
    """Of HIGHRES_IMU [Hz]."""
    asked = (us for message, us in autopilot.commands if message == common.MAVLINK_MSG_ID_HIGHRES_IMU)
    return [1e6 / us for us in asked]


async def test_a_granted_rate_that_does_not_come_is_asked_for_once_at_double_and_kept_where_that_helps():
    autopilot = FakePx4(boot_at=60.0)
    async with Flight(autopilot) as flight:
        flight.fly(5.0)
        assert flight.count["imu_rate_hz"] == pytest.approx(125.0, abs=2.0)
        flight.fly(5.0)
        assert rates_asked(autopilot) == [200.0, 400.0]
        assert flight.count["imu_rate_hz"] == pytest.approx(250.0, abs=2.0)
        autopilot.commands.clear()
        autopilot.reboot(flight.clock.now())
        flight.fly(20.0)
        assert set(rates_asked(autopilot)) == {400.0}
        assert flight.count["imu_rate_hz"] == pytest.approx(250.0, abs=2.0)


async def test_a_double_that_was_in_vain_is_taken_back_and_not_tried_again():
    autopilot = FakePx4(boot_at=60.0)
    autopilot.parameters.values["IMU_INTEG_RATE"] = 125
    async with Flight(autopilot) as flight:
        flight.fly(60.0)
        assert rates_asked(autopilot)[:3] == [200.0, 400.0, 200.0]
        assert set(rates_asked(autopilot)[3:]) == {200.0}
        assert "200 Hz asked, 125 Hz got" in flight.text
        (finding,) = check_autopilot(AutopilotFacts(60.0, status=flight.unit.status()))
        assert finding.found == "125 gyro samples per second, 200 requested"
        assert (
            finding.remedy == "PX4 sends at most IMU_INTEG_RATE: set autopilot.imu_rate_hz to it, or raise it"
        )


class Px4ThatDenies(FakePx4):
    """What would be faster than 333 Hz, as ArduPilot does."""

    def grant(self, message_id: int, interval_us: float, stamp: float, channel: Channel) -> int:
        if 0.0 < interval_us < 3000.0:
            return int(common.MAV_RESULT_DENIED)
        return super().grant(message_id, interval_us, stamp, channel)


async def test_a_double_that_is_denied_does_not_lower_the_rate():
    autopilot = Px4ThatDenies(boot_at=60.0)
    async with Flight(autopilot) as flight:
        flight.fly(20.0)
        assert rates_asked(autopilot)[:3] == [200.0, 400.0, 200.0]
        assert flight.count["imu_rate_granted_hz"] == 200.0


async def test_a_line_that_would_not_carry_the_double_is_not_asked_for_it():
    autopilot = FakePx4(boot_at=60.0)
    async with Flight(autopilot, bytes_per_second=30_000.0) as flight:
        flight.fly(20.0)
        assert set(rates_asked(autopilot)) == {200.0}


@pytest.mark.parametrize(
    ("offered", "source", "tolerance"),
    [
        (common.MAVLINK_MSG_ID_RAW_IMU, "RAW_IMU", 1e-3),
        (common.MAVLINK_MSG_ID_SCALED_IMU, "SCALED_IMU", 1e-3),
        (common.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, "ATTITUDE_QUATERNION", 1e-6),
    ],
)
async def test_lesser_sources_of_gyro_are_used_where_the_best_is_not_offered(offered, source, tolerance):
    autopilot = FakeAutopilot(boot_at=60.0, offered=(offered, common.MAVLINK_MSG_ID_LOCAL_POSITION_NED))
    async with Flight(autopilot) as flight:
        flight.fly(10.0)
        assert f"200 Hz got from {source}" in flight.text
        np.testing.assert_allclose(flight.listener.imu[-1].gyro, autopilot.gyro, atol=tolerance)


async def test_an_old_autopilot_is_asked_the_old_way():
    autopilot = FakeAutopilot(understands_intervals=False)
    async with Flight(autopilot, imu_rate_hz=50.0) as flight:
        flight.fly(20.0)
        assert common.MAV_DATA_STREAM_RAW_SENSORS in autopilot.streams_asked
        assert "50 Hz got from RAW_IMU" in flight.text


async def test_an_autopilot_without_any_imu_is_said_and_not_pestered():
    autopilot = FakeAutopilot(offered=())
    async with Flight(autopilot) as flight:
        flight.fly(30.0)
        assert "requesting: heartbeat, no IMU" in flight.text
        assert len(autopilot.commands) < 30 * 15


def distances_asked(autopilot: FakeAutopilot) -> list[float]:
    """Of DISTANCE_SENSOR [Hz]."""
    return [
        1e6 / us for message, us in autopilot.commands if message == common.MAVLINK_MSG_ID_DISTANCE_SENSOR
    ]


async def test_what_a_range_finder_measures_comes_with_a_pose_a_few_times_per_second():
    autopilot = FakeAutopilot()
    autopilot.ground = 4.0
    # 20° of roll.
    autopilot.q = np.array((math.cos(math.radians(10.0)), math.sin(math.radians(10.0)), 0.0, 0.0))
    async with Flight(autopilot) as flight:
        flight.fly(10.0)
        grounds = [pose.ground for pose in flight.listener.poses[-250:] if pose.ground is not None]
        assert distances_asked(autopilot) == [4.0]
        assert 18 <= len(grounds) <= 22
        assert grounds == pytest.approx(len(grounds) * [4.0 * math.cos(math.radians(20.0))])


WITHOUT = tuple(n for n in SimulatedArduPilot.offers if n != common.MAVLINK_MSG_ID_DISTANCE_SENSOR)


@pytest.mark.parametrize("offered", [None, WITHOUT], ids=["silent", "unknown"])
async def test_a_range_finder_that_is_not_there_is_asked_for_once_and_missed_by_nobody(offered):
    autopilot = FakeAutopilot(offered=offered)
    async with Flight(autopilot) as flight:
        flight.fly(60.0)
        assert len(distances_asked(autopilot)) == 1
        # Nobody takes the autopilot for one of old that has to be asked the old way.
        assert autopilot.streams_asked == []
        assert flight.unit.status().ok
        assert all(pose.ground is None for pose in flight.listener.poses)


@pytest.mark.parametrize(
    "wrong",
    [
        {"orientation": common.MAV_SENSOR_ROTATION_NONE},
        {"current_distance": 10},
        {"current_distance": 5000},
        {"current_distance": 0, "min_distance": 0},
        {"signal_quality": 1},
    ],
    ids=" ".join,
)
async def test_what_looks_elsewhere_or_found_nothing_is_no_ground(wrong):
    said = {
        "time_boot_ms": 0, "min_distance": 20, "max_distance": 5000, "current_distance": 400, "type": 0, "id": 0,
        "orientation": common.MAV_SENSOR_ROTATION_PITCH_270, "covariance": 255, "signal_quality": 0,
    }  # fmt: skip
    autopilot = FakeAutopilot()
    async with Flight(autopilot) as flight:
        flight.fly(3.0)
        for message, is_ground in (({**said, **wrong}, False), (said, True)):
            before = len(flight.listener.poses)
            report = common.MAVLink_distance_sensor_message(**message)
            flight.unit.received(flight.clock.now(), autopilot.frame(report))
            flight.fly(0.5)
            grounds = [pose.ground for pose in flight.listener.poses[before:] if pose.ground is not None]
            assert grounds == ([pytest.approx(4.0)] if is_ground else [])


async def test_other_systems_components_and_our_own_echo_are_counted_and_ignored():
    ours, neighbour = FakeAutopilot(), FakeAutopilot(system=2)
    neighbour.gyro = np.array((9.0, 9.0, 9.0))
    camera = FakeAutopilot(component=100)
    async with Flight(ours, neighbour, camera, system_id=1) as flight:
        neighbour.set_interval(common.MAVLINK_MSG_ID_HIGHRES_IMU, 5000, 100.0)
        camera.set_interval(common.MAVLINK_MSG_ID_HIGHRES_IMU, 5000, 100.0)
        flight.fly(4.0)
        for data in flight.link.sent:
            flight.unit.received(flight.clock.now(), data)
        np.testing.assert_allclose(
            [s.gyro for s in flight.listener.imu], ours.gyro[None].repeat(len(flight.listener.imu), 0)
        )
        assert flight.count["foreign"] > 2 * 4 * 200
        assert flight.count["reboots"] == flight.count["duplicates"] == 0


async def test_the_system_asked_for_is_waited_for_and_the_others_are_named():
    async with Flight(FakeAutopilot(system=7), system_id=3) as flight:
        flight.fly(4.0)
        assert "frames but no autopilot heartbeat of system 3 (heard: 7/1 quadrotor)" in flight.text


async def test_a_neighbour_does_not_take_the_place_of_a_silent_autopilot():
    ours, neighbour = FakeAutopilot(), FakeAutopilot(system=2)
    async with Flight(ours, neighbour, system_id=1) as flight:
        flight.fly(3.0)
        ours.mute = True
        flight.fly(0.6)
        assert ": stale: no IMU sample for 0." in flight.text
        flight.fly(5.0)
        assert "lost: nothing from autopilot 1 for 6 s" in flight.text
        assert not flight.unit.status().ok
        ours.mute = False
        flight.fly(6.0)
        assert "streaming" in flight.text


async def test_duplicates_steps_back_nan_and_nonsense_are_dropped_and_counted():
    autopilot = FakeAutopilot(boot_at=60.0)
    async with Flight(autopilot) as flight:
        flight.fly(3.0)
        now, before = flight.clock.now(), len(flight.listener.imu)
        stamp = round(autopilot.stamp(now) * 1e6)
        ms = stamp // 1000 + 10

        def imu(us: int, gyro: float) -> bytes:
            return autopilot.frame(
                common.MAVLink_highres_imu_message(us, 0, 0, -9.8, gyro, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xFFFF)
            )

        for us, gyro in (
            (stamp + 5000, 0.1),
            (stamp + 5000, 0.1),
            (stamp + 1000, 0.1),
            (stamp + 10000, math.nan),
        ):
            flight.unit.received(now, imu(us, gyro))
        flight.unit.received(now, imu(stamp + 15000, math.inf))
        flight.unit.received(now, imu(stamp + 15000, 1e30))
        flight.unit.received(
            now,
            autopilot.frame(common.MAVLink_attitude_quaternion_message(ms, math.nan, 0, 0, 0, 0, 0, 0)),
        )
        for north in (math.nan, 3e7):  # no drone flies once around the Earth, and no teammate would read it
            flight.unit.received(
                now, autopilot.frame(common.MAVLink_local_position_ned_message(ms, north, 0, 0, 0, 0, 0))
            )
            ms += 40
        assert len(flight.listener.imu) == before + 1
        assert (flight.count["copies"], flight.count["out_of_step"], flight.count["invalid"]) == (1, 1, 6)


async def test_lost_samples_are_counted_by_their_stamps():
    autopilot = FakeAutopilot()
    async with Flight(autopilot) as flight:
        flight.fly(5.0)
        autopilot.mute = True
        flight.fly(0.05)
        autopilot.mute = False
        flight.fly(1.0)
        assert flight.count["gaps"] == 1
        assert flight.count["imu_lost"] == pytest.approx(10, abs=1)


class Px4OnAPoorLink(FakePx4):
    """Every `loses`th datagram is lost."""

    loses, sent = math.inf, 0

    def step(self, now: float, port: int = 0) -> list[bytes]:
        kept = []
        for data in super().step(now, port):
            self.sent += 1
            if self.sent % self.loses:
                kept.append(data)
        return kept


@pytest.mark.parametrize("asked_hz", [200.0, 250.0])
async def test_samples_that_a_px4_on_a_clock_of_its_own_leaves_out_are_not_lost(asked_hz):
    autopilot = Px4OnAPoorLink(lockstep=False, boot_at=60.0)
    async with Flight(autopilot, imu_rate_hz=asked_hz) as flight:
        flight.fly(40.0)
        assert flight.count["imu_rate_hz"] == pytest.approx(asked_hz, abs=2.0)
        steps = np.diff([sample.t for sample in flight.listener.imu[-2000:]])
        assert np.isin(np.rint(steps / 0.00375), (1, 2)).all()
        assert np.ptp(steps) > 0.003
        assert (flight.count["imu_lost"], flight.count["gaps"]) == (0, 0)
        autopilot.loses = 50
        before = flight.count["imu_samples"]
        flight.fly(40.0)
        came = flight.count["imu_samples"] - before
        assert flight.count["imu_lost"] == pytest.approx(came / 49, rel=0.25)


async def test_a_granted_rate_is_no_loss_from_its_first_sample_on():
    autopilot = FakeAutopilot(boot_at=60.0)
    async with Flight(imu_rate_hz=50.0) as flight:
        # Another program has asked for more before us, and what we say is not heard yet.
        autopilot.set_interval(common.MAVLINK_MSG_ID_HIGHRES_IMU, 4000, flight.clock.now())
        for _ in range(500):
            flight.fly(1e-3)
            for data in autopilot.step(flight.clock.now()):
                flight.unit.received(flight.clock.now(), data)
        flight.autopilots = (autopilot,)
        for _ in range(20):
            flight.fly(0.1)
            assert flight.count["gaps"] == 0
        assert autopilot.commands


async def test_their_timesync_is_answered_and_ours_gives_the_clock_a_sigma():
    autopilot = FakeAutopilot(boot_at=60.0)
    async with Flight(autopilot) as flight:
        flight.fly(6.0)
        autopilot.ask_time(flight.clock.now())
        flight.fly(0.01)
        ((ours, theirs),) = autopilot.timesync_answers
        assert ours * 1e-9 == pytest.approx(flight.clock.now(), abs=0.02)
        assert theirs * 1e-9 == pytest.approx(autopilot.stamp(flight.clock.now()), abs=0.02)
        assert flight.count["timesyncs"] > 10
        assert flight.count["clock_sigma_s"] < 2e-3
        assert flight.count["clock_offset_s"] == pytest.approx(60.0, abs=2e-3)


async def test_an_autopilot_in_lockstep_that_runs_slow_is_followed_and_said(caplog):
    autopilot = FakePx4(boot_at=60.0, skew=-0.011)
    async with Flight(autopilot) as flight:
        flight.fly(10.0)
        assert "runs 1.1 % slow: a simulator?" in flight.text
        assert "the autopilot's clock runs 1.1 % slow: a simulator?" in caplog.text
        assert flight.count["clock_sigma_s"] < 3e-3
        assert flight.count["clock_restarts"] >= 1
        flight.fly(20.0)
        assert flight.listener.imu[-1].t == pytest.approx(flight.clock.now(), abs=8e-3)
        assert flight.unit.status().ok


async def test_more_than_the_line_carries_is_warned_of(caplog):
    async with Flight(FakeAutopilot(), bytes_per_second=11520.0) as flight:
        flight.fly(1.5)
        assert "% of what the line carries" in caplog.text


@pytest.fixture
def key_file(tmp_path: Path) -> Path:
    path = tmp_path / "key"
    path.write_bytes(KEY)
    path.chmod(0o600)
    return path


async def test_with_a_key_an_unsigned_autopilot_is_refused_by_name(key_file):
    async with Flight(FakeAutopilot(), signing_key=key_file) as flight:
        flight.fly(4.0)
        assert "1/1 sends unsigned messages, and we hold a signing key" in flight.text
        assert not flight.listener.imu
        assert flight.count["unsigned"] >= 4
    async with Flight(FakeAutopilot(key=bytes(32)), signing_key=key_file) as flight:
        flight.fly(4.0)
        assert "1/1 signs with another key" in flight.text
    async with Flight(FakeAutopilot(key=KEY), signing_key=key_file) as flight:
        flight.fly(4.0)
        assert flight.unit.status().ok  # so it took our signed requests, too
        assert flight.count["signed_good"] > 200
        assert flight.count["signed_bad"] == flight.count["unsigned"] == 0


def signed_frames(autopilot: FakeAutopilot) -> list[bytes]:
    """Three samples, then the heartbeat that tells whose they were."""
    imu = [imu_report(autopilot, 40.0 + 5e-3 * i) for i in range(3)]
    return [autopilot.frame(m) for m in (*imu, autopilot._heartbeat())]


async def test_signed_frames_that_came_before_the_first_heartbeat_are_verified_once(key_file, caplog):
    async with Flight(signing_key=key_file) as flight:
        for data in signed_frames(FakeAutopilot(key=KEY)):
            flight.unit.received(flight.clock.now(), data)
            flight.unit.tick(flight.clock.now())
            assert ": lost:" not in flight.text
        flight.clock.set(flight.clock.now() + 1.2)
        flight.unit.tick(flight.clock.now())
        assert (flight.count["signed_good"], flight.count["signed_old"], flight.count["signed_bad"]) == (
            4,
            0,
            0,
        )
        assert len(flight.listener.imu) == 3
        assert not [r for r in caplog.records if r.levelno >= logging.WARNING]


async def test_a_replayed_frame_is_refused_once_and_forgotten_by_the_reason_for_a_later_silence(key_file):
    autopilot = FakeAutopilot(key=KEY)
    async with Flight(autopilot, signing_key=key_file) as flight:
        first, *others = signed_frames(autopilot)
        for data in (first, *others, first):
            flight.unit.received(flight.clock.now(), data)
        assert (flight.count["signed_good"], flight.count["signed_old"]) == (4, 1)
        flight.fly(2.0)
        autopilot.mute = True
        flight.fly(4.0)
        assert "lost: nothing from autopilot 1 for 4 s" in flight.text
        flight.unit.received(flight.clock.now(), first)
        assert (
            "lost: nothing valid from autopilot 1 for 4 s: 1/1 signs with another key or an old"
            in flight.text
        )


async def test_a_tcp_connection_that_fell_silent_is_dropped_to_be_made_anew():
    autopilot = FakeAutopilot()
    async with Flight(autopilot) as flight:
        flight.link.address = LinkAddress("tcp", host="simulated", port=1)
        flight.fly(6.0)
        assert not flight.link.dropped
        autopilot.mute = True
        flight.fly(6.0)
        assert flight.link.dropped == "silent for 5 s"


@pytest.mark.parametrize(
    ("option", "value"), [("imu_rate_hz", 0.0), ("imu_rate_hz", math.nan), ("system_id", 256)]
)
def test_options_that_can_never_work_are_refused(option, value):
    with pytest.raises(SourceError, match=option):
        MavlinkAutopilot("none", clock=ManualClock(), **{option: value})


async def test_every_change_of_state_is_one_line_in_the_log(caplog):
    caplog.set_level(logging.INFO, logger="swarmtrack")
    autopilot = FakeAutopilot()
    autopilot.mute = True
    async with Flight(autopilot) as flight:
        flight.fly(20.0)
        autopilot.mute = False
        flight.fly(20.0)
        autopilot.mute = True
        flight.fly(20.0)
    lines = [r.getMessage().removeprefix("udpin:localhost:1: ") for r in caplog.records]
    assert [line.split(" (")[0][:38] for line in lines] == [
        "searching: port open, 0 bytes",
        "found autopilot 1/1",
        "gyro taken to be 11.3 ± 1.0 ms late: I",
        "streaming: IMU 200 Hz asked, 200 Hz go",
        "lost: nothing from autopilot 1 for 3 s",
    ]


# ── the pilot's switch ───────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("kind", [FakeAutopilot, FakePx4])
async def test_a_switch_is_thrown_when_it_goes_up_and_not_where_it_was_found_up(kind):
    autopilot = kind()
    autopilot.rc_us[7] = 1900
    async with Flight(autopilot, switch=PilotSwitch(8, 1700.0)) as flight:
        flight.fly(4.0)
        assert flight.text.endswith(", switch on")
        assert flight.listener.switched == []
        autopilot.rc_us[7] = 1100
        flight.fly(2.0)
        assert flight.text.endswith(", switch off")
        thrown = flight.clock.now()
        autopilot.rc_us[7] = 1900
        flight.fly(2.0)
        autopilot.rc_us[7] = 1680  # it trembles
        flight.fly(1.0)
        autopilot.rc_us[7] = 1720
        flight.fly(1.0)
        (switched,) = flight.listener.switched
        assert 0.0 < switched - thrown < 0.3


@pytest.mark.parametrize("kind", [FakeAutopilot, FakePx4])
async def test_a_channel_that_the_receiver_lacks_is_no_switch_and_is_said(kind):
    async with Flight(kind(), switch=PilotSwitch(17, 1700.0)) as flight:
        flight.fly(4.0)
        assert flight.text.endswith(", no switch: channel 17 is not reported")
        assert flight.listener.switched == []


async def test_where_a_switch_stands_after_a_silence_says_nothing_of_when_it_was_moved():
    autopilot = FakeAutopilot()
    async with Flight(autopilot, switch=PilotSwitch(8, 1700.0)) as flight:
        flight.fly(4.0)
        autopilot.mute = True
        flight.fly(3.0)
        autopilot.mute, autopilot.rc_us[7] = False, 1900
        flight.fly(4.0)
        assert flight.text.endswith(", switch on")
        assert flight.listener.switched == []


async def test_who_watches_no_switch_asks_for_none():
    autopilot = FakeAutopilot()
    async with Flight(autopilot) as flight:
        flight.fly(3.0)
        assert common.MAVLINK_MSG_ID_RC_CHANNELS not in [message_id for message_id, _ in autopilot.commands]
        assert "switch" not in flight.text


async def test_an_old_autopilot_loses_no_samples_for_an_intention_that_it_does_not_know():
    """It is asked for groups of messages, of which none has CURRENT_MODE: a slower one would slow the gyro down."""
    autopilot = FakeAutopilot(understands_intervals=False)
    async with Flight(autopilot, engagement=PilotEngagement()) as flight:
        flight.fly(12.0)
        before = flight.count["imu_samples"]
        flight.fly(20.0)
        assert flight.count["imu_samples"] - before == pytest.approx(4000, abs=10)


# ── real sockets ─────────────────────────────────────────────────────────────────────────────────────────────────────


async def test_two_megabytes_of_noise_into_the_udp_port_stop_nothing(caplog):
    port, rng = free_port(), random.Random(11)
    async with RealFlight(f"udpin:127.0.0.1:{port}") as flight:
        autopilot = FakeAutopilot(boot_at=flight.now() - 40.0)
        async with serve_udp(autopilot, "127.0.0.1", port) as transport:
            await flight.until(lambda: len(flight.listener.imu) > 20)
            for _ in range(2_000_000 // 1000):
                transport.sendto(rng.randbytes(1000), ("127.0.0.1", port))
                await asyncio.sleep(0)
            seen = len(flight.listener.imu)
            await flight.until(lambda: len(flight.listener.imu) > seen + 100)
            count = dict(flight.unit.status().counters)
            assert count["bad_bytes"] > 500_000
            assert not caplog.records  # no trouble to tell of
            assert flight.unit.status().ok
            np.testing.assert_allclose(flight.listener.imu[-1].gyro, autopilot.gyro, rtol=1e-6)


async def test_who_forges_an_autopilot_from_another_address_is_counted_and_moves_nothing(caplog, monkeypatch):
    # A busy machine may hold all of us up.
    monkeypatch.setattr(links, "UDP_PEER_SILENT_S", PATIENCE)
    port = free_port()
    async with RealFlight(f"udpin:127.0.0.1:{port}") as flight:
        autopilot = FakeAutopilot(boot_at=flight.now() - 40.0)
        forged = FakeAutopilot(boot_at=flight.now() - 4.0)
        forged.position = np.array([500.0, 500.0, 0.0])
        for message_id in (common.MAVLINK_MSG_ID_ATTITUDE, common.MAVLINK_MSG_ID_LOCAL_POSITION_NED):
            forged.set_interval(message_id, 20_000.0, flight.now(), forged.channels[0])
        async with serve_udp(autopilot, "127.0.0.1", port):
            await flight.until(lambda: len(flight.listener.poses) > 5)
            async with serve_udp(forged, "127.0.0.1", port):
                await flight.until(lambda: flight.count["foreign_datagrams"] >= 100)
                await flight.until(lambda: any(pose.position is not None for pose in flight.listener.poses))
            seen = len(flight.listener.poses)
            await flight.until(lambda: len(flight.listener.poses) > seen + 5)
        assert flight.listener.reboots == 0
        assert not forged.commands
        places = [pose.position for pose in flight.listener.poses if pose.position is not None]
        assert places
        assert np.abs(places).max() < 10.0
        assert sum("sends as well" in line for line in caplog.messages) == 1


@pytest.mark.parametrize(("host", "warned"), [("0.0.0.0", True), ("127.0.0.1", False)])
async def test_a_port_that_everybody_reaches_is_warned_of_unless_a_key_keeps_them_out(
    host, warned, caplog, key_file
):
    for signing_key in (None, key_file):
        caplog.clear()
        async with RealFlight(f"udpin:{host}:{free_port()}", signing_key=signing_key) as flight:
            await flight.until(lambda: "0 bytes" in flight.unit.status().text)
        said = [line for line in caplog.messages if "any host that reaches" in line]
        assert len(said) == (warned and signing_key is None)


async def test_a_switch_is_seen_through_a_real_socket():
    port = free_port()
    async with RealFlight(f"udpin:127.0.0.1:{port}", switch=PilotSwitch(8, 1700.0)) as flight:
        autopilot = FakeAutopilot(boot_at=flight.now() - 40.0)
        async with serve_udp(autopilot, "127.0.0.1", port):
            await flight.until(lambda: flight.unit.status().text.endswith(", switch off"))
            thrown = flight.now()
            autopilot.rc_us[7] = 1900
            await flight.until(lambda: bool(flight.listener.switched))
            assert thrown <= flight.listener.switched[0] <= flight.now()


async def test_a_serial_autopilot_is_found_lost_and_found_again(tmp_path):
    device = tmp_path / "ttyACM0"
    async with RealFlight(f"serial:{device}:921600") as flight:
        await flight.until(lambda: "no such device" in flight.unit.status().text)
        for _ in range(2):
            ours, theirs = os.openpty()
            tty.setraw(ours)
            device.symlink_to(os.ttyname(theirs))
            autopilot = FakeAutopilot(boot_at=flight.now())
            os.set_blocking(ours, False)
            seen = len(flight.listener.imu)

            def heard(autopilot=autopilot, ours=ours, seen=seen) -> bool:
                with contextlib.suppress(BlockingIOError):
                    autopilot.receive(os.read(ours, 4096), flight.now())
                for data in autopilot.step(flight.now()):
                    os.write(ours, data)
                return len(flight.listener.imu) > seen + 20

            await flight.until(heard)
            device.unlink()
            os.close(theirs)
            os.close(ours)
            await flight.until(lambda: "no such device" in flight.unit.status().text)


@pytest.mark.parametrize(
    ("sent", "reason"),
    [
        (b"", "port open, 0 bytes"),
        (b"\x80\x00\xfd\x07" * 50, r"bytes but no valid frame: wrong baud\? \(\d+ bad\)"),
    ],
)
async def test_a_serial_port_that_tells_nothing_names_the_reason(sent, reason):
    ours, theirs = os.openpty()
    tty.setraw(ours)
    async with RealFlight(f"serial:{os.ttyname(theirs)}:57600") as flight:
        await flight.until(lambda: "0 bytes" in flight.unit.status().text)
        os.write(ours, sent)
        await flight.until(lambda: re.search(reason, flight.unit.status().text) is not None)
    os.close(ours)
    os.close(theirs)


# ── recordings ───────────────────────────────────────────────────────────────────────────────────────────────────────


async def replay(name: str, **options: Any) -> tuple[MavlinkAutopilot, Listener]:
    path = SHARED / name
    if not path.exists():
        pytest.skip(f"needs ../shared/data/mavlink/{name}")
    unit = MavlinkAutopilot(f"tlog:{path}?pace=fast", clock=ManualClock(1000.0), **options)
    listener = Listener()
    await unit.run(listener)
    return unit, listener


@pytest.mark.shared
async def test_a_recorded_ardupilot_is_read_without_loss_and_agrees_with_its_simulators_truth():
    unit, listener = await replay("ardupilot_sitl.tlog")
    count = dict(unit.status().counters)
    t = np.array([s.t for s in listener.imu])
    assert (len(t) - 1) / (t[-1] - t[0]) == pytest.approx(200.0, abs=0.1)
    assert len(t) / 90.607 == pytest.approx(199.2, abs=0.1)
    # One was packed late, with the next one's stamp: no frame's number is missing there.
    assert (count["imu_lost"], count["gaps"], count["duplicates"]) == (0, 0, 1)
    assert (count["foreign"], count["bad_bytes"], count["reboots"], count["clock_resyncs"]) == (557, 0, 0, 0)
    assert count["clock_skew_ppm"] == pytest.approx(90, abs=10)
    assert (np.diff(t) > 0).all()

    truth = simulator_truth(SHARED / "ardupilot_sitl.tlog")
    pose_t = np.array([p.t for p in listener.poses])
    nearest = np.searchsorted(pose_t, truth[:, 0]).clip(1, len(pose_t) - 1)
    error_deg, tilt_deg, error_m, gyro_error = [], [], [], []
    imu_nearest = np.searchsorted(t, truth[:, 0]).clip(1, len(t) - 1)
    for row, i, k in zip(truth, nearest, imu_nearest, strict=True):
        pose = listener.poses[i]
        true = from_euler(*row[1:4])
        error_deg.append(rotation_angle_deg(pose.world_from_body.T @ true))
        tilt_deg.append(math.degrees(math.acos(np.clip(pose.world_from_body[2] @ true[2], -1, 1))))
        error_m.append(pose.position[:2] - row[7:9])
        gyro_error.append(listener.imu[k].gyro - row[4:7])
    assert np.percentile(tilt_deg, 95) < 0.5
    # The estimator's heading is off by up to 2.4 degrees in this flight.
    assert np.percentile(error_deg, 95) < 2.5
    assert np.percentile(np.linalg.norm(error_m, axis=1), 95) < 0.1
    assert np.abs(np.median(gyro_error, axis=0)).max() < 5e-3
    assert np.std(gyro_error, axis=0).max() < 0.01


@pytest.mark.shared
async def test_by_gps_a_recorded_flight_is_where_its_local_position_was():
    """The recording's own GPS_GLOBAL_ORIGIN as the team's: two messages of one estimator, by two conversions."""
    name = "ardupilot_sitl.tlog"
    _, local = await replay(name)
    origin = Geodetic.from_degrees(-35.3632610, 149.1652299, 584.090)
    gps, by_gps = await replay(name, gps=GlobalPosition(origin))
    where = {p.t: p.position for p in local.poses if p.position is not None}
    errors = [p.position - where[p.t] for p in by_gps.poses if p.position is not None and p.t in where]
    assert len(errors) > 0.95 * len(where)
    distance = np.ptp([p.position for p in by_gps.poses if p.position is not None], axis=0)
    assert distance[0] > 10.0
    # The grids of 11 and 10 mm, and 0.1 s of velocity in cm/s.
    assert np.percentile(np.abs(errors), 95) < 0.1
    # `h_acc` of the recording.
    assert {p.position_sigma for p in by_gps.poses if p.position is not None} == {0.3}
    assert gps.status().ok


def simulator_truth(path: Path) -> np.ndarray:
    """(n, 9) of SIMSTATE: t, roll, pitch, yaw [rad], body rates [rad/s], north and east of the first [m]."""
    decoder = ardupilotmega.MAVLink(None)
    rows, first, origin = [], None, None
    for stamp, data in records(path.read_bytes()):
        first = stamp if first is None else first
        m = decoder.decode(bytearray(data))
        if m.get_type() == "SIMSTATE":
            lat, lng = m.lat * 1e-7, m.lng * 1e-7
            origin = origin or (lat, lng)
            north = math.radians(lat - origin[0]) * 6_378_137.0
            east = math.radians(lng - origin[1]) * 6_378_137.0 * math.cos(math.radians(lat))
            rows.append(
                (1000.0 + stamp - first, m.roll, m.pitch, m.yaw, m.xgyro, m.ygyro, m.zgyro, north, east)
            )
    return np.array(rows)


def from_euler(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """world_from_body of the aerospace sequence yaw, pitch, roll (3, 3)."""
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    about_z = np.array(((cy, -sy, 0), (sy, cy, 0), (0, 0, 1)))
    about_y = np.array(((cp, 0, sp), (0, 1, 0), (-sp, 0, cp)))
    about_x = np.array(((1, 0, 0), (0, cr, -sr), (0, sr, cr)))
    return about_z @ about_y @ about_x


def rotation_angle_deg(R: np.ndarray) -> float:
    return math.degrees(math.acos(np.clip((np.trace(R) - 1) / 2, -1, 1)))


@pytest.mark.shared
async def test_a_recorded_flight_of_2015_with_garbage_and_a_reboot_is_survived():
    unit, listener = await replay("dronekit_flight_2015.tlog")
    count = dict(unit.status().counters)
    assert len(listener.imu) == 2856  # every RAW_IMU of the file
    assert count["reboots"] == 1
    assert count["foreign"] > 3000  # ground station and radio
    assert count["crc_failures"] > 1300
    assert (np.diff([s.t for s in listener.imu]) > 0).all()
