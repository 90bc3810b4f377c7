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

from swarmtrack.simulation.autopilot import OFFERED, GpsFix, SensedState, SimulatedArduPilot

SIGNING_BEGINS = 1_420_070_400  # s UTC: 2015-01-01


class FakeAutopilot(SimulatedArduPilot):
    """Senses its own public attributes. understands_intervals: False for an old firmware; key: signs with it."""

    def __init__(
        self,
        *,
        system: int = 1,
        component: int = 1,
        boot_at: float = 0.0,
        skew: float = 0.0,
        offered: tuple[int, ...] = OFFERED,
        understands_intervals: bool = True,
        key: bytes | None = None,
    ) -> None:
        super().__init__(
            self, system=system, component=component, boot_at=boot_at, skew=skew, offered=offered
        )
        self.understands_intervals = understands_intervals
        self.gyro = np.array((0.1, -0.2, 0.3))
        self.accel = np.array((0.0, 0.0, -9.80665))
        self.q = np.array((1.0, 0.0, 0.0, 0.0))
        self.position = np.array((1.0, 2.0, -3.0))
        self.velocity = np.zeros(3)
        self.gps: GpsFix | None = None
        self.commands: list[tuple[int, float]] = []  # (message id, interval in µs) as asked
        self.streams_asked: list[int] = []  # REQUEST_DATA_STREAM
        self.companion_heartbeats = 0
        self.signing_setups = 0
        self.timesync_answers: list[tuple[int, int]] = []  # (tc1, ts1) to our own requests
        self._key = key
        if key is not None:
            self._sign(self.mav)
            self.mav.signing.sign_outgoing = True

    def at(self, t: float) -> SensedState:
        return SensedState(self.gyro, self.accel, self.q, self.position, self.velocity, self.gps)

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
        self._outbox.append(self.frame(common.MAVLink_timesync_message(0, int(self.stamp(now) * 1e9))))

    def understand(self, message: Any, now: float) -> None:
        match message.get_type():
            case "COMMAND_LONG" if message.command == common.MAV_CMD_SET_MESSAGE_INTERVAL:
                self.commands.append((int(message.param1), message.param2))
                if not self.understands_intervals:
                    return
            case "REQUEST_DATA_STREAM":
                self.streams_asked.append(message.req_stream_id)
                if message.req_stream_id == common.MAV_DATA_STREAM_RAW_SENSORS:
                    self.set_interval(common.MAVLINK_MSG_ID_RAW_IMU, 1e6 / message.req_message_rate, now)
            case "TIMESYNC" if message.tc1 != 0:
                self.timesync_answers.append((message.tc1, message.ts1))
            case "HEARTBEAT":
                self.companion_heartbeats += 1
            case "SETUP_SIGNING":
                self.signing_setups += 1
        super().understand(message, now)


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
