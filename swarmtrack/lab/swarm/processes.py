"""Child processes that end with us, whatever ends us, each with a log in one folder that goes with them.

A reaper (`reaper.py`) waits at the other end of a pipe. When that closes, because we are done or because we were
killed, it kills what is left and removes the folder. Children run in process groups of their own: Ctrl-C reaches us
alone, and we end them in order. They stay in our session, because to Linux each session is as good as any other when
they compete (autogroup): in sessions of their own a simulator would get no more than each of thirty agents.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Self

from swarmtrack.errors import SwarmtrackError
from swarmtrack.lab.swarm import reaper

STOP_S = 3.0  # s after SIGTERM: agents end within two
LAST_LINES = 15  # of a log, shown when its process died


class ProcessDied(SwarmtrackError):
    """A process ended that should not have; the text holds the last lines of its log."""


class Child:
    """One process. `name` is for people; its standard error, and output unless piped, is in `log`."""

    def __init__(self, name: str, process: asyncio.subprocess.Process, log: Path) -> None:
        self.name = name
        self.process = process
        self.log = log
        self.ending = False
        """Whether we ended it ourselves."""

    @property
    def killed_by(self) -> signal.Signals | None:
        """The signal that ended it; None: none has."""
        code = self.process.returncode
        return signal.Signals(-code) if code is not None and code < 0 else None

    def describe_end(self) -> str:
        """In words, with the last lines of its log."""
        killed_by = self.killed_by
        how = f"exit code {self.process.returncode}" if killed_by is None else f"signal {killed_by.name}"
        lines = self.log.read_text(encoding="utf-8", errors="replace").rstrip().splitlines()[-LAST_LINES:]
        said = "\n".join(f"  | {line}" for line in lines) or "  | (its log is empty)"
        return f"{self.name} ended by itself, {how}. Its last lines:\n{said}"


class Children:
    """Use with `async with`. folder: for the logs, and whatever else; removed at the end unless `keep`."""

    def __init__(self, folder: Path, *, keep: bool) -> None:
        self._folder = folder
        self._keep = keep
        self._reaper: asyncio.subprocess.Process | None = None
        self._watches: set[asyncio.Task[None]] = set()
        self._running: list[Child] = []
        self.died: asyncio.Future[Child] = asyncio.get_running_loop().create_future()
        """The first child that ended by itself, and has no other in its place."""

    @property
    def pids(self) -> list[int]:
        """Of those that run."""
        return [child.process.pid for child in self._running]

    async def __aenter__(self) -> Self:
        folders = [] if self._keep else [str(self._folder)]
        self._reaper = await asyncio.create_subprocess_exec(
            *(sys.executable, "-I", "-S", reaper.__file__, *folders),
            stdin=asyncio.subprocess.PIPE,
            process_group=0,
        )
        return self

    async def __aexit__(self, kind: object, error: object, traceback: object) -> None:
        assert self._reaper is not None
        assert self._reaper.stdin is not None
        try:
            await asyncio.gather(*(self.end(child) for child in list(self._running)))
        finally:
            self._reaper.stdin.close()  # kills what is left, and removes the folder
            await self._reaper.wait()

    async def start(
        self,
        name: str,
        argv: Sequence[str],
        *,
        talks: bool = False,
        replace: Callable[[Child], bool] = lambda child: False,
    ) -> Child:
        """talks: its standard input and output are pipes of ours. replace: called where it ends by itself; returns
        whether another one takes its place, so that `died` does not hold it.
        """
        log = self._folder / f"{name.replace(' ', '-')}.log"
        with log.open("ab") as file:
            pipe = asyncio.subprocess.PIPE
            process = await asyncio.create_subprocess_exec(
                *argv,
                stdin=pipe if talks else asyncio.subprocess.DEVNULL,
                stdout=pipe if talks else file,
                stderr=file,
                process_group=0,
            )
        self._tell_reaper(f"+{process.pid}")
        child = Child(name, process, log)
        self._running.append(child)
        watch = asyncio.create_task(self._watch(child, replace), name=f"watch {name}")
        self._watches.add(watch)
        watch.add_done_callback(self._watches.discard)
        return child

    async def end(self, child: Child, number: signal.Signals = signal.SIGTERM) -> None:
        """Ask it to end; kill it if it does not."""
        child.ending = True
        if child.process.returncode is not None:
            return
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.process.pid, number)
        try:
            async with asyncio.timeout(STOP_S):
                await child.process.wait()
        except TimeoutError:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.process.pid, signal.SIGKILL)
            await child.process.wait()

    async def end_all(self, *, but: Child) -> None:
        """All but one."""
        await asyncio.gather(*(self.end(child) for child in list(self._running) if child is not but))

    async def _watch(self, child: Child, replace: Callable[[Child], bool]) -> None:
        await child.process.wait()
        self._tell_reaper(f"-{child.process.pid}")
        self._running.remove(child)
        if not (child.ending or replace(child) or self.died.done()):
            self.died.set_result(child)

    def _tell_reaper(self, line: str) -> None:
        assert self._reaper is not None
        assert self._reaper.stdin is not None
        if not self._reaper.stdin.is_closing():
            self._reaper.stdin.write(f"{line}\n".encode())
