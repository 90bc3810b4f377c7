"""The agent of a drone with a scripted part, as a process: what remains is the agent's own.

Everything else is as in flight: the task group, a MAVLink link, Onboard, Zenoh. The camera exposes the same picture at
an even rate and delivers it at once; the detector sleeps for `--look-ms`, then finds five drones on slow paths. With
`--detector` the real one looks at the picture instead of the sleep, and its answer is thrown away.

    python -m swarmtrack.benchmarks.scripted_agent --config FILE [--fps 15] [--look-ms 20 | --detector]
    python -m swarmtrack.benchmarks.scripted_agent --config FILE --flies 2.5

With `--flies` the law is scripted instead, north at that speed, and the agent breaks when it is asked to. SIGUSR1: a
task raises. SIGUSR2: the event loop stands still for `BLOCKED_S`.
"""

from __future__ import annotations

import argparse
import asyncio
import signal
import sys
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import cast

import numpy as np

from swarmtrack.clock import Clock, SystemClock
from swarmtrack.config.drone import load_config
from swarmtrack.detection.detector import Detector, Look
from swarmtrack.detection.expectation import Expectation
from swarmtrack.follower import Engagement, LocalSetpoint
from swarmtrack.formation.setpoint import Setpoint, Why
from swarmtrack.log_lines import AGENT_FORMAT, log_to_stderr
from swarmtrack.messages import Array, Detections, Frame, Image, LinkStatus, StampKind
from swarmtrack.outputs.console import Console
from swarmtrack.runtime.agent import Agent
from swarmtrack.runtime.assembly import assemble
from swarmtrack.runtime.door import Door

CENTRE_SIGMA = 1.0  # px
PLACES = np.array([[0.2, 0.3], [0.5, 0.25], [0.8, 0.3], [0.35, 0.7], [0.65, 0.7]])
"""Of the drones that are found, in widths and heights of the image."""
BLOCKED_S = 2.0
# m down to the least height.
ROOM_M = 10.0


class ScriptedCamera:
    """Exposes one picture again and again, on time."""

    def __init__(self, clock: Clock, fps: float, width: int, height: int) -> None:
        self._clock = clock
        self._period = 1.0 / fps
        rng = np.random.default_rng(0)
        self._image: Image = rng.integers(90, 160, (height, width, 3), dtype=np.uint8)

    async def frames(self) -> AsyncIterator[Frame]:
        start, index = self._clock.now(), 0
        while True:
            index = max(index + 1, int((self._clock.now() - start) / self._period))
            await asyncio.sleep(start + index * self._period - self._clock.now())
            yield Frame(self._clock.now(), 1e-4, index, self._image, StampKind.EXPOSURE)

    def status(self) -> LinkStatus:
        return LinkStatus("camera", True, "scripted")

    async def close(self) -> None:
        pass


def centres(t: float, width: int, height: int) -> Array:
    """(5, 2) px: where drones are found at t [s]."""
    phase = 0.7 * t + np.arange(len(PLACES))
    path = 30.0 * np.stack([np.sin(phase), np.cos(phase)], axis=1)
    return np.asarray(np.array([width, height]) * PLACES + path)


class ScriptedDetector:
    """Finds five drones in whatever it is shown, after `look_s` seconds; with `real`, after that one has looked."""

    def __init__(self, real: Detector | None, look_s: float, width: int, height: int) -> None:
        self._real = real
        self._look_s = look_s
        self._size = width, height
        self._rng = np.random.default_rng(1)

    def plan(self, frame: Frame, expectation: Expectation | None = None) -> Look:
        return Look(frame, (), None) if self._real is None else self._real.plan(frame)

    def detect(self, look: Look) -> Detections:
        frame, n = look.frame, len(PLACES)
        if self._real is not None:
            self._real.detect(look)
        else:
            time.sleep(self._look_s)  # in the detector's own thread, as the real one
        centre = centres(frame.t, *self._size) + CENTRE_SIGMA * self._rng.standard_normal((n, 2))
        size, score = np.full((n, 2), 30.0), np.full(n, 0.9)
        return Detections(frame.t, frame.sequence, centre, size, score, camera=frame.camera)

    def warm_up(self, width: int, height: int) -> None:
        if self._real is not None:
            self._real.warm_up(width, height)

    def status(self) -> LinkStatus:
        return LinkStatus("detector", True, "scripted") if self._real is None else self._real.status()


class SteadyDoor(Door):
    """As it stands in a config, but for what the law says."""

    speed = 0.0
    breaks = False

    def command(self, now: float, engagement: Engagement) -> LocalSetpoint:
        if self.breaks:
            raise RuntimeError("a task raises, as it was asked to")
        velocity = (self.speed, 0.0, 0.0)
        setpoint = Setpoint(now, velocity, 0.0, Why.FOLLOW, "flies north")
        return LocalSetpoint(velocity, 0.0, setpoint, ROOM_M)


def main(arguments: list[str] | None = None) -> int:
    """Until it is stopped, or breaks."""
    parser = argparse.ArgumentParser(prog="scripted_agent", description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--config", type=Path, required=True)
    parser.add_argument("--fps", type=float, default=15.0)
    parser.add_argument("--look-ms", type=float, default=0.0, help="how long the scripted detector takes")
    parser.add_argument("--detector", action="store_true", help="let the real detector look at every frame")
    parser.add_argument("--flies", type=float, metavar="M_S", help="script the law, not the camera")
    options = parser.parse_args(arguments)
    parts = assemble(load_config(options.config), SystemClock())
    if options.flies is not None:
        log_to_stderr(30, AGENT_FORMAT)
        parts.door.__class__ = SteadyDoor
        cast(SteadyDoor, parts.door).speed = options.flies
    else:
        size = parts.lens.width, parts.lens.height
        parts.cameras = [ScriptedCamera(parts.clock, options.fps, *size) for _ in parts.cameras]
        real = parts.detector if options.detector else None
        # It has what the agent asks of one.
        parts.detector = cast(Detector, ScriptedDetector(real, 1e-3 * options.look_ms, *size))

    async def fly() -> None:
        agent = Agent(parts, console=Console(*parts.lenses, quiet=True))
        loop = asyncio.get_running_loop()
        loop.add_signal_handler(signal.SIGTERM, agent.stop)
        loop.add_signal_handler(signal.SIGUSR1, setattr, parts.door, "breaks", True)
        # What must not be in an event loop is what is tried here.
        loop.add_signal_handler(signal.SIGUSR2, time.sleep, BLOCKED_S)
        await agent.run()

    asyncio.run(fly())
    return 0


if __name__ == "__main__":
    sys.exit(main())
