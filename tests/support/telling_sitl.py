"""A simulator that tells the truth on a TCP port, as ArduPilot's SITL does: the simulated autopilot on a socket."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field

from swarmtrack.clock import SystemClock
from swarmtrack.geometry.geodesy import Geodetic
from swarmtrack.lab.autopilots.autopilot import SimulatedArduPilot, SimulatedVehicle
from swarmtrack.lab.autopilots.senses import DroneSenses
from swarmtrack.lab.autopilots.truth import DroneTruth
from swarmtrack.lab.scenarios.scenario import SCENARIO_ORIGIN, SteadyYaw, Trajectory
from swarmtrack.lab.world.trajectory import Lissajous
from swarmtrack.lab.world.world import World

TICK = 0.004  # s
PATH = Lissajous((2.0, 0.0, -5.0), (1.0, 0.0, 0.0), (0.1, 0.0, 0.0))


def world() -> World:
    """One drone, number 1, that flies to and fro at 5 m."""
    return World(1, {1: Trajectory(PATH, SteadyYaw(0.0))})


@dataclass
class TellingSitl:
    """paused: time stands still, nothing is sent; truth: whether it is a simulator at all."""

    autopilots: list[SimulatedVehicle]
    address: str = ""
    paused: bool = False
    clients: int = 0
    _clock: SystemClock = field(default_factory=SystemClock)

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.clients += 1
        speaking = asyncio.ensure_future(self._speak(writer))
        with contextlib.suppress(ConnectionError):
            while data := await reader.read(4096):
                for autopilot in self.autopilots:
                    autopilot.receive(data, self._clock.now(), 1)
        speaking.cancel()
        writer.close()

    async def _speak(self, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError):
            while True:
                for autopilot in [] if self.paused else self.autopilots:
                    for data in autopilot.step(self._clock.now(), 1):
                        writer.write(data)
                await writer.drain()
                await asyncio.sleep(TICK)


def autopilot(
    system: int = 1,
    origin: Geodetic = SCENARIO_ORIGIN,
    *,
    truth: bool = True,
    kind: type[SimulatedVehicle] = SimulatedArduPilot,
) -> SimulatedVehicle:
    """Switched on now. origin: where its world lies on the Earth."""
    now = SystemClock().now()
    return kind(
        DroneSenses(world(), 1, now),
        truth=DroneTruth(world(), 1, now, origin) if truth else None,
        system=system,
        boot_at=now,
    )


@asynccontextmanager
async def telling_sitl(*autopilots: SimulatedVehicle, port: int = 0) -> AsyncIterator[TellingSitl]:
    """Several autopilots: behind a router that forwards them all."""
    sitl = TellingSitl(list(autopilots))
    async with AsyncExitStack() as stack:
        server = await asyncio.start_server(sitl.serve, "127.0.0.1", port)
        stack.callback(server.close)
        sitl.address = f"tcp:127.0.0.1:{server.sockets[0].getsockname()[1]}"
        yield sitl
