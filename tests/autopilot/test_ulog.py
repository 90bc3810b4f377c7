"""PX4's own logs: two of real boards, one that is made here, and files that are none."""

from __future__ import annotations

import re
import struct
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from support.autopilot_flight import Listener
from support.mutants import MUTANTS, mutants
from support.patience import soon, soon_and_small
from support.places import SHARED
from swarmtrack.agents import main as swarmtrack
from swarmtrack.autopilot import log_files
from swarmtrack.autopilot.address import is_recording, parse_address
from swarmtrack.autopilot.global_position import GlobalPosition
from swarmtrack.autopilot.log_files import time_limit
from swarmtrack.autopilot.mavlink_autopilot import MavlinkAutopilot
from swarmtrack.autopilot.ulog import read_ulog
from swarmtrack.clock import ManualClock
from swarmtrack.errors import SourceError
from swarmtrack.geometry import rotation
from swarmtrack.geometry.geodesy import Geodetic, from_ned
from swarmtrack.recording.reader import recordings_below

HAND_TURNED = SHARED / "mavlink" / "pyulog_sample_auav_x21.ulg"
CUBE = SHARED / "mavlink" / "pyulog_sample_log_small_cubeorange.ulg"
EVENTS = SHARED / "mavlink" / "pyulog_sample_px4_events.ulg"
HOME = Geodetic.from_degrees(47.397742, 8.545594, 488.0)


async def played(path: Path, gps: GlobalPosition | None = None) -> tuple[Listener, MavlinkAutopilot]:
    clock, kept = ManualClock(1000.0), Listener()
    autopilot = MavlinkAutopilot(f"ulog:{path}?speed=0", clock=clock, gps=gps)
    await autopilot.run(kept)
    assert kept.reboots == 0, "a log is of one boot"
    return kept, autopilot


# --- a log that is made here ----------------------------------------------------------------------

TYPES = {"uint64_t": "Q", "float": "f", "double": "d", "uint8_t": "B", "int32_t": "i", "bool": "?"}


class Log:
    """Writes ULog: https://docs.px4.io/main/en/dev_log/ulog_file_format.html."""

    def __init__(self) -> None:
        self._formats = b""
        self._subscriptions = b""
        self._data: list[tuple[int, bytes]] = []
        self._count = 0

    def topic(self, name: str, fields: dict[str, str], rows: list[tuple]) -> None:
        """fields: name to type, arrays as type[n]; rows: the time stamp in µs first."""
        listed = {"timestamp": "uint64_t", **fields}
        text = f"{name}:" + "".join(f"{kind} {field};" for field, kind in listed.items())
        self._formats += _message("F", text.encode())
        self._subscriptions += _message("A", struct.pack("<BH", 0, self._count) + name.encode())
        code = "<" + "".join(_code(kind) for kind in listed.values())
        for row in rows:
            body = struct.pack("<H", self._count) + struct.pack(code, *row)
            self._data.append((row[0], _message("D", body)))
        self._count += 1

    def bytes(self, since: int = 0) -> bytes:
        head = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", since)
        data = b"".join(
            body[:5] + struct.pack("<Q", t + since) + body[13:]
            for t, body in sorted(self._data, key=lambda one: one[0])
        )
        return head + self._formats + self._subscriptions + data


def _message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


def _code(kind: str) -> str:
    word, bracket, count = kind.partition("[")
    return (count.rstrip("]") if bracket else "") + TYPES[word]


