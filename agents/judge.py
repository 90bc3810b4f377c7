"""`swarmtrack judge URL`: a verdict on a swarm that others started, against the truth of its simulator.

For swarms whose processes are not our children: containers, or several machines. `swarmtrack sim` starts everything
itself and needs none of this.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import signal
import sys
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from swarmtrack.arguments import add_file, add_seconds
from swarmtrack.errors import SourceError, SwarmtrackError, TransportError, ungrouped
from swarmtrack.transport.network_arguments import add_network_arguments, network_of_monitor

if TYPE_CHECKING:
    from swarmtrack.clock import Clock
    from swarmtrack.lab.score.swarm_verdict import SwarmReport
    from swarmtrack.lab.swarm.detail import Detail
    from swarmtrack.lab.swarm.table import Spectator
    from swarmtrack.lab.swarm.watch import Watch
    from swarmtrack.transport.settings import NetworkSettings

FAILED = 1
ASK_S = 0.5  # s between two questions of who is there
ANSWER_S = 5.0  # s for the simulator to answer
SETTLE_S = 3.0  # s from everybody's first tracks to what is judged: names are given within two
SHOW_HZ = 4.0


class NotThere(SwarmtrackError):
    """Nothing to judge: who is missing."""


@dataclass(frozen=True, slots=True)
class FlownScenario:
    """What a simulator says it flies. epoch: its world time 0 on our monotonic clock, s."""

    scenario: str
    seed: int
    drones: int | None
    detector: str
    detail: Detail
    epoch: float


def add_arguments(parser: argparse.ArgumentParser) -> None:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported: its threads only cost here
    parser.add_argument(
        "simulator",
        metavar="URL",
        help="address of `python -m swarmtrack.agents.simulator --port P`: http://HOST:P",
    )
    add_seconds(
        parser,
        "--seconds",
        "how long to judge, once all agents are there (default: %(default)g)",
        default=20.0,
    )
    add_seconds(
        parser,
        "--patience",
        "how long to wait for the simulator and all agents (default: %(default)g)",
        default=90.0,
    )
    add_file(parser, "--json", "write the verdict and all figures to this file")
    add_network_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Exit codes: 0 passed, 1 failed, 2 wrong usage."""
    from rich.console import Console

    from swarmtrack.agents.sim import check_writable, conclude
    from swarmtrack.lab.swarm.table import PlainLines

    if args.json is not None:
        check_writable(args.json)
    if not args.simulator.startswith(("http://", "https://")):
        raise SourceError(f"URL: found {args.simulator}, expected http://HOST:PORT of a simulator")
    network = network_of_monitor(args)
    console = Console()
    try:
        report = asyncio.run(_judge(args, network, PlainLines(console)))
    except (NotThere, TransportError) as error:
        print(f"swarmtrack judge: {error}", file=sys.stderr)
        print("FAILED")
        return FAILED
    except asyncio.CancelledError:
        print("swarmtrack judge: interrupted", file=sys.stderr)
        return FAILED
    return conclude(report, console, args.json)


async def _judge(args: argparse.Namespace, network: NetworkSettings, spectator: Spectator) -> SwarmReport:
    from swarmtrack.clock import SystemClock
    from swarmtrack.lab.scenarios.files import load_limits, load_scenario
    from swarmtrack.lab.scenarios.scenario import as_told
    from swarmtrack.lab.swarm.watch import Watch

    task = asyncio.current_task()
    assert task is not None
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        asyncio.get_running_loop().add_signal_handler(number, task.cancel)
    clock = SystemClock()
    deadline = clock.now() + args.patience
    spectator.note(f"asking {args.simulator} for its scenario …")
    flown = await ask_simulator(args.simulator, args.patience)
    whole, followed = as_told(load_scenario(flown.scenario, seed=flown.seed, drones=flown.drones))
    scenario = flown.detail.of(whole)
    if followed:
        raise NotThere(
            f"{args.simulator}: its drones {', '.join(map(str, followed))} are flown by a ground station, expected a "
            "planned scenario; swarmtrack sim judges guided ones"
        )
    watch = Watch(scenario, clock, clock, epoch=flown.epoch, seconds=0.0)
    with ungrouped():
        async with _heard(network, watch, clock):
            spectator.note(f"{scenario.name}: waiting for drones {', '.join(map(str, scenario.members))} …")
            await _everybody(watch, deadline - clock.now())
            start = watch.t + SETTLE_S
            watch.count_from(start, args.seconds)
            while watch.t < start + args.seconds:
                spectator.show(watch)
                await asyncio.sleep(1.0 / SHOW_HZ)
    await watch.judge_the_rest()
    return watch.report(
        seconds=args.seconds,
        seed=flown.seed,
        tracker="as configured",
        detector=flown.detector,
        limits=flown.detail.expected(whole, load_limits(flown.scenario)),
        detail=flown.detail,
    )


