"""An agent's `MavlinkAutopilot` and simulated autopilots on a perfect link, in simulated time."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import Any, Self

from swarmtrack.autopilot.address import LinkAddress
from swarmtrack.autopilot.links import Receiver, Wire
from swarmtrack.autopilot.mavlink_autopilot import MavlinkAutopilot
from swarmtrack.clock import ManualClock, SystemClock
from swarmtrack.lab.autopilots.autopilot import SimulatedArduPilot
from swarmtrack.messages import EgoPose, FlightState, ImuSample

PATIENCE = 60.0  # s: far beyond what anything here takes, on however slow a machine


class Listener:
    """Keeps what it is told."""

    def __init__(self) -> None:
        self.imu: list[ImuSample] = []
        self.poses: list[EgoPose] = []
        self.states: list[FlightState] = []
        self.switched: list[float] = []
        self.reboots = 0
        self.found_flying = 0

    def on_found_flying(self) -> None:
        self.found_flying += 1

    def on_switch(self, t: float) -> None:
        self.switched.append(t)

    def on_flight_state(self, state: FlightState) -> None:
        self.states.append(state)

    def on_autopilot_reboot(self) -> None:
        self.reboots += 1

    def on_imu(self, sample: ImuSample) -> None:
        self.imu.append(sample)

    def on_pose(self, pose: EgoPose) -> None:
        self.poses.append(pose)


class SimulatedLink:
    """A perfect datagram link in simulated time: the test moves what it carries."""

    datagrams = True
    recording = False
    remark = ""
    foreign = 0
    numbered = True
    left_out = ()

    def __init__(self, bytes_per_second: float | None = None) -> None:
        self.address = LinkAddress("udpin", host="localhost", port=1)
        self.dropped = ""
        self.bytes_per_second = bytes_per_second
        self.sent: list[bytes] = []

    async def run(self, receiver: Receiver) -> None:
        receiver.opened()
        await asyncio.Event().wait()

    def send(self, data: bytes) -> None:
        self.sent.append(data)

    def wire(self) -> Wire:
        return Wire(-1)

    def drop(self, reason: str) -> None:
        self.dropped = reason


class RealFlight:
    """An agent's `MavlinkAutopilot` on a real link, in real time."""

    def __init__(self, link: str, **options: Any) -> None:
        self.now = time.monotonic
        self.listener = Listener()
        self.unit = MavlinkAutopilot(link, clock=SystemClock(), **options)

    async def __aenter__(self) -> Self:
        self._task = asyncio.create_task(self.unit.run(self.listener))
        return self

    async def __aexit__(self, *error: object) -> None:
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)

    async def until(self, condition: Callable[[], bool]) -> None:
        async with asyncio.timeout(PATIENCE):
            while not condition():  # noqa: ASYNC110 (what is waited for happens outside)
                await asyncio.sleep(0.01)

    @property
    def count(self) -> dict[str, float]:
        return dict(self.unit.status().counters)


class Flight:
    """An agent's `MavlinkAutopilot` and simulated autopilots on one simulated link."""

    def __init__(
        self, *autopilots: SimulatedArduPilot, bytes_per_second: float | None = None, **options: Any
    ) -> None:
        self.clock = ManualClock(100.0)
        self.link = SimulatedLink(bytes_per_second)
        self.autopilots = autopilots
        self.listener = Listener()
        self.unit = MavlinkAutopilot(self.link, clock=self.clock, **options)

    async def __aenter__(self) -> Flight:
        self._task = asyncio.create_task(self.unit.run(self.listener))
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        return self

    async def __aexit__(self, *error: object) -> None:
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)

    def fly(self, seconds: float, jitter: Callable[[], float] = lambda: 0.0) -> None:
        """Move time on in steps of 1 ms; the unit ticks every 50 ms."""
        end = self.clock.now() + seconds
        while self.clock.now() < end:
            now = self.clock.now() + 1e-3
            self.clock.set(now)
            sent, self.link.sent = self.link.sent, []
            for autopilot in self.autopilots:
                for data in sent:
                    autopilot.receive(data, now)
                for data in autopilot.step(now):
                    self.unit.received(now + jitter(), data)
            if round(now * 1e3) % 50 == 0:
                self.unit.tick(now)

    @property
    def count(self) -> dict[str, float]:
        return dict(self.unit.status().counters)

    @property
    def text(self) -> str:
        return self.unit.status().text
