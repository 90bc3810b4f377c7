"""A real agent that may fly: its pilot engages it over UDP, it says why it holds, its flight replays bit for bit."""

import asyncio
import math
import signal
import sys
import time

import numpy as np
from pymavlink.dialects.v20 import common

from support.fake_autopilot import FakeAutopilot, serve_udp
from support.patience import PATIENCE
from support.ports import free_port
from swarmtrack.agents import main as swarmtrack
from swarmtrack.lab.autopilots.firmware import FlightMode

CONFIG = """
[team]
airframe_span_m = 0.5
share = "velocity"

[drone]
id = 2
start = {{ position_m = [-4.0, 3.0, -6.0], position_sigma_m = 0.3 }}

[camera]
source = "detections://127.0.0.1:9/2"
intrinsics = {{ fx = 430.0, fy = 430.0, cx = 319.5, cy = 239.5, width = 640, height = 480 }}

[autopilot]
link = "udpin:127.0.0.1:{port}"

[network]
transport = "memory"

[recording]
dir = "{folder}/rec"

[formation]
enabled = true
leader = 1

[formation.slots]
2 = [-4.0, 3.0, -1.0]
"""


class InTheAir(FakeAutopilot):
    """Hovers at its place; keeps setpoints and texts."""

    def __init__(self, **options):
        super().__init__(**options)
        self.gyro, self.position = np.zeros(3), np.array([0.0, 0.0, -6.0])
        self.setpoints, self.texts = [], []
        self.pilot.armed, self.pilot.status = True, common.MAV_STATE_ACTIVE
        self.pilot.landed = common.MAV_LANDED_STATE_IN_AIR
        self.to(FlightMode.HOLD)

    def to(self, mode):
        self.pilot.mode = self.firmware.modes[mode]

    def understand(self, message, now, channel):
        match message.get_type():
            case "SET_POSITION_TARGET_LOCAL_NED":
                self.setpoints.append((now, message))
            case "STATUSTEXT":
                self.texts.append(message.text)
        super().understand(message, now, channel)


async def until(condition):
    async with asyncio.timeout(PATIENCE):
        while not condition():  # noqa: ASYNC110 (what is waited for happens in another process)
            await asyncio.sleep(0.02)


async def test_an_agent_flies_only_while_its_pilot_wants_it_and_its_flight_replays(tmp_path, capsys):
    port = free_port()
    config = tmp_path / "drone.toml"
    config.write_text(CONFIG.format(port=port, folder=tmp_path))
    autopilot = InTheAir(boot_at=time.monotonic() - 40.0)
    async with serve_udp(autopilot, "127.0.0.1", port):
        agent = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "swarmtrack.agents.vehicle", "--config", str(config), "--quiet",
            stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.DEVNULL,
        )  # fmt: skip
        try:
            await until(lambda: autopilot.companion_heartbeats >= 3)
            assert autopilot.setpoints == []
            autopilot.to(FlightMode.GUIDED)
            await until(lambda: len(autopilot.setpoints) >= 20)
            spacing = np.diff([t for t, _ in autopilot.setpoints])
            assert 0.05 < np.median(spacing) < 0.2
            # It has no camera: it stands, and says why.
            await until(lambda: any("camera is silent" in text for text in autopilot.texts))
            assert all(math.hypot(m.vx, m.vy, m.vz) < 1e-6 for _, m in autopilot.setpoints)
            autopilot.to(FlightMode.HOLD)
            await until(lambda: any("released: mode is LOITER now" in text for text in autopilot.texts))
            sent = len(autopilot.setpoints)
            await asyncio.sleep(1.0)
            assert len(autopilot.setpoints) == sent
        finally:
            agent.send_signal(signal.SIGINT)
            await agent.wait()
    assert swarmtrack.main(["replay", str(tmp_path / "rec"), "--exact"]) == 0
    assert "setpoints compared" in " ".join(capsys.readouterr().out.split())
