"""The simulated autopilot as tests want it: at rest where they put it, remembering what it was asked, misbehaving.

`serve_udp` puts one on a real UDP socket in real time. Run as a program it does so until interrupted:

    python tests/fake_autopilot.py 127.0.0.1:14540 [SYSTEM_ID]
"""

from __future__ import annotations

import asyncio
import contextlib
import sys
import time
from collections.abc import AsyncIterator
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common

from swarmtrack.geometry.geodesy import Geodetic
from swarmtrack.lab.autopilots.autopilot import SimulatedArduPilot, SimulatedVehicle
from swarmtrack.lab.autopilots.channel import Channel
from swarmtrack.lab.autopilots.px4 import SimulatedPx4
from swarmtrack.lab.autopilots.senses import GpsFix, Inertial, SensedState

SIGNING_BEGINS = 1_420_070_400  # s UTC: 2015-01-01


class FakeVehicle(SimulatedVehicle):
    """Senses its own public attributes. understands_intervals: False for an old firmware; key: signs with it; the
    rest: as any simulated autopilot."""

    position_lost = False
    goes_by_receiver = True

    def __init__(
        self,
        *,
        understands_intervals: bool = True,
        key: bytes | None = None,
        **options: Any,
    ) -> None:
        super().__init__(self, **options)
        self.understands_intervals = understands_intervals
        self.gyro = np.array((0.1, -0.2, 0.3))
        self.accel = np.array((0.0, 0.0, -9.80665))
        self.q = np.array((1.0, 0.0, 0.0, 0.0))
        self.position = np.array((1.0, 2.0, -3.0))
        self.velocity = np.zeros(3)
        self.gps: GpsFix | None = None
        self.globe: Geodetic | None = None
        """Where it believes to be without a fix."""
        self.ground: float | None = None  # m, by a range finder
        self.commands: list[tuple[int, float]] = []  # (message id, interval in µs) as asked
        self.streams_asked: list[int] = []  # REQUEST_DATA_STREAM
        self.companion_heartbeats = 0
        self.signing_setups = 0
        self.timesync_answers: list[tuple[int, int]] = []  # (tc1, ts1) to our own requests
        self._key = key
        if key is not None:
            for channel in self.channels:
                self._sign(channel.mav)
                channel.mav.signing.sign_outgoing = True

    def rebooted(self, t: float) -> None:
        """What it senses is told by the test."""

    def take_position(self, t: float, position: Any, var: Any, *, is_reset: bool) -> None:
        """Where it is, is told by the test."""

    def at(self, t: float) -> SensedState:
        globe = self.gps.place if self.gps else self.globe
        return SensedState(
            self.gyro, self.accel, self.q, self.position, self.velocity, self.gps, globe, self.ground
        )

    def inertial(self, t: float) -> Inertial:
        return Inertial(self.gyro, self.accel)

    def parser(self) -> Any:
        parser = super().parser()
        if self._key is not None:
            self._sign(parser)
        return parser

    def _sign(self, mav: Any) -> None:
        mav.signing.secret_key = self._key
        mav.signing.timestamp = int((time.time() - SIGNING_BEGINS) * 1e5)

    def ask_time(self, now: float) -> None:
        """PX4 asks its companion for the time."""
        self.channels[0].send(common.MAVLink_timesync_message(0, int(self.stamp(now) * 1e9)))

    def understand(self, message: Any, now: float, channel: Channel) -> None:
        match message.get_type():
            case "COMMAND_LONG" if message.command == common.MAV_CMD_SET_MESSAGE_INTERVAL:
                self.commands.append((int(message.param1), message.param2))
                if not self.understands_intervals:
                    return
            case "REQUEST_DATA_STREAM":
                self.streams_asked.append(message.req_stream_id)
            case "TIMESYNC" if message.tc1 != 0:
                self.timesync_answers.append((message.tc1, message.ts1))
            case "HEARTBEAT":
                self.companion_heartbeats += 1
            case "SETUP_SIGNING":
                self.signing_setups += 1
        super().understand(message, now, channel)


class FakeAutopilot(FakeVehicle, SimulatedArduPilot):
    """An ArduPilot."""


class FakePx4(FakeVehicle, SimulatedPx4):
    """A PX4. lockstep: of 250 samples a second 125 go where 200 are asked for."""

    def __init__(self, *, lockstep: bool = True, **options: Any) -> None:
        super().__init__(lockstep=lockstep, **options)


def imu_report(autopilot: FakeVehicle, stamp: float) -> Any:
    """HIGHRES_IMU of what it senses, stamped `stamp` [s]."""
    return common.MAVLink_highres_imu_message(
        round(stamp * 1e6), *autopilot.accel, *autopilot.gyro, 0, 0, 0, 0, 0, 0, 0, 0xFFFF
    )


class _Socket(asyncio.DatagramProtocol):
    def __init__(self, autopilot: FakeAutopilot) -> None:
        self.autopilot = autopilot

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        self.autopilot.receive(data, time.monotonic())


@contextlib.asynccontextmanager
async def serve_udp(
    autopilot: FakeAutopilot, host: str, port: int
) -> AsyncIterator[asyncio.DatagramTransport]:
    """Fly `autopilot` in real time, speaking from a socket of its own to host:port (a `udpin:` link)."""
    loop = asyncio.get_running_loop()
    transport, _ = await loop.create_datagram_endpoint(lambda: _Socket(autopilot), local_addr=(host, 0))

    async def fly() -> None:
        while True:
            for data in autopilot.step(time.monotonic()):
                transport.sendto(data, (host, port))
            await asyncio.sleep(0.002)

    flight = asyncio.create_task(fly())
    try:
        yield transport
    finally:
        flight.cancel()
        await asyncio.gather(flight, return_exceptions=True)
        transport.close()


async def _main(host: str, port: int, system: int) -> None:
    async with serve_udp(FakeAutopilot(system=system, boot_at=time.monotonic() - 40.0), host, port):
        await asyncio.Event().wait()


if __name__ == "__main__":
    _host, _, _port = sys.argv[1].rpartition(":")
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(_main(_host, int(_port), int(sys.argv[2]) if len(sys.argv) > 2 else 1))
