"""Messages to bytes and back: what the drones of a team say to each other, in MessagePack.

Every message is an array whose first element is its version; `docs/wire.md` lists the fields. Nobody vouches
for the bytes, so they are capped in size before anything reads them, then typed and bounded by msgspec, then
checked for what types cannot say: finite numbers, unit quaternions, covariances that are ones. Anything else
is a `DecodeError`, and nothing else is ever raised.

On the wire times are UTC. `utc_offset` is `clock.utc() - clock.now()`, sampled by the transport as it sends
and as it receives.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Final, Literal, TypeVar

import msgspec
import numpy as np
from msgspec import Meta

from swarmtrack.errors import SwarmtrackError
from swarmtrack.geometry.rotation import from_quaternion, is_rotation, to_quaternion
from swarmtrack.messages import Announcement, Array, IdentifiedTrack, LinkStatus, TrackList

VERSION: Final = 1
MAX_BYTES: Final = 64 * 1024  # of one message; checked before anything is decoded
MAX_TRACKS: Final = 255  # 255 tracks of at most 200 bytes stay below MAX_BYTES

_QUATERNION_TOLERANCE = 1e-6  # of the norm: far above rounding, far below a mistake
_COVARIANCE_TOLERANCE = 1e-9  # of the trace: the most negative eigenvalue that rounding may leave


class DecodeError(SwarmtrackError):
    """Bytes from the network that are no message of ours; the text says which field and why."""


_UPPER = {n: np.triu_indices(n) for n in (3, 4)}  # rows and columns of an upper triangle, row by row


# What a field may hold. The bounds are not physics, they only keep later arithmetic far from overflow.
DroneId = Annotated[int, Meta(ge=1, le=65535)]
Boot = Annotated[str, Meta(pattern="^[0-9a-f]{8}$", min_length=8, max_length=8)]
Sequence = Annotated[int, Meta(ge=0, le=2**32 - 1)]
UtcSeconds = Annotated[float, Meta(ge=0.0, le=2.0**32)]  # until the year 2106
Seconds = Annotated[float, Meta(ge=0.0, le=1e9)]
SignedSeconds = Annotated[float, Meta(ge=-(2.0**33), le=2.0**33)]
Metres = Annotated[float, Meta(ge=-1e7, le=1e7)]
Component = Annotated[float, Meta(ge=-1.1, le=1.1)]  # of a unit quaternion
Pixels = Annotated[float, Meta(ge=-1e7, le=1e7)]  # or px/s
Length = Annotated[float, Meta(ge=0.0, le=1e7)]
Moment = Annotated[float, Meta(ge=-1e15, le=1e15)]  # an entry of a covariance
Probability = Annotated[float, Meta(ge=0.0, le=1.0)]
Quantity = Annotated[float, Meta(ge=-1e15, le=1e15)]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Name = Annotated[str, Meta(max_length=64)]
Line = Annotated[str, Meta(max_length=256)]


class AnnouncementMessage(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True):
    """`pose/<id>`: who I am and where I started, in the team's NED frame.

    quaternion_wxyz: world from body; position_cov_m2: upper triangle, row by row.
    signature: the seat of an Ed25519 signature; nobody writes or checks one yet.
    """

    what: ClassVar[str] = "announcement"
    version: Literal[1]
    drone_id: DroneId
    boot: Boot
    sequence: Sequence
    t_utc_s: UtcSeconds
    t_sigma_s: Seconds
    position_m: tuple[Metres, Metres, Metres]
    quaternion_wxyz: tuple[Component, Component, Component, Component]
    position_cov_m2: Annotated[tuple[Moment, ...], Meta(min_length=6, max_length=6)]
    signature: Annotated[bytes, Meta(max_length=64)] | None = None


class TrackMessage(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True):
    """One track in undistorted pixels. cov_upper: of [u, vu, v, vv], px and px/s, upper triangle, row by row.

    coasting_s: time since the first scan that missed it, null while it is being detected.
    """

    what: ClassVar[str] = "track"
    id: Annotated[int, Meta(ge=0, le=2**53)]
    identity: DroneId | Literal["foreign"] | None
    identity_probability: Probability
    u_px: Pixels
    vu_px_s: Pixels
    v_px: Pixels
    vv_px_s: Pixels
    cov_upper: Annotated[tuple[Moment, ...], Meta(min_length=10, max_length=10)]
    w_px: Length
    h_px: Length
    status: Literal["tentative", "confirmed", "lost"]
    probability: Probability
    coasting_s: Seconds | None


class TracksMessage(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True):
    """`tracks/<id>`: all that one drone tracks at `t_utc_s`; its last scan was exposed `scan_age_s` earlier.

    sequence counts what this boot published, so a jump by more than one is a lost message.
    """

    what: ClassVar[str] = "tracks"
    version: Literal[1]
    t_utc_s: UtcSeconds
    t_sigma_s: Seconds
    sequence: Sequence
    scan_age_s: Seconds
    tracks: Annotated[tuple[TrackMessage, ...], Meta(max_length=MAX_TRACKS)]


class RateHealth(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True):
    """How often something was asked for (null: as it comes), and how often it came."""

    asked_hz: Quantity | None
    got_hz: Quantity


class LatencyHealth(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True):
    """How long something took, over the last reporting interval."""

    p50_s: Seconds
    p95_s: Seconds
    max_s: Seconds


class LinkHealth(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True):
    """One camera, autopilot or network, as `LinkStatus` says it."""

    name: Name
    ok: bool
    text: Line
    counters: Annotated[dict[Name, Quantity], Meta(max_length=64)]


class HealthMessage(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True):
    """`health/<id>`: how the agent is doing. clock_offset_s: ours minus the autopilot's, null without one.

    drops counts what was thrown away since the start, by place; events holds the last lines worth reading.
    """

    what: ClassVar[str] = "health"
    version: Literal[1]
    t_utc_s: UtcSeconds
    boot: Boot
    uptime_s: Seconds
    cpu_percent: Quantity
    rss_mb: Quantity
    rates: Annotated[dict[Name, RateHealth], Meta(max_length=32)]
    latencies: Annotated[dict[Name, LatencyHealth], Meta(max_length=32)]
    clock_offset_s: SignedSeconds | None
    clock_offset_sigma_s: Seconds | None
    links: Annotated[tuple[LinkHealth, ...], Meta(max_length=32)]
    drops: Annotated[dict[Name, Count], Meta(max_length=64)]
    events: Annotated[tuple[Line, ...], Meta(max_length=32)]


Message = AnnouncementMessage | TracksMessage | HealthMessage
_M = TypeVar("_M", AnnouncementMessage, TracksMessage, HealthMessage)

_DECODERS: dict[type[Any], msgspec.msgpack.Decoder[Any]] = {
    kind: msgspec.msgpack.Decoder(kind) for kind in (AnnouncementMessage, TracksMessage, HealthMessage)
}
_ENCODER = msgspec.msgpack.Encoder()


# --- announcement ---------------------------------------------------------------------------------


def encode_announcement(announcement: Announcement, utc_offset: float) -> bytes:
    """Ours to bytes. Raises ValueError where a reader would refuse it."""
    a = announcement
    if not is_rotation(a.world_from_body):
        raise ValueError("announcement: world_from_body is no rotation")
    message = AnnouncementMessage(
        version=VERSION,
        drone_id=a.drone_id,
        boot=a.boot,
        sequence=a.sequence,
        t_utc_s=float(a.t + utc_offset),
        t_sigma_s=float(a.t_sigma),
        position_m=tuple(a.position.tolist()),
        quaternion_wxyz=tuple(to_quaternion(a.world_from_body).tolist()),
        position_cov_m2=_upper_triangle(a.position_cov),
    )
    return _encode(message)


def decode_announcement(data: bytes, utc_offset: float) -> Announcement:
    """Bytes to a teammate's announcement, its time moved to our monotonic clock."""
    m = decode_announcement_message(data)
    return Announcement(
        drone_id=m.drone_id,
        boot=m.boot,
        sequence=m.sequence,
        t=m.t_utc_s - utc_offset,
        t_sigma=m.t_sigma_s,
        position=np.array(m.position_m),
        world_from_body=from_quaternion(m.quaternion_wxyz),
        position_cov=_symmetric(np.array([m.position_cov_m2]), 3)[0],
    )


