"""`swarmtrack config check --autopilot`, of an autopilot that is there."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path

from support.fake_autopilot import FakeAutopilot, serve_udp
from support.ports import free_port
from swarmtrack.agents.main import main


async def check_asks(make: type[FakeAutopilot], config: str, folder: Path) -> int:
    """Its exit code, once it has asked and written nothing; config: a drone's, with {link} for the autopilot's."""
    port, file = free_port(), folder / "drone.toml"
    file.write_text(config.format(link=f"udpin:127.0.0.1:{port}"))
    autopilot = make(boot_at=time.monotonic() - 40.0)
    async with serve_udp(autopilot, "127.0.0.1", port):
        code = await asyncio.to_thread(main, ["config", "check", str(file), "--autopilot"])
    assert autopilot.parameters.written == 0
    return code
