"""`swarmtrack record`: all messages of a running swarm, into a recording, until Ctrl-C."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import signal
import sys

from swarmtrack.arguments import add_flag, add_folder, add_seconds, positive
from swarmtrack.clock import SystemClock
from swarmtrack.errors import TransportError
from swarmtrack.runtime.swarm_recorder import SwarmRecorder
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind
from swarmtrack.transport.network_arguments import add_network_arguments, network_of_monitor
from swarmtrack.transport.zenoh_listener import ZenohListener

NEWS_S = 1.0  # s between two looks at how the disk is doing


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_folder(parser, "dir", "folder for recordings; a subfolder is made for each")
    add_network_arguments(parser)
    add_flag(
        parser,
        "--video",
        "also record video, at most 10 pictures per second and drone; makes every drone encode and send it",
    )
    add_seconds(parser, "--seconds", "end after S seconds")
    parser.add_argument(
        "--max-mb",
        type=positive,
        default=4000.0,
        metavar="MB",
        help="limit for all recordings below DIR/swarm; beyond it the oldest files are deleted (default: %(default)g)",
    )


def run(args: argparse.Namespace) -> int:
    clock = SystemClock()
    try:
        network = network_of_monitor(args)
        wanted = keys.all_but_video(network.team)
        if args.video:
            wanted.append(keys.key(network.team, Kind.VIDEO, "*", "**"))
        listener = ZenohListener(network, wanted, clock)
    except TransportError as error:
        print(f"swarmtrack record: {error}", file=sys.stderr)
        return 2
    recorder = SwarmRecorder(clock, network.team)
    recorder.open(args.dir, bounds={"max_bytes": int(args.max_mb * 1e6), "drop_oldest": True})
    print(f"recording team {network.team} into {recorder.thread.folder}; Ctrl-C ends it", flush=True)
    try:
        heard = asyncio.run(_record(listener, recorder, clock, args.seconds))
    except TransportError as error:
        print(f"swarmtrack record: {error}", file=sys.stderr)
        return 1
    finally:
        recorder.close()
    thread = recorder.thread
    print(f"{heard} messages, {thread.counters.bytes / 1e6:.1f} MB in {thread.counters.segments} files")
    lost = thread.lost + listener.dropped
    if lost:
        print(f"swarmtrack record: {lost} messages were lost", file=sys.stderr)
    if not heard:
        print(
            f"swarmtrack record: received nothing from team {network.team!r}; does an agent run here, or is --connect "
            "missing?",
            file=sys.stderr,
        )
    return 0 if heard else 1


async def _record(
    listener: ZenohListener, recorder: SwarmRecorder, clock: SystemClock, seconds: float | None
) -> int:
    """Until time is up, or a signal ends it; how many messages were heard."""
    heard = 0

    async def listen() -> None:
        nonlocal heard
        async for sample in listener.samples():
            recorder.record_sample(sample, clock.now(), clock.utc())
            heard += 1

    async def tell() -> None:
        while True:
            await asyncio.sleep(NEWS_S)
            if news := recorder.thread.take_news():
                print(f"swarmtrack record: {news}", file=sys.stderr)

    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    await listener.open()
    telling = asyncio.create_task(tell(), name="tell")
    listening = asyncio.create_task(listen(), name="listen")
    try:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await stop.wait()
    finally:
        telling.cancel()
        await listener.close()
        await listening
    return heard
