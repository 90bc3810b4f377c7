"""Addresses of [network] that can never link a team: found before flight, by `config check`, doctor and agent alike.

A shared file names every drone. A name may mean something else on each machine: on Debian a machine's own name means
127.0.1.1, where no other machine can dial it. And Zenoh 1.10 takes an IPv6 address for the name in a
certificate, which it cannot be, so with keys no such address can be dialled.
"""

from __future__ import annotations

import ipaddress
import socket
import threading
from collections.abc import Callable, Collection, Mapping

from swarmtrack.config.drone import NetworkSection
from swarmtrack.errors import TransportError
from swarmtrack.transport.limits import LOOK_UP_S
from swarmtrack.transport.links import EndpointTemplate, host_of
from swarmtrack.transport.settings import parse_endpoint

LookUp = Callable[[Collection[str]], Mapping[str, tuple[str, ...]]]
"""Host names to their IP addresses on this machine; an unknown name is left out."""


def look_up(hosts: Collection[str]) -> dict[str, tuple[str, ...]]:
    """Ask the system, for `LOOK_UP_S` at most: without a name server it may wait much longer."""
    found: dict[str, tuple[str, ...]] = {}

    def ask(host: str) -> None:
        try:
            answers = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
        except (OSError, UnicodeError):
            return
        found[host] = tuple(dict.fromkeys(str(answer[4][0]) for answer in answers))

    threads = [threading.Thread(target=ask, args=(host,), daemon=True) for host in hosts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(LOOK_UP_S)
    return dict(found)


def check_addresses(
    section: NetworkSection, *, secured: bool, drone_id: int | None = None, look_up: LookUp = look_up
) -> None:
    """Raise TransportError that names the entry. secured: with keys. drone_id: that of this machine, if it is one's."""
    peers = section.peers if section.topology == "mesh" else {}
    if secured:
        dialled = {f"network.peers: {i}": peers[i] for i in sorted(peers, key=int)}
        dialled |= {f"network.routers: {n}": router for n, router in enumerate(section.routers, 1)}
        dialled |= {f"network.connect: {n}": address for n, address in enumerate(section.connect, 1)}
        for entry, address in dialled.items():
            if ":" in _host(address):
                raise TransportError(
                    f"{entry}: found {address}, but with keys an IPv6 address cannot be dialled (Zenoh takes it for "
                    f"the name in a certificate); expected an IPv4 address, or a name that means this address, such as "
                    f"one of /etc/hosts"
                )
    links = EndpointTemplate.direct(secured=secured)
    taken: dict[tuple[str, ...], str] = {}
    for i in sorted(peers, key=int):
        other = taken.setdefault(links.at(peers[i], "network.peers"), i)
        if other != i:
            raise TransportError(
                f"network.peers: drones {other} and {i} both have the address {peers[i]}, expected one for each, "
                f"on one machine by their ports"
            )
    if drone_id is not None and str(drone_id) in peers:
        _check_loopback(section, str(drone_id), look_up)


def _check_loopback(section: NetworkSection, own: str, look_up: LookUp) -> None:
    """A drone on loopback is met there only: that is right for all drones of a team, or for none."""
    listen = section.listen or (section.peers[own],)
    others = {i: address for i, address in section.peers.items() if i != own}
    hosts = {_host(address) for address in (*listen, *others.values())}
    known: dict[str, tuple[str, ...]] = {host: (host,) for host in hosts if _is_ip(host)}
    known |= look_up(sorted(hosts - known.keys()))

    def loopback(address: str) -> str | None:
        """The loopback address that it means, if it means no other."""
        means = known.get(_host(address), ())
        within = [ip for ip in means if ipaddress.ip_address(ip.partition("%")[0]).is_loopback]
        return within[0] if within and len(within) == len(means) else None

    ours = [loopback(address) for address in listen]
    far = [i for i in sorted(others, key=int) if loopback(others[i]) is None]
    if far and ours[0] is not None and all(ours):
        key = "network.listen" if section.listen else f"network.peers: {own}"
        raise TransportError(
            f"{key}: found {listen[0]}{_meaning(listen[0], ours[0])}, where no other drone can dial this one; expected "
            f'its address in the team\'s network: write it, or add `listen = ["0.0.0.0"]` under [network] of this '
            f"drone"
        )
    near = [i for i in sorted(others, key=int) if i not in far]
    if near and not all(ours):
        means = loopback(others[near[0]])
        raise TransportError(
            f"network.peers: {near[0]}: found {others[near[0]]}{_meaning(others[near[0]], means)}, which is this "
            f"machine and not drone {near[0]}; expected its address in the team's network (see /etc/hosts here)"
        )


def _meaning(address: str, ip: str | None) -> str:
    return "" if _host(address) == ip else f", which means {ip} on this machine"


def _host(address: str) -> str:
    """Host of HOST, HOST:PORT or a Zenoh endpoint, without brackets; empty for a Unix socket."""
    if "/" not in address:
        return host_of(address)
    endpoint = parse_endpoint(address, "network")
    return "" if endpoint.port is None else endpoint.host


def _is_ip(host: str) -> bool:
    try:
        ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return False
    return True
