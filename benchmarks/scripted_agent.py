"""The agent of a drone with a scripted camera and a scripted detector: what remains is the agent's own cost.

Everything else is as in flight: the task group, a MAVLink link, Onboard, Zenoh. The camera exposes the same picture at
an even rate and delivers it at once; the detector sleeps for `--look-ms`, then finds five drones on slow paths. With
`--detector` the real one looks at the picture instead of the sleep, and its answer is thrown away.

    python -m swarmtrack.benchmarks.scripted_agent --config FILE [--fps 15] [--look-ms 20 | --detector]
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
from swarmtrack.messages import Detections, Frame, Image, LinkStatus, StampKind
from swarmtrack.outputs.console import Console
from swarmtrack.runtime.agent import Agent
from swarmtrack.runtime.assembly import assemble

DRONES = 5
CENTRE_SIGMA = 1.0  # px


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


class ScriptedDetector:
    """Finds five drones in whatever it is shown, after `look_s` seconds; with `real`, after that one has looked."""

    def __init__(self, real: Detector | None, look_s: float, width: int, height: int) -> None:
        self._real = real
        self._look_s = look_s
        self._centre = np.array([width, height]) * [
            [0.2, 0.3],
            [0.5, 0.25],
            [0.8, 0.3],
            [0.35, 0.7],
            [0.65, 0.7],
        ]
        self._rng = np.random.default_rng(1)

    def plan(self, frame: Frame, expectation: Expectation | None = None) -> Look:
        return Look(frame, (), None) if self._real is None else self._real.plan(frame)

    def detect(self, look: Look) -> Detections:
        frame = look.frame
        if self._real is not None:
            self._real.detect(look)
        else:
            time.sleep(self._look_s)  # in the detector's own thread, as the real one
        phase = 0.7 * frame.t + np.arange(DRONES)
        path = 30.0 * np.stack([np.sin(phase), np.cos(phase)], axis=1)
        centre = self._centre + path + CENTRE_SIGMA * self._rng.standard_normal((DRONES, 2))
        size, score = np.full((DRONES, 2), 30.0), np.full(DRONES, 0.9)
        return Detections(frame.t, frame.sequence, centre, size, score, camera=frame.camera)

    def warm_up(self, width: int, height: int) -> None:
        if self._real is not None:
            self._real.warm_up(width, height)

    def status(self) -> LinkStatus:
        return LinkStatus("detector", True, "scripted") if self._real is None else self._real.status()


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="scripted_agent", description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--config", type=Path, required=True)
    parser.add_argument("--fps", type=float, default=15.0)
    parser.add_argument("--look-ms", type=float, default=0.0, help="how long the scripted detector takes")
    parser.add_argument("--detector", action="store_true", help="let the real detector look at every frame")
    options = parser.parse_args(arguments)
    parts = assemble(load_config(options.config), SystemClock())
    size = parts.lens.width, parts.lens.height
    parts.cameras = [ScriptedCamera(parts.clock, options.fps, *size) for _ in parts.cameras]
    scripted = ScriptedDetector(parts.detector if options.detector else None, 1e-3 * options.look_ms, *size)
    parts.detector = cast(Detector, scripted)  # it has what the agent asks of one

    async def fly() -> None:
        agent = Agent(parts, console=Console(*parts.lenses, quiet=True))
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, agent.stop)
        await agent.run()

    asyncio.run(fly())
    return 0


if __name__ == "__main__":
    sys.exit(main())
