"""Streams requested from the autopilot: messages, rates, and whether they arrive.

ArduPilot sends nothing but heartbeats until asked; PX4 sends its own choice. So each stream is asked for by
SET_MESSAGE_INTERVAL, one command at a time because COMMAND_ACK does not say which one it answers, and then watched:
what comes at less than 80 % of its rate over two seconds is asked for again (another program may have changed it, the
autopilot may have rebooted). A DENIED rate is too high: the next try is 0.8 of it, and that is remembered.

An ACCEPTED rate may still never come. PX4 sends the newest sample when one is due, so of a sensor at 250 Hz it makes
125 Hz where 200 are asked for. More than half of what was asked comes in any case, unless the sensor itself is slower;
so such a stream is asked for once at double, and stays so where that helps.
"""

from __future__ import annotations

import enum
import math
import statistics
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.boot_clock import MICROSECONDS_WRAP_S, MILLISECONDS_WRAP_S
from swarmtrack.autopilot.candidates import AutopilotAddress
from swarmtrack.autopilot.framer import CRC_LENGTH, HEADER_V2, PAYLOAD_SIZE, SIGNATURE_LENGTH
from swarmtrack.autopilot.limits import (
    ATTITUDE_HZ,
    COMMAND_ACK_TIMEOUT_S,
    COMMAND_ATTEMPTS,
    DENIED_RATE_FACTOR,
    GLOBAL_POSITION_HZ,
    GPS_FIX_HZ,
    LINE_SHARE,
    LOCAL_POSITION_HZ,
    LOWEST_STREAM_HZ,
    MISSED_RATE_FACTOR,
    RANGE_FINDER_HZ,
    STREAM_ASKED_AGAIN_S,
    STREAM_LONGEST_ASKED_AGAIN_S,
    STREAM_RATE_SHARE,
    STREAM_RATE_WINDOW_S,
)
from swarmtrack.autopilot.pilot_switch import RC_CHANNELS
from swarmtrack.geometry.geodesy import STANDARD_GRAVITY_M_S2
from swarmtrack.mavlink_dialect import CURRENT_MODE

Triple = tuple[float, float, float]
NOT_MEASURED: Triple = (math.nan, math.nan, math.nan)
HIGHRES_IMU: int = common.MAVLINK_MSG_ID_HIGHRES_IMU
RAW_IMU: int = common.MAVLINK_MSG_ID_RAW_IMU
SCALED_IMU: int = common.MAVLINK_MSG_ID_SCALED_IMU
SCALED_IMU2: int = common.MAVLINK_MSG_ID_SCALED_IMU2
SCALED_IMU3: int = common.MAVLINK_MSG_ID_SCALED_IMU3
ATTITUDE_QUATERNION: int = common.MAVLINK_MSG_ID_ATTITUDE_QUATERNION
ATTITUDE: int = common.MAVLINK_MSG_ID_ATTITUDE
LOCAL_POSITION_NED: int = common.MAVLINK_MSG_ID_LOCAL_POSITION_NED
ODOMETRY: int = common.MAVLINK_MSG_ID_ODOMETRY
GLOBAL_POSITION_INT: int = common.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
GPS_RAW_INT: int = common.MAVLINK_MSG_ID_GPS_RAW_INT
GPS2_RAW: int = common.MAVLINK_MSG_ID_GPS2_RAW
DISTANCE_SENSOR: int = common.MAVLINK_MSG_ID_DISTANCE_SENSOR

# Message and rate [Hz], beside the attitude.
LOCAL_POSE: dict[int, float] = {LOCAL_POSITION_NED: LOCAL_POSITION_HZ}
GLOBAL_POSE: dict[int, float] = {
    GLOBAL_POSITION_INT: GLOBAL_POSITION_HZ,
    GPS_RAW_INT: GPS_FIX_HZ,
    GPS2_RAW: GPS_FIX_HZ,
}
# What many drones do not have: it is asked for once, after all else.
OPTIONAL: dict[int, float] = {DISTANCE_SENSOR: RANGE_FINDER_HZ}
# Asked for once, and missed by nobody; and in none of the groups by which old autopilots are asked.
NOT_MISSED = frozenset({*OPTIONAL, CURRENT_MODE, GPS2_RAW})
# Best first. Old firmwares, and those that speak MAVLink 1 only, know no quaternion.
ATTITUDE_MESSAGES = (ATTITUDE_QUATERNION, ATTITUDE)


