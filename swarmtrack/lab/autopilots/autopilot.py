"""Small autopilots with real ones' manners: heartbeats, streams on request, a clock of their own, reboots, commands.

It has no I/O and no clock: `receive` takes a datagram, `step(now)` returns those due by then. `now` and every t here
are seconds on one clock of the caller's. What it senses comes from `Senses`: of a drone in a `World`, `DroneSenses`.

It has several ports, so that a ground station listens beside the companion. Each has its own streams; an answer goes to
the port that asked; what one side says is forwarded to the other, to whoever has spoken there.

Who flies is its `Pilot`: a path that is known beforehand, or whoever commands it.

ArduPilot is here, PX4 in `lab.autopilots.px4`. As measured on ArduCopter: nothing but heartbeats until asked; intervals
in whole milliseconds; DENIED above 333 Hz and for messages it does not offer; samples of several streams that are due
together share a datagram.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np
from pymavlink.dialects.v20 import common

from swarmtrack.lab.autopilots.channel import Channel, MavlinkAddress, SteadyReports, datagrams, target_of
from swarmtrack.lab.autopilots.external_position import RECEIVER_SOURCE, ardupilot_takes
from swarmtrack.lab.autopilots.firmware import ARDUCOPTER, Firmware, ModeNumbers
from swarmtrack.lab.autopilots.pilot import OnItsPath, Pilot
from swarmtrack.lab.autopilots.reports import INERTIAL, SENSED, TRUE
from swarmtrack.lab.autopilots.senses import SensedState, Senses
from swarmtrack.lab.autopilots.truth import TrueState
from swarmtrack.lab.autopilots.vehicle_parameters import VehicleParameters
from swarmtrack.mavlink_dialect import CURRENT_MODE, CurrentMode

SHORTEST_INTERVAL_US = 3000  # ArduCopter's loop of 400 Hz: 333 Hz is granted, 400 Hz is DENIED
LONGEST_INTERVAL_US = 60e6
HEARTBEAT_EVERY = 1.0  # s
RESTARTS_AFTER = 0.5  # s from the command to reboot
CATCH_UP = 0.5  # s: what was not sent for longer (the process was stopped) is not sent at all
RC_CHANNEL_COUNT, RC_FIELDS = 16, 18  # of its receiver, and of the message
RC_MIDDLE_US, RC_LOW_US = 1500, 1000  # of the sticks, and of a switch that is off
PORTS = 3  # the companion's, a ground station's, and one for who asks for the truth, as SITL has
SET_POINTS = ("SET_POSITION_TARGET_LOCAL_NED", "SET_POSITION_TARGET_GLOBAL_INT")
DATA_STREAMS = {
    common.MAV_DATA_STREAM_RAW_SENSORS: (common.MAVLINK_MSG_ID_RAW_IMU,),
    common.MAV_DATA_STREAM_EXTENDED_STATUS: (common.MAVLINK_MSG_ID_GPS_RAW_INT,),
    common.MAV_DATA_STREAM_POSITION: (
        common.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
        common.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    ),
    common.MAV_DATA_STREAM_RC_CHANNELS: (common.MAVLINK_MSG_ID_RC_CHANNELS,),
    common.MAV_DATA_STREAM_EXTRA1: (common.MAVLINK_MSG_ID_ATTITUDE,),
    common.MAV_DATA_STREAM_EXTRA3: (common.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,),
}
"""Of ArduCopter's groups, what we have of them."""
# Of the link they came by, hence not for others.
NOT_FORWARDED = frozenset({"RADIO", "RADIO_STATUS"})


class Truth(Protocol):
    """What a simulator knows of a drone at any time."""

    def at(self, t: float) -> TrueState: ...


