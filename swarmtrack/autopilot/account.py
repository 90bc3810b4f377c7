"""What came from an autopilot, what of it was used, and why not the rest: the last words about an imported log."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.contact import Contact
from swarmtrack.autopilot.framer import Framer
from swarmtrack.autopilot.global_position import FIX_NEEDED
from swarmtrack.autopilot.limits import GYRO_RATE_SHARE, SLOWEST_USEFUL_GYRO_HZ
from swarmtrack.autopilot.streams import (
    GLOBAL_POSITION_INT,
    GPS2_RAW,
    GPS_RAW_INT,
    LOCAL_POSITION_NED,
)
from swarmtrack.autopilot.telemetry import Telemetry

# Of messages that are not read, so many kinds are named.
UNREAD_NAMED = 6


@dataclass(slots=True)
class Arrivals:
    """Count of one kind of message; first, last [s]: when it came."""

    count: int
    first: float
    last: float

    @property
    def hz(self) -> float:
        """0 where one came alone."""
        span = self.last - self.first
        return (self.count - 1) / span if span > 0.0 else 0.0


class Advice(NamedTuple):
    """How to come to a denser gyro, to an attitude, to a position and to a fix of GPS in the next log."""

    gyro: str
    attitude: str
    position: str
    fix: str


# By the kind of log.
ADVICE = {
    "tlog": Advice(
        gyro="import the autopilot's own log (--bin, --ulog), or let it send faster and record again (ArduPilot "
        "SRn_RAW_SENS)",
        attitude="ATTITUDE_QUATERNION or ATTITUDE is needed",
        position="LOCAL_POSITION_NED is needed",
        fix=FIX_NEEDED,
    ),
    "ulog": Advice(
        gyro="fly again with a denser log (SDLOG_PROFILE: high rate)",
        attitude="the topic vehicle_attitude is needed (SDLOG_PROFILE)",
        position="the topic vehicle_local_position with valid positions is needed (SDLOG_PROFILE)",
        fix="the topic vehicle_gps_position or sensor_gps is needed (SDLOG_PROFILE)",
    ),
    "bin": Advice(
        gyro="fly again with the fast IMU in LOG_BITMASK (copters: bit 18)",
        attitude="ATT, XKQ or XKF1 is needed (LOG_BITMASK: attitude, bit 0 or 1)",
        position="POS or a valid XKF1 is needed (LOG_BITMASK: attitude, bit 0 or 1)",
        fix="GPS is needed (LOG_BITMASK: GPS, bit 2)",
    ),
}


class Account:
    """Counts the messages of our autopilot; all times are ours [s]. scheme: of the link's address."""

    def __init__(self, scheme: str) -> None:
        # Of a live link, as of what a ground station records of it.
        self._advice = ADVICE.get(scheme, ADVICE["tlog"])
        self._came: dict[int, Arrivals] = {}

    def add(self, t: float, message_id: int) -> None:
        """A message has come at t."""
        arrivals = self._came.get(message_id)
        if arrivals is None:
            self._came[message_id] = Arrivals(1, t, t)
        else:
            arrivals.count += 1
            arrivals.last = t

    def lines(
        self,
        contact: Contact,
        framer: Framer,
        telemetry: Telemetry,
        unread: frozenset[int],
        *,
        left_out: tuple[str, ...] = (),
    ) -> Iterator[str]:
        """Sentences for people. unread: messages without a reader; left_out: of a log, what was never a message."""
        read = {i: each for i, each in self._came.items() if i not in unread}
        yield f"came from autopilot {contact.address}: {_in_words(read) or 'nothing that is read'}"
        gyro, attitudes, positions = telemetry.intakes
        hz = self._gyro_hz(telemetry)
        source = f" from {telemetry.imu_source.name} ({_in_hz(hz)})" if gyro.used else ""
        yield f"used: {gyro.used} gyro samples{source}, {attitudes.used} attitudes, {positions.used} positions"
        wasted = [*left_out, *(intake.unused for intake in telemetry.intakes if intake.unused)]
        if telemetry.stamps.copies:
            wasted.append(f"{telemetry.stamps.copies} copies of earlier messages")
        if contact.foreign:
            others = [f"{at} {what}".strip() for at, what in contact.others.items() if at != contact.address]
            named = f" ({', '.join(others)})" if others else ""
            wasted.append(f"{contact.foreign} messages of other systems or components{named}")
        if contact.early_lost:
            wasted.append(f"{contact.early_lost} messages from before the autopilot's first heartbeat")
        if framer.bad_bytes:
            wasted.append(f"{framer.bad_bytes} bytes outside of whole frames")
        if framer.unknown:
            wasted.append(f"{framer.unknown} frames of messages that MAVLink's common dialect lacks")
        ignored = {i: each for i, each in self._came.items() if i in unread}
        if ignored:
            named = _in_words(dict(list(ignored.items())[:UNREAD_NAMED]))
            more = ", …" if len(ignored) > UNREAD_NAMED else ""
            wasted.append(f"messages that are not read ({named}{more})")
        if wasted:
            yield f"not used: {'; '.join(wasted)}"
        yield from self._lacks(telemetry, contact.received_at)

    def _gyro_hz(self, telemetry: Telemetry) -> float:
        """Of the samples that were used."""
        came = self._came.get(telemetry.imu_source.id)
        return 0.0 if came is None else came.hz * telemetry.gyro.used / came.count

    def _lacks(self, telemetry: Telemetry, now: float) -> Iterator[str]:
        """What is missing, with the next step."""
        gyro, attitudes, positions = telemetry.intakes
        hz = self._gyro_hz(telemetry)
        advice = self._advice
        if not gyro.used:
            yield f"no gyro sample is usable, so tracks are lost in each turn: {advice.gyro}"
        elif hz < GYRO_RATE_SHARE * SLOWEST_USEFUL_GYRO_HZ:
            yield (
                f"the gyro is too slow, {_in_hz(hz)} and at least {SLOWEST_USEFUL_GYRO_HZ:g} Hz are needed, so tracks "
                f"are lost in each turn: {advice.gyro}"
            )
        if not attitudes.used:
            yield f"no attitude is usable, so no teammate is named: {advice.attitude}"
        if not positions.used:
            why = self._why_no_position(telemetry, now)
            yield f"no position is usable, so the drone's place is unknown: {why}"

    def _why_no_position(self, telemetry: Telemetry, now: float) -> str:
        if lack := telemetry.lack(now):
            return lack if {GPS_RAW_INT, GPS2_RAW} & self._came.keys() else self._advice.fix
        if GLOBAL_POSITION_INT in self._came and LOCAL_POSITION_NED not in self._came:
            return 'the log has GLOBAL_POSITION_INT only, which drone.start = { from = "gps" } and a team.origin use'
        return self._advice.position


def _in_words(came: dict[int, Arrivals]) -> str:
    return ", ".join(f"{each.count} {_name(i)} ({_in_hz(each.hz)})" for i, each in came.items())


def _in_hz(rate: float) -> str:
    return f"{rate:.3g} Hz" if rate < 999.5 else f"{rate:.0f} Hz"


def _name(message_id: int) -> str:
    return str(common.mavlink_map[message_id].msgname)
