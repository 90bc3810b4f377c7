"""An autopilot's own log as the telemetry that it would have sent: MAVLink frames, each at its time.

So a logged flight takes the path of every other link, and the same code handles gyro, attitude, position, GPS and
their errors. What a log holds at a higher rate than an agent requests is thinned to that rate, except the gyro.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.limits import LOGGED_POSES_HZ, LONGEST_RECORDING_S
from swarmtrack.geometry.geodesy import Geodetic
from swarmtrack.messages import Array

NOT_TOLD = 65535  # of a velocity, a course, a heading
MAX_ACCURACY_MM = 2**32 - 1
ROWS_AT_ONCE = 1000

Columns = Mapping[str, Array]
Said = Iterable[tuple[float, Any]]


class LoggedFlight(NamedTuple):
    """One log. records: (time [s since boot], frame), ascending; utc_offset: to UTC [s], None without GPS time;
    left_out: what else the log holds, and why it is not used."""

    records: list[tuple[float, bytes]]
    utc_offset: float | None
    system: int
    left_out: tuple[str, ...] = ()


def frames(said: Said, system: int) -> list[tuple[float, bytes]]:
    """What an autopilot said, (time [s], message), as its frames in the order of their times."""
    mav = common.MAVLink(None, system, common.MAV_COMP_ID_AUTOPILOT1)
    # A message is ten times as large as its frame, so none is kept.
    packed = [(t, frame) for t, message in said if (frame := _frame(mav, message))]
    return sorted(packed, key=lambda record: record[0])


def _frame(mav: Any, message: Any) -> bytes:
    """Empty where a damaged number does not fit into its field."""
    try:
        data = bytes(message.pack(mav))
    except struct.error:
        return b""
    mav.seq = (mav.seq + 1) % 256
    return data


def system_id(parameter: object) -> int:
    """1, as both firmwares' own default, where the log does not tell."""
    return int(parameter) if isinstance(parameter, int | float) and 1 <= parameter <= 255 else 1


def rows(columns: Columns, *names: str) -> Iterator[list[Any]]:
    """time [s since boot], then these columns, a row a sample; without those of damaged times.

    columns: with `timestamp` in µs.
    """
    times = np.asarray(columns["timestamp"], dtype=float) * 1e-6
    middle = np.median(times) if len(times) else 0.0
    sound = np.flatnonzero(np.abs(times - middle) < LONGEST_RECORDING_S)
    kept = [times, *(np.asarray(columns[name]) for name in names)]
    # As Python's numbers, a whole log would take ten times its size.
    for begin in range(0, len(sound), ROWS_AT_ONCE):
        chunk = sound[begin : begin + ROWS_AT_ONCE]
        yield from map(list, zip(*(values[chunk].tolist() for values in kept), strict=True))


def thinned(samples: Iterable[list[Any]], begin: float = -math.inf) -> Iterator[list[Any]]:
    """Rows from `begin` [s] on: at most as many as an agent requests."""
    samples = [row for row in samples if row[0] >= begin]
    often = len(samples) > 1 and (len(samples) - 1) / LOGGED_POSES_HZ > samples[-1][0] - samples[0][0]
    last = -np.inf
    for row in samples:
        if not often or row[0] - last > 0.9 / LOGGED_POSES_HZ:
            last = row[0]
            yield row


class Activity(NamedTuple):
    """Since t [s]: whether it is armed, and whether the heartbeat says so of its flight (MAV_STATE_ACTIVE)."""

    t: float
    armed: bool
    active: bool


def heartbeats(begin: float, end: float, changes: Iterable[Activity], *, kind: int, autopilot: int) -> Said:
    """One a second from shortly before `begin` [s]. changes: ascending in time; before the first it stands by."""
    following = iter(changes)
    now, then = Activity(-math.inf, armed=False, active=False), next(following, None)
    for t in np.arange(begin - 1e-3, end, 1.0).tolist():
        while then is not None and then.t <= t:
            now, then = then, next(following, None)
        mode = common.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        mode |= common.MAV_MODE_FLAG_SAFETY_ARMED if now.armed else 0
        state = common.MAV_STATE_ACTIVE if now.active else common.MAV_STATE_STANDBY
        yield t, common.MAVLink_heartbeat_message(kind, autopilot, mode, 0, state, 3)


def imu(t: float, gyro: list[float], accel: list[float]) -> tuple[float, Any]:
    """gyro rad/s and accel m/s², FRD."""
    return t, common.MAVLink_highres_imu_message(
        round(t * 1e6), *accel, *gyro, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0x3F
    )


def attitude(t: float, quaternion: list[float]) -> tuple[float, Any]:
    """quaternion: w, x, y, z of world_from_body."""
    return t, common.MAVLink_attitude_quaternion_message(round(t * 1e3), *quaternion, 0.0, 0.0, 0.0)


def local_position(t: float, position: list[float], velocity: list[float]) -> tuple[float, Any]:
    """NED, m and m/s."""
    return t, common.MAVLink_local_position_ned_message(round(t * 1e3), *position, *velocity)


def global_position(t: float, place: Geodetic, velocity: list[float]) -> tuple[float, Any]:
    """velocity: NED, m/s."""
    return t, common.MAVLink_global_position_int_message(
        round(t * 1e3),
        round(1e7 * np.degrees(place.latitude)),
        round(1e7 * np.degrees(place.longitude)),
        round(1e3 * place.height),
        0,
        *(round(1e2 * v) for v in velocity),
        NOT_TOLD,
    )


def fix(
    t: float, kind: int, place: list[int], satellites: int, accuracy_mm: Iterable[int]
) -> tuple[float, Any]:
    """kind: GPS_FIX_TYPE; place: latitude and longitude in 1e-7°, height above the sea in mm; accuracy_mm: level and
    vertical, 0 where it is not told."""
    return t, common.MAVLink_gps_raw_int_message(
        round(t * 1e6),
        kind,
        *place,
        *(NOT_TOLD,) * 4,
        satellites,
        0,
        *(min(value, MAX_ACCURACY_MM) for value in accuracy_mm),
    )
