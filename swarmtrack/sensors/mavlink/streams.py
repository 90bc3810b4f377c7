"""Which messages we ask the autopilot for, how often, and whether they come.

ArduPilot sends nothing but heartbeats until asked; PX4 sends its own choice. So each stream is asked for by
SET_MESSAGE_INTERVAL, one command at a time because COMMAND_ACK does not say which one it answers, and then watched:
what comes at less than 80 % of its rate over two seconds is asked for again (another program may have changed it, the
autopilot may have rebooted). A DENIED rate is too high: the next try is 0.8 of it, and that is remembered.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common

from swarmtrack.messages import Array
from swarmtrack.sensors.mavlink.framer import CRC_LENGTH, HEADER_V2, PAYLOAD_SIZE, SIGNATURE_LENGTH

STANDARD_GRAVITY = 9.80665  # m/s²: accelerations come in thousandths of it
WINDOW = 2.0  # s over which a rate is measured
ENOUGH = 0.8  # of the target; below it the stream is asked for again
BACK_OFF = 0.8  # of a denied rate is asked for next
LOWEST_RATE = 10.0  # Hz: denied below it, the message itself is not offered
ACK_TIMEOUT = 1.0  # s: a busy link takes 0.2 s
ATTEMPTS = 3  # unanswered ones, before the command counts as not understood
AGAIN_AFTER = 4.0  # s before a slow stream is asked for again, doubling up to AGAIN_AT_MOST
AGAIN_AT_MOST = 30.0
ATTITUDE_RATE = 50.0  # Hz
# Hz: carried on by its velocity in between, at 5 m/s² to 4 mm and to 25 mm.
LOCAL_POSITION_RATE, GLOBAL_POSITION_RATE = 25.0, 10.0
FIX_RATE = 5.0  # Hz: that of most receivers
LINE_SHARE = 0.7  # of what the line carries may be ours; the rest is for parameters and other programs

NOT_MEASURED = np.full(3, np.nan)
HIGHRES_IMU: int = common.MAVLINK_MSG_ID_HIGHRES_IMU
RAW_IMU: int = common.MAVLINK_MSG_ID_RAW_IMU
SCALED_IMU: int = common.MAVLINK_MSG_ID_SCALED_IMU
ATTITUDE_QUATERNION: int = common.MAVLINK_MSG_ID_ATTITUDE_QUATERNION
LOCAL_POSITION_NED: int = common.MAVLINK_MSG_ID_LOCAL_POSITION_NED
GLOBAL_POSITION_INT: int = common.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
GPS_RAW_INT: int = common.MAVLINK_MSG_ID_GPS_RAW_INT

# Message and rate [Hz], beside the attitude.
LOCAL_POSE: dict[int, float] = {LOCAL_POSITION_NED: LOCAL_POSITION_RATE}
GLOBAL_POSE: dict[int, float] = {GLOBAL_POSITION_INT: GLOBAL_POSITION_RATE, GPS_RAW_INT: FIX_RATE}


@dataclass(frozen=True, slots=True)
class ImuMessage:
    """A message that carries the body's angular velocity.

    stamp: s since boot of a message; read: its gyro (3,) rad/s and accel (3,) m/s², FRD, as sent; numbered: has a
    field `id` for the sensor, 0 the first.
    """

    id: int
    name: str
    stamp: Callable[[Any], float]
    read: Callable[[Any], tuple[Array, Array]]
    numbered: bool = False


def _read_highres(m: Any) -> tuple[Array, Array]:
    return np.array((m.xgyro, m.ygyro, m.zgyro)), np.array((m.xacc, m.yacc, m.zacc))


def _read_milli(m: Any) -> tuple[Array, Array]:
    # RAW_IMU is not raw: both autopilots send calibrated mrad/s and mG.
    gyro = np.array((m.xgyro, m.ygyro, m.zgyro)) * 1e-3
    return gyro, np.array((m.xacc, m.yacc, m.zacc)) * (STANDARD_GRAVITY * 1e-3)


def _read_rates(m: Any) -> tuple[Array, Array]:
    return np.array((m.rollspeed, m.pitchspeed, m.yawspeed)), NOT_MEASURED


def _microseconds(m: Any) -> float:
    return float(m.time_usec) * 1e-6


def _milliseconds(m: Any) -> float:
    return float(m.time_boot_ms) * 1e-3


# Best first: microseconds and floats; then microseconds; then milliseconds; then rates of the estimator.
IMU_MESSAGES = (
    ImuMessage(HIGHRES_IMU, "HIGHRES_IMU", _microseconds, _read_highres, numbered=True),
    ImuMessage(RAW_IMU, "RAW_IMU", _microseconds, _read_milli, numbered=True),
    ImuMessage(SCALED_IMU, "SCALED_IMU", _milliseconds, _read_milli),
    ImuMessage(ATTITUDE_QUATERNION, "ATTITUDE_QUATERNION", _milliseconds, _read_rates),
)


class Answer(enum.Enum):
    """Where a stream's request stands."""

    TO_ASK = enum.auto()
    ASKED = enum.auto()
    ACCEPTED = enum.auto()
    SILENT = enum.auto()  # the command is never answered: an old autopilot, or a one-way link
    REFUSED = enum.auto()


