"""Advice on logs is followed: somebody does what a refusal or the account of an import says, and the log is used.

Another log (SDLOG_PROFILE, LOG_BITMASK) or another file of the same flight stands for a flight that is flown again.
"""

from __future__ import annotations

import gzip
import io
import re
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common

from support.autopilot_flight import Listener
from support.dataflash_writer import DataflashLog
from support.fake_autopilot import FakeAutopilot
from swarmtrack.autopilot.global_position import GlobalPosition
from swarmtrack.autopilot.mavlink_autopilot import MavlinkAutopilot
from swarmtrack.clock import ManualClock
from swarmtrack.errors import SourceError
from swarmtrack.geometry.geodesy import Geodetic
from swarmtrack.lab.autopilots.senses import GpsFix

HOME = Geodetic.from_degrees(47.0, 8.0, 400.0)
RAW_IMU, ATTITUDE, LOCAL, GLOBAL, GPS = (
    common.MAVLINK_MSG_ID_RAW_IMU,
    common.MAVLINK_MSG_ID_ATTITUDE,
    common.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    common.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
    common.MAVLINK_MSG_ID_GPS_RAW_INT,
)
WHOLE = {RAW_IMU: 100.0, ATTITUDE: 50.0, LOCAL: 20.0, GLOBAL: 20.0, GPS: 5.0}


def tlog(rates: dict[int, float] = WHOLE, systems: tuple[int, ...] = (1,), seconds: float = 10.0) -> bytes:
    """A ground station's log, each stream at its rate [Hz]."""
    autopilots, log = [FakeAutopilot(boot_at=60.0, system=system) for system in systems], b""
    for autopilot in autopilots:
        autopilot.gps = GpsFix(HOME, 0.9)
        for message_id, hz in rates.items():
            autopilot.set_interval(message_id, 1e6 / hz, 100.0)
    for k in range(round(100 * seconds)):
        t = 100.0 + 0.01 * k
        for autopilot in autopilots:
            for data in autopilot.step(t):
                log += round((1.7e9 + t) * 1e6).to_bytes(8, "big") + data
    return log


