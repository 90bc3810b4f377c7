"""`swarmtrack monitor`: the web page of a running swarm or of a recording.

How such programs find a team: `monitoring.py`.
"""

from __future__ import annotations

import argparse
import asyncio
import signal
import socket
import sys
import webbrowser
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING

from swarmtrack.agents.network_arguments import add_network_arguments, network_of_monitor
from swarmtrack.arguments import add_file, add_flag, port
from swarmtrack.errors import SwarmtrackError, TransportError

if TYPE_CHECKING:
    from aiohttp import web

    from swarmtrack.monitor.server import Feed

DEFAULT_PORT = 8080


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_network_arguments(parser)
    add_file(
        parser,
        "--recording",
        "play this instead: folders or files of `swarmtrack record`, `sim --record`, or drones' own recordings",
        metavar="PATH",
        nargs="+",
    )
    parser.add_argument(
        "--bind",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="where to serve the page; beyond this machine a token is needed (default: %(default)s)",
    )
    parser.add_argument(
        "--port",
        type=port,
        default=DEFAULT_PORT,
        metavar="PORT",
        help="0: any free port (default: %(default)s)",
    )
    parser.add_argument(
        "--token",
        metavar="TEXT",
        help="what a viewer has to know (default: random, where one is needed)",
    )
    add_flag(parser, "--open", "open the page in this machine's browser")


def run(args: argparse.Namespace) -> int:
    try:
        return asyncio.run(serve(args))
    except TransportError as error:
        print(f"swarmtrack monitor: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 0


class ServeError(TransportError):
    """The page cannot be served there."""


async def serve(args: argparse.Namespace) -> int:
    """Until SIGINT or SIGTERM."""
    if args.recording:
        return await _serve_recording(args)
    return await _serve_swarm(args)


async def _serve_swarm(args: argparse.Namespace) -> int:
    from swarmtrack.clock import SystemClock
    from swarmtrack.monitor.live import LiveFeed
    from swarmtrack.monitor.team import MonitoredTeam
    from swarmtrack.transport import keys
    from swarmtrack.transport.zenoh_listener import ZenohListener

    clock = SystemClock()
    try:
        network = network_of_monitor(args)
        listener = ZenohListener(network, keys.all_but_video(network.team), clock, newest_per_key=True)
    except TransportError as error:
        raise SwarmtrackError(str(error)) from None  # of what was written: exit code 2
    feed = LiveFeed(MonitoredTeam(network.team, clock), listener)
    try:
        return await _serve(args, feed, f"monitor of team {network.team}", listener.open)
    finally:
        await listener.close()


async def _serve_recording(args: argparse.Namespace) -> int:
    from swarmtrack.monitor.player import Playback, RecordingPlayer
    from swarmtrack.monitor.recorded import read_timeline

    if args.team or args.config or args.connect or args.keys or args.insecure:
        raise SwarmtrackError(
            "--recording: given with --team, --config, --connect, --keys or --insecure, expected a recording "
            "or a swarm"
        )
    name = " ".join(path.resolve().name for path in args.recording)
    print(f"swarmtrack monitor: reading {name}", file=sys.stderr)
    timeline = read_timeline(args.recording)
    for note in timeline.notes:
        print(f"swarmtrack monitor: {note}", file=sys.stderr)
    player = RecordingPlayer(Playback(timeline), name)
    return await _serve(args, player, f"recording {name} of team {timeline.team}, {timeline.seconds:.0f} s")


async def _serve(
    args: argparse.Namespace, feed: Feed, what: str, begin: Callable[[], Awaitable[None]] | None = None
) -> int:
    """begin: awaited once the page is there."""
    from aiohttp import web

    from swarmtrack.monitor.access import AccessGuard, token_for
    from swarmtrack.monitor.server import PAGE, MonitorServer

    token = token_for(args.bind, args.token)
    server = MonitorServer(feed, AccessGuard(token, PAGE.read_text(encoding="utf-8")))
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    runner = web.AppRunner(server.application(), access_log=None, shutdown_timeout=1.0)
    await runner.setup()
    try:
        site = web.TCPSite(runner, args.bind, args.port)
        try:
            await site.start()
        except OSError as error:
            reason = error.strerror or str(error)
            raise ServeError(
                f"--bind {args.bind} --port {args.port}: {reason}, expected an address of this machine and a free port"
            ) from None
        if begin is not None:
            await begin()
        url = _address(runner, args.bind, token)
        print(f"{what}: {url}", flush=True)
        if args.open:
            await asyncio.to_thread(webbrowser.open, url)
        running = asyncio.create_task(server.run(), name="monitor")
        stopped = asyncio.create_task(stop.wait(), name="stop")
        await asyncio.wait({running, stopped}, return_when=asyncio.FIRST_COMPLETED)
        if running.done():
            running.result()  # a bug: its exception comes out
        for task in (running, stopped):
            task.cancel()
        await asyncio.gather(running, stopped, return_exceptions=True)
    finally:
        await runner.cleanup()
    return 0


def _address(runner: web.AppRunner, bind: str, token: str | None) -> str:
    """What to open. A page that is served on all addresses is opened by the machine's name."""
    host, port = runner.addresses[0][:2]
    if bind in ("0.0.0.0", "::"):
        host = socket.gethostname()
    elif ":" in host:
        host = f"[{host}]"
    return f"http://{host}:{port}/" + (f"?token={token}" if token else "")
