"""ArduPilot's own log (DataFlash, .bin) as the telemetry that the same autopilot would have sent (`logged_flight`).

Each message is two marks, its type and its fields; FMT messages say which fields a type has. Messages are told apart by
their names and fields, which ArduPilot keeps. pymavlink's DFReader knows the format, and its table of field types is
used here; but it makes an object of each message, and a length of zero keeps it busy for ever.
"""

from __future__ import annotations

import logging
import math
import mmap
import re
import struct
from array import array
from bisect import bisect_left
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard

import numpy as np
from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.limits import GPS_FIX_AGE_S, HIGHEST_PLACE_M, POSITION_GAP_S
from swarmtrack.autopilot.log_files import DATAFLASH_MAGIC, check_kind, time_limit
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
from swarmtrack.errors import SourceError
from swarmtrack.geometry import rotation
from swarmtrack.geometry.geodesy import Geodetic, from_ned, to_ned
from swarmtrack.messages import Array

journal = logging.getLogger(__name__)

MESSAGE_HEADER = 3
FMT = 0x80
# Of a FMT message: the type it describes, its length, name, types of the fields and their names.
FMT_FIELDS = struct.Struct("<BB4s16s64s")
MESSAGE_NAME = re.compile(r"[A-Z][A-Z0-9_]{0,3}")
# NumPy's for a field of `struct`.
NUMPY_TYPES = {"b": "i1", "B": "u1", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4", "q": "<i8", "Q": "<u8"} | {
    "e": "<f2", "f": "<f4", "d": "<f8"
}  # fmt: skip

GYRO, ACCEL = ("GyrX", "GyrY", "GyrZ"), ("AccX", "AccY", "AccZ")
# Before their filters, as the sensor measures; of older firmwares the first sensor's.
RAW_GYROS, RAW_ACCELS = ("GYR", "GYR1"), ("ACC", "ACC1")
# Of several sensors of a kind: the field that counts them. Older firmwares have a message for each instead.
INSTANCES = ("I", "C")
QUATERNIONS = ("XKQ", "XKQ1", "NKQ1")
# Of an estimator, the state that flies, and how sound that is.
STATES = {"XKF1": "XKF4", "NKF1": "NKF4", "EKF1": "EKF4"}
# Of the simple estimator that flies where the others fail.
BACKUP = "AHR2"
LOGGED_MESSAGES = frozenset(
    {"IMU", *RAW_GYROS, *RAW_ACCELS, "ATT", *QUATERNIONS, *STATES, *STATES.values(), BACKUP}
    | {"POS", "ORGN", "GPS", "GPA", "ARM", "EV", "STAT", "PARM", "MSG"}
)
STATE = ("PN", "PE", "PD", "VN", "VE", "VD")
# Bits of a state's SS: relative or absolute position, and height.
LEVEL_KNOWN, HEIGHT_KNOWN = 1 << 3 | 1 << 4, 1 << 5
# Bits of INS_RAW_LOG_OPT: what is logged as raw has passed the filter; and what has not is logged beside it.
AFTER_FILTER, BOTH_SIDES = 1 << 2, 1 << 3
EKF_ORIGIN = 0  # ORGN.Type
# EV.Id: of what has happened, whether it is armed and flies since; None: as before.
EVENTS: dict[int, tuple[bool | None, bool | None]] = {
    10: (True, None),
    11: (False, False),
    18: (None, False),
    28: (None, True),
}
KIND_OF_VEHICLE = {"ArduPlane": common.MAV_TYPE_FIXED_WING, "ArduRover": common.MAV_TYPE_GROUND_ROVER}
GPS_EPOCH, WEEK_S, LEAP_S = 315_964_800.0, 604_800.0, 18.0


def read_dataflash(path: Path) -> LoggedFlight:
    """Read a log of ArduPilot. Raises SourceError for any other file, or one without gyro samples."""
    check_kind(path, "bin")
    # What a damaged format makes of good bytes: names for times, words for numbers, numbers that no field holds.
    try:
        with time_limit(path):
            return _flight(path)
    except (ValueError, TypeError, ArithmeticError, LookupError, MemoryError) as error:
        raise SourceError(f"{path}: is damaged, expected a DataFlash log of ArduPilot ({error})") from None


