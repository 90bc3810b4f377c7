"""The names in certificates: `drone-3`, `monitor`, `router-a`."""

from __future__ import annotations

import enum
import re

from swarmtrack.errors import KeysError

MAX_DRONE_ID = 65535

_NAME = re.compile(
    r"drone-(?P<id>[1-9][0-9]{0,4})|(?P<role>monitor|router)(-[A-Za-z0-9][A-Za-z0-9_-]{0,31})?", re.ASCII
)


class Role(enum.StrEnum):
    DRONE = "drone"
    MONITOR = "monitor"
    ROUTER = "router"


def drone(drone_id: int) -> str:
    return f"{Role.DRONE}-{drone_id}"


def role(name: str) -> Role | None:
    """Role of a name; None for a foreign one."""
    match = _NAME.fullmatch(name)
    if match is None or (match["id"] is not None and int(match["id"]) > MAX_DRONE_ID):
        return None
    return Role.DRONE if match["id"] is not None else Role(match["role"])


def drone_id(name: str) -> int:
    """ID of `drone-3`: 3; only for the names of drones."""
    return int(name.removeprefix(f"{Role.DRONE}-"))


def from_user(text: str) -> str:
    """A name from user input: `3` means `drone-3`. Raises KeysError."""
    name = drone(int(text)) if re.fullmatch("[1-9][0-9]{0,5}", text, re.ASCII) else text
    if role(name) is None or name == Role.ROUTER:
        raise KeysError(
            f"found {text!r}, expected a drone's ID 1 … {MAX_DRONE_ID}, monitor[-NAME] or router-NAME"
        )
    return name