def decode_announcement_message(data: bytes) -> AnnouncementMessage:
    """As it stands on the wire, times in UTC."""
    m = _decode(AnnouncementMessage, data)
    norm = math.sqrt(sum(c * c for c in m.quaternion_wxyz))
    if abs(norm - 1.0) > _QUATERNION_TOLERANCE:
        raise DecodeError(f"announcement: quaternion_wxyz: norm is {norm:.6g}, expected a unit quaternion")
    _check_covariances("announcement: position_cov_m2", [m.position_cov_m2], 3)
    return m


# --- tracks ---------------------------------------------------------------------------------------


def tracks_message(tracks: TrackList, sequence: int, utc_offset: float, t_sigma: float) -> TracksMessage:
    """A drone's tracks as they go on the wire; of more than `MAX_TRACKS` the most probable.

    t_sigma [s] is what we know of our own UTC.
    """
    kept = tracks.tracks
    if len(kept) > MAX_TRACKS:
        kept = tuple(sorted(kept, key=lambda k: -k.track.probability)[:MAX_TRACKS])
    return TracksMessage(
        version=VERSION,
        t_utc_s=float(tracks.t + utc_offset),
        t_sigma_s=float(t_sigma),
        sequence=sequence,
        scan_age_s=max(0.0, float(tracks.t - tracks.scan_t)),
        tracks=tuple(_track_message(k, tracks.t) for k in kept),
    )