def _flight(path: Path) -> LoggedFlight:
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        log = _decoded(data, LOGGED_MESSAGES)
    name, gyro = _densest_gyro(log.messages)
    if gyro is None:
        raise SourceError(f"{path}: holds no gyro, expected IMU messages with a time (LOG_BITMASK)")
    if log.damaged_bytes:
        journal.warning("%s: %d bytes are damaged; the rest is used", path, log.damaged_bytes)
    parameters = _parameters(log.messages.get("PARM"))
    system = system_id(parameters.get("MAV_SYSID", parameters.get("SYSID_THISMAV")))
    raw = int(parameters.get("INS_RAW_LOG_OPT", 0.0)) & (AFTER_FILTER | BOTH_SIDES) != AFTER_FILTER
    if name in RAW_GYROS and raw:
        parameters["INS_GYRO_FILTER"] = 0.0
    gps = _receiver_in_use(log.messages.get("GPS"))
    positions, left_out = _positions(log.messages)
    said = _said(log.messages, gyro, gps, parameters, positions)
    return LoggedFlight(frames(said, system), _utc_offset(gps), system, left_out)


# --- the file -------------------------------------------------------------------------------------


class MessageFormat(NamedTuple):
    """Fields of one type of message, after its header."""

    name: str
    fields: np.dtype[np.void]
    scales: dict[str, float]


class _Log(NamedTuple):
    """messages: by name, columns with `timestamp` [µs] of TimeUS; damaged_bytes: outside of all messages."""

    messages: dict[str, dict[str, Array]]
    damaged_bytes: int


def _decoded(data: mmap.mmap, names: Collection[str]) -> _Log:
    """All messages of these names, in the units of their fields."""
    formats: dict[int, MessageFormat] = {}
    lengths = [0] * 256
    lengths[FMT] = MESSAGE_HEADER + FMT_FIELDS.size
    offsets: dict[int, array[int]] = {}
    position, damaged, size = 0, 0, len(data)
    while position + MESSAGE_HEADER <= size:
        kind = data[position + 2]
        length = lengths[kind]
        if not length or data[position : position + 2] != DATAFLASH_MAGIC:
            found = data.find(DATAFLASH_MAGIC, position + 1)
            damaged += (size if found < 0 else found) - position
            if found < 0:
                break
            position = found
            continue
        if position + length > size:
            break
        if kind == FMT:
            _learn(data[position + MESSAGE_HEADER : position + length], formats, lengths)
        elif formats[kind].name in names:
            offsets.setdefault(kind, array("Q")).append(position + MESSAGE_HEADER)
        position += length
    messages = {formats[kind].name: _columns(data, at, formats[kind]) for kind, at in offsets.items()}
    _date_events(messages, {formats[kind].name: at for kind, at in offsets.items()})
    return _Log(messages, damaged)


def _learn(message: bytes, formats: dict[int, MessageFormat], lengths: list[int]) -> None:
    """From a FMT message, unless it is damaged or its type is known."""
    from pymavlink.DFReader import FORMAT_TO_STRUCT  # noqa: PLC0415  (an agent in flight does not pay for it)

    kind, length, *texts = FMT_FIELDS.unpack(message)
    name, types, columns = (text.rstrip(b"\0").decode("ascii", "replace") for text in texts)
    labels = columns.split(",") if columns else []
    known = all(letter in FORMAT_TO_STRUCT for letter in types)
    if (
        kind in formats
        or kind == FMT
        or not known
        or len(types) != len(labels)
        or not MESSAGE_NAME.fullmatch(name)
    ):
        return
    codes = [FORMAT_TO_STRUCT[letter] for letter in types]
    fields = np.dtype(
        [(f"{k}", NUMPY_TYPES.get(code, f"S{code[:-1]}")) for k, (code, *_) in enumerate(codes)]
    )
    if not labels or length != MESSAGE_HEADER + fields.itemsize or len(set(labels)) < len(labels):
        return
    fields.names = tuple(labels)
    scales = {label: scale for label, (_, scale, _) in zip(labels, codes, strict=True) if scale is not None}
    formats[kind] = MessageFormat(name, fields, scales)
    lengths[kind] = length


def _columns(data: mmap.mmap, offsets: Sequence[int], format: MessageFormat) -> dict[str, Array]:
    size = format.fields.itemsize
    messages = np.frombuffer(b"".join(data[at : at + size] for at in offsets), format.fields)
    columns = {
        label: messages[label] * format.scales[label] if label in format.scales else messages[label]
        for label in format.fields.names or ()
    }
    if "TimeUS" in columns:
        columns["timestamp"] = columns["TimeUS"]
    elif "Week" in columns and "TimeMS" in columns and "T" in columns:
        # A receiver's, before ArduPilot 3.3: its own time is that of the week.
        columns |= {"GWk": columns["Week"], "GMS": columns["TimeMS"], "timestamp": 1e3 * columns["T"]}
    elif "TimeMS" in columns:
        columns["timestamp"] = 1e3 * columns["TimeMS"]
    return columns


