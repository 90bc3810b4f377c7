"""An agent in a process of its own: its config is written, its autopilot played over UDP, its messages heard."""

from __future__ import annotations

import asyncio
import json
import secrets
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import common

from swarmtrack.benchmarks.processes import agent_environment, free_port
from swarmtrack.benchmarks.report import BenchmarkError
from swarmtrack.clock import SystemClock
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind
from swarmtrack.transport.settings import NetworkSettings
from swarmtrack.transport.zenoh_listener import ZenohListener
from swarmtrack.wire import codec
from swarmtrack.wire.health import HealthMessage
from swarmtrack.wire.tracks import TracksMessage

CAMERA = PinholeCamera(430.0, 430.0, 319.5, 239.5, 640, 480)
IMU_HZ, POSE_HZ, FPS = 200, 50, 15.0
HOVERS_AT = np.array([0.0, 0.0, -2.5])
"""(3,) m: level, and it looks north."""
PATIENCE_S = 60.0  # for an agent to show its first track, and its health


class LoneAgent(NamedTuple):
    """heard: of its team, which is nobody else's, until `stop_listening`."""

    process: subprocess.Popen[bytes]
    team: str
    heard: Heard
    stop_listening: Callable[[], Awaitable[None]]


@asynccontextmanager
async def scripted_agent(
    options: Sequence[str] = (), entries: Mapping[str, Any] | None = None
) -> AsyncIterator[LoneAgent]:
    """The scripted agent, once it tracks. options: its own; entries: dotted keys, more of its config."""
    port, team = free_port(), f"bench-{secrets.token_hex(4)}"
    config = scripted_entries(port, team) | dict(entries or {})
    with agent_process(["swarmtrack.benchmarks.scripted_agent", *options], config) as process:
        async with AsyncExitStack() as hearing:
            heard = await hearing.enter_async_context(listening(team))
            async with autopilot(port):
                await until_tracking(process, heard)
                yield LoneAgent(process, team, heard, hearing.aclose)


@dataclass
class Heard:
    """What an agent's messages told a listener. Latencies in s, from exposure to arrival here, one a scan."""

    first_track_at: float | None = None
    latencies: list[float] = field(default_factory=list)
    health: HealthMessage | None = None
    named: set[int] = field(default_factory=set)
    """The drones that are names of tracks, by the last message."""
    _exposure: float = 0.0

    def receive(self, kind: Kind, payload: bytes) -> None:
        arrived_utc, arrived = time.time(), time.monotonic()
        if kind is Kind.HEALTH:
            self.health = codec.decode(HealthMessage, payload)
        elif kind is Kind.TRACKS:
            message = codec.decode(TracksMessage, payload)
            self.named = {track.identity for track in message.tracks if isinstance(track.identity, int)}
            exposure = message.t_utc_s - message.scan_age_s
            if any(track.status == "confirmed" for track in message.tracks) and self.first_track_at is None:
                self.first_track_at = arrived
            # The first message with a new scan in it.
            if message.tracks and exposure > self._exposure + 0.5 / FPS:
                self._exposure = exposure
                self.latencies.append(arrived_utc - exposure)

    async def next_health(self) -> HealthMessage:
        """Not the last one: that may be of the agent's first second, before its autopilot spoke."""
        self.health = None
        deadline = time.monotonic() + PATIENCE_S
        while self.health is None:
            if time.monotonic() > deadline:
                raise BenchmarkError(f"agent: no health was heard within {PATIENCE_S:g} s")
            await asyncio.sleep(0.02)
        return self.health


async def until_tracking(process: subprocess.Popen[bytes], heard: Heard) -> None:
    """Until it has a confirmed track; BenchmarkError if it ends before, or after `PATIENCE_S`."""
    await _until(process, lambda: heard.first_track_at is not None, "a confirmed track")


async def until_named(process: subprocess.Popen[bytes], heard: Heard, drones: set[int]) -> None:
    """Until each of these drones, and no other, is the name of a track; BenchmarkError as of `until_tracking`."""
    await _until(process, lambda: heard.named == drones, f"tracks of drones {sorted(drones)}")


