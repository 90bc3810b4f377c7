"""`swarmtrack router`: relays between drones that do not reach each other, or are too many for a mesh.

It believes nobody more than a drone does: the name in each certificate may speak for itself only. What a router says is
believed by the drones, except announcements, which are signed.
"""

from __future__ import annotations

import argparse
import asyncio
import logging
import os
import signal
import sys

import zenoh

from swarmtrack.arguments import add_file, add_flag, add_folder, add_seconds
from swarmtrack.clock import SystemClock
from swarmtrack.config.drone import load_team_config
from swarmtrack.errors import TransportError
from swarmtrack.log_lines import log_to_stderr
from swarmtrack.security.credentials import Credentials
from swarmtrack.security.names import Role
from swarmtrack.transport import settings, topology
from swarmtrack.transport.addresses import check_addresses
from swarmtrack.transport.following import follow_roster
from swarmtrack.transport.link_watch import LinkWatch, links_up
from swarmtrack.transport.listening import credentials_in
from swarmtrack.transport.settings import NetworkSettings
from swarmtrack.transport.tcp_options import keep_options
from swarmtrack.transport.zenoh_session import close_session, open_session

log = logging.getLogger(__name__)

PERIOD_S = 10.0  # between two lines when nothing changes


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(parser, "--config", "the team's file, with topology and routers", required=True)
    add_folder(parser, "--keys", "the folder that `swarmtrack keys issue … router-NAME` made")
    parser.add_argument(
        "--listen",
        metavar="ADDRESS",
        help="its entry in network.routers (default: the one with an address of this machine)",
    )
    add_seconds(parser, "--seconds", "end after S seconds")
    add_flag(parser, "--quiet", "print only warnings")


def run(args: argparse.Namespace) -> int:
    """Raises ConfigError or KeysError."""
    log_to_stderr(logging.WARNING, "swarmtrack router: %(message)s")
    config = load_team_config(args.config)
    if args.keys is None and config.network.keys is not None:
        raise TransportError(f"{args.config}: this team has keys, expected --keys with those of a router")
    credentials = None if args.keys is None else credentials_in(args.keys, Role.ROUTER)
    with config.blamed("network"):
        network = topology.of_router(config.network, args.listen, credentials)
        check_addresses(config.network, secured=credentials is not None, router=network.listen[0])
        settings.check(network)
    try:
        newer = asyncio.run(relay(network, args.seconds, args.quiet))
    except TransportError as error:  # the config is right; a port is taken
        print(f"swarmtrack router: {error}", file=sys.stderr)
        return 1
    if newer is not None:
        log.warning("roster number %d: starts again", newer.roster.number)
        # Within this process, Zenoh would hold the port for half a minute.
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
    return 0


async def relay(network: NetworkSettings, seconds: float | None, quiet: bool) -> Credentials | None:
    """Until a signal, or for so long, or until there is a newer roster. Raises TransportError."""
    stopped = asyncio.Event()
    newer: list[Credentials] = []

    async def renew(found: Credentials) -> None:
        newer.append(found)
        stopped.set()

    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        loop.add_signal_handler(number, stopped.set)
    session = await open_session(network)
    watch = LinkWatch(network)
    tasks = [
        asyncio.create_task(watch.run(lambda: links_up(session))),
        asyncio.create_task(keep_options()),
        asyncio.create_task(follow_roster(network.credentials, SystemClock(), renew)),
    ]
    if not quiet:
        tasks.append(asyncio.create_task(_tell_health(session, watch)))
    try:
        async with asyncio.timeout(seconds):
            await stopped.wait()
    except TimeoutError:
        pass
    finally:
        for task in tasks:
            task.cancel()
        await close_session(session, [], network.listen)
    return newer[0] if newer else None


async def _tell_health(session: zenoh.Session, watch: LinkWatch) -> None:
    """A line whenever who is linked changed, and now and then."""
    print(f"relaying for team {watch.network.team} on {', '.join(watch.network.listen)}", flush=True)
    told, silent_s = "", 0.0
    while True:
        line = watch.describe(links_up(session))
        if line != told or silent_s >= PERIOD_S:
            print(line, flush=True)
            told, silent_s = line, 0.0
        await asyncio.sleep(1.0)
        silent_s += 1.0