class SimulatedVehicle:
    """boot_at: when it was switched on; skew: of its clock against the caller's [s/s]; offered: messages that can be
    asked for; truth: None where nobody knows it, and it is not offered; pilot: None: it flies a path of its own. Public
    attributes may be changed while it runs.

    mute: says nothing at all; imu_gap: sends no IMU messages, as if the sensor had failed; rc_us: where the pilot's
    sticks and switches are, by channel.
    """

    firmware: Firmware
    offers: tuple[int, ...]

    def __init__(
        self,
        senses: Senses,
        *,
        truth: Truth | None = None,
        pilot: Pilot | None = None,
        system: int = 1,
        component: int = 1,
        boot_at: float = 0.0,
        skew: float = 0.0,
        offered: tuple[int, ...] | None = None,
        ports: int = PORTS,
    ) -> None:
        self.senses = senses
        self.boot_at = boot_at
        self.skew = skew
        self.pilot: Pilot = pilot or OnItsPath()
        self.offered = tuple(
            n for n in (self.offers if offered is None else offered) if truth is not None or n not in TRUE
        )
        self.mute, self.imu_gap = False, False
        self.rc_us = 4 * [RC_MIDDLE_US] + (RC_CHANNEL_COUNT - 4) * [RC_LOW_US]
        self.own = MavlinkAddress(system, component)
        self.channels = tuple(Channel(self.own) for _ in range(ports))
        self.parameters = VehicleParameters(self.firmware.parameters, bytewise=self.firmware.bytewise)
        self.refused_datagrams = 0
        self._reboots_at = math.inf
        self._truth = truth
        self._sensed: tuple[int, SensedState] | None = None
        self._state_said: tuple[ModeNumbers, bool, ModeNumbers] | None = None
        self._odometry_late, self._odometry_resets = math.inf, 0

    def stamp(self, t: float) -> float:
        """Seconds since boot on its own clock."""
        return (t - self.boot_at) * (1.0 + self.skew)

    def time(self, stamp: float) -> float:
        """The inverse of `stamp`."""
        return self.boot_at + stamp / (1.0 + self.skew)

    def reboot(self, now: float) -> None:
        """Time begins again and every stream is forgotten."""
        self.boot_at, self._reboots_at = now, math.inf
        self.senses.rebooted(now)
        for channel in self.channels:
            channel.reset()

    def frame(self, message: Any) -> bytes:
        """As it is sent to the companion."""
        return self.channels[0].frame(message)

    # ── what comes ───────────────────────────────────────────────────────────────────────────────────────────────────

    def receive(self, data: bytes, now: float, port: int = 0) -> bool:
        """Take a datagram from a port; False if there was no valid message in it, whoever sent it."""
        messages = self.parse(data)
        for message in messages:
            self._route(message, now, self.channels[port])
        self.refused_datagrams += not messages
        return bool(messages)

    def parse(self, data: bytes) -> list[Any]:
        """The valid messages of a datagram. Each is read by itself: a cut one must not spoil the next."""
        parser = self.parser()
        try:
            messages = parser.parse_buffer(data) or []
        except common.MAVError:
            return []
        return [m for m in messages if m.get_type() != "BAD_DATA" and not m.get_type().startswith("UNKNOWN")]

    def parser(self) -> Any:
        parser = common.MAVLink(None)
        parser.robust_parsing = True
        return parser

    def _route(self, message: Any, now: float, origin: Channel) -> None:
        """Understand what concerns us, forward what concerns others, as ArduPilot's MAVLink_routing does."""
        sender = MavlinkAddress(message.get_srcSystem(), message.get_srcComponent())
        if sender == self.own:
            return  # a loop somewhere brings our own words back
        origin.heard.add(sender)
        target = target_of(message)
        if target.system in (0, self.own.system) and target.component in (0, self.own.component):
            self.understand(message, now, origin)
        if target == self.own or message.get_type() in NOT_FORWARDED:
            return
        for channel in self.channels:
            if channel is not origin and sender not in channel.heard and channel.reaches(target):
                channel.forward(bytes(message.get_msgbuf()))

    def understand(self, message: Any, now: float, channel: Channel) -> None:
        """Do what a message asks for; the answer goes to its channel."""
        match message.get_type():
            case "COMMAND_LONG" | "COMMAND_INT":
                self._acknowledge(message, self._command(message, now, channel), channel)
            case "SET_MODE" if message.base_mode & common.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
                result = self.pilot.set_mode(message.custom_mode, now)
                if self.firmware.acknowledges_set_mode:
                    ack = common.MAVLink_command_ack_message(common.MAVLINK_MSG_ID_SET_MODE, result)
                    channel.send(ack)
            case kind if kind in SET_POINTS:
                self.pilot.steer(message, now)
            case "ODOMETRY" if self.takes_odometry(message):
                self._take_odometry(message, now)
            case kind if kind.startswith("PARAM_"):
                for answer in self.parameters.answers(message):
                    channel.send(answer)
            case "TIMESYNC" if message.tc1 == 0:
                channel.send(common.MAVLink_timesync_message(int(self.stamp(now) * 1e9), message.ts1))

    def takes_odometry(self, message: Any) -> bool:
        """Whether its parameters let it go by that."""
        raise NotImplementedError

    def _take_odometry(self, message: Any, now: float) -> None:
        """Its stamp is of a clock that nobody told: what came quickest was there at once."""
        sent = 1e-6 * message.time_usec
        self._odometry_late = min(self._odometry_late, now - sent)
        cov = np.array(message.pose_covariance)
        var = np.where(np.isfinite(cov), cov, 0.0)[[0, 6, 11]]
        is_reset = message.reset_counter != self._odometry_resets
        self._odometry_resets = message.reset_counter
        position = np.array((message.x, message.y, message.z))
        self.senses.take_position(sent + self._odometry_late, position, var, is_reset=is_reset)

    def _command(self, command: Any, now: float, channel: Channel) -> int:
        """Do it, or not: the MAV_RESULT."""
        match command.command:
            case common.MAV_CMD_SET_MESSAGE_INTERVAL:
                return self.set_interval(command.param1, command.param2, now, channel)
            case common.MAV_CMD_REQUEST_MESSAGE:
                return self._send_once(command.param1, now, channel)
            case common.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN:
                return self._restart(command.param1, now)
        result = self.pilot.command(command, now)
        return int(common.MAV_RESULT_UNSUPPORTED) if result is None else result

    def _acknowledge(self, command: Any, result: int, channel: Channel) -> None:
        ack = common.MAVLink_command_ack_message(
            command.command,
            result,
            target_system=command.get_srcSystem(),
            target_component=command.get_srcComponent(),
        )
        channel.send(ack)

    def _send_once(self, message_id: float, now: float, channel: Channel) -> int:
        report = self._report(int(message_id), self.stamp(now)) if message_id in self.offered else None
        if report is None:
            return self.firmware.not_offered
        channel.send(report)
        return int(common.MAV_RESULT_ACCEPTED)

    def _restart(self, action: float, now: float) -> int:
        """On the ground only; soon, so that the answer gets away."""
        if self.pilot.armed or action != 1.0:
            return int(common.MAV_RESULT_DENIED)
        self._reboots_at = now + RESTARTS_AFTER
        return int(common.MAV_RESULT_ACCEPTED)

    def set_interval(
        self, message_id: float, interval_us: float, now: float, channel: Channel | None = None
    ) -> int:
        """SET_MESSAGE_INTERVAL: the MAV_RESULT. Negative stops a stream, 0 means its default.

        channel: None: the companion's.
        """
        if message_id not in self.offered or not math.isfinite(interval_us):
            return self.firmware.not_offered
        return self.grant(int(message_id), interval_us, self.stamp(now), channel or self.channels[0])

    def grant(self, message_id: int, interval_us: float, stamp: float, channel: Channel) -> int:
        """Change the stream of a message that is offered: the MAV_RESULT. stamp: now, on its own clock."""
        raise NotImplementedError

    # ── what goes ────────────────────────────────────────────────────────────────────────────────────────────────────

    def next_due(self, port: int = 0) -> float:
        """When `step` will have something to say there."""
        channel = self.channels[port]
        return min(channel.heartbeat_due, self.time(channel.next_due), self.pilot.due, self._reboots_at)

    def step(self, now: float, port: int = 0) -> list[bytes]:
        """The datagrams due by `now` at a port, oldest first."""
        if now >= self._reboots_at:
            self.reboot(now)
        if now >= self.pilot.due:
            self.pilot.poll(now)
        for severity, text in self.pilot.take_texts():
            for each in self.channels:
                each.send(common.MAVLink_statustext_message(severity, text.encode()))
        state = (self.pilot.mode, self.pilot.armed, self.pilot.intended)
        if state != self._state_said:
            # Each change of the mode is said at once.
            self._state_said = state
            for each in self.channels:
                each.heartbeat_due = min(each.heartbeat_due, now)
                if CURRENT_MODE in self.offered:
                    each.send(self._current_mode())
        channel = self.channels[port]
        frames = channel.drain()
        if now >= channel.heartbeat_due:
            channel.heartbeat_due = now + HEARTBEAT_EVERY
            frames.append(channel.frame(self._heartbeat()))
        frames.extend(self._due_streams(now, channel))
        return [] if self.mute else list(datagrams(frames))

    def _heartbeat(self) -> Any:
        _, flags, custom = self.pilot.mode
        return common.MAVLink_heartbeat_message(
            common.MAV_TYPE_QUADROTOR,
            self.firmware.autopilot,
            flags
            | common.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
            | (common.MAV_MODE_FLAG_SAFETY_ARMED if self.pilot.armed else 0),
            custom,
            self.pilot.status,
            3,
        )

    def _due_streams(self, now: float, channel: Channel) -> Iterator[bytes]:
        stamp = self.stamp(now)
        streams = channel.streams
        for stream in streams.values():
            if stamp - stream.due > CATCH_UP:
                stream.skip_to(stamp)
        while streams:
            message_id = min(streams, key=lambda message_id: streams[message_id].due)
            stream = streams[message_id]
            if stream.due > stamp:
                return
            sampled = stream.sampled
            stream.advance()
            report = None if self.imu_gap and message_id in INERTIAL else self._report(message_id, sampled)
            if report is not None:
                yield channel.frame(report)

    def _report(self, message_id: int, stamp: float) -> Any:
        """The message of a stream, of what was sensed at `stamp` [s] of its own clock; None: nothing."""
        if message_id in TRUE:
            assert self._truth is not None
            return TRUE[message_id](stamp, self._truth.at(self.time(stamp)))
        if message_id == common.MAVLINK_MSG_ID_EXTENDED_SYS_STATE:
            return common.MAVLink_extended_sys_state_message(0, self.pilot.landed)
        if message_id == common.MAVLINK_MSG_ID_RC_CHANNELS:
            return self._channels(stamp)
        if message_id == CURRENT_MODE:
            return self._current_mode()
        if message_id in INERTIAL:
            return INERTIAL[message_id](stamp, self.senses.inertial(self.time(stamp)))
        # Several streams are due at once: they tell of one and the same sample.
        us = round(stamp * 1e6)
        if self._sensed is None or self._sensed[0] != us:
            self._sensed = (us, self.senses.at(self.time(stamp)))
        return SENSED[message_id](stamp, self._sensed[1])

    def _current_mode(self) -> CurrentMode:
        return CurrentMode(0, self.pilot.mode.custom, self.pilot.intended.custom)

    def _channels(self, stamp: float) -> Any:
        n = len(self.rc_us)
        missing = (RC_FIELDS - n) * [self.firmware.no_channel]
        return common.MAVLink_rc_channels_message(round(stamp * 1e3), n, *self.rc_us, *missing, 255)


