"""How a program that is no drone finds a team."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from swarmtrack.clock import SystemClock
from swarmtrack.config import NetworkSection, load_team_config
from swarmtrack.errors import KeysError, TransportError
from swarmtrack.security.credentials import Credentials
from swarmtrack.security.names import Role
from swarmtrack.transport import topology
from swarmtrack.transport.settings import NetworkSettings


def network_of_listener(
    *,
    team: str | None = None,
    config: Path | None = None,
    connect: Sequence[str] = (),
    keys: Path | None = None,
    insecure: bool = False,
) -> NetworkSettings:
    """team: its name, None: as the keys or the file say. config: the team's file. connect: where agents listen, nothing
    else then. keys: the folder of a monitor. insecure: beyond this machine without keys.

    Raises ConfigError, TransportError or KeysError.
    """
    section = NetworkSection() if config is None else load_team_config(config).network
    credentials = None if keys is None else credentials_in(keys, Role.MONITOR)
    if credentials is None and section.keys is not None:
        raise TransportError(
            f"{config}: this team has keys, expected the folder with those of a monitor (--keys, keys=)"
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
    return topology.of_monitor(section.model_copy(update=changes), credentials)


def credentials_in(folder: Path, role: Role) -> Credentials:
    """The credentials of whatever process of a role a folder is for. Raises KeysError."""
    # Not above: who has no keys need not load cryptography.
    from swarmtrack.security.loading import find_name, load_credentials  # noqa: PLC0415

    if not folder.is_dir():
        raise KeysError(f"--keys {folder}: is no folder, expected one that `swarmtrack keys issue` made")
    return load_credentials(folder, find_name(folder, role), SystemClock().utc())
