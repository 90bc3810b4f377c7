"""Messages to bytes and back: what the drones of a team say to each other, in MessagePack.

Every message is an array whose first element is its version; `docs/wire.md` lists the fields. Nobody vouches
for the bytes, so they are capped in size before anything reads them, then typed and bounded by msgspec, then
checked for what types cannot say: finite numbers, unit quaternions, covariances that are ones. Anything else
is a `DecodeError`, and nothing else is ever raised.

On the wire a time is told twice: as UTC, and as its age when the bytes were made, which no wall clock enters.
`utc_offset` is `clock.utc() - clock.now()` as the bytes are made. Which of the two a reader believes is the
transport's to decide (`transport/sender_clock.py`); it hands over times on our own clock.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from typing import Annotated, Any, ClassVar, Final, Literal, NamedTuple, TypeVar

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from swarmtrack.errors import SwarmtrackError
from swarmtrack.geometry.camera import Equidistant, PinholeCamera, RadTan
from swarmtrack.geometry.rotation import from_quaternion, is_rotation, to_quaternion
from swarmtrack.messages import (
    Announcement,
    Array,
    IdentifiedTrack,
    LinkStatus,
    Sighting,
    SightingReport,
    TrackList,
)

VERSION: Final = 1
MAX_BYTES: Final = 64 * 1024  # of one message; checked before anything is decoded
MAX_TRACKS: Final = 255  # 255 tracks of at most 200 bytes stay below MAX_BYTES
MAX_SIGHTINGS: Final = 255
MAX_JPEG: Final = MAX_BYTES - 512  # leaves room for everything else in a view
MAX_KNOWN: Final = 1024  # as many drones as a transport remembers
SIGNATURE_BYTES: Final = 64  # Ed25519

_NORM_TOLERANCE = 1e-6  # of a quaternion or direction: far above rounding, far below a mistake
# How NaN and infinity begin in MessagePack, as float64 and float32. Where these bytes do not occur, as nearly always,
# nothing need be looked through; a picture or half a number may hold them by chance.
_PERHAPS_NOT_FINITE = re.compile(rb"\xcb[\x7f\xff][\xf0-\xff]|\xca[\x7f\xff][\x80-\xff]", re.DOTALL)
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
Component = Annotated[float, Meta(ge=-1.1, le=1.1)]  # of a unit quaternion or vector
Pixels = Annotated[float, Meta(ge=-1e7, le=1e7)]  # or px/s
Length = Annotated[float, Meta(ge=0.0, le=1e7)]
Moment = Annotated[float, Meta(ge=-1e15, le=1e15)]  # an entry of a covariance
Probability = Annotated[float, Meta(ge=0.0, le=1.0)]
Rate = Annotated[float, Meta(ge=-1e3, le=1e3)]  # rad/s
Quantity = Annotated[float, Meta(ge=-1e15, le=1e15)]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Name = Annotated[str, Meta(max_length=64)]
Line = Annotated[str, Meta(max_length=256)]


class AnnouncementMessage(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True):
    """`pose/<id>`: who I am and where I started, in the team's NED frame.

    t_utc_s: when the pose held, by the sender's UTC; age_s: how long ago that was when these bytes were made.
    quaternion_wxyz: world from body; position_cov_m2: upper triangle, row by row. signature: see `signed_part`.
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
    age_s: Seconds
    signature: Annotated[bytes, Meta(min_length=SIGNATURE_BYTES, max_length=SIGNATURE_BYTES)] | None = None


class SightingMessage(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True):
    """One teammate in view: the unit vector towards it from the observer's camera, in the team's NED frame."""

    what: ClassVar[str] = "sighting"
    drone_id: DroneId
    probability: Probability
    direction: tuple[Component, Component, Component]
    sigma_rad: Annotated[float, Meta(ge=0.0, le=math.pi)]