class SimulatedArduPilot(SimulatedVehicle):
    """ArduCopter."""

    firmware = ARDUCOPTER
    offers = (
        *INERTIAL,
        *SENSED,
        common.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,
        common.MAVLINK_MSG_ID_RC_CHANNELS,
        common.MAVLINK_MSG_ID_SIM_STATE,
    )

    source_set = 1
    """Whose sources its estimator goes by."""

    def select_source_set(self, number: int) -> None:
        """By the pilot's switch."""
        self._go_by(number)
        text = f"Using EKF Source Set {number}".encode()
        for channel in self.channels:
            channel.send(common.MAVLink_statustext_message(common.MAV_SEVERITY_INFO, text))

    def _go_by(self, number: int) -> None:
        self.source_set = number
        self.senses.goes_by_receiver = self.parameters.values.get(f"EK3_SRC{number}_POSXY") == RECEIVER_SOURCE

    def takes_odometry(self, message: Any) -> bool:
        return ardupilot_takes(message, self.parameters.values, self.source_set)

    def reboot(self, now: float) -> None:
        super().reboot(now)
        self._go_by(1)

    def understand(self, message: Any, now: float, channel: Channel) -> None:
        """Ground stations still ask for groups of messages, by REQUEST_DATA_STREAM."""
        super().understand(message, now, channel)
        if message.get_type() == "REQUEST_DATA_STREAM":
            hz = message.req_message_rate if message.start_stop else 0
            for group, members in DATA_STREAMS.items():
                if message.req_stream_id in (common.MAV_DATA_STREAM_ALL, group):
                    for message_id in members:
                        self.set_interval(message_id, 1e6 / hz if hz else -1.0, now, channel)

    def grant(self, message_id: int, interval_us: float, stamp: float, channel: Channel) -> int:
        """A stream's default is not to be sent."""
        asked = interval_us > 0
        if asked and not SHORTEST_INTERVAL_US <= interval_us <= LONGEST_INTERVAL_US:
            return int(common.MAV_RESULT_DENIED)
        channel.streams.pop(message_id, None)
        if asked:
            interval = (interval_us // 1000) * 1e-3  # whole milliseconds, rounded down
            channel.streams[message_id] = SteadyReports(interval, stamp)
        return int(common.MAV_RESULT_ACCEPTED)