@dataclass(frozen=True, slots=True)
class ImuMessage:
    """A message that carries the body's angular velocity.

    stamp: s since boot of a message; wrap_s: after which that begins again where it is counted in 32 bits; read: its
    gyro rad/s and accel m/s², FRD, as sent; numbered: has a field `id` for the sensor, 0 the first; asked:
    requested, not only read where it comes.
    """

    id: int
    name: str
    stamp: Callable[[Any], float]
    read: Callable[[Any], tuple[Triple, Triple]]
    wrap_s: float
    numbered: bool = False
    asked: bool = True


def _read_highres(m: Any) -> tuple[Triple, Triple]:
    return (m.xgyro, m.ygyro, m.zgyro), (m.xacc, m.yacc, m.zacc)


def _read_milli(m: Any) -> tuple[Triple, Triple]:
    # RAW_IMU is not raw: both autopilots send calibrated mrad/s and mG.
    g = STANDARD_GRAVITY_M_S2 * 1e-3
    return (m.xgyro * 1e-3, m.ygyro * 1e-3, m.zgyro * 1e-3), (m.xacc * g, m.yacc * g, m.zacc * g)


def _read_rates(m: Any) -> tuple[Triple, Triple]:
    return (m.rollspeed, m.pitchspeed, m.yawspeed), NOT_MEASURED


def _microseconds(m: Any) -> float:
    return float(m.time_usec) * 1e-6


def _milliseconds(m: Any) -> float:
    return float(m.time_boot_ms) * 1e-3


# Best first: microseconds and floats; then microseconds; then milliseconds; then those of further sensors, where the
# first is broken; then rates of the estimator.
IMU_MESSAGES = (
    ImuMessage(HIGHRES_IMU, "HIGHRES_IMU", _microseconds, _read_highres, MICROSECONDS_WRAP_S, numbered=True),
    ImuMessage(RAW_IMU, "RAW_IMU", _microseconds, _read_milli, MICROSECONDS_WRAP_S, numbered=True),
    ImuMessage(SCALED_IMU, "SCALED_IMU", _milliseconds, _read_milli, MILLISECONDS_WRAP_S),
    ImuMessage(SCALED_IMU2, "SCALED_IMU2", _milliseconds, _read_milli, MILLISECONDS_WRAP_S, asked=False),
    ImuMessage(SCALED_IMU3, "SCALED_IMU3", _milliseconds, _read_milli, MILLISECONDS_WRAP_S, asked=False),
    ImuMessage(ATTITUDE_QUATERNION, "ATTITUDE_QUATERNION", _milliseconds, _read_rates, MILLISECONDS_WRAP_S),
    ImuMessage(ATTITUDE, "ATTITUDE", _milliseconds, _read_rates, MILLISECONDS_WRAP_S),
)


class Answer(enum.Enum):
    """State of a stream's request."""

    TO_ASK = enum.auto()
    ASKED = enum.auto()
    ACCEPTED = enum.auto()
    SILENT = enum.auto()  # the command is never answered: an old autopilot, or a one-way link
    REFUSED = enum.auto()


class MessageStream:
    """One requested message: `asked_hz` by the user, `target_hz` after denials, `rate_hz` measured.

    factor: times the target that is requested; came: enough of it did, since it was granted; count, useless: messages
    in the present window, and those of them with impossible values.
    """

    def __init__(self, message_id: int, asked_hz: float) -> None:
        self.id = message_id
        self.asked_hz = asked_hz
        self.target_hz = asked_hz
        self.rate_hz = 0.0
        self.factor = 1.0
        self.came = False
        self.answer = Answer.TO_ASK
        self.count = self.useless = 0
        self.attempts = 0
        self.again_after = STREAM_ASKED_AGAIN_S
        self.answered_at: float | None = None

    def ask_again(self) -> None:
        self.answer = Answer.TO_ASK
        self.attempts = 0

    @property
    def request_hz(self) -> float:
        return self.factor * self.target_hz

    @property
    def optional(self) -> bool:
        """Whether its absence is not a fault."""
        return self.id in NOT_MISSED