def _date_events(messages: dict[str, dict[str, Array]], offsets: dict[str, array[int]]) -> None:
    """Before ArduPilot 3.3 events have no time: theirs becomes that of the gyro samples around them, in place."""
    events, gyro = messages.get("EV"), messages.get("IMU")
    if events is not None and not _has(events) and _has(gyro):
        events["timestamp"] = np.interp(offsets["EV"], offsets["IMU"], gyro["timestamp"])


# --- what ArduPilot would have said ---------------------------------------------------------------


def _said(
    messages: dict[str, dict[str, Array]],
    gyro: Columns,
    gps: Columns | None,
    parameters: dict[str, float],
    positions: Said,
) -> Said:
    times = [t for (t,) in rows(gyro)]
    begin, end = min(times), max(times)
    yield from _heartbeats(messages, begin, end)
    if "INS_GYRO_FILTER" in parameters:
        yield (
            begin,
            common.MAVLink_param_value_message(
                b"INS_GYRO_FILTER", parameters["INS_GYRO_FILTER"], common.MAV_PARAM_TYPE_REAL32, 1, 0
            ),
        )
    yield from (imu(t, values[:3], values[3:]) for t, *values in rows(gyro, *GYRO, *ACCEL))
    yield from _attitudes(messages, begin)
    yield from positions
    yield from _fixes(gps, messages.get("GPA"))


def _has(columns: Columns | None, *names: str) -> TypeGuard[Columns]:
    return columns is not None and all(name in columns for name in ("timestamp", *names))


def _of_one_sensor(columns: Columns | None) -> Columns | None:
    """Of the sensor that is logged most often as healthy, of equals the first; None without a time stamp."""
    if columns is None or not _has(columns):
        return None
    instances = next((columns[name] for name in INSTANCES if name in columns), None)
    if instances is None:
        return columns
    healthy = columns["GH"] == 1 if "GH" in columns else np.ones(len(instances), bool)
    numbers, counts = np.unique(instances[healthy] if healthy.any() else instances, return_counts=True)
    return _where(columns, instances == numbers[counts.argmax()])


def _densest_gyro(messages: dict[str, dict[str, Array]]) -> tuple[str, Columns | None]:
    """Name of the message, and GYRO and ACCEL at the times of its samples; None: there is none."""
    gyros = {name: _of_one_sensor(messages.get(name)) for name in ("IMU", *RAW_GYROS)}
    found = {name: columns for name, columns in gyros.items() if _has(columns, *GYRO)}
    if not found:
        return "", None
    name = max(found, key=lambda name: len(found[name]["timestamp"]))
    gyro = _as_sampled(found[name])
    if _has(gyro, *ACCEL):
        return name, gyro
    others = (_of_one_sensor(messages.get(name)) for name in (*RAW_ACCELS, "IMU"))
    accel = next((_as_sampled(columns) for columns in others if _has(columns, *ACCEL)), None)
    nothing = np.full(len(gyro["timestamp"]), np.nan)
    return name, {
        **gyro,
        **{
            axis: nothing if accel is None else np.interp(gyro["timestamp"], accel["timestamp"], accel[axis])
            for axis in ACCEL
        },
    }


def _as_sampled(columns: Columns) -> Columns:
    """By the times of the samples, where these are logged beside those of the messages."""
    return {**columns, "timestamp": columns["SampleUS"]} if "SampleUS" in columns else columns


def _where(columns: Columns, chosen: Array) -> Columns:
    return {name: values[chosen] for name, values in columns.items()}


def _receiver_in_use(columns: Columns | None) -> Columns | None:
    if columns is None or not _has(columns):
        return None
    used = columns["U"] == 1 if "U" in columns else np.zeros(len(columns["timestamp"]), bool)
    return _where(columns, used) if used.any() else _of_one_sensor(columns)


def _parameters(columns: Columns | None) -> dict[str, float]:
    if columns is None or "Name" not in columns or "Value" not in columns:
        return {}
    names = (name.decode("ascii", "replace") for name in columns["Name"].tolist())
    return dict(zip(names, columns["Value"].tolist(), strict=True))