async def ask_simulator(url: str, patience_s: float) -> FlownScenario:
    """Until it answers. Raises NotThere."""
    import aiohttp

    from swarmtrack.clock import SystemClock

    clock = SystemClock()
    deadline, trouble = clock.now() + patience_s, "no answer"
    async with aiohttp.ClientSession(timeout=aiohttp.ClientTimeout(total=ANSWER_S)) as session:
        while clock.now() < deadline:
            asked = clock.now()
            try:
                async with session.get(url, raise_for_status=True) as response:
                    told = await response.json()
                if "world" in told:
                    raise NotThere(
                        f"{url}: draws drones of another simulator, expected a planned scenario; swarmtrack sim "
                        "--world judges such drones"
                    )
                return _understood(told, (asked + clock.now()) / 2.0)
            except (aiohttp.ClientError, TimeoutError) as error:
                trouble = str(error) or "no answer"
            except (ValueError, KeyError, TypeError):
                raise NotThere(
                    f"{url}: is not a swarmtrack simulator, expected its --host and --port"
                ) from None
            await asyncio.sleep(ASK_S)
    raise NotThere(f"{url}: {trouble}; is a simulator there, started with --host and --port?")


def _understood(told: dict[str, Any], now: float) -> FlownScenario:
    """now: when the simulator said it, to half of the time that the question took."""
    from swarmtrack.lab.swarm.detail import Detail

    return FlownScenario(
        scenario=str(told["scenario"]),
        seed=int(told["seed"]),
        drones=None if told["drones"] is None else int(told["drones"]),
        detector=str(told["detector"]),
        detail=Detail(told.get("detail", "full")),
        epoch=now - float(told["world_time_s"]),
    )


@contextlib.asynccontextmanager
async def _heard(network: NetworkSettings, watch: Watch, clock: Clock) -> AsyncIterator[None]:
    """The watch hears the team meanwhile, and judges what it can."""
    from swarmtrack.transport import keys
    from swarmtrack.transport.zenoh_listener import ZenohListener

    listener = ZenohListener(network, keys.all_but_video(network.team), clock)
    await listener.open()
    try:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(watch.listen(listener.samples()), name="hear")
            judging = tasks.create_task(watch.evaluate(), name="judge")
            yield
            judging.cancel()
            await listener.close()  # which ends the hearing
    finally:
        await listener.close()


async def _everybody(watch: Watch, patience_s: float) -> None:
    """Until all have announced themselves and track. Raises NotThere."""

    async def arrival(drone_id: int) -> None:
        await watch.until_alive(drone_id)
        watch.started(drone_id)

    try:
        async with asyncio.timeout(patience_s):
            await asyncio.gather(*map(arrival, watch.agents))
            while watch.missing:  # noqa: ASYNC110 (tracks come by the hundred a second: no event is worth it)
                await asyncio.sleep(ASK_S)
    except TimeoutError:
        who = ", ".join(map(str, watch.missing))
        raise NotThere(
            f"after {patience_s:.0f} s drone {who} has not announced itself, or has no tracks: see its agent's log "
            "and `swarmtrack echo 'health/*'`"
        ) from None
