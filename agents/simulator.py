"""`python -m swarmtrack.agents.simulator`: the cameras and autopilots of a simulated swarm, on real sockets.

For each drone that has an agent, a camera over HTTP (JPEGs, or with `--detector oracle` lines of detections) and an
autopilot that speaks MAVLink over UDP. World time 0 is `--epoch` on this machine's monotonic clock; before it all
drones hover. When everything listens, one line of JSON says where:

    {"ready": true, "drones": {"1": {"camera": "http://127.0.0.1:40001/1", "autopilot": "udpout:127.0.0.1:50001"}, …}}

With `--port P` the cameras are at TCP port P, and the autopilot of drone N at UDP port P + N, for configs that were
written before. At `/` the same server says what is flown and how late it is in that world, for `swarmtrack judge`.

Then it is quiet, and ends on SIGTERM, on SIGINT, or when the pipe at its standard input closes: its parent has died.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import os
import signal
import stat
import sys
from contextlib import suppress
from typing import TYPE_CHECKING

from swarmtrack.arguments import add_seed
from swarmtrack.errors import SwarmtrackError

if TYPE_CHECKING:
    from swarmtrack.simulation.scenarios import Scenario

DONE, FAILED, WRONG_USAGE = 0, 1, 2
NICENESS = -10  # a camera does not wait until the agents have computed; without root, it has to
LEAD = 2.0  # s from the start of the program to world time 0, where nobody gives an epoch


def watch_parent(loop: asyncio.AbstractEventLoop, stop: asyncio.Event) -> None:
    """Stop when the pipe at standard input closes. A terminal or /dev/null there is nobody's lifeline."""
    try:
        mode = os.fstat(0).st_mode
    except OSError:  # closed by whoever started us
        return
    if not (stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode)):
        return

    def on_readable() -> None:
        if not os.read(0, 4096):
            loop.remove_reader(0)
            stop.set()

    loop.add_reader(0, on_readable)


def parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m swarmtrack.agents.simulator",
        description="The cameras and autopilots of a simulated swarm, on real sockets.",
        epilog="Example: python -m swarmtrack.agents.simulator --scenario crossing --drones 4 --detector oracle; "
        "then take camera.source and autopilot.link of a drone's config from the line that it prints.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "--scenario",
        default="hover-triangle",
        metavar="NAME|FILE",
        help="one of configs/scenarios, or a file (default: hover-triangle)",
    )
    add_seed(parser, "seed of everything random", default=1)
    parser.add_argument(
        "--drones", type=int, metavar="N", help="how many drones, where the scenario leaves it open"
    )
    parser.add_argument(
        "--epoch",
        type=_finite,
        metavar="T",
        help=f"world time 0 in seconds of CLOCK_MONOTONIC (default: in {LEAD:g} s)",
    )
    parser.add_argument(
        "--detector",
        choices=["onnx", "oracle"],
        default="onnx",
        help="onnx: send images, for the agents' own detectors; oracle: send detections (default: onnx)",
    )
    parser.add_argument(
        "--host", default="127.0.0.1", metavar="ADDR", help="address to listen on (default: 127.0.0.1)"
    )
    parser.add_argument(
        "--port",
        type=_port,
        default=0,
        metavar="P",
        help="port of the cameras; drone N's autopilot is at UDP port P + N (default: free ports)",
    )
    return parser


def _finite(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"found {text}, expected a number of seconds")
    return value


def _port(text: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text) < 65535):
        raise argparse.ArgumentTypeError(f"found {text}, expected a port number below 65535")
    return int(text)


def main(argv: list[str] | None = None) -> int:
    """Exit codes: 0 done, 2 wrong usage or scenario, 1 anything else."""
    arguments = parser().parse_args(argv)
    # Before NumPy is imported: for matrices of 4 x 4 its threads only cost.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
    from swarmtrack.scenario_file import load_scenario

    try:
        scenario = load_scenario(arguments.scenario, seed=arguments.seed, drones=arguments.drones)
    except SwarmtrackError as error:
        print(error, file=sys.stderr)
        return WRONG_USAGE
    if arguments.port + max(scenario.members) > 65535:
        print(
            f"--port {arguments.port}: leaves no port above it for drone {max(scenario.members)}",
            file=sys.stderr,
        )
        return WRONG_USAGE
    try:
        asyncio.run(fly(scenario, arguments))
    except OSError as error:
        where = f"--host {arguments.host}" + (f" --port {arguments.port}" if arguments.port else "")
        print(f"{where}: {error.strerror or error}", file=sys.stderr)
        return FAILED
    return DONE


async def fly(scenario: Scenario, arguments: argparse.Namespace) -> None:
    """Simulate until told to stop."""
    from swarmtrack.clock import SystemClock
    from swarmtrack.localswarm.hardware import simulate

    clock, loop, stop = SystemClock(), asyncio.get_running_loop(), asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    watch_parent(loop, stop)
    flight = asyncio.create_task(
        simulate(
            scenario,
            oracle=arguments.detector == "oracle",
            epoch=clock.now() + LEAD if arguments.epoch is None else arguments.epoch,
            host=arguments.host,
            port=arguments.port,
            flown={
                "scenario": arguments.scenario,
                "seed": arguments.seed,
                "drones": arguments.drones,
                "detector": arguments.detector,
            },
            clock=clock,
            on_ready=lambda drones: print(json.dumps({"ready": True, "drones": drones}), flush=True),
        )
    )
    stopping = asyncio.create_task(stop.wait())
    await asyncio.wait({flight, stopping}, return_when=asyncio.FIRST_COMPLETED)
    stopping.cancel()
    if not flight.done():
        flight.cancel()
    with suppress(asyncio.CancelledError):
        await flight


if __name__ == "__main__":
    sys.exit(main())
