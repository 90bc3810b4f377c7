"""How tests wait for what happens in its own time: in other threads, processes and sockets."""

from __future__ import annotations

import asyncio
import contextlib
import time
import tracemalloc
from collections.abc import Callable, Iterator
from typing import TypeVar

PATIENCE = 180.0  # s: ends a hang, and says nothing of speed

SOON_S = 3.0  # s of the processor's time: thirty times what a small file takes, also where memory is traced
SMALL_MB = 64.0

T = TypeVar("T")


@contextlib.contextmanager
def soon(seconds: float = SOON_S) -> Iterator[None]:
    """Fails where the block takes more of the processor's time, however busy the machine is."""
    begin = time.thread_time()
    yield
    assert (took := time.thread_time() - begin) < seconds, f"{took:.1f} s"


@contextlib.contextmanager
def soon_and_small(seconds: float = SOON_S, megabytes: float = SMALL_MB) -> Iterator[None]:
    """`soon`, and fails where the block ever held more memory at once."""
    tracemalloc.start()
    try:
        with soon(seconds):
            yield
        assert (held := tracemalloc.get_traced_memory()[1] / 1e6) < megabytes, f"{held:.0f} MB"
    finally:
        tracemalloc.stop()


def until(condition: Callable[[], T], what: str = "") -> T:
    """What `condition` says once it is true; what: said where that never comes."""
    deadline = time.monotonic() + PATIENCE
    while not (value := condition()):
        assert time.monotonic() < deadline, what
        time.sleep(0.02)
    return value


async def eventually(condition: Callable[[], T], what: str = "") -> T:
    """`until` on the event loop: of counters and links, which tell nobody when they change."""
    deadline = time.monotonic() + PATIENCE
    while not (value := condition()):
        assert time.monotonic() < deadline, what
        await asyncio.sleep(0.01)
    return value