class SightingsMessage(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True):
    """`identities/<id>`: whom one drone sees, and where its camera was at the exposure, `age_s` before it was sent.

    sequence counts what this boot published; known: whose announcements the observer has.
    """

    what: ClassVar[str] = "sightings"
    version: Literal[1]
    drone_id: DroneId
    boot: Boot
    sequence: Sequence
    t_utc_s: UtcSeconds
    t_sigma_s: Seconds
    age_s: Seconds
    position_m: tuple[Metres, Metres, Metres]
    position_sigma_m: Length
    known: Annotated[tuple[DroneId, ...], Meta(max_length=MAX_KNOWN)]
    sightings: Annotated[tuple[SightingMessage, ...], Meta(max_length=MAX_SIGHTINGS)]


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


class TimeOffsetHealth(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True):
    """exposure on the IMU's clock = stamp + offset: what the flight says of it (null: nothing), and what is used."""

    found_s: SignedSeconds | None
    sigma_s: Seconds | None
    used_s: SignedSeconds


class GyroBiasHealth(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True):
    """What the gyro says at rest, body FRD: what the flight says of it (null: nothing), and what is taken off."""

    found_rad_s: tuple[Rate, Rate, Rate] | None
    sigma_rad_s: Annotated[float, Meta(ge=0.0, le=1e3)] | None
    used_rad_s: tuple[Rate, Rate, Rate]


class ConsistencyHealth(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True):
    """Mean normalised innovation squared of the last detections; the band in which it lies if the tracker is right."""

    nis: Quantity
    low: Quantity
    high: Quantity


class ReadinessHealth(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True):
    """Whether the drone could fly now, and if not, why."""

    ready: bool
    reasons: Annotated[tuple[Line, ...], Meta(max_length=16)]


class HealthMessage(msgspec.Struct, array_like=True, frozen=True):
    """`health/<id>`: how the agent is doing. clock_offset_s: ours minus the autopilot's, null without one.

    drops counts what was thrown away since the start, by place; events holds the last lines worth reading. It alone
    may grow: what a reader misses at its end is null, and what it does not know there it leaves (decision 10).
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
    time_offset: TimeOffsetHealth | None = None
    gyro_bias: GyroBiasHealth | None = None
    consistency: ConsistencyHealth | None = None
    readiness: ReadinessHealth | None = None


class LensMessage(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True):
    """A calibrated lens, in pixels of the calibrated image; coefficients: of the distortion, empty without one."""

    what: ClassVar[str] = "lens"
    width: Annotated[int, Meta(ge=1, le=65535)]
    height: Annotated[int, Meta(ge=1, le=65535)]
    fx: Pixels
    fy: Pixels
    cx: Pixels
    cy: Pixels
    distortion: Literal["radtan", "equidistant"] | None
    coefficients: Annotated[tuple[Quantity, ...], Meta(max_length=8)]


class VideoMessage(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True):
    """`video/<id>`: one frame for people, said only while somebody listens.

    t_utc_s: of the exposure; frame: as the camera counts them. width, height: of the picture, which is the whole image
    of `lens` made smaller. jpeg is empty where the camera sends no pictures. position_m and quaternion_wxyz: of the
    camera (x right, y down, z forward) in the team's NED frame, null where the drone does not know.
    """

    what: ClassVar[str] = "video"
    version: Literal[1]
    t_utc_s: UtcSeconds
    t_sigma_s: Seconds
    frame: Annotated[int, Meta(ge=0, le=2**53)]
    width: Annotated[int, Meta(ge=1, le=65535)]
    height: Annotated[int, Meta(ge=1, le=65535)]
    jpeg: Annotated[bytes, Meta(max_length=MAX_JPEG)]
    lens: LensMessage
    position_m: tuple[Metres, Metres, Metres] | None
    quaternion_wxyz: tuple[Component, Component, Component, Component] | None


Message = AnnouncementMessage | SightingsMessage | TracksMessage | HealthMessage | VideoMessage
_M = TypeVar("_M", AnnouncementMessage, SightingsMessage, TracksMessage, HealthMessage, VideoMessage)

_DECODERS: dict[type[Any], msgspec.msgpack.Decoder[Any]] = {
    kind: msgspec.msgpack.Decoder(kind)
    for kind in (AnnouncementMessage, SightingsMessage, TracksMessage, HealthMessage, VideoMessage)
}
_ENCODER = msgspec.msgpack.Encoder()


# --- announcement ---------------------------------------------------------------------------------


def encode_announcement(announcement: Announcement, utc_offset: float, now: float) -> bytes:
    """Ours to bytes, unsigned, as of `now`. Raises ValueError where a reader would refuse it."""
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
        age_s=max(0.0, float(now - a.t)),
    )
    return _encode(message)


def decode_announcement(data: bytes) -> AnnouncementMessage:
    """As it stands on the wire; its signature, if any, unchecked."""
    m = _decode(AnnouncementMessage, data)
    _check_unit("announcement: quaternion_wxyz", m.quaternion_wxyz, "a unit quaternion")
    _check_covariances("announcement: position_cov_m2", [m.position_cov_m2], 3)
    return m


def announcement(message: AnnouncementMessage, t: float, t_sigma: float) -> Announcement:
    """A teammate's announcement for us. t: when the pose held, on our monotonic clock."""
    m = message
    return Announcement(
        drone_id=m.drone_id,
        boot=m.boot,
        sequence=m.sequence,
        t=t,
        t_sigma=t_sigma,
        position=np.array(m.position_m),
        world_from_body=from_quaternion(m.quaternion_wxyz),
        position_cov=_symmetric(np.array([m.position_cov_m2]), 3)[0],
    )


