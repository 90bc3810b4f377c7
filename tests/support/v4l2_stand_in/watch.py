"""Runs the real V4l2Camera, for a test that has the stand-in preloaded, and says a JSON line for each frame.

Commands on stdin: `status` (says one line), `block SECONDS` (the event loop does nothing), `close`.
"""

from __future__ import annotations

import asyncio
import json
import os
import resource
import sys
import time

from swarmtrack.camera_sources.opening import open_camera
from swarmtrack.clock import SystemClock


def say(**words: object) -> None:
    print(json.dumps(words), flush=True)


async def main(source: str, width: int, height: int, consumer_seconds: float) -> None:
    clock = SystemClock()
    camera = open_camera(source, clock=clock, size=(width, height) if width else None)

    def on_commands() -> None:
        for line in os.read(0, 4096).decode().splitlines() or ["close"]:
            obey(*line.split())

    def obey(word: str, *arguments: str) -> None:
        if word == "status":
            status = camera.status()
            say(ok=status.ok, text=status.text, **dict(status.counters))
        elif word == "block":
            time.sleep(float(arguments[0]))
        else:
            closing.set()

    async def watch() -> None:
        async for frame in camera.frames():
            say(
                t=frame.t,
                now=clock.now(),
                sequence=frame.sequence,
                stamp=frame.stamp.value,
                sigma=frame.t_sigma,
                shape=frame.image.shape,
                corner=frame.image[0, -1].tolist(),
            )
            await asyncio.sleep(consumer_seconds)

    closing = asyncio.Event()
    asyncio.get_running_loop().add_reader(0, on_commands)
    watching = asyncio.create_task(watch())
    await asyncio.wait([watching, asyncio.create_task(closing.wait())], return_when=asyncio.FIRST_COMPLETED)
    before = clock.now()
    await camera.close()
    closed_in = clock.now() - before
    await watching  # ends by itself, as the frames do
    usage = resource.getrusage(resource.RUSAGE_SELF)
    say(closed_in=closed_in, cpu=usage.ru_utime + usage.ru_stime)


asyncio.run(main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4])))