def dataflash(gyro_hz: int = 200, *, attitude: bool = True, position: bool = True) -> bytes:
    log = DataflashLog()
    log.define("IMU", "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ")
    log.define("ATT", "Qffffff", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw")
    log.define("XKF1", "QBffffff", "TimeUS,C,VN,VE,VD,PN,PE,PD")
    for k in range(4 * gyro_hz):
        us = 10_000_000 + k * 1_000_000 // gyro_hz
        log.add("IMU", us, 0, *[0.0] * 6)
        if attitude and k % (gyro_hz // 20) == 0:
            log.add("ATT", us, *[0.0] * 6)
        if position and k % (gyro_hz // 20) == 0:
            log.add("XKF1", us, 0, *[0.0] * 6)
    return log.bytes()


async def read(path: Path, scheme: str = "tlog", *, gps: bool = False, system: int | None = None) -> str:
    """The account of an import."""
    unit = MavlinkAutopilot(
        f"{scheme}:{path}?speed=0",
        clock=ManualClock(1000.0),
        gps=GlobalPosition(HOME) if gps else None,
        system_id=system,
    )
    await unit.run(Listener())
    return "\n".join(unit.account())


def zipped(data: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("flight.tlog", data)
    return file.getvalue()


def unzipped(data: bytes) -> bytes:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return archive.read(archive.namelist()[0])


@pytest.mark.parametrize(
    ("wrap", "unwrap", "advice"),
    [
        (gzip.compress, gzip.decompress, "is compressed by gzip, expected the log in it"),
        (zipped, unzipped, "is a ZIP archive, expected the log in it"),
    ],
)
async def test_a_log_that_is_unpacked_is_read(
    tmp_path: Path, wrap: Callable[[bytes], bytes], unwrap: Callable[[bytes], bytes], advice: str
) -> None:
    path = tmp_path / "flight.tlog"
    path.write_bytes(wrap(tlog()))
    with pytest.raises(SourceError, match=advice):
        await read(path)
    path.write_bytes(unwrap(path.read_bytes()))
    assert "gyro samples from RAW_IMU (100 Hz)" in await read(path)


@pytest.mark.parametrize(("wrong", "right", "made"), [("tlog", "bin", dataflash), ("bin", "tlog", tlog)])
async def test_a_log_is_read_by_the_option_and_by_the_address_that_a_refusal_names(
    tmp_path: Path, wrong: str, right: str, made: Callable[[], bytes]
) -> None:
    path = tmp_path / "flight.log"
    path.write_bytes(made())
    with pytest.raises(SourceError, match="import it with --") as refused:
        await read(path, wrong)
    named = re.search(r"import it with --(\w+), or write its address as (\w+):FILE", str(refused.value))
    assert named is not None
    assert named[1] == named[2] == right
    assert "gyro samples from" in await read(path, named[1])


async def test_mavlink_without_times_is_read_as_a_telemetry_log_of_the_same_flight(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    path.write_bytes(FakeAutopilot().step(0.0)[0])
    with pytest.raises(
        SourceError, match="expected a telemetry log, which has a time in front of each frame"
    ):
        await read(path)
    path.write_bytes(tlog())
    assert "gyro samples from RAW_IMU (100 Hz)" in await read(path)


async def test_of_two_vehicles_each_is_taken_by_its_id(tmp_path: Path) -> None:
    path = tmp_path / "flight.tlog"
    path.write_bytes(tlog(systems=(1, 2)))
    with pytest.raises(
        SourceError, match=r"two autopilots send, 1/1 .* and 2/1 .*: set autopilot\.system_id"
    ):
        await read(path)
    for system in (1, 2):
        assert f"came from autopilot {system}/1" in await read(path, system=system)


def left(rates: dict[int, float], *ids: int) -> dict[int, float]:
    return {i: hz for i, hz in rates.items() if i not in ids}


# The log, its scheme and whether by GPS; the advice of its account; and the same of the next log, or of the next try.
Log = tuple[Callable[[], bytes], str, bool]
LACKS: dict[str, tuple[Log, str, Log]] = {
    "a slow gyro": (
        (lambda: tlog(WHOLE | {RAW_IMU: 4.0}), "tlog", False), r"import the autopilot's own log \(--bin, --ulog\), or",
        (dataflash, "bin", False),
    ),
    "a slow gyro, sent faster": (
        (lambda: tlog(WHOLE | {RAW_IMU: 4.0}), "tlog", False), r"or let it send faster and record again",
        (tlog, "tlog", False),
    ),
    "a slow gyro of its own log": (
        (lambda: dataflash(20), "bin", False), "fly again with the fast IMU in LOG_BITMASK",
        (dataflash, "bin", False),
    ),
    "no attitude": (
        (lambda: tlog(left(WHOLE, ATTITUDE)), "tlog", False), "ATTITUDE_QUATERNION or ATTITUDE is needed",
        (tlog, "tlog", False),
    ),
    "no attitude of its own log": (
        (lambda: dataflash(attitude=False, position=False), "bin", False), "ATT, XKQ or XKF1 is needed",
        (lambda: dataflash(position=True), "bin", False),
    ),
    "no position": (
        (lambda: tlog(left(WHOLE, LOCAL, GLOBAL)), "tlog", False), "LOCAL_POSITION_NED is needed",
        (tlog, "tlog", False),
    ),
    "no position of its own log": (
        (lambda: dataflash(position=False), "bin", False), "POS or a valid XKF1 is needed",
        (dataflash, "bin", False),
    ),
    "a position by GPS only": (
        (lambda: tlog(left(WHOLE, LOCAL)), "tlog", False),
        'GLOBAL_POSITION_INT only, which drone.start = { from = "gps" } and a team.origin use',
        (lambda: tlog(left(WHOLE, LOCAL)), "tlog", True),
    ),
    "no fix": (
        (lambda: tlog(left(WHOLE, GPS)), "tlog", True), r"GPS_RAW_INT or GPS2_RAW is needed",
        (tlog, "tlog", True),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LACKS)
async def test_who_follows_the_account_of_an_import_does_not_read_of_the_lack_again(
    tmp_path: Path, name: str
) -> None:
    path, accounts = tmp_path / "flight.log", []
    before, advice, after = LACKS[name]
    for made, scheme, gps in (before, after):
        path.write_bytes(made())
        accounts.append(await read(path, scheme, gps=gps))
    assert re.search(advice, accounts[0]), accounts[0]
    assert not re.search(advice, accounts[1]), accounts[1]
