"""The last words about a log: what came, what was used, and why not the rest."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common

from support.autopilot_flight import Listener
from support.dataflash_writer import DataflashLog
from support.fake_autopilot import FakeAutopilot
from support.places import SHARED
from swarmtrack.autopilot.global_position import GlobalPosition
from swarmtrack.autopilot.mavlink_autopilot import MavlinkAutopilot
from swarmtrack.clock import ManualClock
from swarmtrack.errors import SourceError
from swarmtrack.geometry.geodesy import Geodetic
from swarmtrack.lab.autopilots.senses import GpsFix

RAW_IMU, ATTITUDE, LOCAL, GLOBAL = (
    common.MAVLINK_MSG_ID_RAW_IMU,
    common.MAVLINK_MSG_ID_ATTITUDE,
    common.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    common.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
)


def logged(
    path: Path,
    *autopilots: FakeAutopilot,
    rates: dict[int, float],
    seconds: float = 20.0,
    late_s: float = 0.0,
) -> Path:
    """A ground station's log of them, each stream at its rate [Hz]. late_s: when the first of them begins."""
    with path.open("wb") as file:
        for autopilot in autopilots:
            autopilot.gps = GpsFix(Geodetic.from_degrees(47.0, 8.0, 400.0), 0.9)
            for message_id, hz in rates.items():
                autopilot.set_interval(message_id, 1e6 / hz, 100.0)
        for k in range(round(100 * seconds)):
            t = 100.0 + 0.01 * k
            for autopilot in autopilots if t >= 100.0 + late_s else autopilots[1:]:
                for data in autopilot.step(t):
                    file.write(round((1.7e9 + t) * 1e6).to_bytes(8, "big") + data)
    return path


async def account(
    path: Path, gps: GlobalPosition | None = None, *, scheme: str = "tlog", system: int | None = None
) -> list[str]:
    unit = MavlinkAutopilot(f"{scheme}:{path}?speed=0", clock=ManualClock(1000.0), gps=gps, system_id=system)
    await unit.run(Listener())
    return unit.account()


def stamped(path: Path, frames: list[tuple[float, bytes]]) -> Path:
    """frames: (s since the first record, bytes)."""
    path.write_bytes(b"".join(round((1.7e9 + t) * 1e6).to_bytes(8, "big") + data for t, data in frames))
    return path


async def test_a_ground_stations_log_is_used_and_its_gyro_called_too_slow(tmp_path):
    rates = {RAW_IMU: 3.5, ATTITUDE: 4.0, LOCAL: 4.0, GLOBAL: 2.0}
    came, used, unused, lack = await account(
        logged(tmp_path / "a.tlog", FakeAutopilot(boot_at=60.0), rates=rates)
    )
    assert came.startswith("came from autopilot 1/1: 20 HEARTBEAT (1 Hz), ")
    for part in ("70 RAW_IMU (3.51 Hz)", "80 ATTITUDE (4 Hz)", "80 LOCAL_POSITION_NED (4 Hz)"):
        assert part in came
    assert used == "used: 70 gyro samples from RAW_IMU (3.51 Hz), 80 attitudes, 80 positions"
    assert unused == "not used: messages that are not read (40 GLOBAL_POSITION_INT (2 Hz))"
    assert lack.startswith("the gyro is too slow, 3.51 Hz and at least 50 Hz are needed")


async def test_what_is_missing_is_named_with_the_next_step(tmp_path):
    rates = {RAW_IMU: 100.0, GLOBAL: 10.0}
    *_, attitude, position = await account(
        logged(tmp_path / "a.tlog", FakeAutopilot(boot_at=60.0), rates=rates)
    )
    assert (
        attitude
        == "no attitude is usable, so no teammate is named: ATTITUDE_QUATERNION or ATTITUDE is needed"
    )
    assert 'GLOBAL_POSITION_INT only, which drone.start = { from = "gps" }' in position
    *_, gyro, _, _ = await account(logged(tmp_path / "b.tlog", FakeAutopilot(boot_at=60.0), rates={}))
    assert gyro.startswith("no gyro sample is usable")


async def test_of_two_vehicles_in_one_log_none_is_taken(tmp_path):
    both = FakeAutopilot(boot_at=60.0), FakeAutopilot(boot_at=30.0, system=2)
    log = logged(tmp_path / "a.tlog", *both, rates={RAW_IMU: 100.0})
    with pytest.raises(
        SourceError, match=r"two autopilots send, 1/1 .* and 2/1 .*: set autopilot\.system_id"
    ):
        await account(log)


async def test_a_vehicle_that_speaks_first_in_a_log_is_not_taken_for_the_only_one(tmp_path):
    both = FakeAutopilot(boot_at=60.0), FakeAutopilot(boot_at=30.0, system=2)
    log = logged(tmp_path / "a.tlog", *both, rates={RAW_IMU: 100.0}, late_s=3.0)
    with pytest.raises(SourceError, match=r"two autopilots send, 1/1 .* and 2/1 "):
        await account(log)
    came, used, unused, *_ = await account(log, system=1)
    assert came.startswith("came from autopilot 1/1: 17 HEARTBEAT (1 Hz), 1700 RAW_IMU")
    assert used.startswith("used: 1700 gyro samples")
    assert unused == "not used: 2020 messages of other systems or components (2/1 quadrotor)"


