"""`swarmtrack monitor` as a process of its own."""

from __future__ import annotations

import asyncio
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from support.patience import PATIENCE
from support.places import ROOT


@asynccontextmanager
async def monitor_lines(*arguments: str) -> AsyncIterator[asyncio.StreamReader]:
    """What it prints; on leaving it is ended, as Ctrl-C does."""
    command = (sys.executable, "-m", "swarmtrack.agents.main", "monitor", "--port", "0", *arguments)
    process = await asyncio.create_subprocess_exec(*command, stdout=asyncio.subprocess.PIPE, cwd=ROOT)
    assert process.stdout is not None
    try:
        yield process.stdout
    finally:
        process.send_signal(signal.SIGTERM)
        assert await asyncio.wait_for(process.wait(), PATIENCE) == 0
