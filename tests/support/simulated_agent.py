"""A whole agent in simulated time: a minute of flight in a second, to the millisecond the same on any machine.

The agent, its tasks and its transport are the real ones. Time passes only while all of them wait. What would run in a
thread takes the simulated time that a test says.
"""

from __future__ import annotations

import asyncio
import selectors
from typing import Any

import numpy as np

from swarmtrack.camera_sources.newest_slot import NewestSlot
from swarmtrack.clock import ManualClock
from swarmtrack.config.drone import load_config
from swarmtrack.messages import Detections, Frame, ImuSample, LinkStatus, StampKind
from swarmtrack.outputs.console import Console
from swarmtrack.runtime.agent import Agent
from swarmtrack.runtime.assembly import assemble
from swarmtrack.runtime.systemd import Notifier
from swarmtrack.transport import keys
from swarmtrack.transport.memory import MemoryHub, MemoryTransport
from swarmtrack.wire import codec

BEGIN = 1000.0  # s, of the clock
CONFIG = """
drone.id = 1
network.transport = "memory"
camera.source = "detections://127.0.0.1:9/1"
camera.intrinsics = { fx = 600.0, fy = 600.0, cx = 31.5, cy = 23.5, width = 64, height = 48 }
"""
IMAGE = np.zeros((48, 64, 3), np.uint8)


class _PatientSelector(selectors.DefaultSelector):
    """Waits for nothing: where the loop would, the clock goes on."""

    def __init__(self, clock: ManualClock) -> None:
        super().__init__()
        self._clock = clock

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0.0)
        if not ready:
            assert timeout is not None, "everybody waits for ever"
            self._clock.set(self._clock.now() + timeout)
        return ready


class SimulatedLoop(asyncio.SelectorEventLoop):
    """Its time is `clock`'s. in_thread_s: how long work takes that is given to a thread from now on."""

    def __init__(self, clock: ManualClock) -> None:
        super().__init__(_PatientSelector(clock))
        self._manual = clock
        self.in_thread_s = 0.0

    def time(self) -> float:
        return self._manual.now()

    def run_in_executor(self, executor: Any, func: Any, *args: Any) -> asyncio.Future[Any]:
        future = self.create_future()

        def work() -> None:
            if not future.cancelled():
                future.set_result(func(*args))

        self.call_later(self.in_thread_s, work)
        return future


class ScriptedCamera:
    """Exposes `fps` times a second and delivers `age_s` later, unless it is `away` or `silent`. The newest waits."""

    def __init__(self, clock: ManualClock, fps: float = 10.0) -> None:
        self.away, self.silent, self.age_s = False, False, 0.02
        self._clock, self._period = clock, 1.0 / fps
        self._slot: NewestSlot[Frame] = NewestSlot("camera", clock)

    async def frames(self):
        exposing = asyncio.create_task(self._expose())
        while (frame := await self._slot.get()) is not None:
            self._slot.source.given(frame.t, frame.t_sigma)
            yield frame
        await exposing

    async def _expose(self) -> None:
        start, k = self._clock.now(), 0
        while not self._slot.ended:
            k += 1
            await asyncio.sleep(start + k * self._period - self._clock.now())
            self._slot.source.report(not self.away, "unplugged; waiting for it" if self.away else "open")
            if not self.away and not self.silent:
                t = self._clock.now() - self.age_s
                self._slot.put(Frame(t, 1e-4, k, IMAGE, StampKind.EXPOSURE))

    def status(self) -> LinkStatus:
        return self._slot.source.status()

    async def close(self) -> None:
        self._slot.end()


class ScriptedDetector:
    """Sees one drone that stands still, as well as detectors do."""

    def warm_up(self, width: int, height: int) -> None: ...

    def plan(self, frame: Frame, expectation: object) -> Frame:
        return frame

    def detect(self, frame: Frame) -> Detections:
        size = np.full((1, 2), 6.0)
        scatter = 0.5 * np.random.default_rng(frame.sequence).standard_normal((1, 2))
        return Detections(frame.t, frame.sequence, np.array([[32.0, 24.0]]) + scatter, size, np.array([0.9]))

    def status(self) -> LinkStatus:
        return LinkStatus("detector", True, "scripted")


class ScriptedAutopilot:
    """A drone that stands still: gyro samples `hz` times a second."""

    def __init__(self, clock: ManualClock, hz: float = 200.0) -> None:
        self.hz = hz
        self._clock = clock

    async def run(self, listener) -> None:
        still = np.zeros(3)
        while True:
            await asyncio.sleep(1.0 / self.hz)
            listener.on_imu(ImuSample(self._clock.now(), still, still))

    def status(self) -> LinkStatus:
        return LinkStatus("autopilot", True, "scripted")


class Supervisor(Notifier):
    """In place of systemd: what it was told, and when."""

    def __init__(self, clock: ManualClock) -> None:
        super().__init__("")
        self.said: list[tuple[float, str]] = []
        self._clock = clock

    def _send(self, text: str) -> None:
        self.said.append((self._clock.now() - BEGIN, text))

    def times(self, text: str) -> list[float]:
        return [t for t, said in self.said if said == text]


class SimulatedFlight:
    """One agent, and all that it says. Times are seconds since its start."""

    def __init__(self, folder, extra: str = "", *, autopilot: bool = False, heard: bool = True) -> None:
        path = folder / "drone.toml"
        link = "" if autopilot else 'autopilot.link = "none"\n'
        path.write_text(CONFIG + link + extra, encoding="utf-8")
        self.clock = ManualClock(BEGIN)
        self.loop = SimulatedLoop(self.clock)
        self.hub = MemoryHub()
        self.said: list[tuple[float, str, bytes]] = []
        if heard:
            self.hub.listeners.append(self.hear)
        self.parts = parts = assemble(load_config(path), self.clock)
        parts.transport = MemoryTransport(self.hub, "swarm", 1, parts.boot, self.clock)
        self.camera = parts.camera = ScriptedCamera(self.clock)
        parts.detector = ScriptedDetector()
        parts.autopilot = ScriptedAutopilot(self.clock) if autopilot else None
        self.supervisor = Supervisor(self.clock)

    def hear(self, key: str, payload: bytes) -> None:
        self.said.append((self.clock.now() - BEGIN, keys.parse(key).kind, payload))

    def at(self, t: float, do, *args) -> None:
        """Do that so many seconds after the start."""
        self.loop.call_at(BEGIN + t, do, *args)

    def fly(self, seconds: float) -> Agent:
        console = Console(self.parts.lens, quiet=True)
        self.agent = agent = Agent(self.parts, console=console, supervisor=self.supervisor)
        with asyncio.Runner(loop_factory=lambda: self.loop) as runner:
            runner.run(agent.run(seconds))
        return agent

    def times(self, kind, since: float = 0.0, until: float = np.inf) -> list[float]:
        """When messages of this kind were sent."""
        return [t for t, said, _ in self.said if said == kind and since <= t < until]

    def messages(self, message, kind) -> list[tuple[float, Any]]:
        return [(t, codec.decode(message, payload)) for t, said, payload in self.said if said == kind]
