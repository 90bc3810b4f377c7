"""The roster: members of the team and their public keys. A small TOML file that the CA signs."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from swarmtrack.errors import KeysError
from swarmtrack.security import names
from swarmtrack.security.names import Role

MAX_ROSTER_BYTES = 16 * 1024 * 1024  # 65535 drones take 5 MiB
PUBLIC_KEY_BYTES = 32


@dataclass(frozen=True)
class Roster:
    """drones: ID -> Ed25519 public key, 32 bytes. number: counts the rosters of a team; a higher one replaces it."""

    team: str
    number: int = 0
    drones: Mapping[int, bytes] = field(default_factory=dict)
    monitors: tuple[str, ...] = ()
    routers: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        return (*map(names.drone, sorted(self.drones)), *self.monitors, *self.routers)

    def with_drone(self, drone_id: int, public_key: bytes) -> Roster:
        return replace(self, drones={**self.drones, drone_id: public_key})

    def with_others(self, name: str) -> Roster:
        """The roster with a further monitor or router."""
        if name in self.names:
            return self
        if names.role(name) == Role.MONITOR:
            return replace(self, monitors=(*self.monitors, name))
        return replace(self, routers=(*self.routers, name))

    def without(self, name: str) -> Roster:
        return replace(
            self,
            drones={i: key for i, key in self.drones.items() if names.drone(i) != name},
            monitors=tuple(other for other in self.monitors if other != name),
            routers=tuple(other for other in self.routers if other != name),
        )

    def to_toml(self) -> bytes:
        lines = [
            "# Members of the team, as its CA signed them: written by `swarmtrack keys`, signed in roster.sig.",
            f'team = "{self.team}"',
            f"number = {self.number}",
            f"monitors = {_list(self.monitors)}",
            f"routers = {_list(self.routers)}",
            "",
            "[drones]  # ID = Ed25519 public key",
            *(f'{i} = "{key.hex()}"' for i, key in sorted(self.drones.items())),
            "",
        ]
        return "\n".join(lines).encode()


def read_roster(data: bytes, where: str) -> Roster:
    """Parse a roster whose signature was checked. Raises KeysError, worded for a file edited by hand."""
    try:
        table = tomllib.loads(data.decode())
        roster = Roster(
            team=_text(table["team"]),
            number=int(table["number"]),
            drones={int(i): bytes.fromhex(key) for i, key in table["drones"].items()},
            monitors=tuple(map(_text, table["monitors"])),
            routers=tuple(map(_text, table["routers"])),
        )
    except (
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
    ) as error:  # TOML and UTF-8 errors are ValueErrors
        raise KeysError(f"{where}: {error}, expected a roster as `swarmtrack keys` writes it") from None
    for name in roster.names:
        if names.role(name) is None:
            raise KeysError(f"{where}: found {name!r}, expected the name of a drone, monitor or router")
    for drone_id, key in roster.drones.items():
        if len(key) != PUBLIC_KEY_BYTES:
            raise KeysError(f"{where}: drones.{drone_id}: {len(key)} bytes, expected {PUBLIC_KEY_BYTES}")
    return roster


def _list(words: tuple[str, ...]) -> str:
    return json.dumps(list(words))  # a list of plain words is the same in TOML


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise ValueError(f"found {value!r}, expected a string")
    return value