class StreamRequests:
    """Requests streams, watches them and requests again. `tick` and `acknowledged` return the messages to send now.

    line: bytes per second that the link carries, None where it hardly matters; signed: all frames are.
    """

    def __init__(
        self,
        imu_rate_hz: float,
        positions: dict[int, float] = LOCAL_POSE,
        *,
        line: float | None = None,
        signed: bool = False,
    ) -> None:
        self.imu_rate_hz = imu_rate_hz
        self._positions = positions
        self._line = line
        self._signed = signed
        # By message, and they outlive a reboot: target rates after denials; factors that were tried, 1: in vain.
        self._granted: dict[int, float] = {}
        self._factors: dict[int, float] = {}
        self.reset()

    def reset(self) -> None:
        """Request everything again: the connection is new or the autopilot has rebooted."""
        self._rank = 0
        self._attitude = ATTITUDE_MESSAGES[0]
        self._busy: MessageStream | None = None
        self._sent_at = 0.0
        self._window_start: float | None = None
        self._not_before, self._pause = 0.0, STREAM_ASKED_AGAIN_S
        self.legacy = False
        self._choose()

    @property
    def imu(self) -> ImuMessage:
        """The message requested as the source of angular velocity."""
        return IMU_MESSAGES[self._rank]

    @property
    def imu_stream(self) -> MessageStream:
        return self.streams[self.imu.id]

    def _choose(self) -> None:
        rates = {self.imu.id: self.imu_rate_hz}
        rates[self._attitude] = max(ATTITUDE_HZ, rates.get(self._attitude, 0.0))
        rates |= self._positions | OPTIONAL
        self.streams = {i: MessageStream(i, rate) for i, rate in rates.items()}
        for i, granted in self._granted.items():
            if i in self.streams:
                self.streams[i].target_hz = min(granted, rates[i])
        for i, factor in self._factors.items():
            if i in self.streams:
                self.streams[i].factor = factor

    @property
    def bytes_per_second(self) -> float:
        """Load of all requested streams on the line."""
        overhead = HEADER_V2 + CRC_LENGTH + (SIGNATURE_LENGTH if self._signed else 0)
        coming = (s for s in self.streams.values() if s.came or not s.optional)
        return sum((PAYLOAD_SIZE[s.id] + overhead) * s.request_hz for s in coming)

    @property
    def line_share(self) -> float:
        """Share of the line that the requested streams take; 0 where it hardly matters."""
        return 0.0 if self._line is None else self.bytes_per_second / self._line

    def arrived(self, message_id: int) -> None:
        stream = self.streams.get(message_id)
        if stream is not None:
            stream.count += 1

    def useless(self, message_id: int) -> None:
        """A message that has arrived has impossible values: where all do, it is as good as absent."""
        stream = self.streams.get(message_id)
        if stream is not None:
            stream.useless += 1

    def tick(self, now: float, target: AutopilotAddress) -> list[Any]:
        """Measure, and request what is missing."""
        self.measure(now)
        if self._busy is not None and now - self._sent_at > COMMAND_ACK_TIMEOUT_S:
            if self._busy.attempts >= COMMAND_ATTEMPTS:
                self._busy.answer = Answer.SILENT
                self._busy.answered_at = now
                self.legacy = self.legacy or not self._busy.optional
            else:
                self._busy.answer = Answer.TO_ASK
            self._busy = None
        return self._ask(now, target)

    def measure(self, now: float) -> None:
        """Once per window: note the rates, and mark slow streams to be requested again."""
        if self._window_start is None:
            self._window_start = now
        elapsed = now - self._window_start
        if elapsed < STREAM_RATE_WINDOW_S:
            return
        self._window_start = now
        for stream in self.streams.values():
            usable = stream.count if stream.useless < stream.count else 0
            stream.rate_hz, stream.count, stream.useless = usable / elapsed, 0, 0
            if stream.rate_hz >= STREAM_RATE_SHARE * stream.target_hz:
                stream.again_after, stream.came = STREAM_ASKED_AGAIN_S, True
                if stream.factor != 1.0:
                    self._factors[stream.id] = stream.factor
            elif (
                stream.answer not in (Answer.TO_ASK, Answer.ASKED)
                and stream.answered_at is not None
                and now - stream.answered_at >= stream.again_after
                and (stream.came or not stream.optional)
            ):
                if not self._try_double(stream):
                    stream.again_after = min(2 * stream.again_after, STREAM_LONGEST_ASKED_AGAIN_S)
                stream.ask_again()
        if _is_absent(self.imu_stream):
            self._fall_back(now)
        if _is_absent(self.streams[self._attitude]):
            self._ask_other_attitude()

    def _measure_from(self, now: float) -> None:
        """Begin the window again: a rate is that of one grant."""
        self._window_start = now
        for stream in self.streams.values():
            stream.count = stream.useless = 0

    def _try_double(self, stream: MessageStream) -> bool:
        """A granted rate has not come: ask for twice as much, or take that back. False where nothing is to be tried."""
        granted = stream.answer is Answer.ACCEPTED and stream.rate_hz > 0.0
        if not granted or stream.came or stream.id in self._factors:
            return False
        if stream.factor != 1.0:
            self._factors[stream.id] = stream.factor = 1.0
            return True
        stream.factor = MISSED_RATE_FACTOR
        if self.line_share > LINE_SHARE:
            # The line would not carry it, and may be what is too slow.
            self._factors[stream.id] = stream.factor = 1.0
            return False
        return True

    def acknowledged(self, result: int, now: float, target: AutopilotAddress) -> list[Any]:
        """COMMAND_ACK for SET_MESSAGE_INTERVAL has come."""
        stream = self._busy
        if stream is None or result == common.MAV_RESULT_IN_PROGRESS:
            return []
        self._busy = None
        stream.answered_at = now
        if result == common.MAV_RESULT_ACCEPTED:
            stream.answer, stream.came = Answer.ACCEPTED, False
            self._measure_from(now)
        elif result == common.MAV_RESULT_DENIED and stream.factor != 1.0:
            self._factors[stream.id] = stream.factor = 1.0
            stream.ask_again()
        elif result == common.MAV_RESULT_DENIED and DENIED_RATE_FACTOR * stream.target_hz >= LOWEST_STREAM_HZ:
            stream.target_hz *= DENIED_RATE_FACTOR
            self._granted[stream.id] = stream.target_hz
            stream.ask_again()
        else:
            stream.answer = Answer.REFUSED
            # Not even the lowest rate: it was the message that is not offered, forget what we learned of its rate.
            self._granted.pop(stream.id, None)
            stream.target_hz = stream.asked_hz
            if result == common.MAV_RESULT_UNSUPPORTED and not stream.optional:
                self.legacy = True
            if stream is self.imu_stream and stream.rate_hz == 0.0:
                self._fall_back(now)
            # Of the second one, only after a while.
            if stream.id == self._attitude == ATTITUDE_MESSAGES[0] and stream.rate_hz == 0.0:
                self._ask_other_attitude()
        return self._ask(now, target)

    def _fall_back(self, now: float) -> None:
        """Try the next source of angular velocity; after the last, and a pause, the first again."""
        asked = [rank for rank, message in enumerate(IMU_MESSAGES) if message.asked]
        self._rank = next((rank for rank in asked if rank > self._rank), 0)
        if self._rank == 0:
            self._not_before = now + self._pause
            self._pause = min(2 * self._pause, STREAM_LONGEST_ASKED_AGAIN_S)
        self._choose_again(keeps=self._rank != 0)

    def _ask_other_attitude(self) -> None:
        """The attitude has not come as one message: request the other."""
        first, second = ATTITUDE_MESSAGES
        self._attitude = second if self._attitude == first else first
        self._choose_again(keeps=True)

    def _choose_again(self, *, keeps: bool) -> None:
        """keeps: what was learned of streams that are still wanted."""
        old = self.streams
        self._choose()
        for i, stream in old.items():
            if keeps and i in self.streams and self.streams[i].asked_hz == stream.asked_hz:
                self.streams[i] = stream
        if self._busy is not None and self._busy not in self.streams.values():
            self._busy = None

    def _ask(self, now: float, target: AutopilotAddress) -> list[Any]:
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
                target_system=target.system,
                target_component=target.component,
                command=common.MAV_CMD_SET_MESSAGE_INTERVAL,
                confirmation=0,
                param1=stream.id,
                param2=round(1e6 / stream.request_hz),
                param3=0,
                param4=0,
                param5=0,
                param6=0,
                param7=0,
            )
        ]
        if self.legacy and not stream.optional:
            messages.append(_data_stream(stream, target))
        return messages


