"""What Zenoh's TCP sockets are set to, which no configuration of Zenoh's reaches; an option belongs to the socket and
not to who set it.

SO_LINGER. Zenoh has its sockets linger for ten seconds (`TLS_LINGER_TIMEOUT`). Where the other end is out of reach,
closing then blocks a thread of Zenoh's for so long. Meanwhile a peer that is gone is not missed, and what a new link
brings is not read: twelve deaf seconds after a partition or a change of address. Of other sockets none lingers.

TCP_THIN_LINEAR_TIMEOUTS. What TCP has no answer to, it says again after 0.2 s, then 0.4, 0.8, 1.6: it takes each loss
for a full network. Where two fifths of all packets are lost for other reasons, it is silent for longer than a lease.
With this option a stream of less than four packets on their way says it again every 0.2 s (or what the round trip
asks for), six times over. More than that, or a round trip that grows because the radio is full, makes it wait as
before. Those who dial us take it from the socket that listens.

TCP_MAXSEG. A radio or a tunnel may swallow frames longer than it carries, without a word; a stream that has one
to send then says nothing any more, for ever. What our sockets listen for is agreed with those who dial: segments that
every way carries which carries QUIC, and most that do not.
"""

from __future__ import annotations

import asyncio
import socket
import struct
from typing import Final

from swarmtrack.transport.limits import LONGEST_SEGMENT_BYTES, TCP_OPTIONS_PERIOD_S
from swarmtrack.transport.own_sockets import own_streams

_LINGER: Final = struct.Struct("ii")
_THIN_LINEAR_TIMEOUTS: Final = 16  # Linux has it since 2.6.34; Python has no name for it


async def keep_options() -> None:
    """Until cancelled: set what is new."""
    while True:
        set_options()
        await asyncio.sleep(TCP_OPTIONS_PERIOD_S)


def set_options() -> int:
    """Number of this process's sockets that were newly set."""
    return sum(map(_set, own_streams()))


def _set(stream: socket.socket) -> bool:
    try:
        lingers, _ = _LINGER.unpack(stream.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER.size))
        if lingers:
            stream.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER.pack(0, 0))
        if stream.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN):  # which does not say whether it is set
            stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG, LONGEST_SEGMENT_BYTES)
        backs_off = not stream.getsockopt(socket.IPPROTO_TCP, _THIN_LINEAR_TIMEOUTS)
        if backs_off:
            stream.setsockopt(socket.IPPROTO_TCP, _THIN_LINEAR_TIMEOUTS, 1)
        return bool(lingers or backs_off)
    except OSError:  # it is gone
        return False