async def test_a_log_is_used_from_its_first_frame_on_however_much_was_said_before(tmp_path):
    tracker, ours, frames = common.MAVLink(None, 2, 1), common.MAVLink(None, 1, 1), []
    for k in range(4000):
        t = 0.005 * k
        sample = common.MAVLink_raw_imu_message(round(1e6 * (60.0 + t)), *[0] * 9)
        frames.append((t, bytes(sample.pack(tracker))))
        if t >= 15.0:
            frames.append((t, bytes(sample.pack(ours))))
        if k % 200 == 199:
            frames.append((t, bytes(common.MAVLink_heartbeat_message(5, 3, 0, 0, 3, 3).pack(tracker))))
            if t >= 15.0:
                frames.append((t, bytes(common.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3).pack(ours))))
    came, used, unused, *_ = await account(stamped(tmp_path / "a.tlog", frames))
    assert came == "came from autopilot 1/1: 1000 RAW_IMU (200 Hz), 5 HEARTBEAT (1 Hz)"
    assert used.startswith("used: 1000 gyro samples from RAW_IMU (200 Hz)")
    others, early = re.findall(r"(\d+) messages", unused)
    assert int(others) + int(early) == 4020
    assert "messages of other systems or components (2/1 antenna tracker); " in unused


async def test_a_log_that_is_shorter_than_a_second_is_read(tmp_path):
    log = logged(tmp_path / "a.tlog", FakeAutopilot(boot_at=60.0), rates={RAW_IMU: 100.0}, seconds=0.5)
    assert (await account(log))[1].startswith("used: 49 gyro samples")


async def test_positions_without_a_fix_and_samples_of_another_sensor_are_counted(tmp_path):
    mav, frames = common.MAVLink(None, 1, 1), []
    for k in range(400):
        t, lost = 0.05 * k, 100 <= k < 200
        said = [common.MAVLink_highres_imu_message(round(1e6 * (60.0 + t)), *[0.0] * 13, 63, id=k % 2)]
        said.append(common.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3))
        if k % 4 == 0:
            place = 470_000_000, 80_000_000, 400_000
            said.append(common.MAVLink_gps_raw_int_message(0, 1 if lost else 3, *place, 1, 1, 0, 0, 12))
            said.append(
                common.MAVLink_global_position_int_message(round(1e3 * (60.0 + t)), *place, 0, 0, 0, 0, 0)
            )
        frames += [(t, bytes(m.pack(mav))) for m in said]
    frames[300:300] = [(frames[300][0], b"\xfd\x00\x00\x00\x07\x01\x01\xff\xff\xee\x00\x00")] * 3
    _, used, unused, *_ = await account(
        stamped(tmp_path / "a.tlog", frames), GlobalPosition(Geodetic.from_degrees(47.0, 8.0, 400.0))
    )
    assert used.startswith("used: 200 gyro samples")
    assert used.endswith("75 positions")
    assert "25 positions (without a usable GPS fix, or far from the team's origin)" in unused
    assert "200 gyro samples (of another sensor than the first)" in unused
    assert "3 frames of messages that MAVLink's common dialect lacks" in unused


@pytest.mark.shared
async def test_what_comes_beside_a_better_message_is_counted():
    came, _, unused, *_ = await account(SHARED / "mavlink" / "ardupilot_sitl.tlog")
    assert " 4512 ATTITUDE (" in came
    assert " 4512 RAW_IMU (" in came
    assert "4512 gyro samples (RAW_IMU: a better message is used)" in unused
    assert "attitudes (ATTITUDE: a better message is used)" in unused


async def test_an_autopilots_own_log_names_what_is_missing_in_its_own_words(tmp_path):
    log = DataflashLog()
    log.define("IMU", "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ")
    log.define("XKF1", "QBffffff", "TimeUS,C,VN,VE,VD,PN,PE,PD")
    log.define("XKF4", "QBI", "TimeUS,C,SS")
    for k in range(400):
        log.add("IMU", 10_000_000 + 5000 * k, 0, *[0.0] * 6)
        if k % 20 == 0:
            log.add("XKF1", 10_000_000 + 5000 * k, 0, *[0.0] * 6)
            log.add("XKF4", 10_000_000 + 5000 * k, 0, 0x81)
    path = tmp_path / "1.BIN"
    path.write_bytes(log.bytes())
    gps = GlobalPosition(Geodetic.from_degrees(47.0, 8.0, 400.0))
    *_, fix = await account(path, gps, scheme="bin")
    assert fix.endswith("GPS is needed (LOG_BITMASK: GPS, bit 2)")
    _, _, unused, attitude, position = await account(path, scheme="bin")
    assert unused.startswith("not used: 20 positions (not known by the estimator's own word, XKF4.SS: ")
    assert attitude.endswith("ATT, XKQ or XKF1 is needed (LOG_BITMASK: attitude, bit 0 or 1)")
    assert position.endswith("POS or a valid XKF1 is needed (LOG_BITMASK: attitude, bit 0 or 1)")