def _is_absent(stream: MessageStream) -> bool:
    """Whether it was answered, has not come, and is to be requested again."""
    again = stream.answer is Answer.TO_ASK and stream.attempts == 0
    return again and stream.rate_hz == 0.0 and stream.answered_at is not None


# The old way, for autopilots that do not know intervals: groups of messages at one rate.
_GROUPS: dict[int, int] = {
    ATTITUDE_QUATERNION: common.MAV_DATA_STREAM_EXTRA1,
    ATTITUDE: common.MAV_DATA_STREAM_EXTRA1,
    LOCAL_POSITION_NED: common.MAV_DATA_STREAM_POSITION,
    GLOBAL_POSITION_INT: common.MAV_DATA_STREAM_POSITION,
    GPS_RAW_INT: common.MAV_DATA_STREAM_EXTENDED_STATUS,
    RC_CHANNELS: common.MAV_DATA_STREAM_RC_CHANNELS,
}


def _data_stream(stream: MessageStream, target: AutopilotAddress) -> Any:
    return common.MAVLink_request_data_stream_message(
        target_system=target.system,
        target_component=target.component,
        req_stream_id=_GROUPS.get(stream.id, common.MAV_DATA_STREAM_RAW_SENSORS),
        req_message_rate=round(stream.request_hz),
        start_stop=1,
    )


