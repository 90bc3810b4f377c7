"""PX4's own log (ULog) as the telemetry that the same autopilot would have sent: MAVLink frames, each at its time.

So a logged flight takes the path of every other link, and the same code handles gyro, attitude, position, GPS and
their errors. HIGHRES_IMU is stamped as PX4 stamps it, with the time of the newest gyro sample in its mean. Messages
that the log holds at a higher rate than an agent requests are thinned to that rate, except the gyro.
"""

from __future__ import annotations

import contextlib
import io
import logging
import math
import struct
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.limits import LONGEST_RECORDING_S, LONGEST_UPTIME_S, ULOG_POSES_HZ
from swarmtrack.autopilot.log_files import check_kind, time_limit
from swarmtrack.autopilot.ulog_definitions import check_definitions
from swarmtrack.errors import SourceError
from swarmtrack.geometry.geodesy import Geodetic, from_ned
from swarmtrack.messages import Array

journal = logging.getLogger(__name__)

ULOG_UNKNOWN = 65535  # of a velocity, a course, a heading
MAX_ACCURACY_MM = 2**32 - 1
ARMED = 2  # vehicle_status.arming_state
GPS_TOPICS = ("vehicle_gps_position", "sensor_gps")  # until PX4 1.12, and since 1.13 also the receiver's own
GYRO_TOPICS = ("sensor_combined", "vehicle_angular_velocity")
ULOG_TOPICS = (
    *GYRO_TOPICS,
    "vehicle_attitude",
    "vehicle_local_position",
    "vehicle_status",
    "vehicle_land_detected",
    *GPS_TOPICS,
)

Columns = Mapping[str, Array]
Said = Iterator[tuple[float, Any]]


class UlogFlight(NamedTuple):
    """One log. records: (time [s since boot], frame), ascending; utc_offset: to UTC [s], None without GPS time."""

    records: list[tuple[float, bytes]]
    utc_offset: float | None
    system: int


def read_ulog(path: Path) -> UlogFlight:
    """Read a PX4 log. Raises SourceError for any other file, or one without gyro samples."""
    from pyulog import ULog  # noqa: PLC0415  (an agent in flight does not pay for it)
    from pyulog.exceptions import ULogException  # noqa: PLC0415

    check_kind(path, "ulog")
    # What pyulog raises on bytes that are no log, its own error and whatever they mislead it to; and a topic that lacks
    # a column.
    try:
        check_definitions(path)
        with time_limit(path), contextlib.redirect_stdout(io.StringIO()):
            log = ULog(str(path), list(ULOG_TOPICS))
        topics = {data.name: data.data for data in reversed(log.data_list) if len(data.data["timestamp"])}
        gps = next((topics[name] for name in GPS_TOPICS if name in topics), None)
        offset = _utc_offset(gps)
        begin = _count_from_boot(topics.values())
        said = sorted(_said(topics, gps), key=lambda message: message[0])
    except (ULogException, OSError, struct.error, ValueError, TypeError, LookupError, MemoryError) as error:
        raise SourceError(f"{path}: is broken or cut off in its header, expected a ULog ({error})") from None
    if not any(name in topics for name in GYRO_TOPICS):
        raise SourceError(
            f"{path}: holds no gyro, expected the topic sensor_combined (SDLOG_PROFILE) and a log that is not cut off "
            "before it"
        )
    if log.file_corruption:
        journal.warning("%s: is damaged; what can be read of it is used", path)
    system = _system(log.initial_parameters.get("MAV_SYS_ID"))
    mav = common.MAVLink(None, system, common.MAV_COMP_ID_AUTOPILOT1)
    records = [(t, frame) for t, message in said if (frame := _frame(mav, message))]
    return UlogFlight(records, None if offset is None else offset + begin, system)