def written(
    folder: Path, seconds: float = 4.0, *, valid: bool = True, since: int = 0, climb: float = 0.0
) -> Path:
    """A drone that yaws by 0.5 rad/s and flies north at 2 m/s, 3 m east of home. since [µs]: its clock at the boot."""
    times = [round(5e6 + 4000 * k) for k in range(int(250 * seconds))]
    log = Log()
    log.topic(
        "sensor_combined",
        {"gyro_rad": "float[3]", "gyro_integral_dt": "int32_t", "accelerometer_m_s2": "float[3]"},
        [(t, 0.01, -0.02, 0.5, 4000, 0.0, 0.0, -9.81) for t in times],
    )
    yaws = [0.5 * (t - 5e6) * 1e-6 for t in times]
    log.topic(
        "vehicle_attitude",
        {"q": "float[4]"},
        [
            (t, *rotation.to_quaternion(rotation.from_euler(0.0, 0.0, yaw)).tolist())
            for t, yaw in zip(times, yaws, strict=True)
        ],
    )
    log.topic(
        "vehicle_local_position",
        dict.fromkeys(("x", "y", "z", "vx", "vy", "vz"), "float")
        | {"ref_lat": "double", "ref_lon": "double", "ref_alt": "float"}
        | dict.fromkeys(("xy_valid", "z_valid", "xy_global", "z_global"), "bool"),
        [
            (
                t,
                2e-6 * (t - 5e6),
                3.0,
                -4.0,
                2.0,
                0.0,
                climb,
                *np.degrees(HOME[:2]),
                HOME.height,
                *[valid] * 4,
            )
            for t in times[::5]
        ],
    )
    place = from_ned(np.zeros(3), HOME)
    log.topic(
        "sensor_gps",
        {"latitude_deg": "double", "longitude_deg": "double", "altitude_msl_m": "double"}
        | {"time_utc_usec": "uint64_t", "eph": "float", "epv": "float"}
        | {"fix_type": "uint8_t", "satellites_used": "uint8_t"},
        [
            (t, *np.degrees(place[:2]), place.height, 1_700_000_000_000_000 + t, 0.9, 1.8, 3, 14)
            for t in times[::50]
        ],
    )
    log.topic("vehicle_status", {"arming_state": "uint8_t"}, [(times[0], 1), (times[len(times) // 2], 2)])
    half = times[len(times) // 2]
    log.topic("vehicle_land_detected", {"landed": "bool"}, [(t, t < half) for t in times[::50]])
    path = folder / "flight.ulg"
    path.write_bytes(log.bytes(since))
    return path


async def test_a_log_is_what_its_autopilot_would_have_said(tmp_path):
    kept, autopilot = await played(written(tmp_path))
    assert len(kept.imu) == pytest.approx(1000, abs=2)
    assert np.diff([sample.t for sample in kept.imu]) == pytest.approx(0.004, abs=1e-6)
    assert kept.imu[5].gyro == pytest.approx([0.01, -0.02, 0.5], abs=1e-6)
    assert dict(autopilot.status().counters)["imu_lost"] == 0
    # 50 Hz are asked for in flight.
    assert len(kept.poses) == pytest.approx(200, abs=3)
    # It is armed and leaves the ground after two seconds.
    assert kept.states[0].airborne_since is None
    assert kept.states[-1].airborne_since is not None
    begin = kept.imu[0].t
    for pose in kept.poses[10:]:
        elapsed = pose.t - begin
        assert pose.position == pytest.approx([2.0 * elapsed, 3.0, -4.0], abs=0.05)
        assert rotation.to_euler(pose.world_from_body)[2] == pytest.approx(0.5 * elapsed, abs=5e-3)


async def test_by_gps_a_logged_flight_is_in_the_team_frame(tmp_path):
    origin = from_ned(np.array([-10.0, -20.0, 0.0]), HOME)
    kept, _ = await played(written(tmp_path), GlobalPosition(origin))
    begin = kept.imu[0].t
    placed = [pose for pose in kept.poses if pose.position is not None]
    assert len(placed) > 150
    for pose in placed:
        assert pose.position == pytest.approx([10.0 + 2.0 * (pose.t - begin), 23.0, -4.0], abs=0.08)


async def test_an_estimate_that_is_not_valid_is_no_position(tmp_path):
    kept, _ = await played(written(tmp_path, valid=False))
    assert kept.poses
    assert all(pose.position is None for pose in kept.poses)


@pytest.mark.parametrize("climb", [np.nan, np.inf, -1e38])
async def test_a_velocity_that_no_drone_has_costs_positions_and_no_more(tmp_path, climb):
    kept, _ = await played(written(tmp_path, 1.0, climb=climb))
    assert len(kept.imu) > 240
    assert all(pose.position is None for pose in kept.poses)


def test_the_time_of_day_is_that_of_the_gps(tmp_path):
    flight = read_ulog(written(tmp_path))
    assert flight.utc_offset == pytest.approx(1.7e9, abs=1e-3)
    assert [t for t, _ in flight.records] == sorted(t for t, _ in flight.records)


def test_a_log_that_is_cut_off_is_used_as_far_as_it_goes(tmp_path):
    path = written(tmp_path)
    whole = len(read_ulog(path).records)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert 0.3 * whole < len(read_ulog(path).records) < 0.7 * whole


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (
            b"\xa3\x95\x80\x80\x59FMT",
            "is a DataFlash log of ArduPilot (.bin), expected a ULog of PX4 (.ulg): import",
        ),
        (b"", "begins with nothing, expected a ULog"),
        (
            b"\x00\x05\x9c\x11\x22\x33\x44\x55\xfd",
            "is a ground station's telemetry log (.tlog), expected a ULog",
        ),
        (b"\x1f\x8b\x08\x00", "is compressed by gzip, expected the log in it"),
        (b"ULog\x01\x12\x35", "is broken or cut off in its header"),
        (b"ULog\x01\x12\x35\x01" + bytes(8), "holds no gyro, expected the topic sensor_combined"),
        (b"ULog\x01\x12\x35\x01" + bytes(8) + bytes(range(256)) * 40, "is broken or cut off"),
    ],
)
def test_a_file_that_is_no_log_is_said(tmp_path, content, expected):
    path = tmp_path / "flight.ulg"
    path.write_bytes(content)
    with pytest.raises(SourceError) as raised:
        read_ulog(path)
    assert expected in str(raised.value)
    assert str(path) in str(raised.value)


def formats(*texts: str, then: bytes = b"") -> bytes:
    head = b"ULog\x01\x12\x35\x01" + bytes(8)
    subscribed = _message("A", struct.pack("<BH", 0, 0) + b"sensor_combined")
    return head + b"".join(_message("F", text.encode()) for text in texts) + then + subscribed


NESTED = [f"f{k}:f{k + 1}[99] x;" for k in range(6)]


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (
            formats("sensor_combined:uint64_t timestamp;uint8_t[1000] x;")
            + b"".join(_message("A", struct.pack("<BH", 0, k) + b"sensor_combined") for k in range(200)),
            "its topics have more than 100000 fields in all",
        ),
        (
            formats("sensor_combined:uint64_t timestamp;f0[99] x;", *NESTED, "f6:uint8_t[99] x;"),
            "has 9801 fields",
        ),
        (
            formats("sensor_combined:uint64_t timestamp;sensor_combined[2] x;"),
            "sensor_combined contains itself",
        ),
        (formats("sensor_combined:a x;", "a:b x;", "b:a x;"), "contains itself"),
        (formats(*[f"f{k}:f{k + 1} x;" for k in range(2000)]), "more than 8 deep"),
        (formats("sensor_combined:uint8_t[65535] x;"), "has 65535 fields"),
        (formats(then=struct.pack("<HB", 60_000, 0xEE)), "is broken or cut off in its header, at byte 16"),
        (formats(then=struct.pack("<HB", 20_000, 0) + bytes(4000)), "is broken or cut off in its header"),
    ],
    ids=["subscriptions", "product", "itself", "each other", "deep", "wide", "beyond the end", "zeros"],
)
def test_definitions_that_would_keep_the_reader_busy_for_ever_are_refused(tmp_path, content, expected):
    path = tmp_path / "flight.ulg"
    path.write_bytes(content)
    with pytest.raises(SourceError, match=re.escape(str(path))) as raised:
        read_ulog(path)
    assert expected in str(raised.value)


def test_reading_ends_when_it_takes_far_too_long(tmp_path, monkeypatch):
    monkeypatch.setattr(log_files, "LOG_READ_S", 0.1)
    path = tmp_path / "flight.ulg"
    path.write_bytes(b"")

    def read(size: int) -> None:
        begin = time.process_time()
        with time_limit(path), open("/dev/zero", "rb", buffering=0) as zeros:
            while time.process_time() < begin + 30.0:
                zeros.read(size)

    for size in (0, 1 << 20):  # in our own code, and in the system's
        with soon(1.0), pytest.raises(SourceError, match=r"is not read after 0\.1 s of work"):
            read(size)


@pytest.mark.parametrize("byte", [b"\0", b"\xff"], ids=["reserved", "erased"])
def test_a_tail_that_was_never_written_takes_no_time(tmp_path, byte):
    path = written(tmp_path, 1.0)
    records = read_ulog(path).records
    with path.open("ab") as file:
        file.write(byte * 20_000_000)
    with soon():
        assert read_ulog(path).records == records


@pytest.mark.parametrize(
    "count", [100, pytest.param(MUTANTS, marks=pytest.mark.long("a hundred times as many of them"))]
)
def test_a_mutant_of_a_log_is_read_soon_or_refused_in_a_sentence(tmp_path, count):
    path = written(tmp_path, 0.3)
    good = path.read_bytes()
    read, refused = 0, []
    for mutant in mutants(good, count, seed=5):
        path.write_bytes(mutant)
        try:
            with soon_and_small():
                read += bool(read_ulog(path).records)
        except SourceError as error:
            refused.append(str(error))
    assert read > 0.3 * count
    assert all(sentence.isprintable() for sentence in refused)


def test_stamps_since_1970_are_those_of_a_board_that_has_just_started(tmp_path):
    """As PX4's simulation writes them."""
    path = written(tmp_path, 1.0, since=1_700_000_000_000_000)
    flight = read_ulog(path)
    assert flight.records[-1][0] < 2**32 * 1e-3
    assert flight.records[0][0] + flight.utc_offset == pytest.approx(1.7e9 + 5.0, abs=0.01)


def test_a_log_damaged_anywhere_ends_in_a_sentence_or_in_what_can_be_read(tmp_path):
    """Any four hundred bytes of it, overwritten."""
    path = written(tmp_path, 1.0)
    whole, chance = path.read_bytes(), np.random.default_rng(1)
    read = refused = 0
    for _ in range(40):
        start = int(chance.integers(len(whole) - 400))
        path.write_bytes(whole[:start] + chance.bytes(400) + whole[start + 400 :])
        try:
            read += bool(read_ulog(path).records)
        except SourceError:
            refused += 1
    assert read + refused == 40
    assert read > 20


def test_a_log_has_an_address_like_other_recordings():
    assert str(parse_address("flights/a.ulg")) == "ulog:flights/a.ulg?speed=1"
    assert str(parse_address("ulog:a.ulg?speed=0")) == "ulog:a.ulg?speed=0"
    assert is_recording("ulog:a.ulg")
    assert not is_recording("udpin:127.0.0.1:14540")


# --- logs of real boards --------------------------------------------------------------------------


@pytest.mark.shared
async def test_a_real_board_turned_by_hand_turned_as_its_gyro_says():
    """Gyro, integrated, beside the attitude of the board's own estimator: independent but for the same sensor."""
    kept, autopilot = await played(HAND_TURNED)
    assert len(kept.imu) == 17070
    assert np.median(np.diff([sample.t for sample in kept.imu])) == pytest.approx(0.004, abs=1e-4)
    t = np.array([sample.t for sample in kept.imu])
    gyro = np.array([sample.gyro for sample in kept.imu])
    assert np.abs(gyro).max() == pytest.approx(2.8, abs=0.2)
    errors = []
    for before, after in zip(kept.poses[::10], kept.poses[10::10], strict=False):
        inside = (t > before.t) & (t <= after.t)
        turned = np.eye(3)
        for rate, dt in zip(gyro[inside], np.diff(t[inside], prepend=before.t), strict=True):
            turned = turned @ rotation.exp(rate * dt)
        said = before.world_from_body.T @ after.world_from_body
        errors.append(np.linalg.norm(rotation.log(turned.T @ said)))
    assert np.degrees(np.median(errors)) < 0.5
    # Never armed, and it never knew where it was.
    assert all(pose.position is None for pose in kept.poses)
    assert "streaming" in autopilot.status().text or "ended" in autopilot.status().text


@pytest.mark.shared
async def test_a_simulation_of_px4_whose_clock_is_utc_is_read_whole():
    kept, autopilot = await played(EVENTS)
    assert len(kept.imu) == 7783
    assert len(kept.poses) == 622
    account = "\n".join(autopilot.account())
    assert "98 positions (not valid by PX4's own word: take off once its estimator has GPS" in account
    assert "215 positions" in account
    assert len({pose.position.tobytes() for pose in kept.poses if pose.position is not None}) > 215
    assert kept.poses[0].t == pytest.approx(kept.imu[0].t, abs=0.1)
    assert read_ulog(EVENTS).records[0][0] < 2**32 * 1e-3


@pytest.mark.shared
async def test_a_real_cube_at_rest():
    kept, _ = await played(CUBE)
    assert len(kept.imu) == 1298
    rate = 1297 / (kept.imu[-1].t - kept.imu[0].t)
    assert rate == pytest.approx(199.7, rel=0.01)
    assert np.abs([sample.gyro for sample in kept.imu]).max() < 0.05
    # 2021, by its GPS.
    assert read_ulog(CUBE).utc_offset == pytest.approx(1.6189866e9, abs=60.0)


# --- the command ----------------------------------------------------------------------------------


def test_import_needs_one_log(capsys, tmp_path):
    with pytest.raises(SystemExit):
        swarmtrack.main(["import", "--video", "a.mp4", "--config", "a.toml", "--out", str(tmp_path)])
    assert "one of the arguments --tlog --ulog --bin is required" in capsys.readouterr().err


def test_import_makes_a_recording_of_a_log_and_a_video(capsys, tmp_path):
    log = written(tmp_path)
    video = cv2.VideoWriter(str(tmp_path / "flight.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (320, 240))
    for shade in range(20):
        video.write(np.full((240, 320, 3), 100 + shade, np.uint8))
    video.release()
    config = tmp_path / "drone.toml"
    config.write_text(
        'drone.id = 3\n[camera]\nsource = "file://unused.avi"\n'
        "intrinsics = { fx = 215.0, fy = 215.0, cx = 159.5, cy = 119.5, width = 320, height = 240 }\n"
    )
    out = tmp_path / "out"
    options = ("--video", str(tmp_path / "flight.avi"), "--config", str(config), "--out", str(out))
    assert swarmtrack.main(["import", "--ulog", str(log), *options, "--offset", "1.0"]) == 0
    assert "20 frames, 1000 gyro samples, 20 scans" in capsys.readouterr().out
    (recording,) = recordings_below(out)
    # GPS told the time of day: 5 s after boot, when the log began.
    assert float(recording.preface["utc_s"]) == pytest.approx(1.7e9 + 5.0, abs=0.01)
