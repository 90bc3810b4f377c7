"""Network settings of one process, with their checks."""

from __future__ import annotations

import enum
import ipaddress
import re
from dataclasses import dataclass
from typing import Final, NamedTuple

from swarmtrack.errors import TransportError
from swarmtrack.security.credentials import Credentials

ENCRYPTED: Final = ("tls", "quic")

_TEAM = re.compile("[A-Za-z0-9_-]{1,64}")
_ENDPOINT = re.compile(r"(?P<protocol>tcp|udp|tls|quic|ws|unixsock-stream)/(?P<address>[^?#]+)([?#].*)?")


class Mode(enum.StrEnum):
    """Zenoh's own names. Peers are linked to each other and forward nothing; clients are linked to routers, which
    forward.
    """

    PEER = "peer"
    CLIENT = "client"
    ROUTER = "router"


@dataclass(frozen=True, slots=True)
class NetworkSettings:
    """Network settings of one process. `topology` derives them from a team's file.

    Without `listen` and `connect` the agents of one machine find each other on loopback, by themselves. listen,
    connect: Zenoh endpoints, `tls/192.168.1.5:7447`; a process that only connects cannot be dialled. multicast: also
    find peers by scouting on `interface`, a name or "auto" (the first that is not loopback). lease_s: after this long
    a silent link counts as lost. insecure: allow other machines without keys. credentials: our keys; None: without.
    expected: names whose links should come up. callers: one endpoint of each dialler. tracks_kbit_s: for tracks and
    pictures to all listeners together; None: unlimited.
    """

    team: str = "swarm"
    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    multicast: bool = False
    interface: str = "auto"
    insecure: bool = False
    lease_s: float = 2.0
    mode: Mode = Mode.PEER
    credentials: Credentials | None = None
    expected: tuple[str, ...] = ()
    callers: tuple[str, ...] = ()
    tracks_kbit_s: float | None = None

    @property
    def rendezvous(self) -> bool:
        """Whether to meet on loopback's well-known ports."""
        return not self.listen and not self.connect


class Endpoint(NamedTuple):
    """A parsed endpoint, `tls/10.0.0.1:7447?rel=1`; without a port for a Unix socket."""

    protocol: str
    host: str
    port: int | None

    @property
    def is_loopback(self) -> bool:
        if self.protocol == "unixsock-stream" or self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False  # a name: whatever it resolves to today, it may be elsewhere tomorrow


def check(settings: NetworkSettings) -> None:
    """Raise TransportError with the remedy for invalid settings."""
    if not _TEAM.fullmatch(settings.team):
        raise TransportError(
            f"network.team: found {settings.team!r}, expected 1 to 64 letters, digits, '-' or '_'"
        )
    if not 0.5 <= settings.lease_s <= 60.0:
        raise TransportError(f"network.lease_s: found {settings.lease_s:g}, expected 0.5 to 60 s")
    if settings.credentials is not None and settings.credentials.roster.team != settings.team:
        raise TransportError(
            f"network.team: found {settings.team!r}, expected {settings.credentials.roster.team!r}, "
            f"the team that the keys are for"
        )
    for name, endpoints in (("listen", settings.listen), ("connect", settings.connect)):
        for endpoint in endpoints:
            _check_protection(endpoint, f"network.{name}", settings)
    if settings.multicast and settings.interface != "lo":
        # Scouting is not encrypted, with keys or without.
        if not settings.insecure:
            raise TransportError(
                "network.multicast: scouting shows the drones to everyone in reach, keys or not; "
                "leave it out and list network.peers, or write `insecure = true` under [network]"
            )
        if not settings.listen:
            raise TransportError(
                "network.listen: is empty, expected this machine's address (tcp/ADDRESS:PORT), "
                "so that peers that find us by multicast can connect"
            )


def _check_protection(text: str, where: str, settings: NetworkSettings) -> None:
    endpoint = parse_endpoint(text, where)
    if settings.credentials is not None:
        if endpoint.protocol not in ENCRYPTED:
            raise TransportError(
                f"{where}: {text} is not encrypted, and there are keys; expected tls/HOST:PORT or just HOST:PORT"
            )
    elif endpoint.protocol in ENCRYPTED:
        raise TransportError(f"{where}: {text} needs keys, expected `keys = …` (`swarmtrack keys`), or tcp/")
    elif not endpoint.is_loopback and not settings.insecure:
        raise TransportError(
            f"{where}: {text} is not on loopback, and without keys anyone there can pose as a drone; make keys "
            f"(`swarmtrack keys`) and write `keys = …` under [network], stay on tcp/127.0.0.1:PORT, "
            f"or write `insecure = true` (`--insecure`)"
        )


def parse_endpoint(text: str, where: str) -> Endpoint:
    """Parse an endpoint. Raises TransportError for anything else."""
    match = _ENDPOINT.fullmatch(text)
    if match is None:
        raise TransportError(
            f"{where}: found {text!r}, expected PROTOCOL/HOST:PORT with tcp, udp, tls, quic or ws, "
            f"such as tcp/127.0.0.1:7447"
        )
    if match["protocol"] == "unixsock-stream":
        return Endpoint(match["protocol"], match["address"], None)
    host, colon, port = match["address"].rpartition(":")
    if not colon or not port.isdecimal() or int(port) > 65535:
        raise TransportError(f"{where}: {text!r} has no port, expected PROTOCOL/HOST:PORT")
    return Endpoint(match["protocol"], host.strip("[]"), int(port))
