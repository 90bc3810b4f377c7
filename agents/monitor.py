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
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import TYPE_CHECKING

from swarmtrack.arguments import add_file, add_flag, port
from swarmtrack.errors import SwarmtrackError, TransportError
from swarmtrack.transport.network_arguments import add_network_arguments, network_of_monitor

if TYPE_CHECKING:
    import ssl

    from swarmtrack.monitor.foxglove_server import FoxgloveServer
    from swarmtrack.monitor.server import Feed, MonitorServer
    from swarmtrack.outputs.flight_end import FlightEnd

DEFAULT_PORT = 8080
FOXGLOVE_PORT = 8765
MAX_ENDING = 1 << 20  # bytes of a verdict
UNENCRYPTED = (
    "the page, and the token in its address, travel unencrypted: anyone on this network can read them; "
    "--certificate FILE --key FILE serve it by TLS"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_network_arguments(parser)
    add_file(
        parser,
        "--recording",
        "replay recordings instead: folders or files of `swarmtrack record`, `sim --record`, or drones' own recordings",
        metavar="PATH",
        nargs="+",
    )
    parser.add_argument(
        "--bind",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="address to serve the page at; beyond this machine a token is required (default: %(default)s)",
    )
    parser.add_argument(
        "--port",
        type=port,
        default=DEFAULT_PORT,
        metavar="PORT",
        help="port of the page, 0: any free one (default: %(default)s)",
    )
    parser.add_argument(
        "--token",
        metavar="TEXT",
        help="access token for viewers (default: random, if one is required)",
    )
    add_file(parser, "--certificate", "serve over TLS with this certificate, PEM; requires --key")
    add_file(parser, "--key", "key of the certificate, PEM")
    parser.add_argument(
        "--foxglove",
        type=port,
        nargs="?",
        const=FOXGLOVE_PORT,
        metavar="PORT",
        help="serve the team to Foxglove and Lichtblick as well, on this machine only, 0: any free port "
        f"(default: {FOXGLOVE_PORT})",
    )
    add_flag(parser, "--open", "open the page in this machine's browser")
    # Of `swarmtrack sim`, which says on our standard input how the flight ended.
    parser.add_argument("--flight", action="store_true", help=argparse.SUPPRESS)


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
    ending = _Endings().next if args.flight else None
    feed = LiveFeed(MonitoredTeam(network.team, clock), listener, ending)
    try:
        return await _serve(args, feed, f"monitor of team {network.team}", listener.open)
    finally:
        await listener.close()


class _Endings:
    """How the flight ended, as standard input says it: that it did, then its verdict."""

    def __init__(self) -> None:
        self._reader: asyncio.StreamReader | None = None

    async def next(self) -> FlightEnd | None:
        """None: nobody is there to say it."""
        import msgspec

        from swarmtrack.outputs.flight_end import FlightEnd

        if self._reader is None:
            self._reader = reader = asyncio.StreamReader(limit=MAX_ENDING)
            protocol = asyncio.StreamReaderProtocol(reader)
            await asyncio.get_running_loop().connect_read_pipe(lambda: protocol, sys.stdin)
        line = await self._reader.readline()
        return msgspec.json.decode(line, type=FlightEnd) if line else None


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
    from swarmtrack.monitor.access import AccessGuard, is_loopback, token_for
    from swarmtrack.monitor.entrance import tls_context
    from swarmtrack.monitor.server import PAGE, MonitorServer

    token = token_for(args.bind, args.token)
    tls = tls_context(args.certificate, args.key)
    server = MonitorServer(feed, AccessGuard(token, PAGE.read_text(encoding="utf-8")))
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    async with _opened(server, tls, args) as address:
        if begin is not None:
            await begin()
        url = _url(address, args.bind, token, secure=tls is not None)
        print(f"{what}: {url}", flush=True)
        if tls is None and not is_loopback(args.bind):
            print(f"swarmtrack monitor: {UNENCRYPTED}", file=sys.stderr)
        if args.open:
            await asyncio.to_thread(webbrowser.open, url)
        with _foxglove(args.foxglove, feed, what) as others:
            running = asyncio.create_task(server.run(*others), name="monitor")
            stopped = asyncio.create_task(stop.wait(), name="stop")
            await asyncio.wait({running, stopped}, return_when=asyncio.FIRST_COMPLETED)
            if running.done():
                running.result()  # a bug: its exception comes out
            for task in (running, stopped):
                task.cancel()
            await asyncio.gather(running, stopped, return_exceptions=True)
    return 0


@contextmanager
def _foxglove(number: int | None, feed: Feed, name: str) -> Iterator[list[FoxgloveServer]]:
    """What serves Foxglove at that port; none where that is not asked for."""
    if number is None:
        yield []
        return
    from swarmtrack.clock import SystemClock
    from swarmtrack.monitor.foxglove_server import FoxgloveServer
    from swarmtrack.monitor.player import RecordingPlayer

    played = feed.span if isinstance(feed, RecordingPlayer) else None
    server = FoxgloveServer(feed, f"swarmtrack: {name}", SystemClock(), played)
    server.open(number)
    print(f"foxglove: ws://127.0.0.1:{server.port}", flush=True)
    try:
        yield [server]
    finally:
        server.close()


@asynccontextmanager
async def _opened(
    server: MonitorServer, tls: ssl.SSLContext | None, args: argparse.Namespace
) -> AsyncIterator[tuple[str, int]]:
    """host and port of the page, while it is served."""
    from aiohttp import web

    from swarmtrack.monitor.entrance import HEADERS_S, Entrance, SparingLog

    loop = asyncio.get_running_loop()
    trouble = SparingLog(loop.time)
    loop.set_exception_handler(trouble.on_loop_error)
    entrance, application = Entrance(tls, trouble), server.application()
    entrance.prepare(application)
    runner = web.AppRunner(
        application,
        access_log=None,
        shutdown_timeout=1.0,
        logger=trouble,
        keepalive_timeout=HEADERS_S,
        lingering_time=0,
    )
    await runner.setup()
    assert runner.server is not None
    try:
        try:
            await entrance.open(args.bind, args.port, runner.server)
        except OSError as error:
            reason = error.strerror or str(error)
            raise ServeError(
                f"--bind {args.bind} --port {args.port}: {reason}, expected an address of this machine and a free port"
            ) from None
        yield entrance.address
    finally:
        await entrance.close()
        await runner.cleanup()


def _url(address: tuple[str, int], bind: str, token: str | None, *, secure: bool) -> str:
    """What to open. A page that is served on all addresses is opened by the machine's name."""
    host, port = address
    if bind in ("0.0.0.0", "::"):
        host = socket.gethostname()
    elif ":" in host:
        host = f"[{host}]"
    return f"http{'s' if secure else ''}://{host}:{port}/" + (f"?token={token}" if token else "")
