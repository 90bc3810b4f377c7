"""How tests wait for what happens in its own time: in other threads, processes and sockets."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import TypeVar

PATIENCE = 180.0  # s: ends a hang, and says nothing of speed

T = TypeVar("T")


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