class MessageStream:
    """One message we want: `asked_hz` by the user, `target_hz` after denials, `rate_hz` got."""

    def __init__(self, message_id: int, asked_hz: float) -> None:
        self.id = message_id
        self.asked_hz = asked_hz
        self.target_hz = asked_hz
        self.rate_hz = 0.0
        self.answer = Answer.TO_ASK
        self.count = 0  # in the present window
        self.attempts = 0
        self.again_after = AGAIN_AFTER
        self.answered_at: float | None = None

    def ask_again(self) -> None:
        self.answer = Answer.TO_ASK
        self.attempts = 0


class StreamRequests:
    """Asks, watches and asks again. `tick` and `acknowledged` return the messages to send now."""

    def __init__(self, imu_rate_hz: float, positions: dict[int, float] = LOCAL_POSE) -> None:
        self.imu_rate_hz = imu_rate_hz
        self._positions = positions
        self._granted: dict[int, float] = {}  # target rates after denials, which outlive a reboot
        self.reset()

    def reset(self) -> None:
        """Everything must be asked for again: the connection is new or the autopilot has rebooted."""
        self._rank = 0
        self._busy: MessageStream | None = None
        self._sent_at = 0.0
        self._window_start: float | None = None
        self._not_before = 0.0
        self.legacy = False
        self._choose()

    @property
    def imu(self) -> ImuMessage:
        """The message asked for as the source of angular velocity."""
        return IMU_MESSAGES[self._rank]

    @property
    def imu_stream(self) -> MessageStream:
        return self.streams[self.imu.id]

    def _choose(self) -> None:
        rates = {self.imu.id: self.imu_rate_hz}
        rates[ATTITUDE_QUATERNION] = max(ATTITUDE_RATE, rates.get(ATTITUDE_QUATERNION, 0.0))
        rates |= self._positions
        self.streams = {i: MessageStream(i, rate) for i, rate in rates.items()}
        for i, granted in self._granted.items():
            if i in self.streams:
                self.streams[i].target_hz = min(granted, rates[i])

    def bytes_per_second(self, signed: bool) -> float:
        """What the wanted streams put on the line, all of them at their target rates."""
        overhead = HEADER_V2 + CRC_LENGTH + (SIGNATURE_LENGTH if signed else 0)
        return sum((PAYLOAD_SIZE[s.id] + overhead) * s.target_hz for s in self.streams.values())

    def arrived(self, message_id: int) -> None:
        stream = self.streams.get(message_id)
        if stream is not None:
            stream.count += 1

    def tick(self, now: float, system: int) -> list[Any]:
        """Measure, and ask for what is missing."""
        self.measure(now)
        if self._busy is not None and now - self._sent_at > ACK_TIMEOUT:
            if self._busy.attempts >= ATTEMPTS:
                self._busy.answer = Answer.SILENT
                self._busy.answered_at = now
                self.legacy = True
            else:
                self._busy.answer = Answer.TO_ASK
            self._busy = None
        return self._ask(now, system)

    def measure(self, now: float) -> None:
        """Once per window: note the rates, and mark what came too slowly to be asked for again."""
        if self._window_start is None:
            self._window_start = now
        elapsed = now - self._window_start
        if elapsed < WINDOW:
            return
        self._window_start = now
        for stream in self.streams.values():
            stream.rate_hz, stream.count = stream.count / elapsed, 0
            if stream.rate_hz >= ENOUGH * stream.target_hz:
                stream.again_after = AGAIN_AFTER
            elif (
                stream.answer not in (Answer.TO_ASK, Answer.ASKED)
                and stream.answered_at is not None
                and now - stream.answered_at >= stream.again_after
            ):
                stream.again_after = min(2 * stream.again_after, AGAIN_AT_MOST)
                stream.ask_again()
        imu = self.imu_stream
        if (
            imu.answer is Answer.TO_ASK
            and imu.attempts == 0
            and imu.rate_hz == 0.0
            and imu.answered_at is not None
        ):
            self._fall_back(now)

    def acknowledged(self, result: int, now: float, system: int) -> list[Any]:
        """COMMAND_ACK for SET_MESSAGE_INTERVAL has come."""
        stream = self._busy
        if stream is None or result == common.MAV_RESULT_IN_PROGRESS:
            return []
        self._busy = None
        stream.answered_at = now
        if result == common.MAV_RESULT_ACCEPTED:
            stream.answer = Answer.ACCEPTED
        elif result == common.MAV_RESULT_DENIED and BACK_OFF * stream.target_hz >= LOWEST_RATE:
            stream.target_hz *= BACK_OFF
            self._granted[stream.id] = stream.target_hz
            stream.ask_again()
        else:
            stream.answer = Answer.REFUSED
            # Not even the lowest rate: it was the message that is not offered, forget what we learned of its rate.
            self._granted.pop(stream.id, None)
            stream.target_hz = stream.asked_hz
            if result == common.MAV_RESULT_UNSUPPORTED:
                self.legacy = True
            if stream is self.imu_stream and stream.rate_hz == 0.0:
                self._fall_back(now)
        return self._ask(now, system)

    def _fall_back(self, now: float) -> None:
        """Try the next source of angular velocity; after the last, and a pause, the first again."""
        old = self.streams
        self._rank = (self._rank + 1) % len(IMU_MESSAGES)
        if self._rank == 0:
            self._not_before = now + AGAIN_AFTER
        self._choose()
        for i, stream in old.items():
            if i in self.streams and self.streams[i].asked_hz == stream.asked_hz and self._rank:
                self.streams[i] = stream
        if self._busy is not None and self._busy not in self.streams.values():
            self._busy = None

    def _ask(self, now: float, system: int) -> list[Any]:
        if self._busy is not None or now < self._not_before:
            return []
        stream = next((s for s in self.streams.values() if s.answer is Answer.TO_ASK), None)
        if stream is None:
            return []
        self._busy, self._sent_at = stream, now
        stream.answer = Answer.ASKED
        stream.attempts += 1
        messages = [
            common.MAVLink_command_long_message(
                target_system=system,
                target_component=common.MAV_COMP_ID_AUTOPILOT1,
                command=common.MAV_CMD_SET_MESSAGE_INTERVAL,
                confirmation=0,
                param1=stream.id,
                param2=round(1e6 / stream.target_hz),
                param3=0,
                param4=0,
                param5=0,
                param6=0,
                param7=0,
            )
        ]
        if self.legacy:
            messages.append(_data_stream(stream, system))
        return messages


