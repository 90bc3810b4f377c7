"""How programs that are no drone find a team: the arguments they share, and what those mean."""

from __future__ import annotations

import argparse
from pathlib import Path

from swarmtrack.arguments import add_file, add_flag, add_folder, add_list
from swarmtrack.clock import SystemClock
from swarmtrack.config import NetworkSection, load_team_config
from swarmtrack.errors import KeysError, TransportError
from swarmtrack.security.credentials import Credentials
from swarmtrack.security.names import Role
from swarmtrack.transport import topology
from swarmtrack.transport.settings import NetworkSettings


def add_network_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--team", metavar="NAME", help=f"the team to hear (default: {NetworkSection().team})")
    add_file(parser, "--config", "the team's file: its [network] has the team's name and addresses")
    add_list(
        parser,
        "--connect",
        "where an agent listens, HOST[:PORT] or as tcp/192.168.1.5:7447; again for more "
        "(default: all on this machine)",
        "ADDRESS",
    )
    add_folder(parser, "--keys", "the folder that `swarmtrack keys issue … monitor` made")
    add_flag(parser, "--insecure", "connect beyond this machine without keys")


def network_of_monitor(args: argparse.Namespace) -> NetworkSettings:
    """Raises ConfigError, TransportError or KeysError."""
    section = NetworkSection() if args.config is None else load_team_config(args.config).network
    credentials = None if args.keys is None else credentials_in(args.keys, Role.MONITOR)
    if credentials is None and section.keys is not None:
        raise TransportError(f"{args.config}: this team has keys, expected --keys with those of a monitor")
    team = section.team if credentials is None else credentials.roster.team
    changes = {
        "team": args.team or (team if args.config is None else section.team),
        "connect": (*section.connect, *args.connect),
        "insecure": section.insecure or args.insecure,
        "listen": (),
    }
    if args.connect:  # just these
        changes |= {"topology": "mesh", "peers": {}, "connect": tuple(args.connect)}
    return topology.of_monitor(section.model_copy(update=changes), credentials)


def credentials_in(folder: Path, role: Role) -> Credentials:
    """The credentials of whatever process of a role a folder is for. Raises KeysError."""
    from swarmtrack.security.loading import find_name, load_credentials

    if not folder.is_dir():
        raise KeysError(f"--keys {folder}: is no folder, expected one that `swarmtrack keys issue` made")
    return load_credentials(folder, find_name(folder, role), SystemClock().utc())
