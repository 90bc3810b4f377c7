"""The last words about a log: what came, what was used, and why not the rest."""

from __future__ import annotations

from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common

from support.autopilot_flight import Listener
from support.fake_autopilot import FakeAutopilot
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


def logged(path: Path, *autopilots: FakeAutopilot, rates: dict[int, float], seconds: float = 20.0) -> Path:
    """A ground station's log of them, each stream at its rate [Hz]."""
    with path.open("wb") as file:
        for autopilot in autopilots:
            autopilot.gps = GpsFix(Geodetic.from_degrees(47.0, 8.0, 400.0), 0.9)
            for message_id, hz in rates.items():
                autopilot.set_interval(message_id, 1e6 / hz, 100.0)
        for k in range(round(100 * seconds)):
            t = 100.0 + 0.01 * k
            for autopilot in autopilots:
                for data in autopilot.step(t):
                    file.write(round((1.7e9 + t) * 1e6).to_bytes(8, "big") + data)
    return path


async def account(path: Path) -> list[str]:
    unit = MavlinkAutopilot(f"tlog:{path}?speed=0", clock=ManualClock(1000.0))
    await unit.run(Listener())
    return unit.account()


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


async def test_a_log_that_is_shorter_than_a_second_is_read(tmp_path):
    log = logged(tmp_path / "a.tlog", FakeAutopilot(boot_at=60.0), rates={RAW_IMU: 100.0}, seconds=0.5)
    assert (await account(log))[1].startswith("used: 49 gyro samples")
