"""`swarmtrack sim` as a process, and what it started and left behind."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from support.patience import PATIENCE
from support.places import ROOT


def environment(folder: Path) -> dict[str, str]:
    """Temporary files go into `folder`, where a test can look for what is left."""
    return {**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(folder)}


def start(folder: Path, *arguments: str, program: str = "swarmtrack.agents.main") -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", program, "sim", *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(folder),
        cwd=ROOT,
    )


@contextmanager
def ended(process: subprocess.Popen[str]) -> Iterator[subprocess.Popen[str]]:
    """Ends the process with the block. Where the block fails, Popen's own context would wait for it for ever."""
    with process:
        try:
            yield process
        finally:
            process.kill()


def finish(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    out, err = process.communicate(timeout=PATIENCE)
    return process.returncode, out, err


def living(folder: Path) -> list[str]:
    """Command lines of all processes that were started with temporary files in `folder`."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit() or int(entry.name) == os.getpid():
            continue
        try:
            if f"TMPDIR={folder}".encode() in (entry / "environ").read_bytes():
                found.append((entry / "cmdline").read_bytes().replace(b"\0", b" ").decode())
        except OSError:  # it ended just now, or is somebody else's
            continue
    return found


def pid_of(folder: Path, argument: str) -> int | None:
    """The process with temporary files in `folder` whose command line ends with a path to `argument`."""
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            ours = f"TMPDIR={folder}".encode() in (entry / "environ").read_bytes()
            words = (entry / "cmdline").read_bytes().decode().split("\0")
        except OSError:
            continue
        if ours and any(word.endswith(f"/{argument}") for word in words):
            return int(entry.name)
    return None
