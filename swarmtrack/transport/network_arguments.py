"""How programs that are no drone find a team: the arguments they share, and what those mean."""

from __future__ import annotations

import argparse

from swarmtrack.arguments import add_file, add_flag, add_folder, add_list
from swarmtrack.config.drone import NetworkSection
from swarmtrack.transport.listening import network_of_listener
from swarmtrack.transport.settings import NetworkSettings


def add_network_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--team", metavar="NAME", help=f"name of the team (default: {NetworkSection().team})")
    add_file(parser, "--config", "the team's file: its [network] has the team's name and addresses")
    add_list(
        parser,
        "--connect",
        "address of an agent, HOST[:PORT] or such as tcp/192.168.1.5:7447; may be repeated "
        "(default: all on this machine)",
        "ADDRESS",
    )
    add_folder(parser, "--keys", "the folder that `swarmtrack keys issue … monitor` made")
    add_flag(parser, "--insecure", "connect beyond this machine without keys")


def network_of_monitor(args: argparse.Namespace) -> NetworkSettings:
    """Raises ConfigError, TransportError or KeysError."""
    return network_of_listener(
        team=args.team, config=args.config, connect=args.connect, keys=args.keys, insecure=args.insecure
    )
