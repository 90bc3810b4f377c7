"""ArduPilot's own logs: one that is made here, a real one, and files that are none. pymavlink's DFReader judges."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from pymavlink.DFReader import DFReader_binary

from support.autopilot_flight import Listener
from support.dataflash_writer import MARKS, DataflashLog
from support.mutants import MUTANTS, mutants
from support.patience import soon_and_small
from support.places import SHARED
from swarmtrack.agents import main as swarmtrack
from swarmtrack.autopilot.address import is_recording, parse_address
from swarmtrack.autopilot.dataflash import read_dataflash
from swarmtrack.autopilot.global_position import GlobalPosition
from swarmtrack.autopilot.gyro_delay import low_pass_delay
from swarmtrack.autopilot.mavlink_autopilot import MavlinkAutopilot
from swarmtrack.clock import ManualClock
from swarmtrack.errors import SourceError
from swarmtrack.geometry import rotation
from swarmtrack.geometry.geodesy import Geodetic, from_ned
from swarmtrack.recording.reader import recordings_below

REAL = SHARED / "mavlink" / "pymavlink_test.BIN"
HOME = Geodetic.from_degrees(-35.363261, 149.165230, 584.0)
BOOT_US = 90_000_000
WEEK, TIME_OF_WEEK_MS = 2300, 100_000_000
UTC_AT_BOOT = 315_964_800 + 604_800 * WEEK + 1e-3 * TIME_OF_WEEK_MS - 18 - 1e-6 * BOOT_US


async def played(path: Path, gps: GlobalPosition | None = None) -> tuple[Listener, MavlinkAutopilot]:
    clock, kept = ManualClock(1000.0), Listener()
    autopilot = MavlinkAutopilot(f"bin:{path}?speed=0", clock=clock, gps=gps)
    await autopilot.run(kept)
    assert kept.reboots == 0
    return kept, autopilot


def written(
    folder: Path, seconds: float = 4.0, *, attitude: str = "ATT", imus: int = 2, gyro_hz: int = 400
) -> Path:
    """A copter that yaws by 0.5 rad/s, flies north at 2 m/s, 3 m east of home, and takes off after half the time."""
    log = DataflashLog()
    log.define("PARM", "QNff", "TimeUS,Name,Value,Default")
    log.define("MSG", "QZ", "TimeUS,Message")
    log.define(
        "IMU",
        "QBffffffIIfBBHH",
        "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz",
        "s#EEEooo--O--zz",
    )
    log.define(
        "ATT", "QccccCCCCB", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,ErrRP,ErrYaw,AEKF", "sddddhhdh-"
    )
    log.define("XKQ", "QBffff", "TimeUS,C,Q1,Q2,Q3,Q4", "s#????")
    log.define("POS", "QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt", "sDUmmm")
    log.define("ORGN", "QBLLf", "TimeUS,Type,Lat,Lng,Alt", "s-DUm")
    log.define(
        "GPS",
        "QBBIHBcLLffffB",
        "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,U",
        "s#-s-S-DUmnhnb",
    )
    log.define("GPA", "QBCCCCBIHfH", "TimeUS,I,VDop,HAcc,VAcc,SAcc,VV,SMS,Delta,Und,RTCM", "s#-mmnb--m-")
    log.define("EV", "QB", "TimeUS,Id", "s-")
    log.define("ARM", "QBIBB", "TimeUS,ArmState,ArmChecks,Forced,Method", "s----")
    log.add("PARM", BOOT_US, b"INS_GYRO_FILTER", 40.0, 20.0)
    log.add("PARM", BOOT_US, b"MAV_SYSID", 7.0, 1.0)
    log.add("MSG", BOOT_US, b"ArduCopter V4.6.0 (12345678)")
    log.add("ORGN", BOOT_US, EKF_ORIGIN, *np.degrees(HOME[:2]), HOME.height)
    log.add("ORGN", BOOT_US, AHRS_HOME, *np.degrees(HOME[:2]), HOME.height + 3.0)
    for k in range(round(gyro_hz * seconds)):
        t = k / gyro_hz
        stamp = BOOT_US + round(1e6 * t)
        for sensor in range(imus):
            log.add(
                "IMU", stamp, sensor, 0.01 + sensor, -0.02, 0.5, 0.0, 0.0, -9.81, 0, 0, 40.0, 1, 1, 1000, 1000
            )
        if k % (gyro_hz // 25) == 0:
            _slow_messages(log, stamp, t, attitude)
        if k == round(0.5 * gyro_hz * seconds):
            log.add("ARM", stamp, 1, 0, 0, 0)
            log.add("EV", stamp, 10)
            log.add("EV", stamp + 1000, 28)
        if k % (gyro_hz // 5) == 0:
            place = from_ned(np.zeros(3), HOME)
            level = (*np.degrees(place[:2]), place.height, 0.0, 0.0, 0.0)
            ms = TIME_OF_WEEK_MS + round(1e3 * t)
            log.add("GPS", stamp, 1, 1, ms, WEEK, 3, 9.9, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0)
            log.add("GPS", stamp, 0, 4, ms, WEEK, 14, 0.7, *level, 1)
            log.add("GPA", stamp, 0, 1.1, 0.9, 1.8, 0.2, 1, 0, 200, 0.0, 0)
    path = folder / "00000012.BIN"
    path.write_bytes(log.bytes())
    return path


EKF_ORIGIN, AHRS_HOME = 0, 1


def _slow_messages(log: DataflashLog, stamp: int, t: float, attitude: str) -> None:
    if attitude == "ATT":
        yaw = math.degrees(0.5 * t) % 360.0
        log.add("ATT", stamp, 0.0, 0.0, 0.0, 0.0, yaw, yaw, 0.1, 0.1, 3)
    else:
        turned = rotation.to_quaternion(rotation.from_euler(0.0, 0.0, 0.5 * t)).tolist()
        log.add("XKQ", stamp, 0, *turned)
        log.add("XKQ", stamp, 1, 1.0, 0.0, 0.0, 0.0)
    place = from_ned(np.array([2.0 * t, 3.0, -4.0]), HOME)
    log.add("POS", stamp, *np.degrees(place[:2]), place.height, 4.0, 4.0)


@pytest.mark.parametrize("attitude", ["ATT", "XKQ"])
async def test_a_log_is_what_its_autopilot_would_have_said(tmp_path, attitude):
    kept, autopilot = await played(written(tmp_path, attitude=attitude))
    assert len(kept.imu) == pytest.approx(1600, abs=2)
    assert np.diff([sample.t for sample in kept.imu]) == pytest.approx(0.0025, abs=1e-6)
    assert kept.imu[5].gyro == pytest.approx([0.01, -0.02, 0.5], abs=1e-6)
    assert kept.imu[5].accel == pytest.approx([0.0, 0.0, -9.81], abs=1e-5)
    assert kept.imu[5].gyro_delay == pytest.approx(low_pass_delay(40.0))
    assert dict(autopilot.status().counters)["imu_lost"] == 0
    assert autopilot.system == 7
    assert kept.states[0].airborne_since is None
    assert kept.states[-1].airborne_since is not None
    assert len(kept.poses) == pytest.approx(100, abs=1)
    begin = kept.poses[0].t
    for pose in kept.poses[2:]:
        elapsed = pose.t - begin
        assert pose.position == pytest.approx([2.0 * elapsed, 3.0, -4.0], abs=0.05)
        assert math.remainder(
            rotation.to_euler(pose.world_from_body)[2] - 0.5 * elapsed, math.tau
        ) == pytest.approx(0.0, abs=1e-3)


async def test_by_gps_a_logged_flight_is_in_the_team_frame(tmp_path):
    origin = from_ned(np.array([-10.0, -20.0, 0.0]), HOME)
    kept, _ = await played(written(tmp_path), GlobalPosition(origin))
    placed = [pose for pose in kept.poses if pose.position is not None]
    assert len(placed) > 90
    begin = kept.poses[0].t
    for pose in placed:
        assert pose.position == pytest.approx([10.0 + 2.0 * (pose.t - begin), 23.0, -4.0], abs=0.08)
        assert (pose.position_sigma, pose.vertical_sigma) == (0.9, 1.8)


def test_the_time_of_day_is_that_of_the_gps(tmp_path):
    flight = read_dataflash(written(tmp_path, 1.0))
    assert flight.records[0][0] + flight.utc_offset == pytest.approx(UTC_AT_BOOT + 90.0, abs=0.01)
    assert [t for t, _ in flight.records] == sorted(t for t, _ in flight.records)


def judged(path: Path, name: str, *fields: str, sensor: int | None = None) -> list[tuple[float, ...]]:
    """What DFReader reads of it."""
    reader, found = DFReader_binary(str(path)), []
    while (message := reader.recv_match(type=[name], strict=True)) is not None:
        if sensor is None or sensor == message.I:
            found.append((message.TimeUS, *(getattr(message, field) for field in fields)))
    reader.close()
    return found


@pytest.mark.parametrize("real", [False, pytest.param(True, marks=pytest.mark.shared)])
async def test_dfreader_reads_the_same(tmp_path, real):
    path = REAL if real else written(tmp_path, 1.0)
    kept, _ = await played(path)
    gyro = judged(path, "IMU", "GyrX", "GyrY", "GyrZ", sensor=None if real else 0)
    np.testing.assert_allclose([sample.gyro for sample in kept.imu], [row[1:] for row in gyro], rtol=1e-6)
    times = np.diff([1e-6 * row[0] for row in gyro])
    assert np.diff([sample.t for sample in kept.imu]) == pytest.approx(times, abs=1e-6)
    attitudes = judged(path, "ATT", "Roll", "Pitch", "Yaw")
    assert len(kept.poses) == len(attitudes)
    for pose, (_, *angles) in zip(kept.poses, attitudes, strict=True):
        expected = rotation.from_euler(*np.radians(angles))
        np.testing.assert_allclose(pose.world_from_body, expected, atol=1e-6)


async def test_a_log_whose_gyro_is_too_slow_names_the_setting_for_the_next_flight(tmp_path):
    _, autopilot = await played(written(tmp_path, gyro_hz=25))
    assert "fly again with the fast IMU in LOG_BITMASK" in "\n".join(autopilot.account())


@pytest.mark.shared
async def test_a_real_planes_log_has_all_that_it_holds():
    kept, _ = await played(REAL)
    assert (len(kept.imu), len(kept.poses)) == (45, 24)
    assert sum(pose.position is not None for pose in kept.poses) == 23
    # Its estimator's origin is 6 m west of where it stands (NKF1: PN 0.93, PE -5.72).
    assert kept.poses[-1].position == pytest.approx([0.93, -5.72, 1.2], abs=0.3)
    assert read_dataflash(REAL).utc_offset == pytest.approx(
        DFReader_binary(str(REAL)).clock.timebase, abs=0.1
    )


def test_a_log_that_is_cut_off_or_has_holes_is_used_as_far_as_it_goes(tmp_path, caplog):
    path = written(tmp_path, 2.0)
    whole, data = len(read_dataflash(path).records), path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    assert 0.3 * whole < len(read_dataflash(path).records) < 0.7 * whole
    path.write_bytes(data[:20_000] + bytes(3000) + data[23_000:] + b"\xff" * 240)
    assert 0.9 * whole < len(read_dataflash(path).records) < whole
    assert "bytes are damaged; the rest is used" in caplog.text


def fmt(kind: int, length: int, name: bytes, types: bytes, columns: bytes) -> bytes:
    return MARKS + b"\x80" + struct.pack("<BB4s16s64s", kind, length, name, types, columns)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "begins with nothing, expected a DataFlash log"),
        (b"FMT, 128, 89, FMT, BBnNZ, Type", "turned into text, expected the .bin that it was made of"),
        (b"ULog\x01\x12\x35\x01" + bytes(8), "is a ULog of PX4 (.ulg), expected a DataFlash log"),
        (
            (1_700_000_000_000_000).to_bytes(8, "big") + b"\xfd\x09",
            "is a ground station's telemetry log (.tlog)",
        ),
        (MARKS, "holds no gyro, expected IMU messages"),
        (fmt(0x85, 0, b"IMU", b"", b"") + (MARKS + b"\x85") * 1000, "holds no gyro"),
        (fmt(0x85, 3, b"IMU", b"", b"") + (MARKS + b"\x85") * 1000, "holds no gyro"),
        (fmt(0x85, 255, b"IMU", b"Q" * 16, b"TimeUS"), "holds no gyro"),
        (fmt(0x80, 3, b"FMT", b"", b"") * 50, "holds no gyro"),
        (
            fmt(0x85, 59, b"IMU", b"dffffff" + b"Q" * 3, b"TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,a,b,c")
            + (MARKS + b"\x85" + struct.pack("<d", math.nan) + bytes(48)) * 9,
            "is damaged",
        ),
    ],
    ids=["empty", "text", "ulog", "tlog", "marks", "length 0", "length 3", "lengths", "itself", "times"],
)
def test_a_file_that_is_no_log_is_said(tmp_path, content, expected):
    path = tmp_path / "flight.bin"
    path.write_bytes(content)
    with pytest.raises(SourceError) as raised:
        read_dataflash(path)
    assert expected in str(raised.value)
    assert str(path) in str(raised.value)


@pytest.mark.parametrize(
    "count", [40, pytest.param(MUTANTS, marks=pytest.mark.long("many times as many of them"))]
)
@pytest.mark.parametrize("real", [False, pytest.param(True, marks=pytest.mark.shared)])
def test_a_mutant_of_a_log_is_read_soon_or_refused_in_a_sentence(tmp_path, count, real):
    good = (REAL if real else written(tmp_path, 0.1)).read_bytes()
    path = tmp_path / "mutant.bin"
    read, refused = 0, []
    for mutant in mutants(good, count, seed=7):
        path.write_bytes(mutant)
        try:
            with soon_and_small():
                read += bool(read_dataflash(path).records)
        except SourceError as error:
            refused.append(str(error))
    assert read > 0.5 * count
    assert all(sentence.isprintable() for sentence in refused)


def test_a_log_of_the_smallest_messages_needs_little_memory(tmp_path):
    """Messages that have nothing but a time."""
    path = tmp_path / "flight.bin"
    path.write_bytes(fmt(0x86, 11, b"IMU", b"Q", b"TimeUS") + (MARKS + b"\x86" + bytes(8)) * 30_000)
    with soon_and_small(megabytes=10.0), pytest.raises(SourceError, match="holds no gyro"):
        read_dataflash(path)


def test_a_log_of_nothing_but_gyro_needs_little_more_memory_than_its_records(tmp_path):
    path = tmp_path / "flight.bin"
    samples = [MARKS + b"\x86" + struct.pack("<Q6f", 1000 * k, *[0.1] * 6) for k in range(30_000)]
    path.write_bytes(
        fmt(0x86, 35, b"IMU", b"Qffffff", b"TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ") + b"".join(samples)
    )
    with soon_and_small(10.0, megabytes=12.0):
        assert len(read_dataflash(path).records) > 30_000


def test_a_log_has_an_address_like_other_recordings():
    assert str(parse_address("/logs/00000012.BIN")) == "bin:/logs/00000012.BIN?speed=1"
    assert str(parse_address("bin:a.bin?speed=0")) == "bin:a.bin?speed=0"
    assert is_recording("bin:a.bin")
    # What is written in front counts, not how the file is called.
    assert str(parse_address("tlog:flight.ulg")) == "tlog:flight.ulg?speed=1"


def config(folder: Path) -> Path:
    path = folder / "drone.toml"
    path.write_text(
        'drone.id = 3\n[camera]\nsource = "file://unused.avi"\n'
        "intrinsics = { fx = 215.0, fy = 215.0, cx = 159.5, cy = 119.5, width = 320, height = 240 }\n"
    )
    return path


@pytest.mark.parametrize(("option", "said"), [("--tlog", "--bin"), ("--ulog", "--bin")])
def test_import_names_the_option_of_a_log_of_another_kind(capsys, tmp_path, option, said):
    path = written(tmp_path, 0.1)
    (tmp_path / "a.avi").write_bytes(b"")
    options = (
        "--video",
        str(tmp_path / "a.avi"),
        "--config",
        str(config(tmp_path)),
        "--out",
        str(tmp_path),
    )
    assert swarmtrack.main(["import", option, str(path), *options]) == 2
    error = capsys.readouterr().err
    assert "is a DataFlash log of ArduPilot (.bin), expected" in error
    assert f"import it with {said}" in error
    assert "Traceback" not in error


def test_import_makes_a_recording_of_a_log_and_a_video(capsys, tmp_path):
    log = written(tmp_path, 2.0)
    video = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (320, 240))
    for shade in range(5):
        video.write(np.full((240, 320, 3), 100 + shade, np.uint8))
    video.release()
    out = tmp_path / "out"
    options = ("--video", str(tmp_path / "a.avi"), "--config", str(config(tmp_path)), "--out", str(out))
    assert swarmtrack.main(["import", "--bin", str(log), *options, "--offset", "1.0"]) == 0
    assert "5 frames, 800 gyro samples, 5 scans" in capsys.readouterr().out
    (recording,) = recordings_below(out)
    assert float(recording.preface["utc_s"]) == pytest.approx(UTC_AT_BOOT + 90.0, abs=0.01)
