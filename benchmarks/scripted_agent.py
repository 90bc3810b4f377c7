"""The agent of a drone with a scripted camera and a scripted detector: what remains is the agent's own cost.

Everything else is as in flight: the task group, a MAVLink link, Onboard, Zenoh. The camera exposes the same picture at
an even rate and delivers it at once; the detector answers at once with five drones on slow paths. With `--detector`
the real one looks at the picture first, and its answer is thrown away.

    python -m swarmtrack.benchmarks.scripted_agent --config FILE --fps 15 [--detector]
"""

from __future__ import annotations

import argparse
import asyncio
import signal
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import cast

import numpy as np

from swarmtrack.config import load_config
from swarmtrack.detection.detector import Detector
from swarmtrack.messages import Detections, Frame, Image, LinkStatus, StampKind
from swarmtrack.runtime.agent import Agent
from swarmtrack.runtime.assembly import assemble
from swarmtrack.runtime.clock import Clock
from swarmtrack.runtime.console import Console

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
    """Finds five drones wherever it is shown an image; with `real`, only after that one has looked at it."""

    def __init__(self, real: Detector | None, width: int, height: int) -> None:
        self._real = real
        self._centre = np.array([width, height]) * [
            [0.2, 0.3],
            [0.5, 0.25],
            [0.8, 0.3],
            [0.35, 0.7],
            [0.65, 0.7],
        ]
        self._rng = np.random.default_rng(1)

    def detect(self, frame: Frame) -> Detections:
        if self._real is not None:
            self._real.detect(frame)
        phase = 0.7 * frame.t + np.arange(DRONES)
        path = 30.0 * np.stack([np.sin(phase), np.cos(phase)], axis=1)
        centre = self._centre + path + CENTRE_SIGMA * self._rng.standard_normal((DRONES, 2))
        return Detections(frame.t, frame.sequence, centre, np.full((DRONES, 2), 30.0), np.full(DRONES, 0.9))

    def warm_up(self, width: int, height: int) -> None:
        if self._real is not None:
            self._real.warm_up(width, height)

    def status(self) -> LinkStatus:
        return LinkStatus("detector", True, "scripted") if self._real is None else self._real.status()


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="scripted_agent", description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--config", type=Path, required=True)
    parser.add_argument("--fps", type=float, default=15.0)
    parser.add_argument(
        "--detector", action="store_true", help="let the real detector look at every frame, too"
    )
    options = parser.parse_args(arguments)
    parts = assemble(load_config(options.config))
    size = parts.lens.width, parts.lens.height
    parts.camera = ScriptedCamera(parts.clock, options.fps, *size)
    scripted = ScriptedDetector(parts.detector if options.detector else None, *size)
    parts.detector = cast(Detector, scripted)  # it has what the agent asks of one

    async def fly() -> None:
        agent = Agent(parts, console=Console(quiet=True))
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, agent.stop)
        await agent.run()

    asyncio.run(fly())
    return 0


if __name__ == "__main__":
    sys.exit(main())
