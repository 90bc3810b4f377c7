"""`swarmtrack echo KEY`: the messages of a running swarm, decoded, one JSON line per message."""

from __future__ import annotations

import argparse
import asyncio
import json
import sys
from collections.abc import Mapping
from typing import Any

from swarmtrack.arguments import add_seconds, count
from swarmtrack.clock import SystemClock
from swarmtrack.errors import TransportError
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind, Sample
from swarmtrack.transport.listening import hint_at, other_teams
from swarmtrack.transport.network_arguments import add_network_arguments, network_of_monitor
from swarmtrack.transport.zenoh_listener import ZenohListener
from swarmtrack.wire import codec
from swarmtrack.wire.checks import DecodeError
from swarmtrack.wire.records import as_record

SILENT_S = 3.0  # s of silence, after which other teams are named


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "key",
        metavar="KEY",
        help="key of the messages, below swarmtrack/TEAM/v1: 'tracks/*', 'pose/*', 'health/3', '**'; or a full key",
    )
    add_network_arguments(parser)
    parser.add_argument("--count", type=count, metavar="N", help="end after N messages")
    add_seconds(parser, "--seconds", "end after S seconds")


def run(args: argparse.Namespace) -> int:
    try:
        network = network_of_monitor(args)
        expression = args.key if args.key.startswith(f"{keys.ROOT}/") else keys.key(network.team, args.key)
        listener = ZenohListener(network, expression, SystemClock())
    except TransportError as error:
        print(f"swarmtrack echo: {error}", file=sys.stderr)
        return 2
    try:
        heard, hint = asyncio.run(echo(listener, network.team, args.count, args.seconds))
    except TransportError as error:
        print(f"swarmtrack echo: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 0
    if heard == 0 or heard < (args.count or 0):
        wanted = "no message" if args.count is None else f"{heard} of {args.count} messages"
        after = "" if args.seconds is None else f" in {args.seconds:g} s"
        print(
            f"swarmtrack echo: received {wanted} on {expression}{after}; "
            f"does an agent of team {network.team!r} run here, or is --connect missing?"
            f"{f' {hint[0].upper()}{hint[1:]}' if hint else ''}",
            file=sys.stderr,
        )
    return 1 if heard < (args.count or 0) else 0


async def echo(
    listener: ZenohListener, team: str, count: int | None, seconds: float | None
) -> tuple[int, str]:
    """Print until enough was heard or time is up; how many were, and where nothing was, whom one could hear instead."""
    heard, hint = 0, ""

    async def tell_of_silence() -> None:
        await asyncio.sleep(SILENT_S)
        if not heard and (hint := hint_at(await other_teams(listener, team))):
            print(f"swarmtrack echo: nothing of team {team!r} yet; {hint}", file=sys.stderr)

    await listener.open()
    telling = asyncio.create_task(tell_of_silence(), name="silence")
    try:
        async with asyncio.timeout(seconds):
            async for sample in listener.samples():
                print(json.dumps(line(sample), allow_nan=False), flush=True)
                heard += 1
                if heard == count:
                    break
    except TimeoutError:
        pass
    finally:
        telling.cancel()
        if not heard:
            hint = hint_at(await other_teams(listener, team))
        await listener.close()
        if listener.dropped:
            print(
                f"swarmtrack echo: {listener.dropped} messages came too fast and were dropped",
                file=sys.stderr,
            )
    return heard, hint


def line(sample: Sample) -> Mapping[str, Any]:
    """One message as JSON; what cannot be read says why."""
    address = keys.parse(sample.key)
    if not sample.alive or (address is not None and address.kind == Kind.ALIVE):
        return {"key": sample.key, "alive": sample.alive}
    kind = None if address is None else keys.MESSAGES.get(address.kind)
    if kind is None:
        return {"key": sample.key, "error": "unknown kind of key", "bytes": len(sample.payload)}
    try:
        return {"key": sample.key, **as_record(codec.decode(kind, sample.payload))}
    except DecodeError as error:
        return {"key": sample.key, "error": str(error), "bytes": len(sample.payload)}