# The old way, for autopilots that do not know intervals: groups of messages at one rate.
_GROUPS: dict[int, int] = {
    ATTITUDE_QUATERNION: common.MAV_DATA_STREAM_EXTRA1,
    LOCAL_POSITION_NED: common.MAV_DATA_STREAM_POSITION,
    GLOBAL_POSITION_INT: common.MAV_DATA_STREAM_POSITION,
    GPS_RAW_INT: common.MAV_DATA_STREAM_EXTENDED_STATUS,
}


def _data_stream(stream: MessageStream, system: int) -> Any:
    return common.MAVLink_request_data_stream_message(
        target_system=system,
        target_component=common.MAV_COMP_ID_AUTOPILOT1,
        req_stream_id=_GROUPS.get(stream.id, common.MAV_DATA_STREAM_RAW_SENSORS),
        req_message_rate=round(stream.target_hz),
        start_stop=1,
    )


class StampStep(enum.Enum):
    """What a stamp means after those before it."""

    NEXT = enum.auto()
    REPEATED = enum.auto()  # the same again, or a little back: drop it
    REBOOT = enum.auto()


class Cadence:
    """Counts what is missing, doubled or out of order in one stream, by its stamps alone.

    gaps: intervals of at least GAP times the usual one; lost: samples missing in them; repeated: dropped ones.
    """

    GAP = 1.8  # of the mean interval: ArduPilot at 333 Hz alternates 2.5 and 5.0 ms, 1.67 times their mean
    REBOOT = 1.0  # s back in time
    LEARNING = 20  # intervals that make a mean, and gaps in a row that mean a new rate
    MEMORY = 200  # intervals

    def __init__(self) -> None:
        self.gaps = 0
        self.lost = 0
        self.repeated = 0
        self.reset()

    def reset(self) -> None:
        """Forget the usual interval and the last stamp; the counters stay."""
        self.newest: float | None = None
        self.period = 0.0
        self._seen = 0
        self._gaps_in_a_row = 0
        self._just_lost = 0

    def observe(self, stamp: float) -> StampStep:
        """Judge the next stamp [s]."""
        if self.newest is None:
            self.newest = stamp
            return StampStep.NEXT
        interval = stamp - self.newest
        if interval < -self.REBOOT:
            return StampStep.REBOOT
        if interval <= 0:
            self.repeated += 1
            # A sample that was packed a moment late carries the next one's stamp: doubled, but not lost.
            if self._just_lost:
                self._just_lost -= 1
                self.lost -= 1
            return StampStep.REPEATED
        self.newest = stamp
        if self._seen >= self.LEARNING and interval > self.GAP * self.period:
            self.gaps += 1
            self._just_lost = round(interval / self.period) - 1
            self.lost += self._just_lost
            self._gaps_in_a_row += 1
            if self._gaps_in_a_row == self.LEARNING:
                self._seen = self._gaps_in_a_row = 0
            return StampStep.NEXT
        self._gaps_in_a_row = self._just_lost = 0
        self._seen += 1
        self.period += (interval - self.period) / min(self._seen, self.MEMORY)
        return StampStep.NEXT
