"""Endpoints that each process listens on and dials, from a team's [network].

    mesh      every drone dials those of lower ID and is dialled by the higher: each pair once, and a drone that
              returns is met again. Peers forward nothing; good to some thirty drones, all in reach of each other.
    routers   drones are clients of the routers listed and need not reach each other; each router dials those before
              it in the list.

`links` defines the endpoints of an address.
"""

from __future__ import annotations

import contextlib
import socket

from swarmtrack.config.drone import NetworkSection
from swarmtrack.errors import TransportError
from swarmtrack.security import names
from swarmtrack.security.credentials import Credentials
from swarmtrack.transport.links import EndpointTemplate, host_of
from swarmtrack.transport.settings import Mode, NetworkSettings


def of_drone(section: NetworkSection, drone_id: int, credentials: Credentials | None) -> NetworkSettings:
    """Settings of a drone. Raises TransportError that names the wrong entry."""
    if section.topology == "routers":
        return _settings(
            section,
            credentials,
            mode=Mode.CLIENT,
            connect=EndpointTemplate.relayed(secured=credentials is not None).at_all(
                section.routers, "network.routers"
            ),
        )
    links = EndpointTemplate.direct(secured=credentials is not None)
    peers = {int(i): address for i, address in section.peers.items()}
    listen = links.at_all(section.listen, "network.listen")
    if peers and drone_id not in peers:
        raise TransportError(
            f"network.peers: has no address for drone {drone_id}, expected one for every drone of the team"
        )
    if peers and not listen:
        listen = links.at(peers[drone_id], "network.peers")
    lower = [peers[i] for i in sorted(peers) if i < drone_id]
    return _settings(
        section,
        credentials,
        listen=listen,
        connect=links.at_all(lower, "network.peers") + links.at_all(section.connect, "network.connect"),
        expected=tuple(names.drone(i) for i in sorted(peers) if i != drone_id),
        callers=tuple(links.at(peers[i], "network.peers")[-1] for i in sorted(peers) if i > drone_id),
    )


def of_monitor(section: NetworkSection, credentials: Credentials | None) -> NetworkSettings:
    """Settings of a listener: it dials all drones, because peers forward nothing; or any one router."""
    if section.topology == "routers":
        connect = EndpointTemplate.relayed(secured=credentials is not None).at_all(
            section.routers, "network.routers"
        )
        return _settings(section, credentials, mode=Mode.CLIENT, connect=connect)
    links = EndpointTemplate.direct(secured=credentials is not None)
    peers = {int(i): address for i, address in section.peers.items()}
    return _settings(
        section,
        credentials,
        connect=links.at_all((peers[i] for i in sorted(peers)), "network.peers")
        + links.at_all(section.connect, "network.connect"),
        expected=tuple(map(names.drone, sorted(peers))),
    )


def of_companion(section: NetworkSection, drone_id: int, credentials: Credentials | None) -> NetworkSettings:
    """Settings of a program on board of a drone: it dials that drone's agent only; or any one router."""
    own = {i: address for i, address in section.peers.items() if int(i) == drone_id}
    if section.topology == "mesh" and section.peers and not own:
        raise TransportError(f"network.peers: has no address for drone {drone_id}, expected its agent's")
    return of_monitor(section.model_copy(update={"peers": own}), credentials)


def of_router(
    section: NetworkSection, listen: str | None, credentials: Credentials | None
) -> NetworkSettings:
    """Settings of a router. listen: one of `routers`; None: the one that is an address of this machine. Raises
    TransportError.
    """
    if section.topology != "routers":
        raise TransportError(
            'network.topology: found "mesh", expected "routers": peers in a mesh take no router'
        )
    own = _own_router(section.routers, listen)
    links = EndpointTemplate.relayed(secured=credentials is not None)
    return _settings(
        section,
        credentials,
        mode=Mode.ROUTER,
        listen=links.at(section.routers[own], "network.routers"),
        connect=links.at_all(section.routers[:own], "network.routers"),
    )


def _own_router(routers: tuple[str, ...], listen: str | None) -> int:
    """The place in the list of the router that we are."""
    one_of = f"expected one of network.routers: {', '.join(routers)}"
    if listen is not None:
        if listen not in routers:
            raise TransportError(f"network.routers: {listen} (--listen) is not among them, {one_of}")
        return routers.index(listen)
    here = [i for i, address in enumerate(routers) if is_here(host_of(address))]
    if len(here) != 1:
        found = "none" if not here else f"{len(here)} of them"
        raise TransportError(f"network.routers: {found} is an address of this machine, {one_of} as --listen")
    return here[0]


def is_here(host: str) -> bool:
    """Whether an address, or what a name means, is this machine's: only those can be bound."""
    with contextlib.suppress(OSError, UnicodeError):
        family = socket.getaddrinfo(host, 0, type=socket.SOCK_DGRAM)[0][0]
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.bind((host, 0))
        return True
    return False


def _settings(
    section: NetworkSection,
    credentials: Credentials | None,
    *,
    mode: Mode = Mode.PEER,
    listen: tuple[str, ...] = (),
    connect: tuple[str, ...] = (),
    expected: tuple[str, ...] = (),
    callers: tuple[str, ...] = (),
) -> NetworkSettings:
    return NetworkSettings(
        team=section.team,
        listen=listen,
        connect=connect,
        multicast=section.multicast,
        interface=section.interface,
        insecure=section.insecure,
        lease_s=section.lease_s,
        mode=mode,
        credentials=credentials,
        expected=expected,
        callers=callers,
        tracks_kbit_s=section.tracks_kbit_s,
    )