def _track_message(identified: IdentifiedTrack, now: float) -> TrackMessage:
    track = identified.track
    u, vu, v, vv = track.mean.tolist()
    w, h = track.size.tolist()
    since = track.coasting_since
    return TrackMessage(
        id=int(track.id),  # not NumPy's
        identity=identified.identity,
        identity_probability=float(identified.identity_probability),
        u_px=u,
        vu_px_s=vu,
        v_px=v,
        vv_px_s=vv,
        cov_upper=_upper_triangle(track.cov),
        w_px=w,
        h_px=h,
        status=track.status.value,
        probability=float(track.probability),
        coasting_s=None if since is None else max(0.0, float(now - since)),
    )


def encode_tracks(message: TracksMessage) -> bytes:
    """Raises ValueError where a reader would refuse a number in it.

    Fifty times a second the bounds are checked, which NaN fails too, but not again that covariances are such: trackers
    update in Joseph form.
    """
    data = _ENCODER.encode(message)
    try:
        _DECODERS[TracksMessage].decode(data)
    except msgspec.MsgspecError as error:
        raise ValueError(f"{message.what}: {_with_field_name(TracksMessage, str(error))}") from None
    return data


def decode_tracks(data: bytes) -> TracksMessage:
    m = _decode(TracksMessage, data)
    if m.tracks:
        _check_covariances("tracks: cov_upper", [track.cov_upper for track in m.tracks], 4)
    return m


def track_cov(track: TrackMessage) -> Array:
    """The covariance (4, 4) of [u, vu, v, vv], px and px/s."""
    cov: Array = _symmetric(np.array([track.cov_upper]), 4)[0]
    return cov


# --- health ---------------------------------------------------------------------------------------


def link_health(status: LinkStatus) -> LinkHealth:
    """A link's state, cut to what fits on the wire; a counter that is not a number (yet) is left out."""
    counters = {name[:64]: float(value) for name, value in status.counters[:64] if math.isfinite(value)}
    return LinkHealth(name=status.name[:64], ok=status.ok, text=status.text[:256], counters=counters)


def encode_health(message: HealthMessage) -> bytes:
    """Raises ValueError where a reader would refuse it."""
    return _encode(message)


def decode_health(data: bytes) -> HealthMessage:
    return _decode(HealthMessage, data)


