"""One drone of real sockets: a config, a camera over HTTP, an autopilot that somebody turns by hand."""

from __future__ import annotations

import asyncio
import contextlib
import time
from pathlib import Path

import cv2
import numpy as np
from aiohttp import web

from support.fake_autopilot import FakeAutopilot
from swarmtrack.autopilot.gyro_delay import INS_GYRO_FILTER, low_pass_delay
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.lab.autopilots.senses import Inertial, SensedState
from swarmtrack.lab.world.hand_turned import HandTurned

SMALL = PinholeCamera(160.0, 160.0, 79.5, 59.5, 160, 120)
NUMBERS = "{ fx = 160.0, fy = 160.0, cx = 79.5, cy = 59.5, width = 160, height = 120 }"
SOURCE = "http://127.0.0.1:9/stream"


def written(folder: Path, **tables: str) -> Path:
    """A config: what is not given is a camera that does not answer, and nothing else."""
    folder.mkdir(parents=True, exist_ok=True)
    parts = {
        "drone": "id = 1",
        "camera": f'source = "{SOURCE}"\nintrinsics = {NUMBERS}',
        "network": 'transport = "memory"',
    } | tables
    path = folder / "drone.toml"
    path.write_text("".join(f"[{name}]\n{text}\n" for name, text in parts.items()), encoding="utf-8")
    return path


def camera_at(source: str) -> str:
    return f'source = "{source}"\nintrinsics = {NUMBERS}'


class Server:
    """MJPEG of a real HTTP server: what `picture(t)` gives, stamped as exposed `late` s ago."""

    def __init__(self, picture, *, late: float | None = 0.02, fps: float = 15.0) -> None:
        self.picture, self.late, self.fps = picture, late, fps
        self.url = ""

    async def _stream(self, request: web.Request) -> web.StreamResponse:
        kind = {"Content-Type": "multipart/x-mixed-replace; boundary=frame"}
        response = web.StreamResponse(headers=kind)
        await response.prepare(request)
        with contextlib.suppress(ConnectionError):
            while True:
                t = time.monotonic()
                image = await asyncio.to_thread(self.picture, t)
                body = b"" if image is None else cv2.imencode(".jpg", image)[1].tobytes()
                stamp = "" if self.late is None else f"X-Timestamp: {t - self.late:.6f}\r\n"
                head = f"--frame\r\nContent-Type: image/jpeg\r\n{stamp}Content-Length: {len(body)}\r\n\r\n"
                if body:
                    await response.write(head.encode() + body + b"\r\n")
                await asyncio.sleep(max(0.0, t + 1.0 / self.fps - time.monotonic()))
        return response

    async def __aenter__(self) -> Server:
        application = web.Application()
        application.router.add_get("/stream", self._stream)
        self._runner = web.AppRunner(application, shutdown_timeout=0.1)
        await self._runner.setup()
        await web.TCPSite(self._runner, "127.0.0.1", 0).start()
        self.url = f"http://127.0.0.1:{self._runner.addresses[0][1]}/stream"
        return self

    async def __aexit__(self, *error: object) -> None:
        await self._runner.cleanup()


class TurnedAutopilot(FakeAutopilot):
    """Of a drone in somebody's hands, its gyro's axes multiplied by `signs`, and late by its filter."""

    def __init__(self, hand: HandTurned, signs: tuple[float, float, float], boot_at: float) -> None:
        super().__init__(boot_at=boot_at)
        self._hand, self._signs = hand, np.array(signs)

    def at(self, t: float) -> SensedState:
        return super().at(t)._replace(gyro=self.inertial(t).gyro)

    def inertial(self, t: float) -> Inertial:
        sensed = np.array([t - low_pass_delay(INS_GYRO_FILTER.usual_hz)])
        return super().inertial(t)._replace(gyro=self._hand.rates(sensed)[0] * self._signs)
