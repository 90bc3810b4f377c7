"""Check of the ports to listen on before Zenoh tries, which reports little and retries silently."""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
from typing import Final

from swarmtrack.errors import TransportError
from swarmtrack.transport.limits import PORT_TRIES, PORT_TRY_PERIOD_S
from swarmtrack.transport.settings import Endpoint, parse_endpoint

log = logging.getLogger(__name__)

DATAGRAMS: Final = ("udp", "quic")


async def wait_for_ports(endpoints: tuple[str, ...]) -> None:
    """Wait for ports to become free. Raises TransportError for a port that stays taken, or is not permitted.

    An address that this machine does not have is worth a warning only: its interface may come up later.
    """
    absent: dict[str, str] = {}
    for text in endpoints:
        endpoint = parse_endpoint(text, "network.listen")
        error = await obstacle(endpoint)
        if error is None:
            continue
        if error.errno != errno.EADDRNOTAVAIL and not isinstance(error, socket.gaierror):
            hint = "; does another agent run here?" if error.errno == errno.EADDRINUSE else ""
            raise TransportError(f"network: cannot open: {text}: {error.strerror}{hint}")
        absent[endpoint.host] = str(error.strerror)
    for host, reason in absent.items():
        log.warning(
            "network: %s is not an address of this machine now (%s); we listen there as soon as it is",
            host,
            reason,
        )


async def obstacle(endpoint: Endpoint) -> OSError | None:
    """Reason against listening at an endpoint, for good; None: none."""
    for _ in range(PORT_TRIES):
        error = await asyncio.to_thread(_try_to_bind, endpoint)
        if error is None or error.errno != errno.EADDRINUSE:
            break
        await asyncio.sleep(PORT_TRY_PERIOD_S)
    return error


def _try_to_bind(endpoint: Endpoint) -> OSError | None:
    """What is against it now."""
    if endpoint.port is None:
        return None
    kind = socket.SOCK_DGRAM if endpoint.protocol in DATAGRAMS else socket.SOCK_STREAM
    try:
        family, _, _, _, address = socket.getaddrinfo(endpoint.host, endpoint.port, type=kind)[0]
        with socket.socket(family, kind) as probe:
            if kind == socket.SOCK_STREAM:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as Zenoh does
            probe.bind(address)
            if kind == socket.SOCK_STREAM:
                probe.listen()  # two may bind with SO_REUSEADDR, but only one listens
    except OSError as error:
        return error
    return None
