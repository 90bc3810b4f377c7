"""Python modules as other processes, and what the kernel counts of a process."""

from __future__ import annotations

import asyncio
import os
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import swarmtrack
from swarmtrack.benchmarks.report import BenchmarkError

OURS = "swarmtrack.agents.main"
"""The module of all our commands."""


@asynccontextmanager
async def module_process(
    *words: str,
    stderr: int | None = None,
    environment: Mapping[str, str] | None = None,
    patience_s: float = 0.0,
) -> AsyncIterator[asyncio.subprocess.Process]:
    """`python -m WORDS…` with its stdin and stdout in our hands. When the block ends it is killed, or gets SIGTERM and
    so many seconds to end; environment: more of it."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", *words),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=stderr,
        env=agent_environment() | dict(environment or {}),
    )
    try:
        yield process
    finally:
        with suppress(ProcessLookupError, TimeoutError):
            if patience_s:
                process.terminate()
                await asyncio.wait_for(process.wait(), patience_s)
        with suppress(ProcessLookupError):
            process.kill()
        await process.wait()


async def said(process: asyncio.subprocess.Process, patience_s: float) -> str:
    """The next line of a process."""
    assert process.stdout is not None
    line = await asyncio.wait_for(process.stdout.readline(), patience_s)
    if not line:
        raise BenchmarkError(f"a process ended with {await process.wait()}, expected a line of it")
    return line.decode()


def descendants(pid: int | None) -> list[int]:
    """Children and theirs; empty where the process has ended."""
    try:
        children = [int(text) for text in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []
    return [one for child in children for one in (child, *descendants(child))]


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    """Of this machine, free a moment ago."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def agent_environment() -> dict[str, str]:
    """In which an agent's process finds this very package, installed or not."""
    here = str(Path(swarmtrack.__file__).resolve().parents[1])
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [here, os.environ.get("PYTHONPATH")]))}


def our_command(*words: str) -> str:
    """`swarmtrack WORDS…`, whatever comes of it; returns what it said."""
    command = [sys.executable, "-m", OURS, *words]
    done = subprocess.run(command, env=agent_environment(), capture_output=True, text=True, check=False)
    return done.stdout + done.stderr


def cpu_seconds(pid: int | str = "self") -> float:
    """User and system time of a process, all its threads."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    # utime, stime: proc(5), fields 14 and 15
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def rss_mb(pid: int | str = "self") -> float:
    """Resident memory, 10⁶ bytes."""
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGESIZE") / 1e6
