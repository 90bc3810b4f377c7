"""A small autopilot for tests: heartbeats, streams on request, reboots, a clock of its own, and ArduPilot's manners.

`FakeAutopilot` has no I/O and no clock: `receive` takes bytes, `step(now)` returns the datagrams due by then.
`serve_udp` puts one on a real UDP socket in real time. Run as a program it does so until interrupted:

    python tests/fake_autopilot.py 127.0.0.1:14540 [SYSTEM_ID]
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import sys
import time
from collections.abc import AsyncIterator, Iterator
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common

SHORTEST_INTERVAL_US = 3000  # ArduCopter's loop of 400 Hz: 333 Hz is granted, 400 Hz is DENIED
OFFERED = (
    common.MAVLINK_MSG_ID_HIGHRES_IMU,
    common.MAVLINK_MSG_ID_RAW_IMU,
    common.MAVLINK_MSG_ID_SCALED_IMU,
    common.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
    common.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
)


class FakeAutopilot:
    """Sends nothing but heartbeats until asked, like ArduPilot.

    boot_at: when it was switched on; skew: of its clock against ours [s/s]; offered: messages that can be asked for;
    understands_intervals: False for an old firmware. Public attributes may be changed while it runs.
    """

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
        self.boot_at = boot_at
        self.skew = skew
        self.offered = offered
        self.understands_intervals = understands_intervals
        self.mute = False
        self.gyro = np.array((0.1, -0.2, 0.3))
        self.accel = np.array((0.0, 0.0, -9.80665))
        self.q = np.array((1.0, 0.0, 0.0, 0.0))
        self.position = np.array((1.0, 2.0, -3.0))
        self.velocity = np.zeros(3)
        self.commands: list[tuple[int, float]] = []  # (message id, interval in µs) as asked
        self.streams_asked: list[int] = []  # REQUEST_DATA_STREAM
        self.companion_heartbeats = 0
        self.signing_setups = 0
        self.timesync_answers: list[tuple[int, int]] = []  # (tc1, ts1) to our own requests
        self._intervals: dict[int, float] = {}  # s
        self._due: dict[int, float] = {}
        self._heartbeat_due = -math.inf
        self._outbox: list[bytes] = []
        self._receive = common.MAVLink(None)
        self._receive.robust_parsing = True
        self._mav = common.MAVLink(None, system, component)
        if key is not None:
            for mav in (self._mav, self._receive):
                mav.signing.secret_key = key
                mav.signing.timestamp = int((time.time() - 1_420_070_400) * 1e5)
            self._mav.signing.sign_outgoing = True

    def stamp(self, now: float) -> float:
        """Seconds since boot on its own clock."""
        return (now - self.boot_at) * (1.0 + self.skew)

    def reboot(self, now: float) -> None:
        """Time begins again and every stream is forgotten."""
        self.boot_at = now
        self._intervals.clear()
        self._due.clear()
        self._mav.seq = 0

    def frame(self, message: Any, **kwargs: bool) -> bytes:
        data = bytes(message.pack(self._mav, **kwargs))
        self._mav.seq = (self._mav.seq + 1) % 256
        return data

    def ask_time(self, now: float) -> None:
        """PX4 asks its companion for the time."""
        self._outbox.append(self.frame(common.MAVLink_timesync_message(0, int(self.stamp(now) * 1e9))))

    def receive(self, data: bytes, now: float) -> None:
        """Take what the companion sent."""
        for m in self._receive.parse_buffer(data) or []:
            match m.get_type():
                case "COMMAND_LONG" if m.command == common.MAV_CMD_SET_MESSAGE_INTERVAL:
                    self._set_interval(int(m.param1), m.param2, now, m.get_srcSystem(), m.get_srcComponent())
                case "REQUEST_DATA_STREAM":
                    self.streams_asked.append(m.req_stream_id)
                    if m.req_stream_id == common.MAV_DATA_STREAM_RAW_SENSORS:
                        self._intervals[common.MAVLINK_MSG_ID_RAW_IMU] = 1.0 / m.req_message_rate
                case "TIMESYNC" if m.tc1 == 0:
                    answer = common.MAVLink_timesync_message(int(self.stamp(now) * 1e9), m.ts1)
                    self._outbox.append(self.frame(answer))
                case "TIMESYNC":
                    self.timesync_answers.append((m.tc1, m.ts1))
                case "HEARTBEAT":
                    self.companion_heartbeats += 1
                case "SETUP_SIGNING":
                    self.signing_setups += 1

    def _set_interval(
        self, message_id: int, interval_us: float, now: float, system: int, component: int
    ) -> None:
        self.commands.append((message_id, interval_us))
        if not self.understands_intervals:
            return
        if message_id not in self.offered or 0 < interval_us < SHORTEST_INTERVAL_US:
            result = common.MAV_RESULT_DENIED
        else:
            result = common.MAV_RESULT_ACCEPTED
            self._intervals[message_id] = (interval_us // 1000) * 1e-3  # whole milliseconds, rounded down
            self._due[message_id] = now
        ack = common.MAVLink_command_ack_message(
            common.MAV_CMD_SET_MESSAGE_INTERVAL, result, target_system=system, target_component=component
        )
        self._outbox.append(self.frame(ack))

    def step(self, now: float) -> list[bytes]:
        """The datagrams due by `now`, oldest first."""
        frames, self._outbox = self._outbox, []
        if now >= self._heartbeat_due:
            self._heartbeat_due = now + 1.0
            frames.append(
                self.frame(
                    common.MAVLink_heartbeat_message(
                        common.MAV_TYPE_QUADROTOR,
                        common.MAV_AUTOPILOT_ARDUPILOTMEGA,
                        0,
                        0,
                        common.MAV_STATE_ACTIVE,
                        3,
                    )
                )
            )
        frames.extend(self._due_streams(now))
        return [] if self.mute else frames

    def _due_streams(self, now: float) -> Iterator[bytes]:
        for message_id, interval in self._intervals.items():
            due = self._due.setdefault(message_id, now)
            while due <= now:
                yield self.frame(self._message(message_id, due))
                due += interval
            self._due[message_id] = due

    def _message(self, message_id: int, at: float) -> Any:
        stamp = self.stamp(at)
        us, ms = round(stamp * 1e6), int(stamp * 1e3)
        milli_g = [int(a / 9.80665e-3) for a in self.accel]
        milli_rad = [round(w * 1e3) for w in self.gyro] if np.isfinite(self.gyro).all() else [0, 0, 0]
        match message_id:
            case common.MAVLINK_MSG_ID_HIGHRES_IMU:
                return common.MAVLink_highres_imu_message(
                    us, *self.accel, *self.gyro, 0.2, 0.1, 0.4, 1013.0, 0.0, 100.0, 25.0, 0xFFFF
                )
            case common.MAVLINK_MSG_ID_RAW_IMU:
                return common.MAVLink_raw_imu_message(us, *milli_g, *milli_rad, 0, 0, 0)
            case common.MAVLINK_MSG_ID_SCALED_IMU:
                return common.MAVLink_scaled_imu_message(ms, *milli_g, *milli_rad, 0, 0, 0)
            case common.MAVLINK_MSG_ID_ATTITUDE_QUATERNION:
                return common.MAVLink_attitude_quaternion_message(ms, *self.q, *self.gyro)
            case common.MAVLINK_MSG_ID_LOCAL_POSITION_NED:
                return common.MAVLink_local_position_ned_message(ms, *self.position, *self.velocity)
        raise AssertionError(f"message {message_id} is offered but not written")


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
