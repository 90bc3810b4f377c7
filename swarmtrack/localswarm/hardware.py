"""The hardware of a simulated swarm on real sockets: cameras over HTTP, autopilots as MAVLink over UDP."""

from __future__ import annotations

import asyncio
import dataclasses
import functools
import json
import math
import os
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack, suppress
from typing import Any, cast

import numpy as np

from swarmtrack.clock import Clock
from swarmtrack.messages import Image
from swarmtrack.simulation.autopilot import DroneSenses, SimulatedArduPilot
from swarmtrack.simulation.scenarios import FaultKind, Scenario, ScenarioFault
from swarmtrack.simulation.sensors import ImuParameters, Instant, detect

TICK = 0.002  # s: autopilots that have something to say within it are served together
# Cameras expose in so many groups: one after another for the processor, together for the world.
SHUTTER_GROUPS = 3
DETECTION_TIME = 0.03  # s from exposure to the oracle's detections, as a small computer's detector needs
JPEG_QUALITY = 90
SEND_BUFFER = 1 << 16  # bytes: two frames; the kernel's own megabytes would be a backlog of seconds
BOUNDARY = "frame"
AUTOPILOT_FAULTS = (FaultKind.IMU_GAP, FaultKind.AUTOPILOT_REBOOT)


class CameraClient:
    """One client of a camera: it gets the newest, and misses what comes while it is busy."""

    def __init__(self) -> None:
        self._newest: bytes | None = None
        self._changed = asyncio.Event()

    def show(self, part: bytes) -> None:
        self._newest = part
        self._changed.set()

    async def take(self) -> bytes:
        await self._changed.wait()
        self._changed.clear()
        assert self._newest is not None
        return self._newest


class CameraHardware:
    """Exposes on time, as long as somebody watches; a picture is shown when it is made.

    make: what is sent of the exposure (index, t), t in world time. An exposure that falls due while the last one is
    still being made is skipped, as in a camera that cannot keep its rate.
    """

    def __init__(
        self,
        drone_id: int,
        scenario: Scenario,
        epoch: float,
        clock: Clock,
        make: Callable[[int, int, float], Awaitable[bytes]],
    ) -> None:
        self._drone_id = drone_id
        self._fps = scenario.fps
        self._phase = (drone_id % SHUTTER_GROUPS) / SHUTTER_GROUPS
        self._stalls = tuple(f for f in scenario.faults if f.kind is FaultKind.CAMERA_STALL)
        self._epoch = epoch
        self._clock = clock
        self._make = make
        self._watchers: set[CameraClient] = set()
        self._watched = asyncio.Event()

    async def run(self) -> None:
        last = -math.inf
        while True:
            await self._watched.wait()
            now = self._clock.now() - self._epoch
            index = math.ceil(max(now * self._fps - self._phase, last + 1))
            last, t = index, (index + self._phase) / self._fps
            await asyncio.sleep(t - now)
            if any(stall.concerns(self._drone_id, t) for stall in self._stalls):
                continue
            part = await self._make(self._drone_id, index, t)
            for watcher in self._watchers:
                watcher.show(part)

    async def parts(self) -> AsyncIterator[bytes]:
        watcher = CameraClient()
        self._watchers.add(watcher)
        self._watched.set()
        try:
            while True:
                yield await watcher.take()
        finally:
            self._watchers.discard(watcher)
            if not self._watchers:
                self._watched.clear()


class CameraRenderer:
    """Renders what a camera sees, in worker threads: OpenCV lets go of Python's lock while it draws."""

    content_type = f"multipart/x-mixed-replace; boundary={BOUNDARY}"
    scheme = "http"

    def __init__(self, scenario: Scenario, epoch: float) -> None:
        import cv2

        from swarmtrack.simulation.rendering import Renderer

        cv2.setNumThreads(1)  # a frame a thread; its own pool costs more than it gains on images of this size
        self._encode = functools.partial(
            cv2.imencode, ".jpg", params=[cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        )
        self._renderer = Renderer(scenario.world, scenario.camera, scenario.body_from_camera)
        self._scenario = scenario
        self._epoch = epoch
        self._workers = ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="renderer")

    async def make(self, drone_id: int, index: int, t: float) -> bytes:
        loop = asyncio.get_running_loop()
        jpeg = await loop.run_in_executor(self._workers, self._photograph, drone_id, index, t)
        head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n"
        return f"{head}X-Timestamp: {self._epoch + t:.6f}\r\n\r\n".encode() + jpeg + b"\r\n"

    def _photograph(self, drone_id: int, index: int, t: float) -> bytes:
        image = self._renderer.image(drone_id, t, index)
        birds = extra_clutter(self._scenario.faults, drone_id, t)
        if birds:
            draw_birds(image, birds, self._scenario.world.chance("birds", drone_id, index))
        return bytes(self._encode(image)[1])

    def close(self) -> None:
        self._workers.shutdown(wait=False, cancel_futures=True)


