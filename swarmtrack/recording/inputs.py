"""Inputs of `Onboard` as JSON and back, without losing a bit.

Each kind has a topic and a form: a key with its unit for each attribute of the message. A float is written with enough
digits to restore it exactly; NaN and infinity, which JSON does not have, are the strings "nan", "inf" and "-inf".
Every record carries a running number `n`, so a gap is visible.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec
import numpy as np

from swarmtrack.errors import RecordingError
from swarmtrack.messages import (
    AgreedMotion,
    Announcement,
    AutopilotRebooted,
    Detections,
    EgoPose,
    FlightState,
    IdClash,
    ImuSample,
    Input,
    MotionReport,
    PeerArrived,
    PeerDeparted,
    PeerExpelled,
    RangeReport,
    RemoteIdClaim,
    Sighting,
    SightingReport,
    StrangerRay,
    StrangerReport,
    VisualTurn,
)


class Entry(NamedTuple):
    """One attribute of a message under its key. shape: of an array, -1 for any length; form: of a nested message;
    added: to the form later, so that earlier records lack it and mean the attribute's default; sparse: absent from
    later records as well where it is 0.
    """

    attribute: str
    key: str
    shape: tuple[int, ...] | None = None
    type: str = "number"
    form: Form | None = None
    added: bool = False
    sparse: bool = False


class Form(NamedTuple):
    """Serialised form of one kind of message."""

    topic: str
    schema: str
    kind: type[Any]
    entries: tuple[Entry, ...]


_T = Entry("t", "t_s")
_BOOT = Entry("boot", "boot", type="string")
_DRONE = Entry("drone_id", "drone_id", type="integer")
_SEQUENCE = Entry("sequence", "sequence", type="integer")
_T_SIGMA = Entry("t_sigma", "t_sigma_s")
_POSITION = Entry("position", "position_m", (3,))

_STRANGER_RAY = Form(
    "",
    "swarmtrack.StrangerRay",
    StrangerRay,
    (
        Entry("number", "number", type="integer"),
        Entry("direction", "direction", (3,)),
        Entry("sigma", "sigma_rad"),
        Entry("width", "width_rad"),
    ),
)

_SIGHTING = Form(
    "",
    "swarmtrack.Sighting",
    Sighting,
    (
        _DRONE,
        Entry("probability", "probability"),
        Entry("direction", "direction", (3,)),
        Entry("sigma", "sigma_rad"),
        Entry("is_confirmed", "is_confirmed", type="boolean", added=True, sparse=True),
    ),
)

FORMS: tuple[Form, ...] = (
    Form(
        "/imu",
        "swarmtrack.ImuSample",
        ImuSample,
        (
            _T,
            Entry("gyro", "gyro_rad_s", (3,)),
            Entry("accel", "accel_m_s2", (3,)),
            Entry("gyro_delay", "gyro_delay_s", added=True),
        ),
    ),
    Form(
        "/turn",
        "swarmtrack.VisualTurn",
        VisualTurn,
        (
            Entry("since", "since_s"),
            _T,
            Entry("turn", "turn_rad", (3,)),
            Entry("variance", "variance_rad2"),
        ),
    ),
    Form(
        "/ego",
        "swarmtrack.EgoPose",
        EgoPose,
        (
            _T,
            _POSITION,
            Entry("world_from_body", "world_from_body", (3, 3)),
            Entry("position_sigma", "position_sigma_m"),
            Entry("attitude_sigma", "attitude_sigma_rad"),
            Entry("vertical_sigma", "vertical_sigma_m", added=True),
            Entry("ground", "ground_m", added=True, sparse=True),
            Entry("t_sigma", "t_sigma_s", added=True),
        ),
    ),
    Form(
        "/autopilot/flight",
        "swarmtrack.FlightState",
        FlightState,
        (_T, Entry("airborne_since", "airborne_since_s")),
    ),
    Form("/autopilot/rebooted", "swarmtrack.AutopilotRebooted", AutopilotRebooted, ()),
    Form(
        "/detections",
        "swarmtrack.Detections",
        Detections,
        (
            _T,
            _SEQUENCE,
            Entry("centre", "centre_px", (-1, 2)),
            Entry("size", "size_px", (-1, 2)),
            Entry("score", "score", (-1,)),
            Entry("covariance", "covariance_px2", (-1, 2, 2)),
            Entry("coverage", "coverage"),
            Entry("likeness", "likeness", (-1,), added=True),
            Entry("camera", "camera", type="integer", added=True, sparse=True),
        ),
    ),
    Form(
        "/peers/announcement",
        "swarmtrack.Announcement",
        Announcement,
        (
            _DRONE,
            _BOOT,
            _SEQUENCE,
            _T,
            _T_SIGMA,
            _POSITION,
            Entry("world_from_body", "world_from_body", (3, 3)),
            Entry("position_cov", "position_cov_m2", (3, 3)),
        ),
    ),
    Form("/peers/arrived", "swarmtrack.PeerArrived", PeerArrived, (_DRONE, _BOOT)),
    Form("/peers/departed", "swarmtrack.PeerDeparted", PeerDeparted, (_DRONE, _BOOT)),
    Form("/peers/expelled", "swarmtrack.PeerExpelled", PeerExpelled, (_DRONE,)),
    Form(
        "/peers/clash",
        "swarmtrack.IdClash",
        IdClash,
        (_DRONE, Entry("boots", "boots", type="strings"), Entry("ours", "ours", type="boolean")),
    ),
    Form(
        "/peers/sightings",
        "swarmtrack.SightingReport",
        SightingReport,
        (
            Entry("observer", "observer", type="integer"),
            _BOOT,
            _SEQUENCE,
            _T,
            _T_SIGMA,
            _POSITION,
            Entry("position_sigma", "position_sigma_m"),
            Entry("known", "known", type="integers"),
            Entry("sightings", "sightings", form=_SIGHTING),
            Entry("leans_on", "leans_on", type="integers", added=True, sparse=True),
        ),
    ),
    Form(
        "/peers/motion",
        "swarmtrack.MotionReport",
        MotionReport,
        (
            _DRONE,
            _BOOT,
            _SEQUENCE,
            _T,
            _T_SIGMA,
            Entry("displacement", "displacement_m", (3,)),
            Entry("displacement_cov", "displacement_cov_m2", (3, 3)),
            Entry("velocity", "velocity_m_s", (3,)),
            Entry("velocity_cov", "velocity_cov_m2_s2", (3, 3)),
        ),
    ),
    Form(
        "/peers/strangers",
        "swarmtrack.StrangerReport",
        StrangerReport,
        (
            Entry("observer", "observer", type="integer"),
            _BOOT,
            _SEQUENCE,
            _T,
            _T_SIGMA,
            _POSITION,
            Entry("position_sigma", "position_sigma_m"),
            Entry("tilt_sigma", "tilt_sigma_rad"),
            Entry("heading_sigma", "heading_sigma_rad"),
            Entry("rays", "rays", form=_STRANGER_RAY),
        ),
    ),
    Form(
        "/autopilot/remote_id",
        "swarmtrack.RemoteIdClaim",
        RemoteIdClaim,
        (
            _T,
            Entry("uas_id", "uas_id", type="string"),
            _POSITION,
            Entry("velocity", "velocity_m_s", (3,)),
            Entry("position_sigma", "position_sigma_m"),
            Entry("vertical_sigma", "vertical_sigma_m"),
        ),
    ),
    Form(
        "/ranges",
        "swarmtrack.RangeReport",
        RangeReport,
        (
            _DRONE,
            Entry("other", "other", type="integer"),
            _T,
            _T_SIGMA,
            Entry("distance", "distance_m"),
            Entry("sigma", "sigma_m"),
        ),
    ),
    Form(
        "/team/agreed",
        "swarmtrack.AgreedMotion",
        AgreedMotion,
        (
            _DRONE,
            Entry("t", "t_s", (-1,)),
            Entry("displacement", "displacement_m", (-1, 3)),
            Entry("planned", "planned", type="boolean"),
            Entry("tried", "tried", type="boolean", added=True),
        ),
    ),
)
FORM_OF_TOPIC = {form.topic: form for form in FORMS}
FORM_OF_KIND = {form.kind: form for form in FORMS}

_ENCODER = msgspec.json.Encoder()
_DECODER = msgspec.json.Decoder(dict[str, Any])


def encode(n: int, event: Input) -> bytes:
    """Record of an event, the n-th of a recording."""
    return _ENCODER.encode({"n": n, **_fields(FORM_OF_KIND[type(event)], event)})


def decode(topic: str, data: bytes) -> tuple[int, Input]:
    """Number and event of a record. Raises RecordingError for a malformed one."""
    try:
        record = _DECODER.decode(data)
        return record["n"], _READERS[topic](record)
    except (msgspec.MsgspecError, KeyError, TypeError, ValueError) as error:
        schema = FORM_OF_TOPIC[topic].schema
        raise RecordingError(f"{topic}: a record that is not {schema}: {error}") from None


def plain(value: float) -> float | str:
    """A number in a form that JSON can hold."""
    return value if math.isfinite(value) else str(value)


def numbers(array: Any) -> Any:
    """An array of any shape as nested lists."""
    if np.isfinite(array).all():
        return array.tolist()
    return [numbers(part) if np.ndim(part) else plain(float(part)) for part in array]


def _fields(form: Form, message: Any) -> dict[str, Any]:
    return {
        entry.key: _field(entry, getattr(message, entry.attribute))
        for entry in form.entries
        if not entry.sparse or getattr(message, entry.attribute)
    }


def _field(entry: Entry, value: Any) -> Any:
    if value is None or entry.type == "boolean":
        return value
    if entry.shape is not None:
        return numbers(value)
    if entry.form is not None:
        return [_fields(entry.form, part) for part in value]
    match entry.type:
        case "number":
            return plain(float(value))
        case "integer":
            return int(value)
        case "integers":
            return [int(part) for part in value]
        case "strings":
            return list(value)
    return value


def _reader(form: Form) -> Callable[[dict[str, Any]], Any]:
    """What makes a message of a record; how each attribute is read is looked up once, not with every record."""
    kind = form.kind
    parts = [(entry.attribute, entry.key, entry.added, _read_by(entry)) for entry in form.entries]

    def read(record: dict[str, Any]) -> Any:
        values = {}
        for attribute, key, added, convert in parts:
            if added and key not in record:
                continue
            value = record[key]
            values[attribute] = None if value is None else convert(value)
        return kind(**values)

    return read


def _read_by(entry: Entry) -> Callable[[Any], Any]:
    if entry.shape is not None:
        shape = entry.shape
        return lambda value: np.array(value, dtype=np.float64).reshape(shape)
    if entry.form is not None:
        read = _reader(entry.form)
        return lambda value: tuple(map(read, value))
    match entry.type:
        case "number":
            return float
        case "integers" | "strings":
            return tuple
    return lambda value: value


_READERS = {form.topic: _reader(form) for form in FORMS}
