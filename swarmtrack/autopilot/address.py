"""Addresses of autopilots: accepts pymavlink's and MAVSDK's forms, prints one normal form."""

from __future__ import annotations

import difflib
import ipaddress
import re
from dataclasses import dataclass
from typing import Literal
from urllib.parse import parse_qsl

from swarmtrack.autopilot.limits import DEFAULT_BAUD, SLOWEST_BAUD
from swarmtrack.errors import SourceError

Scheme = Literal["udpin", "udpout", "tcp", "serial", "tlog", "ulog", "bin", "none"]


# What people write, to what we call it. MAVSDK's and pymavlink's plain `udp` both listen.
SCHEMES: dict[str, Scheme] = {
    "udpin": "udpin",
    "udp": "udpin",
    "udpout": "udpout",
    "tcp": "tcp",
    "tcpout": "tcp",
    "serial": "serial",
    "tlog": "tlog",
    "ulog": "ulog",
    "bin": "bin",
    "none": "none",
}
RECORDING_ENDINGS: dict[Scheme, str] = {"tlog": ".tlog", "ulog": ".ulg", "bin": ".bin"}
EXAMPLES = (
    "udpin:127.0.0.1:14540, udpout:192.168.1.2:14550, tcp:127.0.0.1:5760, "
    "serial:/dev/ttyACM0:921600, tlog:flight.tlog?speed=1, ulog:flight.ulg, bin:flight.bin "
    "or none"
)


@dataclass(frozen=True, slots=True)
class LinkAddress:
    """Address of an autopilot. host, port: of udpin, udpout, tcp; path: of the others.

    speed: of a recording; 0: as fast as possible.
    """

    scheme: Scheme
    host: str = ""
    port: int = 0
    path: str = ""
    baud: int = DEFAULT_BAUD
    speed: float = 1.0

    @property
    def reachable_from_outside(self) -> bool:
        """Whether other machines can send to us at this address: UDP beyond loopback."""
        return self.scheme == "udpin" and not is_loopback(self.host)

    def __str__(self) -> str:
        match self.scheme:
            case "udpin" | "udpout" | "tcp":
                host = f"[{self.host}]" if ":" in self.host else self.host
                return f"{self.scheme}:{host}:{self.port}"
            case "serial":
                return f"serial:{self.path}:{self.baud}"
            case "tlog" | "ulog" | "bin":
                return f"{self.scheme}:{self.path}?speed={self.speed:g}"
            case "none":
                return "none"


def is_loopback(host: str) -> bool:
    """Whether a host is loopback. An unknown name is not: it may resolve to any host."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def parse_address(text: str) -> LinkAddress:
    """Parse an autopilot's address. Raises `SourceError` for an impossible one."""
    text = text.strip()
    if text == "none":
        return LinkAddress("none")
    if text.startswith("/dev/"):
        return _serial(text, text)
    if text.partition(":")[0].lower() not in SCHEMES:
        for recorded, ending in RECORDING_ENDINGS.items():
            if text.partition("?")[0].lower().endswith(ending):
                return _recording(text, recorded, text.removeprefix("file://").removeprefix("file:"))
    if re.fullmatch(r"COM\d+.*", text, re.IGNORECASE):
        raise _mistake(text, "a Windows port, expected a Linux device such as /dev/ttyACM0")

    name, colon, rest = text.partition(":")
    scheme = SCHEMES.get(name.lower())
    if not colon or scheme is None or scheme == "none":
        raise _unknown_scheme(text, name)
    rest = rest.removeprefix("//")
    if scheme == "serial":
        return _serial(text, rest)
    if scheme in RECORDING_ENDINGS:
        return _recording(text, scheme, rest)
    return _network(text, scheme, rest.rstrip("/"))


def is_recording(text: str) -> bool:
    """Whether an address, in any form, is of a recorded flight."""
    return any(
        text.startswith(f"{scheme}:") or text.partition("?")[0].lower().endswith(ending)
        for scheme, ending in RECORDING_ENDINGS.items()
    )


def _mistake(text: str, found: str) -> SourceError:
    return SourceError(f"autopilot link {text!r}: {found}; write it like {EXAMPLES}")


def _unknown_scheme(text: str, name: str) -> SourceError:
    if name.lower() == "tcpin":
        return _mistake(text, "tcpin is not supported: connect to the autopilot with tcp:")
    if re.fullmatch(r"([^:]+:)?\d+", text):
        return _mistake(text, "has no scheme: udpin: listens here, udpout: and tcp: connect to that address")
    near = difflib.get_close_matches(name.lower(), SCHEMES, n=1)
    hint = f" (did you mean {near[0]!r}?)" if near else ""
    return _mistake(text, f"unknown scheme {name!r}{hint}")


def _network(text: str, scheme: Scheme, rest: str) -> LinkAddress:
    host, colon, port = rest.rpartition(":")
    if not colon and rest.isdecimal():
        port = rest  # udpin:14540
    if not port.isdecimal() or not 0 < int(port) < 65536:
        raise _mistake(
            text, f"found port {port if colon else rest!r}, expected HOST:PORT with a port in 1…65535"
        )
    host = host.removeprefix("[").removesuffix("]")
    if not host and scheme != "udpin":
        raise _mistake(text, "has no host to connect to")
    try:
        host.encode("idna")
    except UnicodeError:
        raise _mistake(text, f"found host {host!r}, expected a name or an IP address") from None
    return LinkAddress(scheme, host=host or "0.0.0.0", port=int(port))


def _serial(text: str, rest: str) -> LinkAddress:
    path, comma, baud = rest.rpartition(",")
    if not comma:
        path, colon, baud = rest.rpartition(":")
        if not colon or (baud.isdecimal() and int(baud) < SLOWEST_BAUD) or "/" in baud or "." in baud:
            path, baud = rest, str(DEFAULT_BAUD)
    if path.isdecimal() or not path.startswith("/"):
        raise _mistake(
            text, f"found device {path!r}, expected a path such as /dev/ttyACM0, the baud rate after it"
        )
    if not baud.isdecimal() or int(baud) < SLOWEST_BAUD:
        raise _mistake(text, f"found baud rate {baud!r}, expected a number such as 57600, 115200 or 921600")
    return LinkAddress("serial", path=path, baud=int(baud))


def _recording(text: str, scheme: Scheme, rest: str) -> LinkAddress:
    path, _, query = rest.partition("?")
    if not path:
        raise _mistake(text, "has no file")
    speed = 1.0
    for key, value in parse_qsl(query, keep_blank_values=True):
        if key == "pace" and value in ("fast", "realtime"):
            speed = 0.0 if value == "fast" else 1.0
        elif key == "speed" and re.fullmatch(r"\d+(\.\d*)?", value):
            speed = float(value)
        else:
            raise _mistake(
                text, f"found {key}={value}, expected speed=NUMBER (0: fast) or pace=realtime|fast"
            )
    return LinkAddress(scheme, path=path, speed=speed)