# --- for people -----------------------------------------------------------------------------------


def as_record(message: Message) -> dict[str, Any]:
    """The message with its fields named, ready for JSON; the names carry the units."""
    record: dict[str, Any] = _named(message)
    return record


def _named(value: Any) -> Any:
    if isinstance(value, msgspec.Struct):
        return {name: _named(getattr(value, name)) for name in value.__struct_fields__}
    if isinstance(value, Mapping):
        return {name: _named(v) for name, v in value.items()}
    if isinstance(value, tuple):
        return [_named(v) for v in value]
    return value.hex() if isinstance(value, bytes) else value


# --- the common part ------------------------------------------------------------------------------


def _encode(message: Message) -> bytes:
    data = _ENCODER.encode(message)
    try:
        _CHECKED[type(message)](data)  # we never send what we would not read
    except DecodeError as error:
        raise ValueError(str(error)) from None
    return data


def _decode(kind: type[_M], data: bytes) -> _M:
    if len(data) > MAX_BYTES:
        raise DecodeError(f"{kind.what}: has more than {MAX_BYTES} bytes")
    # A short array (0x90 | length) that starts with another version deserves the better of two error texts.
    if len(data) > 1 and data[0] & 0xF0 == 0x90 and data[1] < 0x80 and data[1] != VERSION:
        raise DecodeError(f"{kind.what}: is of version {data[1]}, this program reads version {VERSION}")
    try:
        message: _M = _DECODERS[kind].decode(data)
    except msgspec.ValidationError as error:
        raise DecodeError(f"{kind.what}: {_with_field_name(kind, str(error))}") from None
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise DecodeError(f"{kind.what}: {error} in {len(data)} bytes") from None
    if not _is_finite(message):
        raise DecodeError(f"{kind.what}: holds NaN or infinity, expected finite numbers")
    return message


def _with_field_name(kind: type[msgspec.Struct], text: str) -> str:
    """msgspec counts (`$[6][0]`), people name (`position_m[0]`)."""

    def name(match: re.Match[str]) -> str:
        return f"`{kind.__struct_fields__[int(match[1])]}"

    return re.sub(r"`\$\[(\d+)\]", name, text)


def _is_finite(value: object) -> bool:
    """Whether every number in it is. The bounds refuse NaN too, but only by the way msgspec happens to compare."""
    if isinstance(value, float):
        return math.isfinite(value)
    if isinstance(value, msgspec.Struct):
        value = msgspec.structs.astuple(value)
    elif isinstance(value, dict):
        value = tuple(value.values())
    if not isinstance(value, tuple):
        return True
    # Floats are looked at here and not in a call each: a message holds hundreds, fifty times a second.
    return all(math.isfinite(item) if type(item) is float else _is_finite(item) for item in value)


def _check_covariances(where: str, uppers: list[tuple[float, ...]], n: int) -> None:
    """uppers: upper triangles of (n, n) matrices, each to be positive semi-definite."""
    cov = _symmetric(np.array(uppers), n)
    smallest = np.linalg.eigvalsh(cov)[:, 0]
    if not np.all(smallest >= -_COVARIANCE_TOLERANCE * np.trace(cov, axis1=1, axis2=2)):
        raise DecodeError(
            f"{where}: has the eigenvalue {smallest.min():.3g}, expected a covariance (none negative)"
        )


def _upper_triangle(matrix: Array) -> tuple[float, ...]:
    return tuple(matrix[_UPPER[len(matrix)]].tolist())


def _symmetric(upper: Array, n: int) -> Array:
    """upper (k, n(n+1)/2), row by row -> (k, n, n)."""
    rows, columns = _UPPER[n]
    matrix = np.empty((len(upper), n, n))
    matrix[:, rows, columns] = upper
    matrix[:, columns, rows] = upper
    return matrix


_CHECKED: dict[type[Any], Any] = {
    AnnouncementMessage: decode_announcement_message,
    TracksMessage: decode_tracks,
    HealthMessage: decode_health,
}
