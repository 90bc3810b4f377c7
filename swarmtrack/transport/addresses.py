"""Addresses of [network] that can never link a team: found before flight, by `config check`, doctor and agent alike.

A shared file names every drone. A name may mean something else on each machine: on Debian a machine's own name means
127.0.1.1, where no other machine can dial it. And Zenoh 1.10 takes an IPv6 address for the name in a
certificate, which it cannot be, so with keys no such address can be dialled.
"""

from __future__ import annotations

import ipaddress
import socket
import threading
from collections.abc import Callable, Collection, Iterable, Mapping

from swarmtrack.config.drone import NetworkSection
from swarmtrack.errors import TransportError
from swarmtrack.transport.limits import LOOK_UP_S
from swarmtrack.transport.links import EndpointTemplate, host_of
from swarmtrack.transport.settings import parse_endpoint

Ip = ipaddress.IPv4Address | ipaddress.IPv6Address
Meanings = Mapping[str, tuple[Ip, ...]]
BROADCAST = ipaddress.IPv4Address("255.255.255.255")

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
    section: NetworkSection,
    *,
    secured: bool,
    drone_id: int | None = None,
    router: str = "",
    look_up: LookUp = look_up,
) -> None:
    """Raise TransportError that names the entry. secured: with keys. drone_id: that of this machine, if it is one's.
    router: a router's own address.
    """
    mesh = section.topology == "mesh"
    peers = section.peers if mesh else {}
    routers = {} if mesh else {f"network.routers: {n}": router for n, router in enumerate(section.routers, 1)}
    connect = {f"network.connect: {n}": address for n, address in enumerate(section.connect, 1)}
    dialled = {f"network.peers: {i}": peers[i] for i in sorted(peers, key=int)} | routers | connect
    if secured:
        _check_dialled_by_name(dialled)
    means = _meanings((*dialled.values(), *section.listen), look_up)
    for entry, address in dialled.items():
        if not router or _host(address) != _host(router):  # which may listen on 0.0.0.0
            _check_of_a_machine(entry, address, means)
    # A drone's own name; a monitor may well dial the agent on its own machine.
    for entry, address in (routers if drone_id is None else routers | connect).items():
        _check_own_name(entry, address, means)
    _check_distinct(peers, EndpointTemplate.direct(secured=secured), means)
    if drone_id is not None and str(drone_id) in peers:
        _check_loopback(section, str(drone_id), means)


def _meanings(addresses: Iterable[str], look_up: LookUp) -> Meanings:
    hosts = {_host(address) for address in addresses} - {""}
    texts: dict[str, tuple[str, ...]] = {host: (host,) for host in hosts if _is_ip(host)}
    texts |= look_up(sorted(hosts - texts.keys()))
    return {host: tuple(map(_ip, found)) for host, found in texts.items()}


def _check_dialled_by_name(dialled: Mapping[str, str]) -> None:
    for entry, address in dialled.items():
        if ":" in _host(address):
            raise TransportError(
                f"{entry}: found {address}, but with keys an IPv6 address cannot be dialled (Zenoh takes it for "
                f"the name in a certificate); expected an IPv4 address, or a name that means this address, such as "
                f"one of /etc/hosts"
            )


def _check_of_a_machine(entry: str, address: str, means: Meanings) -> None:
    """Whoever dials 0.0.0.0 meets itself."""
    for ip in means.get(_host(address), ()):
        if ip.is_unspecified or ip.is_multicast or ip == BROADCAST:
            listen = ', and `listen = ["0.0.0.0"]` to listen on all that it has' if "peers" in entry else ""
            raise TransportError(
                f"{entry}: found {address}{_meaning(address, ip)}, which is no machine's address; expected its address "
                f"in the team's network{listen}"
            )


def _check_own_name(entry: str, address: str, means: Meanings) -> None:
    """A router listens where its entry says: on loopback only, if that is its own name."""
    host, ip = _host(address), _loopback(address, means)
    if ip is not None and not _is_ip(host) and "localhost" not in host:
        raise TransportError(
            f"{entry}: found {address}{_meaning(address, ip)}, where no other machine can dial it; expected its "
            f"address in the team's network (see /etc/hosts here), or {ip} if the whole team is on this machine"
        )


def _check_distinct(peers: Mapping[str, str], links: EndpointTemplate, means: Meanings) -> None:
    taken: dict[tuple[object, ...], str] = {}
    for i in sorted(peers, key=int):
        endpoints = links.at(peers[i], "network.peers")
        port = parse_endpoint(endpoints[0], "network.peers").port
        # Of loopback and of one link, the same address may be another process or machine.
        ips = [ip for ip in means.get(_host(peers[i]), ()) if not (ip.is_loopback or ip.is_link_local)]
        for place in (endpoints, *((ip, port) for ip in ips)):
            other = taken.setdefault(place, i)
            if other != i:
                both = peers[i] if place == endpoints else f"{place[0]} ({peers[other]}, {peers[i]})"
                raise TransportError(
                    f"network.peers: drones {other} and {i} both have the address {both}, expected one for each, "
                    f"on one machine by their ports"
                )


def _check_loopback(section: NetworkSection, own: str, means: Meanings) -> None:
    """A drone on loopback is met there only: that is right for all drones of a team, or for none."""
    listen = section.listen or (section.peers[own],)
    others = {i: address for i, address in section.peers.items() if i != own}
    ours = [_loopback(address, means) for address in listen]
    far = [i for i in sorted(others, key=int) if _loopback(others[i], means) is None]
    if far and ours[0] is not None and all(ours):
        key = "network.listen" if section.listen else f"network.peers: {own}"
        raise TransportError(
            f"{key}: found {listen[0]}{_meaning(listen[0], ours[0])}, where no other drone can dial this one; expected "
            f'its address in the team\'s network: write it, or add `listen = ["0.0.0.0"]` under [network] of this '
            f"drone"
        )
    near = [i for i in sorted(others, key=int) if i not in far]
    if near and not all(ours):
        ip = _loopback(others[near[0]], means)
        raise TransportError(
            f"network.peers: {near[0]}: found {others[near[0]]}{_meaning(others[near[0]], ip)}, which is this "
            f"machine and not drone {near[0]}; expected its address in the team's network (see /etc/hosts here)"
        )


def _loopback(address: str, means: Meanings) -> Ip | None:
    """The loopback address that it means, if it means no other."""
    ips = means.get(_host(address), ())
    return ips[0] if ips and all(ip.is_loopback for ip in ips) else None


def _meaning(address: str, ip: Ip | None) -> str:
    return "" if _is_ip(_host(address)) else f", which means {ip} on this machine"


def _host(address: str) -> str:
    """Host of HOST, HOST:PORT or a Zenoh endpoint, without brackets; empty for a Unix socket."""
    if "/" not in address:
        return host_of(address)
    endpoint = parse_endpoint(address, "network")
    return "" if endpoint.port is None else endpoint.host


def _is_ip(host: str) -> bool:
    try:
        _ip(host)
    except ValueError:
        return False
    return True


def _ip(text: str) -> Ip:
    """The address without a zone; an IPv4 address that is written as an IPv6 one is what it is. Raises ValueError."""
    ip = ipaddress.ip_address(text.partition("%")[0])
    return getattr(ip, "ipv4_mapped", None) or ip
