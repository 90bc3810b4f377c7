"""Session of a ROS 2 node: a client of the router that the nodes of rmw_zenoh meet at, or that router itself.

A client, because topics of a peer on another machine stay invisible behind `rmw_zenohd` (ros2/rmw_zenoh#929). Port 7447
is the default of rmw_zenohd and of `[network] peers` alike, so what is found there is looked at.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import Final

import zenoh

from swarmtrack.errors import TransportError
from swarmtrack.transport.links import EndpointTemplate
from swarmtrack.transport.settings import Mode, NetworkSettings, parse_endpoint
from swarmtrack.transport.zenoh_session import close_session, open_session

ROUTER_PROBE_S: Final = 1.0
"""s: on one machine it takes a millisecond."""
SHARED_PORT: Final = (
    "agents with [network] peers listen on port 7447, as ROS 2's router does; give one of them another port. Nodes of "
    "ROS 2 find theirs by ZENOH_CONFIG_OVERRIDE='connect/endpoints=[\"tcp/127.0.0.1:7448\"]'"
)


def ros2_network(address: str, where: str, *, serve: bool, insecure: bool) -> NetworkSettings:
    """Settings of the session. address: HOST[:PORT] of the router; where: the option or key that states it. serve: be
    that router. Raises TransportError with the remedy, also for another machine without `insecure`.
    """
    endpoints = EndpointTemplate.PLAIN.at(address, where)
    if not insecure and not all(parse_endpoint(each, where).is_loopback for each in endpoints):
        raise TransportError(
            f"{where}: {address} is not on this machine, and ROS 2 has no keys here: everyone in reach can read the "
            f"swarm, though not command it; expected 127.0.0.1, or insecure = true (--insecure)"
        )
    if serve:
        return NetworkSettings(mode=Mode.ROUTER, listen=endpoints, insecure=insecure)
    return NetworkSettings(mode=Mode.CLIENT, connect=endpoints, insecure=insecure)


async def answers(network: NetworkSettings) -> bool:
    """Whether anything accepts connections at a client's router."""
    endpoint = parse_endpoint(network.connect[0], "router")
    with suppress(OSError, TimeoutError):
        async with asyncio.timeout(ROUTER_PROBE_S):
            _, writer = await asyncio.open_connection(endpoint.host, endpoint.port)
        writer.close()
        return True
    return False


async def open_ros2_session(network: NetworkSettings) -> zenoh.Session:
    """Raises TransportError: no router answers, what answers is no router, or the router's own port is taken."""
    if network.mode is Mode.ROUTER:
        try:
            return await open_session(network)
        except TransportError as error:
            (listen,) = network.listen
            raise TransportError(
                f"ROS 2: cannot be its router at {listen} ({error}): where rmw_zenohd runs, join it by --router; "
                f"{SHARED_PORT}"
            ) from None
    try:
        session = await open_session(network)
    except TransportError:
        raise TransportError(
            f"ROS 2: no router answers at {network.connect[0]}; start one (ros2 run rmw_zenoh_cpp rmw_zenohd, or "
            f"swarmtrack ros2 --serve)"
        ) from None
    if not list(session.info.routers_zid()):
        await close_session(session, [])
        raise TransportError(f"ROS 2: what answers at {network.connect[0]} is no router: {SHARED_PORT}")
    return session