def _utc_offset(gps: Columns | None) -> float | None:
    """s; median over all fixes."""
    if gps is None or not _has(gps, "GWk", "GMS"):
        return None
    weeks = gps["GWk"].astype(float)
    utc = GPS_EPOCH + WEEK_S * weeks + 1e-3 * gps["GMS"] - LEAP_S
    told = weeks > 0.0
    return float(np.median((utc - 1e-6 * gps["timestamp"])[told])) if told.any() else None


def _heartbeats(messages: dict[str, dict[str, Array]], begin: float, end: float) -> Said:
    """As ArduPilot says it: armed, and active in the air. Where nothing tells whether it flies, it does while armed."""
    changes: list[tuple[float, bool | None, bool | None]] = []
    if _has(events := messages.get("EV"), "Id"):
        changes += [(t, *EVENTS[id]) for t, id in rows(events, "Id") if id in EVENTS]
    if _has(arming := messages.get("ARM"), "ArmState"):
        changes += [(t, bool(armed), None) for t, armed in rows(arming, "ArmState")]
    if _has(status := messages.get("STAT"), "Armed", "isFlying"):
        changes += [(t, bool(armed), bool(flies)) for t, armed, flies in rows(status, "Armed", "isFlying")]
    changes.sort(key=lambda change: change[0])
    tells_flight = any(flies is not None for *_, flies in changes)
    armed = flies = False
    activities = []
    for t, now_armed, now_flies in changes:
        armed = armed if now_armed is None else now_armed
        flies = flies if now_flies is None else now_flies
        activities.append(Activity(t, armed, flies if tells_flight else armed))
    kind = _kind_of_vehicle(messages.get("MSG"))
    return heartbeats(begin, end, activities, kind=kind, autopilot=common.MAV_AUTOPILOT_ARDUPILOTMEGA)


def _kind_of_vehicle(columns: Columns | None) -> Any:
    """A copter, unless its first messages name another firmware."""
    texts = columns["Message"].tolist() if columns is not None and "Message" in columns else []
    firmware = " ".join(text.decode("ascii", "replace") for text in texts[:100])
    return next(
        (kind for name, kind in KIND_OF_VEHICLE.items() if name in firmware), common.MAV_TYPE_QUADROTOR
    )


def _attitudes(messages: dict[str, dict[str, Array]], begin: float) -> Said:
    """Of the estimator that flies; else of the first core, else of the backup."""
    for name in ("ATT", *QUATERNIONS, *STATES, BACKUP):
        columns = _of_one_sensor(messages.get(name))
        if _has(columns, "Q1", "Q2", "Q3", "Q4"):
            yield from (attitude(t, q) for t, *q in thinned(rows(columns, "Q1", "Q2", "Q3", "Q4"), begin))
            return
        if _has(columns, "Roll", "Pitch", "Yaw"):
            for t, *rpy in thinned(rows(columns, "Roll", "Pitch", "Yaw"), begin):
                if all(map(math.isfinite, rpy)):
                    attitude_matrix = rotation.from_euler(*(math.radians(angle) for angle in rpy))
                    yield attitude(t, rotation.to_quaternion(attitude_matrix).tolist())
            return


def _positions(messages: dict[str, dict[str, Array]]) -> tuple[Said, tuple[str, ...]]:
    """Of the estimator that flies; else of the first core, which needs no GPS; else of the backup. And those that are
    not used, in words.
    """
    origin = _origin(messages.get("ORGN"))
    if places := _places(messages.get("POS")):
        return _global_positions(places, origin), ()
    states, unknown = _states(messages)
    why = "not known by the estimator's own word, XKF4.SS: take off once it has GPS, optical flow or vision"
    left_out = (f"{unknown} positions ({why})",) if unknown else ()
    if states:
        return _local_positions(states, origin), left_out
    return _global_positions(_places(messages.get(BACKUP)), origin), left_out


def _places(columns: Columns | None) -> list[tuple[float, Geodetic]]:
    """Where it was, each with its time [s]."""
    if not _has(columns, "Lat", "Lng", "Alt"):
        return []
    return [
        (t, Geodetic.from_degrees(latitude, longitude, height))
        for t, latitude, longitude, height in thinned(rows(columns, "Lat", "Lng", "Alt"))
        if _is_place(latitude, longitude, height)
    ]


