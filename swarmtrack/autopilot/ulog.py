"""PX4's own log (ULog) as the telemetry that the same autopilot would have sent (`logged_flight`).

HIGHRES_IMU is stamped as PX4 stamps it, with the time of the newest gyro sample in its mean.
"""

from __future__ import annotations

import contextlib
import io
import logging
import math
import struct
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.limits import LONGEST_RECORDING_S, LONGEST_UPTIME_S
from swarmtrack.autopilot.log_files import check_kind, time_limit
from swarmtrack.autopilot.logged_flight import (
    Activity,
    Columns,
    LoggedFlight,
    Said,
    attitude,
    fix,
    frames,
    global_position,
    heartbeats,
    imu,
    local_position,
    rows,
    system_id,
    thinned,
)
from swarmtrack.autopilot.ulog_definitions import check_definitions, written_size
from swarmtrack.errors import SourceError
from swarmtrack.geometry.geodesy import Geodetic, from_ned
from swarmtrack.messages import Array

journal = logging.getLogger(__name__)

BAD_LOG_ERRORS = (ValueError, TypeError, ArithmeticError, LookupError, MemoryError)
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


def read_ulog(path: Path) -> LoggedFlight:
    """Read a PX4 log. Raises SourceError for any other file, or one without gyro samples."""
    from pyulog import ULog  # noqa: PLC0415  (an agent in flight does not pay for it)
    from pyulog.exceptions import ULogException  # noqa: PLC0415

    check_kind(path, "ulog")
    # What pyulog raises on bytes that are no log, its own error and whatever they mislead it to; and a topic that lacks
    # a column.
    try:
        with time_limit(path):
            size = written_size(path)
            check_definitions(path, size)
            with path.open("rb") as file, contextlib.redirect_stdout(io.StringIO()):
                whole = size == path.stat().st_size
                log = ULog(file if whole else io.BytesIO(file.read(size)), list(ULOG_TOPICS))
            topics = {data.name: data.data for data in reversed(log.data_list) if len(data.data["timestamp"])}
            gps = next((topics[name] for name in GPS_TOPICS if name in topics), None)
            offset = _utc_offset(gps)
            begin = _count_from_boot(topics.values())
            system = system_id(log.initial_parameters.get("MAV_SYS_ID"))
            said = frames(_said(topics, gps), system)
            left_out = _left_out(topics.get("vehicle_local_position"))
    except (*BAD_LOG_ERRORS, ULogException, OSError, struct.error) as error:
        raise SourceError(f"{path}: is broken or cut off in its header, expected a ULog ({error})") from None
    if not any(name in topics for name in GYRO_TOPICS):
        raise SourceError(
            f"{path}: holds no gyro, expected the topic sensor_combined (SDLOG_PROFILE) and a log that is not cut off "
            "before it"
        )
    if log.file_corruption:
        journal.warning("%s: is damaged; what can be read of it is used", path)
    return LoggedFlight(said, None if offset is None else offset + begin, system, left_out)


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


def _said(topics: Mapping[str, Columns], gps: Columns | None) -> Said:
    name = next((name for name in GYRO_TOPICS if name in topics), None)
    if name is None:
        return
    times = [t for (t,) in rows(topics[name])]
    begin, end = min(times), max(times)
    yield from (_sensor_combined if name == "sensor_combined" else _angular_velocity)(topics[name])
    yield from _heartbeats(topics.get("vehicle_status"), begin, end)
    yield from _landings(topics.get("vehicle_land_detected"))
    yield from _attitudes(topics.get("vehicle_attitude"), begin)
    yield from _positions(topics.get("vehicle_local_position"))
    yield from _fixes(gps)


def _utc_offset(gps: Columns | None) -> float | None:
    """Median over all that the receiver told; PX4 writes 0 until it knows."""
    if gps is None or "time_utc_usec" not in gps:
        return None
    utc = np.asarray(gps["time_utc_usec"], dtype=float)
    told = utc > 0.0
    if not told.any():
        return None
    return float(np.median(utc[told] - np.asarray(gps["timestamp"], dtype=float)[told])) * 1e-6