def _count_from_boot(topics: Iterable[dict[str, Array]]) -> float:
    """Make all stamps of a simulation that counts from 1970 such as those of a board, in place: in milliseconds they do
    not fit into MAVLink's 32 bits. Returns what was taken off [s]."""
    topics = list(topics)
    begin = min((float(np.median(columns["timestamp"])) for columns in topics), default=0.0)
    if begin < LONGEST_UPTIME_S * 1e6:
        return 0.0
    begin -= LONGEST_RECORDING_S * 1e6
    for columns in topics:
        for name in ("timestamp", "timestamp_sample"):
            if name in columns:
                columns[name] = np.asarray(columns[name], dtype=float) - begin
    return begin * 1e-6


def _system(parameter: object) -> int:
    """1, as PX4's own default, where the log does not tell."""
    return parameter if isinstance(parameter, int) and 1 <= parameter <= 255 else 1


def _said(topics: Mapping[str, Columns], gps: Columns | None) -> Said:
    if "sensor_combined" in topics:
        gyro = list(_sensor_combined(topics["sensor_combined"]))
    elif "vehicle_angular_velocity" in topics:
        gyro = list(_angular_velocity(topics["vehicle_angular_velocity"]))
    else:
        return
    yield from gyro
    yield from _heartbeats(topics.get("vehicle_status"), gyro[0][0], gyro[-1][0])
    yield from _landings(topics.get("vehicle_land_detected"))
    yield from _attitudes(topics.get("vehicle_attitude"))
    yield from _positions(topics.get("vehicle_local_position"))
    yield from _fixes(gps)


def _frame(mav: Any, message: Any) -> bytes:
    """Empty where a damaged number does not fit into its field."""
    try:
        data = bytes(message.pack(mav))
    except struct.error:
        return b""
    mav.seq = (mav.seq + 1) % 256
    return data


def _utc_offset(gps: Columns | None) -> float | None:
    """Median over all that the receiver told; PX4 writes 0 until it knows."""
    if gps is None or "time_utc_usec" not in gps:
        return None
    utc = np.asarray(gps["time_utc_usec"], dtype=float)
    told = utc > 0.0
    if not told.any():
        return None
    return float(np.median(utc[told] - np.asarray(gps["timestamp"], dtype=float)[told])) * 1e-6


def _rows(columns: Columns, *names: str) -> Iterator[list[Any]]:
    """time [s since boot], then these columns, a row a sample; without those of damaged times."""
    times = np.asarray(columns["timestamp"], dtype=float) * 1e-6
    sound = np.flatnonzero(np.abs(times - np.median(times)) < LONGEST_RECORDING_S)
    kept = [np.asarray(values)[sound].tolist() for values in (times, *(columns[name] for name in names))]
    return map(list, zip(*kept, strict=True))


def _thinned(rows: Iterable[list[Any]]) -> Iterator[list[Any]]:
    """At most as many as an agent requests."""
    rows = list(rows)
    often = len(rows) > 1 and (len(rows) - 1) / ULOG_POSES_HZ > rows[-1][0] - rows[0][0]
    last = -np.inf
    for row in rows:
        if not often or row[0] - last > 0.9 / ULOG_POSES_HZ:
            last = row[0]
            yield row


# --- what PX4 would have said ---------------------------------------------------------------------


def _heartbeats(status: Columns | None, begin: float, end: float) -> Said:
    """One a second, from before the first sample; armed as the log says, where it does."""
    changes = list(_rows(status, "arming_state")) if status is not None else []
    armed = False
    for t in np.arange(begin - 1e-3, end, 1.0).tolist():
        while changes and changes[0][0] <= t:
            armed = changes.pop(0)[1] == ARMED
        yield (
            t,
            common.MAVLink_heartbeat_message(
                common.MAV_TYPE_QUADROTOR,
                common.MAV_AUTOPILOT_PX4,
                common.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
                | (common.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0),
                0,
                common.MAV_STATE_ACTIVE if armed else common.MAV_STATE_STANDBY,
                3,
            ),
        )


