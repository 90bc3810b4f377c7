"""Zenoh endpoints of an address HOST[:PORT]: the links between two processes.

With keys, a pair of drones has two links: TLS on PORT for what must arrive, and QUIC on PORT + 1, whose datagrams are
for tracks, which a lost packet must not hold up. QUIC has a stream as well, because Zenoh's four messages of greeting
would otherwise be datagrams without retransmission: where two fifths of all frames are lost, one attempt in eight
would come to an end. A client of Zenoh has one link only, so to routers it is one QUIC connection on PORT that carries
both, streams and datagrams. Without keys it is TCP.
"""

from __future__ import annotations

import enum
import re
from collections.abc import Iterable
from typing import Final

from swarmtrack.errors import TransportError

DEFAULT_PORT: Final = 7447

_ADDRESS: Final = re.compile(r"(?P<host>\[[0-9A-Fa-f:.%]+\]|[^\s:/?#\[\]]+)(:(?P<port>[0-9]{1,5}))?")


class EndpointTemplate(enum.Enum):
    """Endpoints at an address."""

    PLAIN = ("tcp/{host}:{port}",)
    PAIR = ("tls/{host}:{port}?rel=1", "quic/{host}:{next_port}?mixed_rel=1")
    RELAYED = ("quic/{host}:{port}?mixed_rel=1",)

    @classmethod
    def direct(cls, secured: bool) -> EndpointTemplate:
        """Template between two peers."""
        return cls.PAIR if secured else cls.PLAIN

    @classmethod
    def relayed(cls, secured: bool) -> EndpointTemplate:
        """Template between any process and a router."""
        return cls.RELAYED if secured else cls.PLAIN

    def at(self, address: str, where: str) -> tuple[str, ...]:
        """Zenoh endpoints at an address; a complete endpoint is kept as it is. Raises TransportError."""
        if "/" in address:
            return (address,)
        match = _ADDRESS.fullmatch(address)
        port = DEFAULT_PORT if match is None or match["port"] is None else int(match["port"])
        if match is None or not 0 < port < 65535:
            raise TransportError(
                f"{where}: found {address!r}, expected HOST or HOST:PORT, such as 10.0.0.11:7447"
            )
        return tuple(e.format(host=match["host"], port=port, next_port=port + 1) for e in self.value)

    @property
    def anywhere(self) -> tuple[str, ...]:
        """Endpoints on loopback, at ports that the system picks."""
        return tuple(endpoint.format(host="127.0.0.1", port=0, next_port=0) for endpoint in self.value)

    def at_all(self, addresses: Iterable[str], where: str) -> tuple[str, ...]:
        return tuple(endpoint for address in addresses for endpoint in self.at(address, where))


def host_of(address: str) -> str:
    """Host of an address without the port, and without the brackets of IPv6; empty where it is not an address."""
    match = _ADDRESS.fullmatch(address)
    return "" if match is None else match["host"].strip("[]")
