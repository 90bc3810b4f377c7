"""`swarmtrack ros2`: a running swarm as ROS 2 topics under rmw_zenoh, without ROS."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import logging
import os
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from swarmtrack.arguments import add_seconds, positive
from swarmtrack.clock import SystemClock
from swarmtrack.errors import TransportError
from swarmtrack.log_lines import log_to_stderr
from swarmtrack.transport.listening import hint_at, other_teams
from swarmtrack.transport.network_arguments import add_network_arguments, network_of_monitor

if TYPE_CHECKING:
    from swarmtrack.client.ros2_bridge import TeamBridge
    from swarmtrack.config.ros2 import Ros2Section
    from swarmtrack.transport.settings import NetworkSettings
    from swarmtrack.transport.zenoh_listener import ZenohListener

NEWS_S = 1.0  # s between two looks at which drones are there
SILENT_S = 5  # s without a drone, after which the reason is asked for
NODE_NAME = "swarmtrack"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_network_arguments(parser)
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--router",
        metavar="HOST[:PORT]",
        help="the router of ROS 2 to join, rmw_zenohd (default: that of this machine; if none answers, --serve)",
    )
    where.add_argument(
        "--serve",
        nargs="?",
        const="127.0.0.1:7447",
        metavar="HOST[:PORT]",
        help="be the router of ROS 2 at this address, in place of rmw_zenohd (default: %(const)s)",
    )
    parser.add_argument("--domain", metavar="ID", help="ROS domain (default: ROS_DOMAIN_ID, or 0)")
    parser.add_argument(
        "--namespace", metavar="NAME", help="first part of topics and frames (default: swarm)"
    )
    parser.add_argument("--distro", metavar="NAME", help="jazzy, kilted or humble (default: jazzy)")
    parser.add_argument(
        "--hz", type=positive, metavar="HZ", help="tracks per drone and second, at most (default: 20)"
    )
    add_seconds(parser, "--seconds", "end after S seconds")


def run(args: argparse.Namespace) -> int:
    """Raises ConfigError, KeysError or TransportError."""
    log_to_stderr(logging.WARNING, "swarmtrack ros2: %(message)s")
    from swarmtrack.outputs.ros2.connection import ros2_network

    team, section = network_of_monitor(args), section_of(args)
    serve = args.serve is not None
    network = ros2_network(
        section.router, "--serve" if serve else "--router", serve=serve, insecure=section.insecure
    )
    try:
        return asyncio.run(_serve(args, team, section, network))
    except TransportError as error:  # the options are right; a router is missing, or a port is taken
        print(f"swarmtrack ros2: {error}", file=sys.stderr)
        return 1


def section_of(args: argparse.Namespace) -> Ros2Section:
    """The options as a config has them. Raises ConfigError."""
    from swarmtrack.config.ros2 import Ros2Section
    from swarmtrack.config.toml.layers import Layer, Layers
    from swarmtrack.config.toml.sections import validated

    domain = args.domain or os.environ.get("ROS_DOMAIN_ID", "")
    said = {
        "router": args.serve or args.router,
        "domain": int(domain) if domain.isdecimal() else domain or None,
        "namespace": args.namespace,
        "distro": args.distro,
        "hz": args.hz,
        "insecure": args.insecure,
    }
    table = {key: value for key, value in said.items() if value is not None}
    return validated(Ros2Section, Layers([Layer(Path("options"), "", table)], table), [])


async def _serve(
    args: argparse.Namespace, team: NetworkSettings, section: Ros2Section, network: NetworkSettings
) -> int:
    from swarmtrack.client.ros2_bridge import TeamBridge
    from swarmtrack.outputs.ros2.connection import answers, ros2_network
    from swarmtrack.outputs.ros2.node import RosNode
    from swarmtrack.transport.zenoh_listener import ZenohListener

    clock = SystemClock()
    if args.serve is None and args.router is None and not await answers(network):
        network = ros2_network(section.router, "--serve", serve=True, insecure=section.insecure)
    node = RosNode(network, section, NODE_NAME, clock)
    bridge = TeamBridge(team.team, node, namespace=section.namespace, hz=section.hz, clock=clock)
    listener = ZenohListener(team, bridge.key_expressions, clock)
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    await node.open()
    where = f"is the router at {network.listen[0]}" if network.listen else f"joined {network.connect[0]}"
    print(f"ROS 2: domain {section.domain}, {section.distro}, {where}; Ctrl-C ends it", flush=True)
    try:
        await listener.open()
        tasks = [
            asyncio.create_task(bridge.run(listener), name="bridge"),
            asyncio.create_task(_tell(bridge, listener, team.team), name="tell"),
        ]
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(args.seconds):
                await asyncio.wait(
                    {*tasks, asyncio.create_task(stop.wait())}, return_when=asyncio.FIRST_COMPLETED
                )
        for task in tasks:
            if task.done():
                task.result()
            task.cancel()
    finally:
        await listener.close()
        await node.close()
    return 0


async def _tell(bridge: TeamBridge, listener: ZenohListener, team: str) -> None:
    """A line whenever other drones are there; and if there are none, why."""
    told: tuple[int, ...] = ()
    silent_s = 0
    while True:
        await asyncio.sleep(NEWS_S)
        if bridge.drones != told:
            told = bridge.drones
            print(f"drones: {', '.join(map(str, told)) or 'none'}", flush=True)
        silent_s = 0 if told else silent_s + 1
        if silent_s == SILENT_S:
            hint = (
                hint_at(await other_teams(listener, team))
                or "does an agent run here, or is --connect missing?"
            )
            print(f"swarmtrack ros2: no drone of team {team!r} is found; {hint}", file=sys.stderr)