async def _until(process: subprocess.Popen[bytes], holds: Callable[[], bool], expected: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not holds():
        if process.poll() is not None:
            raise BenchmarkError(f"agent: ended with {process.returncode}, expected {expected}")
        if time.monotonic() > deadline:
            raise BenchmarkError(f"agent: expected {expected}, heard of none within {PATIENCE_S:g} s")
        await asyncio.sleep(0.02)


def scripted_entries(port: int, team: str) -> dict[str, Any]:
    """The config of the scripted agent: its autopilot at a UDP port of this machine."""
    lens = {name: getattr(CAMERA, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    return {
        "drone.id": 1,
        "camera.source": "http://127.0.0.1:9/",  # never opened: the scripted camera takes its place
        "autopilot.link": f"udpin:127.0.0.1:{port}",
        "network.team": team,
        **{f"camera.intrinsics.{name}": value for name, value in lens.items()},
    }


@contextmanager
def agent_process(module: list[str], entries: dict[str, Any]) -> Iterator[subprocess.Popen[bytes]]:
    """`python -m MODULE… --config` with these dotted keys as its config, ended on leaving. A list of tables, each of
    dotted keys, is an array of tables: `{"camera": [{"source": …}, …]}`."""
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "drone.toml"
        lines = (f"{key} = {_as_toml(value)}\n" for key, value in entries.items())
        config.write_text("".join(lines), encoding="utf-8")
        command = [sys.executable, "-m", *module, "--config", str(config)]
        process = subprocess.Popen(command, env=agent_environment(), stdout=subprocess.DEVNULL)
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(5.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _as_toml(value: Any) -> str:
    match value:
        case dict():
            return f"{{ {', '.join(f'{key} = {_as_toml(one)}' for key, one in value.items())} }}"
        case list():
            return f"[{', '.join(map(_as_toml, value))}]"
        case _:
            return json.dumps(value)


@asynccontextmanager
async def listening(team: str) -> AsyncIterator[Heard]:
    """Hear a team meanwhile."""
    heard = Heard()
    listener = ZenohListener(NetworkSettings(team=team), keys.all_but_video(team), SystemClock())
    await listener.open()

    async def listen() -> None:
        async for sample in listener.samples():
            address = keys.parse(sample.key)
            if address is not None and sample.payload:
                heard.receive(address.kind, sample.payload)

    task = asyncio.create_task(listen())
    try:
        yield heard
    finally:
        task.cancel()
        await listener.close()


@asynccontextmanager
async def autopilot(port: int) -> AsyncIterator[None]:
    """An autopilot that hovers: heartbeat, gyro and pose over UDP, on time."""
    task = asyncio.create_task(_play_autopilot(port))
    try:
        yield
    finally:
        task.cancel()


async def _play_autopilot(port: int) -> None:
    mav = common.MAVLink(None, srcSystem=1, srcComponent=1)
    rng = np.random.default_rng(5)
    start = time.monotonic()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.setblocking(False)
        sample = 0
        while True:
            for message in _due_messages(sample, rng):
                with_header = message.pack(mav)
                mav.seq = (mav.seq + 1) % 256
                udp.sendto(with_header, ("127.0.0.1", port))
            sample += 1
            await asyncio.sleep(max(start + sample / IMU_HZ - time.monotonic(), 0.0))


def _due_messages(sample: int, rng: np.random.Generator) -> list[Any]:
    t_us = 10_000_000 + sample * 1_000_000 // IMU_HZ
    x, y, z = rng.normal(0.0, 2e-3, 3)
    messages: list[Any] = [
        common.MAVLink_highres_imu_message(t_us, 0.0, 0.0, -9.81, x, y, z, 0, 0, 0, 1013.0, 0, 0, 20.0, 63)
    ]
    if sample % (IMU_HZ // POSE_HZ) == 0:
        t_ms = t_us // 1000
        messages.append(common.MAVLink_attitude_quaternion_message(t_ms, 1.0, 0.0, 0.0, 0.0, x, y, z))
        messages.append(common.MAVLink_local_position_ned_message(t_ms, *HOVERS_AT.tolist(), 0.0, 0.0, 0.0))
    if sample % IMU_HZ == 0:
        kind, maker = common.MAV_TYPE_QUADROTOR, common.MAV_AUTOPILOT_PX4
        messages.append(common.MAVLink_heartbeat_message(kind, maker, 0, 0, common.MAV_STATE_ACTIVE, 3))
    return messages