# The signature is the last field of eleven. What it covers is the same array without it, so with another first
# byte; the bytes between are taken as they are, which spares signer and reader a canonical form.
_ARRAY_OF_10, _ARRAY_OF_11 = b"\x9a", b"\x9b"
_NIL = b"\xc0"
_SIGNATURE_HEAD = bytes([0xC4, SIGNATURE_BYTES])


class SignedPart(NamedTuple):
    """What was signed, and the signature."""

    signed: bytes
    signature: bytes


def sign_announcement(unsigned: bytes, key: str, sign: Callable[[bytes], bytes]) -> bytes:
    """What `encode_announcement` made, with its last field filled in. key: where it will be said."""
    assert unsigned[:1] == _ARRAY_OF_11, "as encode_announcement makes it"
    signature = sign(_signed(key, unsigned[1:-1]))
    return unsigned[:-1] + _SIGNATURE_HEAD + signature


def signed_part(data: bytes, key: str) -> SignedPart | None:
    """Of an announcement's bytes, heard on `key`; None where they are not signed in the one way that counts."""
    head = data[-SIGNATURE_BYTES - 2 : -SIGNATURE_BYTES]
    if data[:1] != _ARRAY_OF_11 or head != _SIGNATURE_HEAD:
        return None
    return SignedPart(_signed(key, data[1 : -SIGNATURE_BYTES - 2]), data[-SIGNATURE_BYTES:])


def _signed(key: str, fields: bytes) -> bytes:
    return key.encode() + b"\0" + _ARRAY_OF_10 + fields


# --- sightings ------------------------------------------------------------------------------------


def encode_sightings(report: SightingReport, utc_offset: float, now: float) -> bytes:
    """Ours to bytes, as of `now`. Raises ValueError where a reader would refuse it."""
    r = report
    message = SightingsMessage(
        version=VERSION,
        drone_id=r.observer,
        boot=r.boot,
        sequence=r.sequence,
        t_utc_s=float(r.t + utc_offset),
        t_sigma_s=float(r.t_sigma),
        age_s=max(0.0, float(now - r.t)),
        position_m=tuple(r.position.tolist()),
        position_sigma_m=float(r.position_sigma),
        known=r.known,
        sightings=tuple(
            SightingMessage(s.drone_id, float(s.probability), tuple(s.direction.tolist()), float(s.sigma))
            for s in r.sightings
        ),
    )
    return _encode(message)