# --- what PX4 would have said ---------------------------------------------------------------------


def _heartbeats(status: Columns | None, begin: float, end: float) -> Said:
    """Armed as the log says, where it does; an armed PX4 is active."""
    states = rows(status, "arming_state") if status is not None else ()
    changes = [Activity(t, state == ARMED, state == ARMED) for t, state in states]
    kind, autopilot = common.MAV_TYPE_QUADROTOR, common.MAV_AUTOPILOT_PX4
    return heartbeats(begin, end, changes, kind=kind, autopilot=autopilot)


def _landings(columns: Columns | None) -> Said:
    if columns is None:
        return
    for t, landed in rows(columns, "landed"):
        state = common.MAV_LANDED_STATE_ON_GROUND if landed else common.MAV_LANDED_STATE_IN_AIR
        yield t, common.MAVLink_extended_sys_state_message(0, state)


def _sensor_combined(columns: Columns) -> Said:
    names = [f"gyro_rad[{k}]" for k in range(3)] + [f"accelerometer_m_s2[{k}]" for k in range(3)]
    return (imu(t, values[:3], values[3:]) for t, *values in rows(columns, *names))


def _angular_velocity(columns: Columns) -> Said:
    samples = rows(columns, "timestamp_sample", *(f"xyz[{k}]" for k in range(3)))
    return (imu(sampled * 1e-6, gyro, [0.0] * 3) for _, sampled, *gyro in samples)


def _attitudes(columns: Columns | None, begin: float) -> Said:
    """From where the gyro begins: whoever reads their rates meanwhile would take them for it."""
    if columns is None:
        return
    for t, *q in thinned(rows(columns, *(f"q[{k}]" for k in range(4))), begin):
        yield attitude(t, q)


def _positions(columns: Columns | None) -> Said:
    """Local while the estimator holds it for valid; global as well, where it knows where its origin lies."""
    if columns is None:
        return
    names = ["x", "y", "z", "vx", "vy", "vz", "ref_lat", "ref_lon", "ref_alt"]
    valid = ["xy_valid", "z_valid", "xy_global", "z_global"]
    for t, *row in thinned(rows(columns, *names, *valid)):
        (position, velocity), (latitude, longitude, height) = (row[:3], row[3:6]), row[6:9]
        xy, z, xy_global, z_global = row[9:]
        if not (xy and z):
            continue
        yield local_position(t, position, velocity)
        if (
            xy_global
            and z_global
            and abs(latitude) <= 90.0
            and np.isfinite([*position, *velocity, longitude, height]).all()
        ):
            origin = Geodetic.from_degrees(latitude, longitude, height)
            place = from_ned(np.array(position), origin)
            yield global_position(t, place, velocity)


def _left_out(positions: Columns | None) -> tuple[str, ...]:
    if positions is None:
        return ()
    invalid = sum(not (xy and z) for _, xy, z in thinned(rows(positions, "xy_valid", "z_valid")))
    why = "not valid by PX4's own word: take off once its estimator has GPS, optical flow or vision"
    return (f"{invalid} positions ({why})",) if invalid else ()


def _fixes(columns: Columns | None) -> Said:
    if columns is None:
        return
    places: tuple[tuple[str, float], ...] = (("lat", 1.0), ("lon", 1.0), ("alt", 1.0))
    if "latitude_deg" in columns:
        # PX4 1.15 and newer.
        places = (("latitude_deg", 1e7), ("longitude_deg", 1e7), ("altitude_msl_m", 1e3))
    names = [name for name, _ in places]
    for t, *row in rows(columns, *names, "fix_type", "satellites_used", "eph", "epv"):
        scaled = [value * scale for value, (_, scale) in zip(row[:3], places, strict=True)]
        # Until it knows, a receiver tells NaN; 0 means the same in MAVLink.
        whole = [
            round(value) if math.isfinite(value) else 0 for value in (*scaled, *(1e3 * v for v in row[5:]))
        ]
        yield fix(t, int(row[3]), whole[:3], int(row[4]), whole[3:])