class OracleDetector:
    """Knows where everybody is, and says it as a detector would: with misses, noise and clutter."""

    content_type = "application/x-ndjson"
    scheme = "detections"

    def __init__(self, scenario: Scenario, epoch: float) -> None:
        self._scenario = scenario
        self._epoch = epoch
        self._sequences: dict[int, int] = {}  # of each camera's first frame
        # Cameras of one shutter group look at the same instant.
        self._instant: Callable[[float], Instant] = functools.lru_cache(maxsize=2 * SHUTTER_GROUPS)(
            lambda t: Instant(scenario.world, t)
        )

    async def make(self, drone_id: int, index: int, t: float) -> bytes:
        scenario, detector = self._scenario, self._scenario.detector
        clutter = detector.clutter_per_frame + extra_clutter(scenario.faults, drone_id, t)
        found = detect(
            self._instant(t).visible(drone_id, scenario.camera, scenario.body_from_camera),
            scenario.camera,
            dataclasses.replace(detector, clutter_per_frame=clutter),
            scenario.world.chance("detector", drone_id, index),
            t=self._epoch + t,
            sequence=index - self._sequences.setdefault(drone_id, index),
        )
        rows = [
            [*(round(value, 3) for value in (*centre, *size)), round(score, 4)]
            for centre, size, score in zip(
                found.centre.tolist(), found.size.tolist(), found.score.tolist(), strict=True
            )
        ]
        line = {"t_s": round(found.t, 6), "sequence": found.sequence, "detections": rows}
        await asyncio.sleep(DETECTION_TIME)
        return json.dumps(line).encode() + b"\n"

    def close(self) -> None:
        """Nothing is open."""


def extra_clutter(faults: Iterable[ScenarioFault], drone_id: int, t: float) -> float:
    """False detections to expect in a frame exposed at world time t, beyond the detector's own."""
    return sum(f.value for f in faults if f.kind is FaultKind.CLUTTER and f.concerns(drone_id, t))


