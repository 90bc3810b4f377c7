"""`swarmtrack ros2` as a process, for tests that listen to it."""

import asyncio
import contextlib
import os
import sys

from support.patience import PATIENCE
from support.places import PYTHONPATH, ROOT

ENVIRONMENT = {**os.environ, "PYTHONPATH": PYTHONPATH, "ROS_DOMAIN_ID": "0"}


@contextlib.asynccontextmanager
async def bridge(team, *options):
    """From when it is there until SIGTERM ends it, cleanly; gives its first line."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "swarmtrack.agents.main", "ros2", "--team", team, *options,
        cwd=ROOT, env=ENVIRONMENT, stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip
    try:
        line = await asyncio.wait_for(process.stdout.readline(), PATIENCE)
        assert b"Ctrl-C" in line
        yield line.decode()
    finally:
        process.terminate()
        assert await asyncio.wait_for(process.wait(), PATIENCE) == 0
