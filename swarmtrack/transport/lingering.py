"""Links that cannot be closed in peace are closed at once.

Zenoh sets SO_LINGER to ten seconds on each of its TCP sockets (`TLS_LINGER_TIMEOUT`, which no configuration reaches).
Where the other end is out of reach, closing then blocks a thread of Zenoh's for so long. Meanwhile a peer that is gone
is not missed, and what a new link brings is not read: twelve deaf seconds after a partition or a change of address. The
option belongs to the socket and not to who set it, so we take it off again. Of other sockets none lingers.
"""

from __future__ import annotations

import asyncio
import os
import socket
import stat
import struct
from pathlib import Path
from typing import Final

DESCRIPTORS: Final = Path("/proc/self/fd")
PERIOD_S: Final = 0.5  # a link is older than that when it is lost
_LINGER: Final = struct.Struct("ii")


async def close_at_once() -> None:
    """Until cancelled: have no stream of this process linger."""
    while True:
        stop_lingering()
        await asyncio.sleep(PERIOD_S)


def stop_lingering() -> int:
    """How many sockets of this process lingered. None where the system does not list descriptors."""
    try:
        descriptors = [int(name) for name in os.listdir(DESCRIPTORS)]
    except OSError:
        return 0
    return sum(map(_stop, descriptors))


def _stop(descriptor: int) -> bool:
    try:
        if not stat.S_ISSOCK(os.fstat(descriptor).st_mode):
            return False
        # A descriptor of its own: Zenoh may close the original meanwhile.
        with socket.fromfd(descriptor, socket.AF_INET, socket.SOCK_STREAM) as copy:
            lingers, _ = _LINGER.unpack(copy.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER.size))
            if lingers:
                copy.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER.pack(0, 0))
            return bool(lingers)
    except OSError:  # it is gone
        return False
