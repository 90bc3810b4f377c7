"""The pilot's switch, from the autopilot's socket to what Onboard is told."""

from __future__ import annotations

import asyncio
import time

from support.fake_autopilot import FakeAutopilot, serve_udp
from support.patience import PATIENCE
from support.ports import free_port
from swarmtrack.clock import SystemClock
from swarmtrack.config.drone import load_config
from swarmtrack.messages import AgreedMotion
from swarmtrack.motion.priors import SWAY_BEGINS_EVERY_S
from swarmtrack.outputs.console import Console
from swarmtrack.runtime.agent import Agent
from swarmtrack.runtime.assembly import assemble

CONFIG = """
drone.id = 1
network.transport = "memory"
autopilot.link = "udpin:127.0.0.1:{port}"
[camera]
source = "detections://127.0.0.1:9/"
intrinsics = {{ fx = 600.0, fy = 600.0, cx = 320.0, cy = 256.0, width = 640, height = 512 }}
[team]
announce = false
code = {{ switch = {{ channel = 8 }} }}
drones = {{ 1 = {{}}, 2 = {{}} }}
"""


class Listener:
    """Hears what Onboard is told of codes."""

    def __init__(self):
        self.motions = []
        self.some = asyncio.Event()

    def told(self, event):
        if isinstance(event, AgreedMotion):
            self.motions.append(event)
            self.some.set()

    def asked(self, tracks): ...

    def scanned(self, report, world_from_camera): ...


async def test_the_pilot_throws_the_switch_and_onboard_knows_how_its_teammate_will_sway(tmp_path):
    port, file, clock = free_port(), tmp_path / "drone.toml", SystemClock()
    file.write_text(CONFIG.format(port=port), encoding="utf-8")
    parts = assemble(load_config(file), clock)
    agent = Agent(parts, console=Console(parts.lens, quiet=True))
    heard = parts.door.listener = Listener()
    flying = asyncio.create_task(agent.run())
    autopilot = FakeAutopilot(boot_at=time.monotonic() - 40.0)
    async with serve_udp(autopilot, "127.0.0.1", port), asyncio.timeout(PATIENCE):
        while "switch off" not in parts.autopilot.status().text:  # noqa: ASYNC110 (it happens outside)
            await asyncio.sleep(0.02)
        assert heard.motions == []
        autopilot.rc_us[7] = 1900
        await heard.some.wait()
    agent.stop()
    await flying
    assert {motion.drone_id for motion in heard.motions} == {1, 2}
    began = heard.motions[-1].t[0] + clock.utc() - clock.now()
    assert abs(began / SWAY_BEGINS_EVERY_S - round(began / SWAY_BEGINS_EVERY_S)) < 1e-3
