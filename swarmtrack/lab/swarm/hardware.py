"""The hardware of a simulated swarm on real sockets: cameras over HTTP, autopilots as MAVLink over UDP."""

from __future__ import annotations

import asyncio
import functools
import json
import math
import os
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack, suppress
from typing import Any, Protocol, cast

import numpy as np
from pymavlink.dialects.v20 import common

from swarmtrack.clock import Clock
from swarmtrack.lab.autopilots.autopilot import SimulatedArduPilot, SimulatedVehicle
from swarmtrack.lab.autopilots.firmware import ARDUCOPTER, PX4_FIRMWARE, FlightMode
from swarmtrack.lab.autopilots.pilot import GuidedPilot, OnItsPath, Pilot
from swarmtrack.lab.autopilots.px4 import LOCKSTEP_HZ, SimulatedPx4, integration_s
from swarmtrack.lab.autopilots.senses import DroneSenses
from swarmtrack.lab.autopilots.truth import DroneTruth
from swarmtrack.lab.scenarios.oracle import OracleDetector
from swarmtrack.lab.scenarios.scenario import AutopilotKind, FaultKind, Scenario, ScenarioFault
from swarmtrack.lab.swarm.truth_feed import Followers, told
from swarmtrack.lab.world.followed import NotTold, ToldPose
from swarmtrack.lab.world.guided import GuidedDrone
from swarmtrack.lab.world.sensors import ImuParameters
from swarmtrack.lab.world.star import Star
from swarmtrack.lab.world.world import frame_numbers
from swarmtrack.messages import Image

HARDWARE_TICK_S = 0.002  # s: autopilots that have something to say within it are served together
# Cameras expose in so many groups: one after another for the processor, together for the world.
SHUTTER_GROUPS = 3
TRUTH_EVERY = 0.02  # s
DETECTION_TIME = 0.03  # s from exposure to the oracle's detections, as a small computer's detector needs
SIMULATED_JPEG_QUALITY = 90
STREAM_SEND_BUFFER_BYTES = (
    1 << 16
)  # bytes: two frames; the kernel's own megabytes would be a backlog of seconds
BOUNDARY = "frame"
# What each port of an autopilot is called among a drone's addresses, and how far above the cameras' port drone 0's is.
AUTOPILOT_PORTS = {"autopilot": 0, "ground": 1000, "truth": 2000}
# m, horizontal and vertical, as their receivers say it.
ARDUPILOT_GPS, PX4_GPS = (0.8, 1.2), (0.9, 1.78)
LOITER_BEFORE_ENGAGING_S = 1.0  # in LOITER, before a follower is engaged
AUTOPILOT_FAULTS = (
    FaultKind.IMU_GAP,
    FaultKind.AUTOPILOT_REBOOT,
    FaultKind.POSITION_LOSS,
    FaultKind.LOW_BATTERY,
)


Cameras = dict[tuple[int, int], "CameraHardware"]
"""By drone and number."""
Addresses = dict[int, dict[str, str | list[str]]]
"""Where each drone's parts are: `cameras`, of which the first one is also `camera`, and the ports of its autopilot."""


class CameraClient:
    """One client of a camera: it gets the newest, and misses what comes while it is busy."""

    def __init__(self) -> None:
        self._newest: bytes | None = None
        self._changed = asyncio.Event()

    def show(self, part: bytes) -> None:
        self._newest = part
        self._changed.set()

    async def get(self) -> bytes:
        await self._changed.wait()
        self._changed.clear()
        assert self._newest is not None
        return self._newest


class WorldTime(Protocol):
    """The time of a world, as far as a camera can expose in it."""

    def now(self) -> float:
        """World time up to which can be exposed [s]."""
        ...

    async def until(self, t: float) -> None:
        """Until an exposure at world time t can be made."""
        ...