def decode_sightings(data: bytes) -> SightingsMessage:
    """As it stands on the wire."""
    m = _decode(SightingsMessage, data)
    for sighting in m.sightings:
        _check_unit("sightings: direction", sighting.direction, "a unit vector")
    seen = [sighting.drone_id for sighting in m.sightings]
    for name, ids in (("sightings", seen), ("known", m.known)):
        if len(set(ids)) < len(ids):
            raise DecodeError(f"sightings: {name}: names a drone twice, expected each once")
    return m


def sighting_report(message: SightingsMessage, t: float, t_sigma: float) -> SightingReport:
    """A teammate's report for us. t: the exposure, on our monotonic clock."""
    m = message
    return SightingReport(
        observer=m.drone_id,
        boot=m.boot,
        sequence=m.sequence,
        t=t,
        t_sigma=t_sigma,
        position=np.array(m.position_m),
        position_sigma=m.position_sigma_m,
        known=m.known,
        sightings=tuple(
            Sighting(s.drone_id, s.probability, np.array(s.direction), s.sigma_rad) for s in m.sightings
        ),
    )


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


class _NumberedMessage(msgspec.Struct, array_like=True, frozen=True):
    """The first fields of `TracksMessage`."""

    version: Literal[1]
    t_utc_s: float
    t_sigma_s: float
    sequence: int


_NUMBERED = msgspec.msgpack.Decoder(_NumberedMessage)


def tracks_sequence(data: bytes) -> int:
    """The number of a tracks message, whatever else is in it. Raises DecodeError."""
    try:
        return _NUMBERED.decode(data).sequence
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise DecodeError(f"{TracksMessage.what}: {error} in {len(data)} bytes") from None


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


# --- video ----------------------------------------------------------------------------------------


def lens_message(camera: PinholeCamera) -> LensMessage:
    """A lens as it goes on the wire."""
    c, distortion = camera, camera.distortion
    name: Literal["radtan", "equidistant"] | None = None
    coefficients: tuple[float, ...] = ()
    if distortion is not None:
        name = "radtan" if isinstance(distortion, RadTan) else "equidistant"
        coefficients = tuple(map(float, distortion.coefficients))
    return LensMessage(c.width, c.height, c.fx, c.fy, c.cx, c.cy, name, coefficients)


def lens(message: LensMessage) -> PinholeCamera:
    """The camera a message tells of. Raises DecodeError where there is no such lens."""
    m = message
    kinds: dict[str, type[RadTan] | type[Equidistant]] = {"radtan": RadTan, "equidistant": Equidistant}
    try:
        distortion = None if m.distortion is None else kinds[m.distortion](m.coefficients)
        return PinholeCamera(m.fx, m.fy, m.cx, m.cy, m.width, m.height, distortion)
    except ValueError as error:
        raise DecodeError(f"video: lens: {error}") from None


def encode_video(message: VideoMessage) -> bytes:
    """Raises ValueError where a reader would refuse it."""
    return _encode(message)


def decode_video(data: bytes) -> VideoMessage:
    m = _decode(VideoMessage, data)
    if m.quaternion_wxyz is not None:
        _check_unit("video: quaternion_wxyz", m.quaternion_wxyz, "a unit quaternion")
    if not (m.lens.fx > 0.0 and m.lens.fy > 0.0):
        raise DecodeError(f"video: lens: focal lengths are {m.lens.fx:g} and {m.lens.fy:g}, expected above 0")
    return m


# --- for people -----------------------------------------------------------------------------------


def as_record(message: Message) -> dict[str, Any]:
    """The message with its fields named, ready for JSON; the names carry the units."""
    record: dict[str, Any] = _named(message)
    return record


