"""A companion and a ground station at the ports of a simulated autopilot: pymavlink, in simulated time."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega

from swarmtrack.lab.autopilots.autopilot import SimulatedVehicle

COMPANION, GROUND = 0, 1
GROUND_STATION = 255


class Peer:
    """A program at one port of an autopilot, speaking ardupilotmega's dialect."""

    def __init__(self, autopilot: SimulatedVehicle, port: int, system: int, component: int) -> None:
        self.autopilot = autopilot
        self.port = port
        self.heard: list[Any] = []
        self._mav = ardupilotmega.MAVLink(None, system, component)
        self._parser = ardupilotmega.MAVLink(None)

    def send(self, message: Any, now: float) -> None:
        assert self.autopilot.receive(message.pack(self._mav), now, self.port)

    def command(self, command: int, *values: float, now: float, system: int = 1) -> None:
        seven = [*values, *[0.0] * (7 - len(values))]
        self.send(ardupilotmega.MAVLink_command_long_message(system, 1, command, 0, *seven), now)

    def ask(self, message_id: int, hz: float, now: float) -> None:
        self.command(ardupilotmega.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, 1e6 / hz, now=now)

    def listen(self, now: float) -> None:
        for data in self.autopilot.step(now, self.port):
            self.heard += self._parser.parse_buffer(data) or []

    def of(self, kind: str) -> list[Any]:
        return [m for m in self.heard if m.get_type() == kind]


class Bench:
    """An autopilot with a companion and a ground station, in steps of a millisecond."""

    def __init__(self, autopilot: SimulatedVehicle, now: float = 0.0) -> None:
        self.now = now
        self.autopilot = autopilot
        self.companion = Peer(autopilot, COMPANION, 1, 191)
        self.ground = Peer(autopilot, GROUND, GROUND_STATION, 190)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 1e3)):
            self.now += 1e-3
            self.companion.listen(self.now)
            self.ground.listen(self.now)

    def until(self, condition: Callable[[], bool], patience: float = 60.0) -> float:
        """The seconds that it took."""
        began = self.now
        while not condition():
            assert self.now - began < patience, "it never came"
            self.run(0.02)
        return self.now - began

    def both_say_hello(self) -> None:
        for peer in (self.companion, self.ground):
            peer.send(ardupilotmega.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), self.now)

    # ── what a pilot at the ground station does ──────────────────────────────────────────────────────────────────────

    def order(self, command: int, *values: float) -> int:
        """The MAV_RESULT."""
        self.ground.command(command, *values, now=self.now)
        self.run(0.02)
        ack = self.ground.of("COMMAND_ACK")[-1]
        assert ack.command == command
        return int(ack.result)

    def mode(self, main: int, sub: int = 0) -> int:
        return self.order(ardupilotmega.MAV_CMD_DO_SET_MODE, 1, main, sub)

    def arm(self, on: bool = True) -> int:
        return self.order(ardupilotmega.MAV_CMD_COMPONENT_ARM_DISARM, float(on))

    def take_off(self, height: float) -> int:
        return self.order(ardupilotmega.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, math.nan, 0, 0, height)

    def land(self) -> int:
        return self.order(ardupilotmega.MAV_CMD_NAV_LAND)

    def set_point(
        self,
        *,
        position: tuple[float, float, float] | None = None,
        velocity: tuple[float, float, float] | None = None,
        yaw: float | None = None,
        yaw_rate: float | None = None,
        frame: int = ardupilotmega.MAV_FRAME_LOCAL_NED,
    ) -> None:
        """Of what is None, the type mask says that it is to be ignored."""
        ignored = 0b111 << 6 | (0b111 if position is None else 0) | (0b111 << 3 if velocity is None else 0)
        ignored |= (1 << 10 if yaw is None else 0) | (1 << 11 if yaw_rate is None else 0)
        x, v = position or (0.0, 0.0, 0.0), velocity or (0.0, 0.0, 0.0)
        message = ardupilotmega.MAVLink_set_position_target_local_ned_message(
            0, 1, 1, frame, ignored, *x, *v, 0, 0, 0, yaw or 0.0, yaw_rate or 0.0
        )
        self.ground.send(message, self.now)

    def keep_telling(self, seconds: float, **point: Any) -> None:
        """A set point at 10 Hz."""
        for _ in range(round(seconds * 10.0)):
            self.set_point(**point)
            self.run(0.1)

    @property
    def texts(self) -> list[str]:
        return [m.text for m in self.ground.of("STATUSTEXT")]
