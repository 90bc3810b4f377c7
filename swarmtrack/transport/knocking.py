"""Datagrams from a dialled end to its diallers, which help them to resolve its hardware address.

A dialler's first packet waits until a broadcast of its kernel's (ARP, or IPv6's neighbour solicitation) is answered:
one try per second, of which a radio that loses two fifths of all frames carries a third. No radio repeats a broadcast,
and three tries in a row may well fail. But the host that is asked learns the address of the one that asks. So the
dialled end sends its diallers a datagram each second until they are linked, which makes its own kernel ask for them:
then one broadcast that arrives, of either end, is enough. The datagram itself is empty, goes to the dialler's QUIC
port, and carries no information.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import socket
from collections.abc import Callable, Collection

from swarmtrack.transport.limits import KNOCK_PERIOD_S
from swarmtrack.transport.settings import parse_endpoint


async def keep_knocking(callers: Collection[str], linked: Callable[[], Collection[str]]) -> None:
    """Run until cancelled. callers: endpoints of our diallers; linked: hosts at the other ends of our links."""
    doors = [door for caller in callers if (door := _door(caller)) is not None]
    while doors:
        hosts = linked()
        for host, port in doors:
            if host not in hosts:
                _knock(host, port)
        await asyncio.sleep(KNOCK_PERIOD_S)


def _door(caller: str) -> tuple[str, int] | None:
    """Host and port; None for a name, which would have to be looked up first, and that may take long."""
    endpoint = parse_endpoint(caller, "network.peers")
    try:
        ipaddress.ip_address(endpoint.host)
    except ValueError:
        return None
    return None if endpoint.port is None else (endpoint.host, endpoint.port)


def _knock(host: str, port: int) -> None:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # An error: there is no way to it now.
    with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as own:
        own.setblocking(False)
        own.sendto(b"", (host, port))