def from_record(kind: type[_M], record: Mapping[str, Any]) -> _M:
    """What `as_record` named, checked again as if it were heard. Raises DecodeError."""
    message: _M = _CHECKED[kind](_ENCODER.encode(_unnamed(msgspec.inspect.type_info(kind), record)))
    return message


def _unnamed(kind: msgspec.inspect.Type, value: Any) -> Any:
    """A record as the array that stands on the wire; what is no record of this kind is left for msgspec to refuse."""
    match kind:
        case msgspec.inspect.StructType() if isinstance(value, Mapping):
            return [_unnamed(field.type, value.get(field.name)) for field in kind.fields]
        case msgspec.inspect.DictType() if isinstance(value, Mapping):
            return {name: _unnamed(kind.value_type, v) for name, v in value.items()}
        case msgspec.inspect.VarTupleType() if isinstance(value, list | tuple):
            return [_unnamed(kind.item_type, v) for v in value]
        case msgspec.inspect.UnionType() if isinstance(value, Mapping):  # of ours: a struct or null
            return next(
                _unnamed(one, value) for one in kind.types if isinstance(one, msgspec.inspect.StructType)
            )
    return value


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
    # An array (0x90 | length, or 0xdc and two bytes of it) of another version deserves the better of two error texts.
    version = data[3:4] if data[:1] == b"\xdc" else data[1:2] if data[:1] and data[0] & 0xF0 == 0x90 else b""
    if version and version[0] < 0x80 and version[0] != VERSION:
        raise DecodeError(f"{kind.what}: is of version {version[0]}, this program reads version {VERSION}")
    try:
        message: _M = _DECODERS[kind].decode(data)
    except msgspec.ValidationError as error:
        raise DecodeError(f"{kind.what}: {_with_field_name(kind, str(error))}") from None
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise DecodeError(f"{kind.what}: {error} in {len(data)} bytes") from None
    if _PERHAPS_NOT_FINITE.search(data) and not _is_finite(message):
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


def _check_unit(where: str, components: tuple[float, ...], expected: str) -> None:
    norm = math.sqrt(sum(c * c for c in components))
    if abs(norm - 1.0) > _NORM_TOLERANCE:
        raise DecodeError(f"{where}: norm is {norm:.6g}, expected {expected}")


def _check_covariances(where: str, uppers: list[tuple[float, ...]], n: int) -> None:
    """uppers: upper triangles of (n, n) matrices, each to be positive semi-definite."""
    cov = _symmetric(np.array(uppers), n)
    try:
        np.linalg.cholesky(cov)
        return
    except np.linalg.LinAlgError:  # singular ones are allowed, and need a closer look
        pass
    smallest = np.linalg.eigvalsh(cov)[:, 0]
    if not np.all(smallest >= -_COVARIANCE_TOLERANCE * np.trace(cov, axis1=1, axis2=2)):
        raise DecodeError(
            f"{where}: has the eigenvalue {smallest.min():.3g}, expected a covariance (none negative)"
        )


def _upper_triangle(matrix: Array) -> tuple[float, ...]:
    return tuple(matrix[_UPPER[len(matrix)]].tolist())


def _entries(n: int) -> NDArray[np.intp]:
    """(n, n): which entry of the upper triangle stands there."""
    entry = np.zeros((n, n), dtype=np.intp)
    entry[_UPPER[n]] = np.arange(n * (n + 1) // 2)
    return np.maximum(entry, entry.T)


_ENTRIES = {n: _entries(n) for n in _UPPER}


def _symmetric(upper: Array, n: int) -> Array:
    """upper (k, n(n+1)/2), row by row -> (k, n, n)."""
    matrix: Array = upper[:, _ENTRIES[n]]
    return matrix


_CHECKED: dict[type[Any], Any] = {
    AnnouncementMessage: decode_announcement,
    SightingsMessage: decode_sightings,
    TracksMessage: decode_tracks,
    HealthMessage: decode_health,
    VideoMessage: decode_video,
}