class OwnTime:
    """Of a world that is known for all times: it passes as our clock does. epoch: world time 0 on the clock."""

    def __init__(self, clock: Clock, epoch: float) -> None:
        self._clock = clock
        self._epoch = epoch

    def now(self) -> float:
        return self._clock.now() - self._epoch

    async def until(self, t: float) -> None:
        await asyncio.sleep(t - self.now())


class CameraHardware:
    """One camera of a drone. Exposes on time, as long as somebody watches; a picture is shown when it is made.

    make: what is sent of the exposure (drone, camera, index, t), t in world time. An exposure that falls due while the
    last one is still being made is skipped, as in a camera that cannot keep its rate. So is one of which nobody told
    the truth.
    """

    def __init__(
        self,
        drone_id: int,
        number: int,
        scenario: Scenario,
        time: WorldTime,
        make: Callable[[int, int, int, float], Awaitable[bytes]],
    ) -> None:
        """number: which of the drone's cameras it is."""
        self._drone_id = drone_id
        self._number = number
        camera = scenario.cameras[number]
        self._fps = camera.fps
        self._phase = (drone_id % SHUTTER_GROUPS) / SHUTTER_GROUPS + camera.phase
        self._stalls = tuple(f for f in scenario.faults if f.kind is FaultKind.CAMERA_STALL)
        self._time = time
        self._make = make
        self._watchers: set[CameraClient] = set()
        self._watched = asyncio.Event()

    async def run(self) -> None:
        last = -math.inf
        while True:
            await self._watched.wait()
            index = math.ceil(max(self._time.now() * self._fps - self._phase, last + 1))
            last, t = index, (index + self._phase) / self._fps
            await self._time.until(t)
            if any(stall.concerns(self._drone_id, t) for stall in self._stalls):
                continue
            try:
                part = await self._make(self._drone_id, self._number, index, t)
            except NotTold:
                continue
            for watcher in self._watchers:
                watcher.show(part)

    async def parts(self) -> AsyncIterator[bytes]:
        watcher = CameraClient()
        self._watchers.add(watcher)
        self._watched.set()
        try:
            while True:
                yield await watcher.get()
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

        from swarmtrack.lab.world.rendering import Renderer

        cv2.setNumThreads(1)  # a frame a thread; its own pool costs more than it gains on images of this size
        self._encode = functools.partial(
            cv2.imencode, ".jpg", params=[cv2.IMWRITE_JPEG_QUALITY, SIMULATED_JPEG_QUALITY]
        )
        self._renderers = [
            Renderer(scenario.world, camera.lens, camera.body_from_camera, number=number)
            for number, camera in enumerate(scenario.cameras)
        ]
        self._scenario = scenario
        self._epoch = epoch
        self._workers = ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="renderer")

    async def make(self, drone_id: int, camera: int, index: int, t: float) -> bytes:
        loop = asyncio.get_running_loop()
        jpeg = await loop.run_in_executor(self._workers, self._photograph, drone_id, camera, index, t)
        head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n"
        stamp = self._epoch + t + self._scenario.camera_offset_s.get(drone_id, 0.0)
        return f"{head}X-Timestamp: {stamp:.6f}\r\n\r\n".encode() + jpeg + b"\r\n"

    def _photograph(self, drone_id: int, camera: int, index: int, t: float) -> bytes:
        image = self._renderers[camera].image(drone_id, t, index)
        birds = self._scenario.extra_clutter(drone_id, t)
        if birds:
            chance = self._scenario.world.chance("birds", *frame_numbers(drone_id, camera, index))
            draw_birds(image, birds, chance)
        return bytes(self._encode(image)[1])

    def close(self) -> None:
        self._workers.shutdown(wait=False, cancel_futures=True)


