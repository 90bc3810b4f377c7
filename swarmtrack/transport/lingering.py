"""Links that cannot be closed in peace are closed at once.

Zenoh sets SO_LINGER to ten seconds on each of its TCP sockets (`TLS_LINGER_TIMEOUT`, which no configuration reaches).
Where the other end is out of reach, closing then blocks a thread of Zenoh's for so long. Meanwhile a peer that is gone
is not missed, and what a new link brings is not read: twelve deaf seconds after a partition or a change of address. The
option belongs to the socket and not to who set it, so we take it off again. Of other sockets none lingers.
"""

from __future__ import annotations

import asyncio
import socket
import struct
from typing import Final

from swarmtrack.transport.own_sockets import own_streams

PERIOD_S: Final = 0.5  # a link is older than that when it is lost
_LINGER: Final = struct.Struct("ii")


async def close_at_once() -> None:
    """Until cancelled: have no stream of this process linger."""
    while True:
        stop_lingering()
        await asyncio.sleep(PERIOD_S)


def stop_lingering() -> int:
    """How many sockets of this process lingered."""
    return sum(map(_stop, own_streams()))


def _stop(stream: socket.socket) -> bool:
    try:
        lingers, _ = _LINGER.unpack(stream.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER.size))
        if lingers:
            stream.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER.pack(0, 0))
        return bool(lingers)
    except OSError:  # it is gone
        return False
