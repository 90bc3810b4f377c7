"""ArduPilot's own logs by what was asked for (LOG_BITMASK, INS_RAW_LOG_OPT), by the flight and by the firmware."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from support.autopilot_flight import Listener
from support.dataflash_writer import DataflashLog
from swarmtrack.autopilot.dataflash import read_dataflash
from swarmtrack.autopilot.global_position import GlobalPosition
from swarmtrack.autopilot.gyro_delay import low_pass_delay
from swarmtrack.autopilot.mavlink_autopilot import MavlinkAutopilot
from swarmtrack.clock import ManualClock
from swarmtrack.geometry import rotation
from swarmtrack.geometry.geodesy import Geodetic

BOOT_US = 90_000_000
HOME = (-35.363261, 149.165230, 584.0)  # °, °, m
GYRO, ACCEL = (0.01, -0.02, 0.5), (0.1, 0.2, -9.8)
ESTIMATOR_FINE, ESTIMATOR_LOST = 0b11_1111, 0b1000_0001


def imu(log: DataflashLog, hz: int, *, seconds: float = 2.0) -> None:
    log.define("IMU", "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ")
    for k in range(round(hz * seconds)):
        log.add("IMU", BOOT_US + round(1e6 * k / hz), 0, 0.0, 0.0, 0.4, *ACCEL)


def raw(log: DataflashLog, hz: int = 1000, *, option: int = 0) -> None:
    """Written in bursts of four, as a sensor with a queue is read."""
    log.define("PARM", "QNff", "TimeUS,Name,Value,Default")
    log.define("GYR", "QBQfff", "TimeUS,I,SampleUS,GyrX,GyrY,GyrZ")
    log.define("ACC", "QBQfff", "TimeUS,I,SampleUS,AccX,AccY,AccZ")
    log.add("PARM", BOOT_US, b"INS_GYRO_FILTER", 20.0, 20.0)
    log.add("PARM", BOOT_US, b"INS_RAW_LOG_OPT", option, 0.0)
    for k in range(2 * hz):
        sampled, written = (BOOT_US + round(1e6 * n / hz) for n in (k, k - k % 4 + 4))
        log.add("GYR", written, 0, sampled, *GYRO)
        log.add("ACC", written, 0, sampled, *ACCEL)


def attitudes(log: DataflashLog) -> None:
    log.define("ATT", "QccccCCCC", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,ErrRP,ErrYaw")
    for k in range(50):
        log.add("ATT", BOOT_US + 40_000 * k, 0.0, 0.0, 0.0, 0.0, 30.0, 30.0, 0.0, 0.0)


def states(log: DataflashLog, *, lost_s: float = 0.0) -> None:
    """The estimator's two cores; the first one knows no position at the beginning."""
    log.define("XKF1", "QBccCfffffff", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD")
    log.define("XKF4", "QBcI", "TimeUS,C,SV,SS")
    for k in range(50):
        t = 0.04 * k
        for core in range(2):
            stamp = BOOT_US + round(1e6 * t)
            log.add("XKF1", stamp, core, 0.0, 0.0, 30.0 + core, 1.0, 0.0, 0.0, 0.0, t, 7.0 * core, -3.0)
            log.add("XKF4", stamp, core, 0.1, ESTIMATOR_LOST if t < lost_s else ESTIMATOR_FINE)


def origin(log: DataflashLog) -> None:
    log.define("ORGN", "QBLLf", "TimeUS,Type,Lat,Lng,Alt")
    log.add("ORGN", BOOT_US, 0, *HOME)


def backup(log: DataflashLog) -> None:
    log.define("AHR2", "QccCfLLffff", "TimeUS,Roll,Pitch,Yaw,Alt,Lat,Lng,Q1,Q2,Q3,Q4")
    latitude, longitude, height = HOME
    turned = rotation.to_quaternion(rotation.from_euler(0.0, 0.0, np.radians(30.0))).tolist()
    for k in range(50):
        log.add("AHR2", BOOT_US + 40_000 * k, 0.0, 0.0, 30.0, height + 0.1 * k, latitude, longitude, *turned)


async def played(
    folder: Path, *parts: Callable[[DataflashLog], None], gps: GlobalPosition | None = None
) -> tuple[Listener, list[str]]:
    log, path = DataflashLog(), folder / "1.BIN"
    for part in parts:
        part(log)
    path.write_bytes(log.bytes())
    autopilot, kept = MavlinkAutopilot(f"bin:{path}?speed=0", clock=ManualClock(1000.0), gps=gps), Listener()
    await autopilot.run(kept)
    return kept, autopilot.account()


@pytest.mark.parametrize("beside", [(), (lambda log: imu(log, 25),)], ids=["alone", "beside a slow IMU"])
async def test_the_raw_gyro_is_used_where_it_is_the_densest(tmp_path, beside):
    kept, account = await played(tmp_path, *beside, raw, attitudes)
    assert len(kept.imu) == pytest.approx(2000, abs=2)
    assert np.diff([sample.t for sample in kept.imu]) == pytest.approx(1e-3, abs=2e-6)
    assert kept.imu[9].gyro == pytest.approx(GYRO)
    assert kept.imu[9].accel == pytest.approx(ACCEL)
    assert len(kept.poses) == pytest.approx(50, abs=1)
    assert "too slow" not in "\n".join(account)
    assert account[1].startswith("used: 2000 gyro samples from HIGHRES_IMU (1000 Hz)")


async def test_a_dense_imu_is_used_rather_than_a_sparser_raw_gyro(tmp_path):
    kept, _ = await played(tmp_path, lambda log: imu(log, 400), lambda log: raw(log, 100))
    assert kept.imu[9].gyro == pytest.approx([0.0, 0.0, 0.4])


async def test_of_several_sensors_the_first_that_is_healthy_is_used(tmp_path):
    def sensors(log: DataflashLog) -> None:
        log.define("IMU", "QBffffffB", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,GH")
        for k in range(400):
            for sensor in range(3):
                rates = GYRO if sensor == 1 else (0.0, 0.0, 0.0)
                log.add("IMU", BOOT_US + 5000 * k, sensor, *rates, *ACCEL, sensor > 0)

    kept, _ = await played(tmp_path, sensors)
    assert len(kept.imu) == pytest.approx(400, abs=2)
    assert kept.imu[9].gyro == pytest.approx(GYRO)


@pytest.mark.parametrize(("option", "filtered"), [(0, False), (1, False), (4, True), (5, True), (8, False)])
async def test_a_raw_gyro_has_no_filters_delay_unless_it_is_logged_behind_it(tmp_path, option, filtered):
    kept, _ = await played(tmp_path, lambda log: raw(log, option=option))
    assert kept.imu[-1].gyro_delay == pytest.approx(low_pass_delay(20.0) if filtered else 0.0)


async def test_without_gps_the_position_is_the_estimators(tmp_path):
    """Of its first core, as soon as that holds it for known; its attitude where no other is logged."""
    kept, _ = await played(tmp_path, lambda log: imu(log, 400), lambda log: states(log, lost_s=0.5), backup)
    placed = [pose for pose in kept.poses if pose.position is not None]
    assert len(kept.poses) == pytest.approx(50, abs=1)
    assert len(placed) == pytest.approx(37, abs=2)
    begin = kept.poses[0].t
    for pose in placed:
        assert pose.position == pytest.approx([pose.t - begin, 0.0, -3.0], abs=0.01)
        assert np.degrees(rotation.to_euler(pose.world_from_body)[2]) == pytest.approx(30.0, abs=0.01)


async def test_by_a_known_origin_the_estimators_position_is_a_global_one(tmp_path):
    def fixes(log: DataflashLog) -> None:
        log.define("GPS", "QBBBLLf", "TimeUS,I,Status,NSats,Lat,Lng,Alt")
        for k in range(10):
            log.add("GPS", BOOT_US + 200_000 * k, 0, 4, 14, *HOME)

    kept, _ = await played(
        tmp_path,
        lambda log: imu(log, 400),
        states,
        origin,
        fixes,
        gps=GlobalPosition(Geodetic.from_degrees(*HOME)),
    )
    assert kept.poses[-1].position == pytest.approx([1.96, 0.0, -3.0], abs=0.05)


async def test_of_the_backup_estimator_both_are_used_where_there_is_no_other(tmp_path):
    kept, _ = await played(tmp_path, lambda log: imu(log, 400), backup)
    assert len(kept.poses) == pytest.approx(50, abs=1)
    assert kept.poses[-1].position == pytest.approx([0.0, 0.0, -4.9], abs=0.05)
    assert np.degrees(rotation.to_euler(kept.poses[-1].world_from_body)[2]) == pytest.approx(30.0, abs=0.01)


def old(log: DataflashLog) -> None:
    """ArduPilot 3.2: milliseconds, events without a time, and a receiver whose time is that of the week."""
    log.define("EV", "B", "Id")
    log.define("IMU", "Iffffff", "TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ")
    log.define("ATT", "IccccCC", "TimeMS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw")
    log.define("EKF1", "IccCffffff", "TimeMS,Roll,Pitch,Yaw,VN,VE,VD,PN,PE,PD")
    log.define("GPS", "BIHBcLLccI", "Status,TimeMS,Week,NSats,HDop,Lat,Lng,RelAlt,Alt,T")
    for k in range(200):
        ms = 90_000 + 20 * k
        log.add("IMU", ms, *GYRO, *ACCEL)
        if k % 4 == 0:
            log.add("ATT", ms, 0.0, 0.0, 0.0, 0.0, 30.0, 30.0)
            log.add("EKF1", ms, 0.0, 0.0, 30.0, 1.0, 0.0, 0.0, 0.02 * k, 0.0, -3.0)
        if k % 20 == 0:
            log.add("GPS", 3, 100_000_000 + 20 * k, 1800, 11, 0.9, *HOME[:2], 0.0, 100.0, ms)
        if k == 75:
            log.add("EV", 10)
            log.add("EV", 28)


async def test_a_log_that_counts_milliseconds_is_read(tmp_path):
    kept, _ = await played(tmp_path, old)
    assert len(kept.imu) == pytest.approx(200, abs=2)
    assert kept.imu[9].gyro == pytest.approx(GYRO)
    assert np.diff([sample.t for sample in kept.imu]) == pytest.approx(0.02, abs=1e-6)
    assert len(kept.poses) == pytest.approx(50, abs=1)
    assert kept.poses[-1].position == pytest.approx([0.02 * 196, 0.0, -3.0], abs=0.02)
    flies = [(state.t, state.airborne_since is not None) for state in kept.states]
    assert [t - flies[0][0] >= 1.5 for t, _ in flies] == [airborne for _, airborne in flies]
    flight = read_dataflash(tmp_path / "1.BIN")
    gps_s = 315_964_800 + 604_800 * 1800 + 100_000 - 18
    assert flight.records[0][0] + flight.utc_offset == pytest.approx(gps_s, abs=0.01)
