"""The stand-in flight controller and the clocks of public field reports (../shared/field), as telemetry logs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from support.autopilot_flight import Listener
from support.places import SHARED
from swarmtrack.autopilot.global_position import GlobalPosition
from swarmtrack.autopilot.mavlink_autopilot import MavlinkAutopilot
from swarmtrack.autopilot.tlog import records
from swarmtrack.clock import ManualClock
from swarmtrack.errors import SourceError
from swarmtrack.geometry.geodesy import Geodetic

FIELD = SHARED.parent / "field"
pytestmark = [
    pytest.mark.shared,
    pytest.mark.skipif(not FIELD.is_dir(), reason="../shared/field is absent"),
]
HOME = Geodetic.from_degrees(-35.363262, 149.165237, 584.0)


def made(script: str, *arguments: object) -> None:
    """By one of the scripts there."""
    subprocess.run(
        [sys.executable, str(FIELD / script), *map(str, arguments)],
        check=True,
        capture_output=True,
        timeout=60.0,
    )


async def played(
    log: Path, gps: GlobalPosition | None = None, system_id: int | None = None
) -> tuple[Listener, MavlinkAutopilot]:
    kept = Listener()
    autopilot = MavlinkAutopilot(
        f"tlog:{log}?speed=0", clock=ManualClock(1000.0), gps=gps, system_id=system_id
    )
    await autopilot.run(kept)
    return kept, autopilot


async def board(
    folder: Path, case: str, *, seconds: float = 10.0, gps: GlobalPosition | None = None
) -> tuple[Listener, MavlinkAutopilot]:
    made("A_board.py", case, "--seconds", seconds, "--tlog", folder / "flight.tlog")
    return await played(folder / "flight.tlog", gps)


@pytest.mark.parametrize("case", ["normal", "split", "tracker_first"])
async def test_all_of_one_vehicle_is_used(tmp_path, case):
    kept, autopilot = await board(tmp_path, case)
    assert len(kept.imu) == pytest.approx(2000, abs=20)
    assert sum(pose.position is not None for pose in kept.poses) == pytest.approx(500, abs=20)
    assert kept.reboots == 0
    assert autopilot.status().ok
    assert autopilot.account()[0].startswith("came from autopilot 1/1: ")
    assert ("2/1 antenna tracker" in "\n".join(autopilot.account())) == (case == "tracker_first")


@pytest.mark.parametrize("case", ["neighbour_first", "neighbour_full"])
async def test_of_two_vehicles_none_is_taken_until_one_is_named(tmp_path, case):
    _, autopilot = await board(tmp_path, case)
    with pytest.raises(SourceError, match=r"two autopilots send, 1/1 .* and 2/1 .*system_id"):
        autopilot.account()
    kept, autopilot = await played(tmp_path / "flight.tlog", system_id=1)
    assert len(kept.imu) == pytest.approx(2000, abs=120)
    assert "2/1 quadrotor" in "\n".join(autopilot.account())


async def test_two_vehicles_of_one_id_are_said(tmp_path, caplog):
    kept, _ = await board(tmp_path, "same_sysid")
    assert "two autopilots send as system 1 component 1" in caplog.text
    assert kept.reboots == 0


@pytest.mark.parametrize(("case", "seconds"), [("late_copy", 15.0), ("late_one", 40.0)])
async def test_what_comes_again_by_a_slower_way_is_dropped(tmp_path, case, seconds):
    kept, autopilot = await board(tmp_path, case, seconds=seconds)
    assert len(kept.imu) == pytest.approx(200 * seconds, abs=20)
    assert kept.reboots == 0
    assert autopilot.status().ok
    assert "copies of earlier messages" in "\n".join(autopilot.account())


async def test_a_second_receiver_is_enough_for_a_start_by_gps(tmp_path):
    kept, _ = await board(tmp_path, "gps2_only", gps=GlobalPosition(HOME))
    assert sum(pose.position is not None for pose in kept.poses) > 450


async def test_a_ground_stations_log_is_used_and_its_gyro_called_too_slow(tmp_path):
    kept, autopilot = await board(tmp_path, "gcs_log", seconds=30.0)
    assert len(kept.poses) == pytest.approx(120, abs=3)
    assert "the gyro is too slow, 3.5" in "\n".join(autopilot.account())


async def test_a_place_that_leaps_is_followed(tmp_path):
    made("A_board.py", "pos_reset", "--seconds", 10, "--at", 6, "--tlog", tmp_path / "flight.tlog")
    kept, _ = await played(tmp_path / "flight.tlog")
    placed = [pose.position for pose in kept.poses if pose.position is not None]
    assert placed[0] == pytest.approx([0.0, 0.0, -3.0])
    assert placed[-1] == pytest.approx([7.0, 0.0, -3.0])


async def test_all_of_a_flight_is_used_whose_computers_clock_is_set(tmp_path):
    # The clock is set at 30 s.
    real, folder = tmp_path / "real.tlog", tmp_path / "set"
    recorded = list(records((SHARED / "mavlink" / "ardupilot_sitl.tlog").read_bytes()))
    begin = [(t, frame) for t, frame in recorded if t < recorded[0][0] + 34.0]
    real.write_bytes(b"".join(round(1e6 * t).to_bytes(8, "big") + frame for t, frame in begin))
    made("A_tlog_clock.py", real, folder)
    expected, _ = await played(real)
    assert expected.imu[-1].t > 1032.0
    logs = sorted(folder.glob("*.tlog"))
    assert len(logs) == 3
    for log in logs:
        kept, _ = await played(log)
        assert len(kept.imu) == pytest.approx(len(expected.imu), abs=5)
        assert kept.imu[-1].t == pytest.approx(expected.imu[-1].t, abs=0.05)
        assert len(kept.poses) == pytest.approx(len(expected.poses), abs=5)