def draw_birds(image: Image, expected: float, rng: np.random.Generator) -> None:
    """Writes a flock into `image`: what a detector makes of it is its own affair."""
    import cv2

    height, width = image.shape[:2]
    for _ in range(int(rng.poisson(expected))):
        u, v, span = int(rng.integers(width)), int(rng.integers(height)), int(rng.integers(4, 16))
        lift = int(rng.integers(-span // 2, span // 2 + 1))
        for side in (-1, 1):
            cv2.line(image, (u, v), (u + side * span, v - lift), (30, 30, 30), max(1, span // 5), cv2.LINE_AA)


class AutopilotSocket(asyncio.DatagramProtocol):
    """A simulated autopilot on a UDP port. It answers whoever last sent it a valid message."""

    def __init__(self, autopilot: SimulatedArduPilot, clock: Clock) -> None:
        self.autopilot = autopilot
        self.due = -math.inf
        self._clock = clock
        self._peer: tuple[Any, ...] | None = None
        self._transport: asyncio.DatagramTransport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        # Not one by inheritance, in asyncio itself.
        self._transport = cast(asyncio.DatagramTransport, transport)

    def datagram_received(self, data: bytes, addr: tuple[Any, ...]) -> None:
        now = self._clock.now()
        if self.autopilot.receive(data, now):
            self._peer = addr
            self.speak(now)  # the companion measures the way of its question and of the answer

    def error_received(self, error: Exception) -> None:
        """The companion's port is closed just now: it is being started again."""

    def speak(self, now: float) -> None:
        for data in self.autopilot.step(now):
            if self._peer is not None:
                self._transport.sendto(data, self._peer)
        self.due = self.autopilot.next_due


async def keep_speaking(sockets: list[AutopilotSocket], clock: Clock) -> None:
    """Serve all autopilots by one timer."""
    while True:
        now = clock.now()
        for autopilot in sockets:
            if autopilot.due <= now:
                autopilot.speak(now)
        await asyncio.sleep(max(min(autopilot.due for autopilot in sockets) - now, TICK))


async def play(
    fault: ScenarioFault, autopilots: dict[int, SimulatedArduPilot], epoch: float, clock: Clock
) -> None:
    """A fault of autopilots, at its world time."""
    begin, end = epoch + fault.at_s, epoch + fault.at_s + fault.seconds
    concerned = [a for drone_id, a in autopilots.items() if not fault.drones or drone_id in fault.drones]
    await asyncio.sleep(begin - clock.now())
    for autopilot in concerned:
        if fault.kind is FaultKind.IMU_GAP:
            autopilot.imu_gap = True
        else:
            autopilot.mute = True
    await asyncio.sleep(end - clock.now())
    for autopilot in concerned:
        if fault.kind is FaultKind.IMU_GAP:
            autopilot.imu_gap = False
        else:
            autopilot.reboot(clock.now())
            autopilot.mute = False


def make_autopilot(scenario: Scenario, drone_id: int, epoch: float, now: float) -> SimulatedArduPilot:
    skew = scenario.autopilot_skew.get(drone_id, 0.0)
    switched_on = epoch - scenario.autopilot_boot_s.get(drone_id, 0.0) / (1.0 + skew)
    return SimulatedArduPilot(
        DroneSenses(scenario.world, drone_id, epoch, imu=ImuParameters(rate_hz=scenario.imu_rate_hz)),
        system=(drone_id - 1) % 255 + 1,
        boot_at=min(switched_on, now),  # agents start before world time 0: by then it is on
        skew=skew,
    )


async def simulate(
    scenario: Scenario,
    *,
    oracle: bool,
    epoch: float,
    host: str,
    port: int,
    flown: Mapping[str, Any],
    clock: Clock,
    on_ready: Callable[[dict[int, dict[str, str]]], None],
) -> None:
    """Run it all until cancelled. on_ready: called with the addresses of each drone, once everything listens.

    port: of the cameras; that of drone N's autopilot is N higher. 0: whichever are free. flown: what the server tells
    at `/` beside the world time.
    """
    images = OracleDetector(scenario, epoch) if oracle else CameraRenderer(scenario, epoch)
    cameras = {n: CameraHardware(n, scenario, epoch, clock, images.make) for n in scenario.members}
    autopilots = {n: make_autopilot(scenario, n, epoch, clock.now()) for n in scenario.members}
    async with AsyncExitStack() as stack:
        stack.callback(images.close)
        http = await serve_cameras(
            stack,
            cameras,
            images.content_type,
            (host, port),
            tell=lambda: {**flown, "world_time_s": clock.now() - epoch},
        )
        sockets, addresses = [], {}
        for n, autopilot in autopilots.items():
            transport, protocol = await asyncio.get_running_loop().create_datagram_endpoint(
                functools.partial(AutopilotSocket, autopilot, clock),
                local_addr=(host, port + n if port else 0),
            )
            stack.callback(transport.close)
            sockets.append(protocol)
            addresses[n] = {
                "camera": f"{images.scheme}://{_authority(http)}/{n}",
                "autopilot": f"udpout:{_authority(transport.get_extra_info('sockname'))}",
            }
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(keep_speaking(sockets, clock), name="autopilots")
            for n, camera in cameras.items():
                tasks.create_task(camera.run(), name=f"camera {n}")
            for fault in scenario.faults:
                if fault.kind in AUTOPILOT_FAULTS and epoch + fault.at_s > clock.now():
                    tasks.create_task(play(fault, autopilots, epoch, clock), name=str(fault.kind))
            on_ready(addresses)


async def serve_cameras(
    stack: AsyncExitStack,
    cameras: dict[int, CameraHardware],
    content_type: str,
    address: tuple[str, int],
    *,
    tell: Callable[[], dict[str, Any]],
) -> tuple[Any, ...]:
    """Serve each at /ID, and at / what `tell` says; returns the socket's address."""
    from aiohttp import web

    async def introduce(_: web.Request) -> web.Response:
        return web.json_response(tell())

    async def watch(request: web.Request) -> web.StreamResponse:
        camera = cameras.get(int(request.match_info["drone"]))
        if camera is None:
            raise web.HTTPNotFound(text=f"no such drone here, known: {', '.join(map(str, cameras))}\n")
        assert request.transport is not None
        request.transport.get_extra_info("socket").setsockopt(
            socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER
        )
        request.transport.set_write_buffer_limits(high=0)
        response = web.StreamResponse(headers={"Content-Type": content_type, "Cache-Control": "no-store"})
        await response.prepare(request)
        with suppress(ConnectionError):  # whoever watched has gone, perhaps in the middle of a frame
            async for part in camera.parts():
                await response.write(part)
        return response

    application = web.Application()
    application.router.add_get("/", introduce)
    application.router.add_get(r"/{drone:\d{1,5}}", watch)
    # Without its cancellation, the handler of a client that left would wait for a camera that is stalled.
    runner = web.AppRunner(application, access_log=None, shutdown_timeout=0.1, handler_cancellation=True)
    await runner.setup()
    stack.push_async_callback(runner.cleanup)
    await web.TCPSite(runner, *address).start()
    bound: tuple[Any, ...] = runner.addresses[0]
    return bound


def _authority(address: tuple[Any, ...]) -> str:
    host, port = address[:2]
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
