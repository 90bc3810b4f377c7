"""What the network may be told, and what it refuses."""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass

from swarmtrack.errors import TransportError

_TEAM = re.compile("[A-Za-z0-9_-]{1,64}")
_ENDPOINT = re.compile(r"(?P<protocol>tcp|udp|tls|quic|ws|unixsock-stream)/(?P<address>[^?#]+)([?#].*)?")


@dataclass(frozen=True, slots=True)
class NetworkSettings:
    """How one agent reaches its team.

    Without `listen` and `connect` the agents of one machine find each other on loopback, by themselves.
    listen, connect: Zenoh endpoints, `tcp/192.168.1.5:7447`; who only connects cannot be dialled. multicast: also find
    peers by scouting on `interface`, a name or "auto" (the first that is not loopback). lease_s: after this long a
    silent link counts as lost. insecure: beyond loopback without keys.
    """

    team: str = "swarm"
    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    multicast: bool = False
    interface: str = "auto"
    insecure: bool = False
    lease_s: float = 2.0

    @property
    def rendezvous(self) -> bool:
        """Whether to meet on loopback's well-known ports."""
        return not self.listen and not self.connect


def check(settings: NetworkSettings) -> None:
    """Raises TransportError with what to write instead."""
    if not _TEAM.fullmatch(settings.team):
        raise TransportError(
            f"network.team: found {settings.team!r}, expected 1 to 64 letters, digits, '-' or '_'"
        )
    if not 0.5 <= settings.lease_s <= 60.0:
        raise TransportError(f"network.lease_s: found {settings.lease_s:g}, expected 0.5 to 60 s")
    for name, endpoints in (("listen", settings.listen), ("connect", settings.connect)):
        for endpoint in endpoints:
            if not is_loopback(endpoint, f"network.{name}") and not settings.insecure:
                raise TransportError(
                    f"network.{name}: {endpoint} is not on loopback, and without keys anyone there can pose as a "
                    f"drone; stay on tcp/127.0.0.1:PORT, or write `insecure = true` under [network] "
                    f"(`swarmtrack echo --insecure`)"
                )
    if settings.multicast and settings.interface != "lo":
        if not settings.insecure:
            raise TransportError(
                "network.multicast: scouting without keys tells everyone in reach who flies; "
                "leave it out to stay on loopback, or write `insecure = true` under [network]"
            )
        if not settings.listen:
            raise TransportError(
                "network.listen: is empty, expected this machine's address (tcp/ADDRESS:PORT), "
                "so that those who find us by multicast can connect"
            )


def is_loopback(endpoint: str, where: str = "network") -> bool:
    """Whether the endpoint stays on this machine; raises TransportError where it is no endpoint at all."""
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None:
        raise TransportError(
            f"{where}: found {endpoint!r}, expected PROTOCOL/HOST:PORT with tcp, udp, tls, quic or ws, "
            f"such as tcp/127.0.0.1:7447"
        )
    if match["protocol"] == "unixsock-stream":
        return True
    host, colon, port = match["address"].rpartition(":")
    if not colon or not port.isdecimal() or int(port) > 65535:
        raise TransportError(f"{where}: {endpoint!r} has no port, expected PROTOCOL/HOST:PORT")
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False  # a name: whatever it resolves to today, it may be elsewhere tomorrow