class Gap(NamedTuple):
    """An interval that is longer than usual. run: usual intervals since the last one; ticks: usual ones in it; lost:
    samples, None: the sender left out what is missing, as its frames' numbers prove."""

    run: int
    ticks: int
    lost: int | None


class Rhythm(NamedTuple):
    """Gaps that repeat: of `ticks` usual intervals, after a run of `run` of them, or of one more."""

    run: int
    ticks: int


class Cadence:
    """Counts what is missing, doubled or out of order in one stream, by its stamps alone.

    gaps: intervals of at least GAP times the usual one; lost: samples missing in them; repeated: dropped ones.

    A sender whose rate is not a whole part of its sensor's leaves samples out by a rule: 200 of 250 Hz go as 4, 4, 4,
    8 ms. A receiver that learned 4 ms earlier sees gaps, but nothing was lost. Random losses at any rate have at most
    0.385 of their gaps alike (of one length, after one of two neighbouring runs: (1 - p) p (2 - p) at p = 0.42), so
    where most of the last ones are, they are a rhythm: they count as lost no more, nor do those that taught us so.

    A sender that looks for samples in its own time has no rhythm. But it leaves out at most every second one, and what
    it did not send has no number: such a gap between frames whose numbers are whole has lost nothing.
    """

    GAP = 1.8  # of the usual interval: ArduPilot's loop makes 5.0 and 7.5 ms of 6 ms
    SILENCE = 0.1  # s: nobody who is slower is worth being asked for another rate
    LEARNING = 20  # intervals whose median is the usual one, and gaps in a row that mean a new rate
    MEMORY = 200  # intervals: it follows their mean from there
    LEFT_OUT = 2  # usual intervals in a gap that a sender makes: its own are of n and of n + 1 samples
    RHYTHM = 40  # gaps that are looked at for a rule
    ALIKE = 0.7  # of them follow it: by chance once in 20,000 times at the worst, at a loss of 5 % never

    def __init__(self) -> None:
        self.gaps = 0
        self.lost = 0
        self.repeated = 0
        self.reset()

    def reset(self) -> None:
        """Drop the usual interval and the last stamp; the counters stay."""
        self.newest: float | None = None
        self.period = 0.0
        self.learn_again()

    def learn_again(self) -> None:
        """The rate may change from here on."""
        self._seen = 0
        self._first: list[float] = []
        self._gaps_in_a_row = 0
        self._just_lost = 0
        self._rhythm: Rhythm | None = None
        self._past: deque[Gap] = deque(maxlen=self.RHYTHM)
        # Usual intervals since the last gap, and since the last one that the rhythm demands.
        self._run = self._beat = 0

    def observe(self, stamp: float, *, is_whole: bool = False) -> bool:
        """Take the next stamp [s]; False where it is not later than the last one. is_whole: since the last one no
        number of a frame is missing."""
        if self.newest is None:
            self.newest = stamp
            return True
        interval = stamp - self.newest
        if interval <= 0:
            self.repeated += 1
            # A sample that was packed a moment late carries the next one's stamp: doubled, but not lost.
            if self._just_lost:
                self._just_lost -= 1
                self.lost -= 1
            return False
        self.newest = stamp
        self._just_lost = 0
        if self._is_silence(interval):
            self._just_lost = round(interval / self.period) - 1
            self._count(self._just_lost)
        elif self._seen < self.LEARNING:
            self._learn(interval)
        elif interval > self.GAP * self.period:
            self._on_gap(round(interval / self.period), is_whole=is_whole)
        else:
            self._on_usual(interval)
        return True

    def _is_silence(self, interval: float) -> bool:
        """Whether a rate that is to be learned anew begins with a gap in the one before: who was silent is asked again,
        and agrees before it speaks."""
        return not self._first and self._seen == 0 and 0.0 < self.GAP * self.period < interval > self.SILENCE

    def _learn(self, interval: float) -> None:
        # A mean would take samples that are lost meanwhile for a slower rate, in which later ones are no gaps.
        self._first.append(interval)
        self.period = statistics.median_low(self._first)
        self._seen += 1

    def _on_usual(self, interval: float) -> None:
        self._gaps_in_a_row = 0
        self._run += 1
        self._beat += 1
        if self._rhythm is not None and self._beat > 2 * (self._rhythm.run + 1):
            # It has ended.
            self._rhythm = None
            self._past.clear()
        self._seen += 1
        self.period += (interval - self.period) / min(self._seen, self.MEMORY)

    def _on_gap(self, ticks: int, *, is_whole: bool) -> None:
        is_left_out = is_whole and ticks <= self.LEFT_OUT
        gap = Gap(self._run, ticks, None if is_left_out else self._missing(ticks))
        self._take_gap(gap)
        self._past.append(gap)
        self._run = 0
        self._gaps_in_a_row += 1
        if self._gaps_in_a_row == self.LEARNING:
            for past in list(self._past)[-self.LEARNING :]:
                self._count(-(past.lost or 0))
            self.learn_again()
        elif self._rhythm is None and len(self._past) == self.RHYTHM:
            self._rhythm = self._find_rhythm()
            if self._rhythm is not None:
                self._judge_again(self._rhythm)

    def _take_gap(self, gap: Gap) -> None:
        if gap.lost is None:
            # As one that the rhythm demands.
            self._beat = 0
        self._just_lost = gap.lost or 0
        self._count(self._just_lost)

    def _count(self, lost: int) -> None:
        """Of one gap; negative: that was none."""
        self.lost += lost
        self.gaps += (lost > 0) - (lost < 0)

    def _missing(self, ticks: int) -> int:
        """Samples lost in a gap: all inside it, but those that the rhythm leaves out."""
        if self._rhythm is None:
            return ticks - 1
        run, beat = self._rhythm
        if ticks == beat and self._beat >= run:
            self._beat = 0
            return 0
        since = self._beat + ticks
        left_out, self._beat = divmod(since, run + beat)
        return max(0, ticks - 1 - left_out * (beat - 1))

    def _find_rhythm(self) -> Rhythm | None:
        """The rule that most of the last gaps follow, if there is one."""
        ticks, _ = Counter(gap.ticks for gap in self._past).most_common(1)[0]
        runs = Counter(gap.run for gap in self._past if gap.ticks == ticks)
        run = max(list(runs), key=lambda run: runs[run] + runs[run + 1])
        return Rhythm(run, ticks) if runs[run] + runs[run + 1] >= self.ALIKE * self.RHYTHM else None

    def _judge_again(self, rhythm: Rhythm) -> None:
        self._beat = rhythm.run - self._past[0].run
        for gap in self._past:
            self._count(-(gap.lost or 0))
            self._beat += gap.run
            self._take_gap(gap._replace(lost=None if gap.lost is None else self._missing(gap.ticks)))
