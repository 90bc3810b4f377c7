"""What `swarmtrack import` and a replay of its recording report of a flight."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from swarmtrack.agents import main as swarmtrack

UTC, BOOT = 1_700_000_000.0, 100.0
PLACE = -353_632_620, 1_491_652_370, 584_000  # 1e-7°, 1e-7°, mm


def flight(step_deg: float, at: float = 6.0, seconds: float = 9.0) -> bytes:
    """A telemetry log of a drone in the air whose heading is reset without a turn of its gyro."""
    mav, log = common.MAVLink(None, 1, 1), b""
    for k in range(round(200 * seconds)):
        t = k / 200
        us, ms = round(1e6 * (BOOT + t)), round(1e3 * (BOOT + t))
        yaw = math.radians(step_deg) if t > at else 0.0
        said = [common.MAVLink_heartbeat_message(2, 3, 209, 0, common.MAV_STATE_ACTIVE, 3)][k % 200 :]
        said.append(common.MAVLink_highres_imu_message(us, 0.0, 0.0, -9.8, *[0.0] * 10, 63))
        if k % 4 == 0:
            turned = math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)
            said.append(common.MAVLink_attitude_quaternion_message(ms, *turned, 0.0, 0.0, 0.0))
        if k % 20 == 0:
            said.append(common.MAVLink_gps_raw_int_message(us, 3, *PLACE, 80, 100, 0, 0, 14))
            said.append(common.MAVLink_global_position_int_message(ms, *PLACE, 0, 0, 0, 0, 0))
        for message in said:
            log += round(1e6 * (UTC + t)).to_bytes(8, "big") + bytes(message.pack(mav))
    return log


def files(folder: Path, log: bytes) -> list[str]:
    """Options of an import by GPS."""
    (folder / "flight.tlog").write_bytes(log)
    (folder / "drone.toml").write_text(
        "drone.id = 1\nteam.origin = { lat_deg = -35.363262, lon_deg = 149.165237, alt_m = 584.0 }\n"
        'drone.start = { from = "gps" }\n[camera]\nsource = "file://unused.avi"\n'
        "intrinsics = { fx = 215.0, fy = 215.0, cx = 159.5, cy = 119.5, width = 320, height = 240 }\n"
    )
    video = cv2.VideoWriter(str(folder / "a.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (320, 240))
    for shade in range(2):
        video.write(np.full((240, 320, 3), 100 + shade, np.uint8))
    video.release()
    names = {"--tlog": "flight.tlog", "--video": "a.avi", "--config": "drone.toml", "--out": "out"}
    return [part for option, name in names.items() for part in (option, str(folder / name))]


@pytest.mark.parametrize(
    "step_deg", [0.0, 150.0, pytest.param(20.0, marks=pytest.mark.long("a smaller step than the other"))]
)
def test_a_heading_that_is_reset_in_flight_is_said(tmp_path, capsys, step_deg):
    assert swarmtrack.main(["import", *files(tmp_path, flight(step_deg))]) == 0
    imported = capsys.readouterr().err
    assert swarmtrack.main(["replay", str(tmp_path / "out")]) == 0
    for said in (imported, capsys.readouterr().out):
        lines = [line for line in said.splitlines() if "our heading" in line]
        assert len(lines) == (step_deg > 0.0)
        assert all(f"at 6.1 s: our heading was reset by +{step_deg:.1f}° against" in line for line in lines)
