"""`python -m swarmtrack.agents.simulator`: the cameras and autopilots of a simulated swarm, on real sockets.

For each drone that has an agent, its cameras over HTTP (JPEGs, or with `--detector oracle` lines of detections) and an
autopilot that speaks MAVLink on three UDP ports: one for the agent, one for a ground station beside it, and one for who
asks for the truth. World time 0 is `--epoch` on this machine's monotonic clock; before it all drones hover. When
everything listens, one line of JSON says where, where on the Earth the world's origin lies, and when world time 0 is:

    {"ready": true, "origin": {"lat_deg": 47.397742, "lon_deg": 8.545594, "alt_m": 488.0}, "epoch_s": 4711.5, "drones":
    {"1": {"camera": "http://127.0.0.1:40001/1", "cameras": ["http://127.0.0.1:40001/1"], "autopilot":
    "udpout:127.0.0.1:50001", "ground": "udpout:127.0.0.1:50002", "truth": "udpout:127.0.0.1:50003"}, …}}

`cameras` are all of a drone, in the order of the scenario; the first one is also `camera`, the others are at `/1/1`,
`/1/2`, … of the same server.

Whoever asks an autopilot for SIM_STATE by SET_MESSAGE_INTERVAL, at any port, is told the truth about its drone. Each
port answers whoever spoke to it last.

With `--world FILE` it simulates cameras only, of drones that others fly (docs/rehearse.md). It is then ready when the
truth about every drone is told, passes the truth on at `/truth`, a line of JSON per sample, and its line says where:

    {"ready": true, "origin": …, "epoch_s": …, "truth": "http://127.0.0.1:40001/truth", "drones": {"1": {"camera": …

or, where nobody tells, `{"ready": false, "error": "drone 1: truth link tcp:127.0.0.1:5763 is silent: …"}`.

With `--port P`, for configs that were written before, the cameras are at TCP port P, and the autopilot of drone N at
UDP ports P + N, for the ground station P + 1000 + N, and for the truth P + 2000 + N. At `/` the same server says what
is flown and how late it is in that world, for `swarmtrack judge`.

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

from swarmtrack.arguments import add_file, add_seconds, add_seed
from swarmtrack.errors import SourceError, SwarmtrackError

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from swarmtrack.clock import Clock
    from swarmtrack.geometry.geodesy import Geodetic
    from swarmtrack.lab.scenarios.scenario import Scenario
    from swarmtrack.lab.swarm.hardware import Addresses
    from swarmtrack.lab.swarm.world_file import OutsideWorld

DONE, FAILED, WRONG_USAGE = 0, 1, 2
NICENESS = -10  # a camera does not wait until the agents have computed; without root, it has to
LEAD = 2.0  # s until world time 0, where nobody says when it is
DEFAULT_SCENARIO, DEFAULT_SEED = "hover-triangle", 1


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
        "then take camera.source and autopilot.link of a drone's config from the line that it prints. A ground station "
        "connects to the address `ground`.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "--scenario",
        metavar="NAME|FILE",
        help=f"one of configs/scenarios, or a file (default: {DEFAULT_SCENARIO})",
    )
    add_file(
        parser, "--world", "a world file instead of a scenario: cameras of drones flown in another simulator"
    )
    add_seed(parser, f"random seed (default: {DEFAULT_SEED}, or the world file's)", default=None)
    parser.add_argument(
        "--drones", type=int, metavar="N", help="number of drones, if the scenario leaves it open"
    )
    parser.add_argument(
        "--detail",
        choices=["full", "reduced", "low"],
        default="full",
        help="how much of the scenario: fewer frames and gyro samples (default: full)",
    )
    parser.add_argument(
        "--epoch",
        type=_finite,
        metavar="T",
        help="world time 0 in seconds of CLOCK_MONOTONIC, instead of --lead",
    )
    add_seconds(parser, "--lead", f"time from ready to world time 0 (default: {LEAD:g})", default=LEAD)
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
        help="port of the cameras; drone N's autopilot is at UDP ports P + N, for its agent, P + 1000 + N, for a "
        "ground station, and P + 2000 + N, for the truth (default: free ports)",
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
    from swarmtrack.lab.swarm.outside import NoTruth

    try:
        flown = _load(arguments)
    except SwarmtrackError as error:
        print(error, file=sys.stderr)
        return WRONG_USAGE
    try:
        asyncio.run(fly(flown, arguments))
    except NoTruth as error:
        print(json.dumps({"ready": False, "error": str(error)}), flush=True)
        print(error, file=sys.stderr)
        return FAILED
    except OSError as error:
        where = f"--host {arguments.host}" + (f" --port {arguments.port}" if arguments.port else "")
        print(f"{where}: {error.strerror or error}", file=sys.stderr)
        return FAILED
    return DONE


def _load(arguments: argparse.Namespace) -> Scenario | OutsideWorld:
    """Raises SwarmtrackError for what cannot be flown as asked for."""
    from swarmtrack.lab.scenarios.files import load_scenario
    from swarmtrack.lab.swarm.detail import Detail
    from swarmtrack.lab.swarm.hardware import AUTOPILOT_PORTS
    from swarmtrack.lab.swarm.world_file import check_alone, load_world

    if arguments.world is not None:
        check_alone(
            arguments.world,
            scenario=arguments.scenario,
            drones=arguments.drones,
            detail=arguments.detail,
        )
        if arguments.epoch is not None:
            raise SourceError("--epoch with --world, expected --lead: it begins when the truth arrives")
        return load_world(arguments.world, seed=arguments.seed)
    arguments.scenario = arguments.scenario or DEFAULT_SCENARIO
    arguments.seed = DEFAULT_SEED if arguments.seed is None else arguments.seed
    whole = load_scenario(arguments.scenario, seed=arguments.seed, drones=arguments.drones)
    scenario = Detail(arguments.detail).of(whole)
    highest = max(scenario.members) + max(AUTOPILOT_PORTS.values())
    if arguments.port and arguments.port + highest > 65535:
        raise SourceError(
            f"--port {arguments.port}: leaves no ports above it for drone {max(scenario.members)}, expected "
            f"{65535 - highest} at most"
        )
    return scenario


async def fly(flown: Scenario | OutsideWorld, arguments: argparse.Namespace) -> None:
    """Simulate until told to stop. Raises NoTruth."""
    from swarmtrack.clock import SystemClock

    clock, loop, stop = SystemClock(), asyncio.get_running_loop(), asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    watch_parent(loop, stop)
    flight = asyncio.create_task(_simulation(flown, arguments, clock))
    stopping = asyncio.create_task(stop.wait())
    await asyncio.wait({flight, stopping}, return_when=asyncio.FIRST_COMPLETED)
    stopping.cancel()
    if not flight.done():
        flight.cancel()
    with suppress(asyncio.CancelledError):
        await flight


def _simulation(
    flown: Scenario | OutsideWorld, arguments: argparse.Namespace, clock: Clock
) -> Coroutine[None, None, None]:
    from swarmtrack.lab.swarm.hardware import simulate
    from swarmtrack.lab.swarm.outside import simulate_outside
    from swarmtrack.lab.swarm.world_file import OutsideWorld

    oracle = arguments.detector == "oracle"
    told = {"seed": arguments.seed, "detector": arguments.detector, "detail": arguments.detail}
    if isinstance(flown, OutsideWorld):
        origin = flown.scenario.origin
        return simulate_outside(
            flown,
            oracle=oracle,
            lead=arguments.lead,
            host=arguments.host,
            port=arguments.port,
            flown={"world": str(arguments.world), **told},
            clock=clock,
            on_ready=lambda epoch, drones, truth: _say_ready(origin, epoch, drones, {"truth": truth}),
        )
    epoch = clock.now() + arguments.lead if arguments.epoch is None else arguments.epoch
    origin = flown.origin
    return simulate(
        flown,
        oracle=oracle,
        epoch=epoch,
        host=arguments.host,
        port=arguments.port,
        flown={"scenario": arguments.scenario, "drones": arguments.drones, **told},
        clock=clock,
        on_ready=lambda drones, truth: _say_ready(origin, epoch, drones, {"truth": truth} if truth else {}),
    )


def _say_ready(origin: Geodetic, epoch: float, drones: Addresses, more: dict[str, str]) -> None:
    latitude, longitude, height = origin
    place = {
        "lat_deg": round(math.degrees(latitude), 9),
        "lon_deg": round(math.degrees(longitude), 9),
        "alt_m": height,
    }
    print(
        json.dumps({"ready": True, "origin": place, "epoch_s": epoch, **more, "drones": drones}), flush=True
    )


if __name__ == "__main__":
    sys.exit(main())