def _landings(columns: Columns | None) -> Said:
    if columns is None:
        return
    for t, landed in _rows(columns, "landed"):
        state = common.MAV_LANDED_STATE_ON_GROUND if landed else common.MAV_LANDED_STATE_IN_AIR
        yield t, common.MAVLink_extended_sys_state_message(0, state)


def _imu(t: float, gyro: list[float], accel: list[float]) -> tuple[float, Any]:
    return t, common.MAVLink_highres_imu_message(
        round(t * 1e6), *accel, *gyro, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0x3F
    )


def _sensor_combined(columns: Columns) -> Said:
    names = [f"gyro_rad[{k}]" for k in range(3)] + [f"accelerometer_m_s2[{k}]" for k in range(3)]
    return (_imu(t, values[:3], values[3:]) for t, *values in _rows(columns, *names))


def _angular_velocity(columns: Columns) -> Said:
    rows = _rows(columns, "timestamp_sample", *(f"xyz[{k}]" for k in range(3)))
    return (_imu(sampled * 1e-6, gyro, [0.0] * 3) for _, sampled, *gyro in rows)


def _attitudes(columns: Columns | None) -> Said:
    if columns is None:
        return
    for t, *q in _thinned(_rows(columns, *(f"q[{k}]" for k in range(4)))):
        yield t, common.MAVLink_attitude_quaternion_message(round(t * 1e3), *q, 0.0, 0.0, 0.0)


def _positions(columns: Columns | None) -> Said:
    """Local while the estimator holds it for valid; global as well, where it knows where its origin lies."""
    if columns is None:
        return
    names = ["x", "y", "z", "vx", "vy", "vz", "ref_lat", "ref_lon", "ref_alt"]
    valid = ["xy_valid", "z_valid", "xy_global", "z_global"]
    for t, *row in _thinned(_rows(columns, *names, *valid)):
        (position, velocity), (latitude, longitude, height) = (row[:3], row[3:6]), row[6:9]
        xy, z, xy_global, z_global = row[9:]
        if not (xy and z):
            continue
        yield t, common.MAVLink_local_position_ned_message(round(t * 1e3), *position, *velocity)
        if (
            xy_global
            and z_global
            and abs(latitude) <= 90.0
            and np.isfinite([*position, longitude, height]).all()
        ):
            origin = Geodetic.from_degrees(latitude, longitude, height)
            place = from_ned(np.array(position), origin)
            yield t, _global_position(t, place, velocity)


def _global_position(t: float, place: Geodetic, velocity: list[float]) -> Any:
    return common.MAVLink_global_position_int_message(
        round(t * 1e3),
        round(1e7 * np.degrees(place.latitude)),
        round(1e7 * np.degrees(place.longitude)),
        round(1e3 * place.height),
        0,
        *(round(1e2 * v) for v in velocity),
        ULOG_UNKNOWN,
    )


def _fixes(columns: Columns | None) -> Said:
    if columns is None:
        return
    places: tuple[tuple[str, float], ...] = (("lat", 1.0), ("lon", 1.0), ("alt", 1.0))
    if "latitude_deg" in columns:
        # PX4 1.15 and newer.
        places = (("latitude_deg", 1e7), ("longitude_deg", 1e7), ("altitude_msl_m", 1e3))
    names = [name for name, _ in places]
    for t, *row in _rows(columns, *names, "fix_type", "satellites_used", "eph", "epv"):
        scaled = [value * scale for value, (_, scale) in zip(row[:3], places, strict=True)]
        # Until it knows, a receiver tells NaN; 0 means the same in MAVLink.
        whole = [
            round(value) if math.isfinite(value) else 0 for value in (*scaled, *(1e3 * v for v in row[5:]))
        ]
        yield (
            t,
            common.MAVLink_gps_raw_int_message(
                round(t * 1e6),
                int(row[3]),
                *whole[:3],
                *(ULOG_UNKNOWN,) * 4,
                int(row[4]),
                0,
                *(min(value, MAX_ACCURACY_MM) for value in whole[3:]),
            ),
        )