class OracleCamera:
    """Tells what the detector found in the place of pictures."""

    content_type = "application/x-ndjson"
    scheme = "detections"

    def __init__(self, scenario: Scenario, epoch: float) -> None:
        self._oracle = OracleDetector(scenario)
        self._stamps_late = scenario.camera_offset_s
        self._epoch = epoch
        # Of each camera's first frame, by drone and camera.
        self._sequences: dict[tuple[int, int], int] = {}

    async def make(self, drone_id: int, camera: int, index: int, t: float) -> bytes:
        found = self._oracle.detections(drone_id, index, t, camera)
        rows = [
            [*(round(value, 3) for value in (*centre, *size)), round(score, 4)]
            for centre, size, score in zip(
                found.centre.tolist(), found.size.tolist(), found.score.tolist(), strict=True
            )
        ]
        stamp = self._epoch + t + self._stamps_late.get(drone_id, 0.0)
        sequence = index - self._sequences.setdefault((drone_id, camera), index)
        line = {"t_s": round(stamp, 6), "sequence": sequence, "detections": rows}
        await asyncio.sleep(DETECTION_TIME)
        return json.dumps(line).encode() + b"\n"

    def close(self) -> None:
        """Nothing is open."""


def draw_birds(image: Image, expected: float, rng: np.random.Generator) -> None:
    """Writes a flock into `image`: what a detector makes of it is its own affair."""
    import cv2

    height, width = image.shape[:2]
    for _ in range(int(rng.poisson(expected))):
        u, v, span = int(rng.integers(width)), int(rng.integers(height)), int(rng.integers(4, 16))
        lift = int(rng.integers(-span // 2, span // 2 + 1))
        for side in (-1, 1):
            cv2.line(image, (u, v), (u + side * span, v - lift), (30, 30, 30), max(1, span // 5), cv2.LINE_AA)


class AutopilotPort(asyncio.DatagramProtocol):
    """A port of a simulated autopilot on UDP. It answers whoever last sent it a valid message."""

    def __init__(
        self, autopilot: SimulatedVehicle, port: int, clock: Clock, siblings: list[AutopilotPort]
    ) -> None:
        """siblings: the ports that this autopilot has until now, to which it is added."""
        self.due = -math.inf
        self._siblings = siblings
        siblings.append(self)
        self._autopilot = autopilot
        self._port = port
        self._clock = clock
        self._peer: tuple[Any, ...] | None = None
        self._transport: asyncio.DatagramTransport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        # Not one by inheritance, in asyncio itself.
        self._transport = cast(asyncio.DatagramTransport, transport)

    def datagram_received(self, data: bytes, addr: tuple[Any, ...]) -> None:
        now = self._clock.now()
        if self._autopilot.receive(data, now, self._port):
            self._peer = addr
            # At once: the companion measures the way of its question and of the answer.
            for port in self._siblings:
                port.speak(now)

    def error_received(self, error: Exception) -> None:
        """The companion's port is closed just now: it is being started again."""

    def speak(self, now: float) -> None:
        for data in self._autopilot.step(now, self._port):
            if self._peer is not None:
                self._transport.sendto(data, self._peer)
        self.due = self._autopilot.next_due(self._port)


async def keep_speaking(ports: list[AutopilotPort], clock: Clock) -> None:
    """Serve all autopilots by one timer."""
    while True:
        now = clock.now()
        for port in ports:
            if port.due <= now:
                port.speak(now)
        await asyncio.sleep(max(min(port.due for port in ports) - now, HARDWARE_TICK_S))


async def let_fly(pilot: GuidedPilot, star: Star, drone_id: int, epoch: float, clock: Clock) -> None:
    """What a follower's own pilot does, transmitter in hand: take off, if it does not hover already, hold, and let its
    agent fly. Taking off in GUIDED engages no agent; coming back to it does.
    """
    if star.takes_off_s > -math.inf:
        await asyncio.sleep(epoch + star.takes_off_s - clock.now())
        pilot.switch_to(FlightMode.GUIDED, clock.now())
        for command, first, height in (
            (common.MAV_CMD_COMPONENT_ARM_DISARM, 1.0, 0.0),
            (common.MAV_CMD_NAV_TAKEOFF, 0.0, star.height_of(drone_id)),
        ):
            numbers = (first, *5 * (0.0,), height)
            pilot.command(common.MAVLink_command_long_message(0, 0, command, 0, *numbers), clock.now())
        await asyncio.sleep(epoch + star.engages_s - LOITER_BEFORE_ENGAGING_S - clock.now())
        pilot.switch_to(FlightMode.HOLD, clock.now())
    await asyncio.sleep(epoch + star.engages_s - clock.now())
    pilot.switch_to(FlightMode.GUIDED, clock.now())


async def play(
    fault: ScenarioFault, autopilots: dict[int, SimulatedVehicle], epoch: float, clock: Clock
) -> None:
    """A fault of autopilots, at its world time."""
    begin, end = epoch + fault.at_s, epoch + fault.at_s + fault.seconds
    concerned = [a for drone_id, a in autopilots.items() if not fault.drones or drone_id in fault.drones]
    await asyncio.sleep(begin - clock.now())
    for autopilot in concerned:
        begin_fault(fault.kind, autopilot, clock.now())
    await asyncio.sleep(end - clock.now())
    for autopilot in concerned:
        end_fault(fault.kind, autopilot, clock.now())


def begin_fault(kind: FaultKind, autopilot: SimulatedVehicle, now: float) -> None:
    match kind:
        case FaultKind.IMU_GAP:
            autopilot.imu_gap = True
        case FaultKind.POSITION_LOSS:
            autopilot.senses.position_lost = True
        case FaultKind.LOW_BATTERY:
            autopilot.pilot.return_home(now)
        case _:
            autopilot.mute = True


def end_fault(kind: FaultKind, autopilot: SimulatedVehicle, now: float) -> None:
    match kind:
        case FaultKind.IMU_GAP:
            autopilot.imu_gap = False
        case FaultKind.POSITION_LOSS:
            autopilot.senses.position_lost = False
        case FaultKind.AUTOPILOT_REBOOT:
            autopilot.reboot(now)
            autopilot.mute = False


def make_autopilot(scenario: Scenario, drone_id: int, epoch: float, now: float) -> SimulatedVehicle:
    """The autopilot of a drone, switched on before `now`. epoch: world time 0."""
    kind, drone = scenario.autopilot(drone_id), scenario.world.flown(drone_id)
    skew = scenario.autopilot_skew.get(drone_id, 0.0)
    switched_on = epoch - scenario.autopilot_boot_s.get(drone_id, 0.0) / (1.0 + skew)
    ardupilot = kind is AutopilotKind.ARDUPILOT
    firmware = ARDUCOPTER if ardupilot else PX4_FIRMWARE
    senses = DroneSenses(
        scenario.world,
        drone_id,
        epoch,
        imu=_imu(kind, scenario.imu_rate_hz),
        ego=scenario.ego(drone_id),
        earth=scenario.origin,
        gps_sigma=ARDUPILOT_GPS[0] if ardupilot else PX4_GPS[0],
        gps_vertical_sigma=ARDUPILOT_GPS[1] if ardupilot else PX4_GPS[1],
    )
    pilot: Pilot = OnItsPath(epoch + drone.takes_off_s)
    if isinstance(drone, GuidedDrone):
        pilot = GuidedPilot(
            drone,
            firmware,
            epoch=epoch,
            origin=scenario.origin,
            located=senses.is_located,
            ready=senses.is_ready,
            errors=senses.lasting_errors,
        )
    make: Callable[..., SimulatedVehicle] = SimulatedArduPilot
    if not ardupilot:
        make = functools.partial(SimulatedPx4, lockstep=kind is AutopilotKind.PX4_LOCKSTEP)
    return make(
        senses,
        truth=DroneTruth(scenario.world, drone_id, epoch, scenario.origin),
        pilot=pilot,
        system=(drone_id - 1) % 255 + 1,
        boot_at=min(switched_on, now),  # agents start before world time 0: by then it is on
        skew=skew,
    )


def _imu(kind: AutopilotKind, rate_hz: float) -> ImuParameters:
    """ArduPilot filters its gyro, PX4 tells the mean of an integration interval."""
    match kind:
        case AutopilotKind.ARDUPILOT:
            return ImuParameters(rate_hz=rate_hz, filter_hz=ARDUCOPTER.parameters["INS_GYRO_FILTER"])
        case AutopilotKind.PX4:
            window_s = integration_s(PX4_FIRMWARE.parameters["IMU_INTEG_RATE"])
            return ImuParameters(rate_hz=rate_hz, filter_hz=0.0, window_s=window_s)
        case AutopilotKind.PX4_LOCKSTEP:
            return ImuParameters(rate_hz=rate_hz, filter_hz=0.0, window_s=1.0 / LOCKSTEP_HZ)


async def simulate(
    scenario: Scenario,
    *,
    oracle: bool,
    epoch: float,
    host: str,
    port: int,
    flown: Mapping[str, Any],
    clock: Clock,
    on_ready: Callable[[Addresses, str | None], None],
) -> None:
    """Run it all until cancelled.

    on_ready: called once everything listens, with the addresses of each drone, and with the URL at which the truth
    about guided drones is told, if there are any.

    port: of the cameras; those of drone N's autopilot are N higher, see AUTOPILOT_PORTS. 0: whichever are free.
    flown: what the server tells at `/` beside the world time.
    """
    guided = {n: d for n, d in scenario.world.drones.items() if isinstance(d, GuidedDrone)}
    followers = Followers()
    images = OracleCamera(scenario, epoch) if oracle else CameraRenderer(scenario, epoch)
    time = OwnTime(clock, epoch)
    cameras = make_cameras(scenario, time, images.make)
    autopilots = {n: make_autopilot(scenario, n, epoch, clock.now()) for n in scenario.members}
    async with AsyncExitStack() as stack:
        stack.callback(images.close)
        http = await serve_cameras(
            stack,
            cameras,
            images.content_type,
            (host, port),
            time=time,
            flown=flown,
            truth=followers.lines if guided else None,
        )
        ports: list[AutopilotPort] = []
        addresses: Addresses = {}
        for n, autopilot in autopilots.items():
            siblings: list[AutopilotPort] = []
            addresses[n] = camera_addresses(images.scheme, http, scenario, n)
            for k, (name, above) in enumerate(AUTOPILOT_PORTS.items()):
                transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(
                    functools.partial(AutopilotPort, autopilot, k, clock, siblings),
                    local_addr=(host, port + above + n if port else 0),
                )
                stack.callback(transport.close)
                addresses[n][name] = f"udpout:{authority(transport.get_extra_info('sockname'))}"
            ports += siblings
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(keep_speaking(ports, clock), name="autopilots")
            for (n, k), camera in cameras.items():
                tasks.create_task(camera.run(), name=f"camera {k} of {n}")
            for fault in scenario.faults:
                if fault.kind in AUTOPILOT_FAULTS and epoch + fault.at_s > clock.now():
                    tasks.create_task(play(fault, autopilots, epoch, clock), name=str(fault.kind))
            star = scenario.star
            for n in star.followers if star is not None else ():
                pilot = autopilots[n].pilot
                assert star is not None
                assert isinstance(pilot, GuidedPilot)
                tasks.create_task(let_fly(pilot, star, n, epoch, clock), name=f"pilot {n}")
            if guided:
                tasks.create_task(tell_truth(guided, followers, OwnTime(clock, epoch)), name="truth")
            on_ready(addresses, f"http://{authority(http)}/truth" if guided else None)


async def tell_truth(drones: Mapping[int, GuidedDrone], followers: Followers, time: OwnTime) -> None:
    """Where guided drones are, for those who do not fly them."""
    while True:
        t = time.now()
        for drone_id, drone in drones.items():
            followers.send(told(drone_id, ToldPose(t, drone.pose(t))))
        await asyncio.sleep(TRUTH_EVERY)


def make_cameras(
    scenario: Scenario, time: WorldTime, make: Callable[[int, int, int, float], Awaitable[bytes]]
) -> Cameras:
    """All of everybody who has an agent."""
    return {
        (n, k): CameraHardware(n, k, scenario, time, make)
        for n in scenario.members
        for k in range(len(scenario.cameras))
    }


def camera_addresses(
    scheme: str, server: tuple[Any, ...], scenario: Scenario, drone_id: int
) -> dict[str, str | list[str]]:
    """Where a drone's cameras are served."""
    first = f"{scheme}://{authority(server)}/{drone_id}"
    cameras = [first, *(f"{first}/{k}" for k in range(1, len(scenario.cameras)))]
    return {"camera": first, "cameras": [*cameras]}


async def serve_cameras(
    stack: AsyncExitStack,
    cameras: Cameras,
    content_type: str,
    address: tuple[str, int],
    *,
    time: OwnTime,
    flown: Mapping[str, Any],
    truth: Callable[[], AsyncIterator[bytes]] | None = None,
) -> tuple[Any, ...]:
    """Serve each at /ID/NUMBER, the first one of a drone at /ID as well; at / what is flown and when, and at /truth its
    lines; returns the socket's address."""
    from aiohttp import web

    async def introduce(_: web.Request) -> web.Response:
        return web.json_response({**flown, "world_time_s": time.now()})

    async def watch(request: web.Request) -> web.StreamResponse:
        drone, number = (int(request.match_info.get(key, 0)) for key in ("drone", "camera"))
        camera = cameras.get((drone, number))
        if camera is None:
            drones = {n: None for n, _ in cameras}
            if drone not in drones:
                raise web.HTTPNotFound(text=f"no such drone here, known: {', '.join(map(str, drones))}\n")
            raise web.HTTPNotFound(text=f"no such camera, known: 0 to {len(cameras) // len(drones) - 1}\n")
        assert request.transport is not None
        request.transport.get_extra_info("socket").setsockopt(
            socket.SOL_SOCKET, socket.SO_SNDBUF, STREAM_SEND_BUFFER_BYTES
        )
        request.transport.set_write_buffer_limits(high=0)
        response = web.StreamResponse(headers={"Content-Type": content_type, "Cache-Control": "no-store"})
        await response.prepare(request)
        with suppress(ConnectionError):  # whoever watched has gone, perhaps in the middle of a frame
            async for part in camera.parts():
                await response.write(part)
        return response

    async def follow(request: web.Request) -> web.StreamResponse:
        if truth is None:
            raise web.HTTPNotFound(text="its truth is the scenario that it flies, see /\n")
        response = web.StreamResponse(headers={"Content-Type": "application/x-ndjson"})
        await response.prepare(request)
        with suppress(ConnectionError):
            async for line in truth():
                await response.write(line)
        return response

    application = web.Application()
    application.router.add_get("/", introduce)
    application.router.add_get("/truth", follow)
    application.router.add_get(r"/{drone:\d{1,5}}", watch)
    application.router.add_get(r"/{drone:\d{1,5}}/{camera:\d}", watch)
    # Without its cancellation, the handler of a client that left would wait for a camera that is stalled.
    runner = web.AppRunner(application, access_log=None, shutdown_timeout=0.1, handler_cancellation=True)
    await runner.setup()
    stack.push_async_callback(runner.cleanup)
    await web.TCPSite(runner, *address).start()
    bound: tuple[Any, ...] = runner.addresses[0]
    return bound


def authority(address: tuple[Any, ...]) -> str:
    host, port = address[:2]
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
