"""Network settings of programs that are not drones."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from swarmtrack.clock import SystemClock
from swarmtrack.config.drone import NetworkSection, load_team_config
from swarmtrack.errors import KeysError, TransportError
from swarmtrack.plain_text import plain
from swarmtrack.security import names
from swarmtrack.security.credentials import Credentials
from swarmtrack.security.names import Role
from swarmtrack.transport import topology
from swarmtrack.transport.addresses import check_addresses
from swarmtrack.transport.limits import MOST_TEAMS_NAMED
from swarmtrack.transport.settings import NetworkSettings


def network_of_listener(
    *,
    team: str | None = None,
    config: Path | None = None,
    connect: Sequence[str] = (),
    keys: Path | None = None,
    insecure: bool = False,
) -> NetworkSettings:
    """Settings of a listener. team: its name, None: from the keys or the file. config: the team's file. connect:
    addresses of agents, used exclusively. keys: the folder of a monitor. insecure: allow other machines without
    keys.

    Raises ConfigError, TransportError or KeysError.
    """
    section, credentials = _section(
        Role.MONITOR, team=team, config=config, connect=connect, keys=keys, insecure=insecure
    )
    check_addresses(section, secured=credentials is not None)
    return topology.of_monitor(section, credentials)


def network_of_companion(
    drone_id: int,
    *,
    team: str | None = None,
    config: Path | None = None,
    connect: Sequence[str] = (),
    keys: Path | None = None,
    insecure: bool = False,
) -> NetworkSettings:
    """Settings of a program on board of a drone, next to its agent. keys: the drone's own folder; the rest as in
    `network_of_listener`.

    Raises ConfigError, TransportError or KeysError.
    """
    section, credentials = _section(
        Role.DRONE, team=team, config=config, connect=connect, keys=keys, insecure=insecure
    )
    if credentials is not None and credentials.name != names.drone(drone_id):
        raise KeysError(
            f"--keys {keys}: found those of {credentials.name}, expected those of {names.drone(drone_id)}"
        )
    return topology.of_companion(section, drone_id, credentials)


def _section(
    role: Role,
    *,
    team: str | None,
    config: Path | None,
    connect: Sequence[str],
    keys: Path | None,
    insecure: bool,
) -> tuple[NetworkSection, Credentials | None]:
    section = NetworkSection() if config is None else load_team_config(config).network
    credentials = None if keys is None else credentials_in(keys, role)
    if credentials is None and section.keys is not None:
        raise TransportError(
            f"{config}: this team has keys, expected the folder with those of a {role} (--keys, keys=)"
        )
    named = section.team if credentials is None else credentials.roster.team
    changes = {
        "team": team or (named if config is None else section.team),
        "connect": (*section.connect, *connect),
        "insecure": section.insecure or insecure,
        "listen": (),
    }
    if connect:  # just these
        changes |= {"topology": "mesh", "peers": {}, "connect": tuple(connect)}
    return section.model_copy(update=changes), credentials


class HasTeams(Protocol):
    """A session that can list the teams within its reach."""

    async def teams(self) -> set[str]: ...


async def other_teams(listener: HasTeams, team: str) -> tuple[str, ...]:
    """Names of other teams within reach, where the given team is silent."""
    try:
        return tuple(sorted(await listener.teams() - {team}))
    except TransportError:
        return ()


def hint_at(others: Sequence[str]) -> str:
    """Hint for a wrong team name, or an empty string."""
    if not others:
        return ""
    named = ", ".join(plain(other, 64) for other in others[:MOST_TEAMS_NAMED])
    more = f" and {len(others) - MOST_TEAMS_NAMED} more" if len(others) > MOST_TEAMS_NAMED else ""
    return f"found drones of {named}{more}: --team {plain(others[0], 64)}"


def credentials_in(folder: Path, role: Role) -> Credentials:
    """Credentials in a folder, whatever the role of its process. Raises KeysError."""
    # Not above: who has no keys need not load cryptography.
    from swarmtrack.security.loading import find_name, load_credentials  # noqa: PLC0415

    if not folder.is_dir():
        raise KeysError(f"--keys {folder}: is not a folder, expected one that `swarmtrack keys issue` made")
    return load_credentials(folder, find_name(folder, role), SystemClock().utc())