def _global_positions(places: list[tuple[float, Geodetic]], origin: Geodetic | None) -> Said:
    """Global, and local from the estimator's origin, or where that is not logged from the first place."""
    if not places:
        return
    start = origin or places[0][1]
    times = np.array([t for t, _ in places])
    local = np.array([to_ned(place, start) for _, place in places])
    for (t, place), position, velocity in zip(
        places, local.tolist(), _slopes(times, local).tolist(), strict=True
    ):
        yield local_position(t, position, velocity)
        yield global_position(t, place, velocity)


def _local_positions(states: list[list[float]], origin: Geodetic | None) -> Said:
    """Local, see `_states`, and where the estimator's origin is logged global."""
    for t, *row in states:
        position, velocity = row[:3], row[3:]
        yield local_position(t, position, velocity)
        if origin is not None and np.isfinite(row).all():
            yield global_position(t, from_ned(np.array(position), origin), velocity)


def _states(messages: dict[str, dict[str, Array]]) -> tuple[list[list[float]], int]:
    """time [s], position [m] and velocity [m/s] in NED from the estimator's origin, while it holds them for known; and
    how many it does not.
    """
    for name, status in STATES.items():
        columns = _of_one_sensor(messages.get(name))
        if _has(columns, *STATE):
            known = _known(columns, _of_one_sensor(messages.get(status)))
            return list(thinned(rows(_where(columns, known), *STATE))), int(np.count_nonzero(known == 0))
    return [], 0


def _known(states: Columns, statuses: Columns | None) -> Array:
    """(n,) whether the status, which is written right after a state, holds its position for known."""
    if not _has(statuses, "SS"):
        return np.ones(len(states["timestamp"]), bool)
    after = np.searchsorted(statuses["timestamp"], states["timestamp"])
    flags = statuses["SS"].astype(int)[np.minimum(after, len(statuses["SS"]) - 1)]
    return np.asarray((flags & LEVEL_KNOWN != 0) & (flags & HEIGHT_KNOWN != 0))


def _is_place(latitude: float, longitude: float, height: float) -> bool:
    """Without one, ArduPilot writes 0° N 0° E."""
    return (
        abs(latitude) <= 90.0
        and abs(longitude) <= 180.0
        and abs(height) < HIGHEST_PLACE_M
        and (latitude, longitude) != (0.0, 0.0)
    )


def _origin(columns: Columns | None) -> Geodetic | None:
    """The last one that the log tells; it is set once."""
    if not _has(columns, "Type", "Lat", "Lng", "Alt"):
        return None
    told = [row[1:] for t, *row in rows(columns, "Type", "Lat", "Lng", "Alt") if row[0] == EKF_ORIGIN]
    return Geodetic.from_degrees(*told[-1]) if told and _is_place(*told[-1]) else None


def _slopes(times: Array, places: Array) -> Array:
    """(n, 3) m/s of places (n, 3) m, from the neighbours on either side; 0 next to a gap."""
    if len(times) < 2:
        return np.zeros_like(places)
    before, after = (
        np.maximum(np.arange(len(times)) - 1, 0),
        np.minimum(np.arange(len(times)) + 1, len(times) - 1),
    )
    elapsed = times[after] - times[before]
    sound = (elapsed > 0.0) & (elapsed < 2.0 * POSITION_GAP_S)
    return np.asarray((places[after] - places[before]) / np.where(sound, elapsed, np.inf)[:, None])


def _fixes(gps: Columns | None, accuracy: Columns | None) -> Said:
    names = ("Status", "Lat", "Lng", "Alt", "NSats")
    if gps is None or not _has(gps, *names):
        return
    told = list(rows(accuracy, "HAcc", "VAcc")) if _has(accuracy, "HAcc", "VAcc") else []
    at = [t for t, *_ in told]
    for t, status, latitude, longitude, height, satellites in rows(gps, *names):
        # It is written right after the fix that it is of.
        k = min(bisect_left(at, t), len(at) - 1)
        sigmas = told[k][1:] if told and abs(at[k] - t) < GPS_FIX_AGE_S else [0.0, 0.0]
        whole = [
            round(value) if math.isfinite(value) else 0
            for value in (1e7 * latitude, 1e7 * longitude, 1e3 * height)
        ]
        mm = [round(1e3 * sigma) if 0.0 <= sigma < 1e4 else 0 for sigma in sigmas]
        yield fix(t, int(status), whole, int(satellites), mm)
