"""`tracks/<id>`: the current tracks of a drone."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import msgspec
import numpy as np
from msgspec import Meta

from swarmtrack.messages import Array, IdentifiedTrack, RelativeState, TrackList
from swarmtrack.wire.checks import DecodeError, check_covariances, symmetric, upper_triangle
from swarmtrack.wire.fields import (
    MAX_MESSAGE_BYTES,
    MAX_TRACKS,
    WIRE_VERSION,
    CameraNumber,
    DroneId,
    Length,
    Moment,
    Pixels,
    Position,
    Probability,
    Record,
    Seconds,
    Sequence,
    UtcSeconds,
    Velocity,
)

# Bytes at most: of everything but records, of a track, of a proof, of a relative state.
_FRAME_BYTES, _TRACK_BYTES, _PROOF_BYTES, _RELATIVE_BYTES = 64, 200, 28, 320


class TrackMessage(Record, frozen=True):
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


class ProofMessage(Record, frozen=True):
    """A name confirmed by the track's motion alone: its probability, and for how long it has been confirmed."""

    what: ClassVar[str] = "proof"
    track_id: Annotated[int, Meta(ge=0, le=2**53)]
    probability: Probability
    proved_s: Seconds


class RelativeMessage(Record, frozen=True):
    """Position and velocity of a track's teammate relative to this drone's camera, in team axes (NED).

    cov: of (position_m, velocity_m_s), upper triangle, row by row. range_sigma_log: uncertainty of the range, as a
    share of it. sources: measurements used in addition to the direction.
    """

    what: ClassVar[str] = "relative"
    track_id: Annotated[int, Meta(ge=0, le=2**53)]
    position_m: Position
    velocity_m_s: Velocity
    cov: Annotated[tuple[Moment, ...], Meta(min_length=21, max_length=21)]
    range_sigma_log: Annotated[float, Meta(ge=0.0, le=100.0)]
    sources: Annotated[tuple[Annotated[str, Meta(max_length=16)], ...], Meta(max_length=16)]


class TracksMessage(Record, frozen=True, forbid_unknown_fields=False):
    """`tracks/<id>`: all tracks of one drone at `t_utc_s`; its last scan was exposed `scan_age_s` earlier.

    sequence counts what this boot published, so a jump by more than one is a lost message. proofs: of tracks whose
    name is confirmed by motion. relatives: of tracks whose teammate's position is known. cameras: for each track, in
    order, the number of the drone's camera (from 0, see `camera/<id>`) in whose pixels it is; empty: all are of the
    first. Empty fields at the end are not on the wire (`shortened`). Like a health message it may grow at its end.
    """

    what: ClassVar[str] = "tracks"
    version: Literal[1]
    t_utc_s: UtcSeconds
    t_sigma_s: Seconds
    sequence: Sequence
    scan_age_s: Seconds
    tracks: Annotated[tuple[TrackMessage, ...], Meta(max_length=MAX_TRACKS)]
    proofs: Annotated[tuple[ProofMessage, ...], Meta(max_length=MAX_TRACKS)] = ()
    relatives: Annotated[tuple[RelativeMessage, ...], Meta(max_length=MAX_TRACKS)] = ()
    cameras: Annotated[tuple[CameraNumber, ...], Meta(max_length=MAX_TRACKS)] = ()

    def camera_of(self, index: int) -> int:
        """Number of the camera in whose pixels a track of `tracks` is."""
        return self.cameras[index] if self.cameras else 0


def tracks_message(tracks: TrackList, sequence: int, utc_offset: float, t_sigma: float) -> TracksMessage:
    """The message of a drone's tracks; of more than `MAX_TRACKS`, the most probable.

    t_sigma [s]: uncertainty of our own UTC.
    """
    kept = tracks.tracks
    if len(kept) > MAX_TRACKS:
        kept = tuple(sorted(kept, key=lambda k: -k.track.probability)[:MAX_TRACKS])
    proofs = tuple(
        ProofMessage(int(k.track.id), float(k.proof.probability), max(0.0, float(tracks.t - k.proof.since)))
        for k in kept
        if k.proof is not None
    )
    cameras = tuple(int(k.track.camera) for k in kept)
    room = (
        MAX_MESSAGE_BYTES - _FRAME_BYTES - len(kept) - _TRACK_BYTES * len(kept) - _PROOF_BYTES * len(proofs)
    )
    return TracksMessage(
        version=WIRE_VERSION,
        t_utc_s=float(tracks.t + utc_offset),
        t_sigma_s=float(t_sigma),
        sequence=sequence,
        scan_age_s=max(0.0, float(tracks.t - tracks.scan_t)),
        tracks=tuple(_track_message(k, tracks.t) for k in kept),
        proofs=proofs,
        relatives=_relative_messages(kept, room // _RELATIVE_BYTES),
        cameras=cameras if any(cameras) else (),
    )


def _track_message(identified: IdentifiedTrack, now: float) -> TrackMessage:
    track = identified.track
    u, vu, v, vv = track.mean.tolist()
    w, h = track.size.tolist()
    since = track.coasting_since
    return TrackMessage(
        id=int(track.id),
        identity=identified.identity,
        identity_probability=float(identified.identity_probability),
        u_px=u,
        vu_px_s=vu,
        v_px=v,
        vv_px_s=vv,
        cov_upper=upper_triangle(track.cov),
        w_px=w,
        h_px=h,
        status=track.status.value,
        probability=float(track.probability),
        coasting_s=None if since is None else max(0.0, float(now - since)),
    )


def _relative_messages(tracks: tuple[IdentifiedTrack, ...], most: int) -> tuple[RelativeMessage, ...]:
    """Of the nearest teammates, where there are more than fit."""
    placed = [(int(k.track.id), k.relative) for k in tracks if k.relative is not None]
    if len(placed) > most:
        placed = sorted(placed, key=lambda one: float(np.linalg.norm(one[1].position)))[:most]
    return tuple(_relative_message(track_id, state) for track_id, state in placed)


def _relative_message(track_id: int, state: RelativeState) -> RelativeMessage:
    return RelativeMessage(
        track_id=track_id,
        position_m=tuple(state.position.tolist()),
        velocity_m_s=tuple(state.velocity.tolist()),
        cov=upper_triangle(state.cov),
        range_sigma_log=float(state.range_sigma_log),
        sources=state.sources,
    )


# The head of a message of nine fields, without its length; and an empty array, as its last three may be.
_ARRAY, _FIELDS, _EMPTY = 0x90, 9, 0x90


def shortened(data: bytes, message: TracksMessage) -> bytes:
    """Bytes of a message without empty fields at its end, which older readers do not have."""
    assert data[0] == _ARRAY | _FIELDS, "as encode makes it"
    empty = 0
    for field in (message.cameras, message.relatives, message.proofs):
        if field:
            break
        empty += 1
    if not empty:
        return data
    assert data[-empty:] == bytes([_EMPTY] * empty), "as encode makes it"
    return bytes([_ARRAY | (_FIELDS - empty)]) + data[1:-empty]


def check(message: TracksMessage) -> None:
    """Raise DecodeError for an invalid message."""
    proved = [proof.track_id for proof in message.proofs]
    if len(set(proved)) < len(proved) or not set(proved) <= {track.id for track in message.tracks}:
        raise DecodeError(f"tracks: proofs: of tracks {proved}, expected each once and among the tracks")
    if message.cameras and len(message.cameras) != len(message.tracks):
        raise DecodeError(
            f"tracks: cameras: {len(message.cameras)} for {len(message.tracks)} tracks, expected one for each, or none"
        )
    if message.tracks:
        check_covariances("tracks: cov_upper", [track.cov_upper for track in message.tracks], 4)
    if message.relatives:
        _check_relatives(message)


def _check_relatives(message: TracksMessage) -> None:
    placed = [relative.track_id for relative in message.relatives]
    named = {track.id for track in message.tracks if isinstance(track.identity, int)}
    if len(set(placed)) < len(placed) or not set(placed) <= named:
        raise DecodeError(
            f"tracks: relatives: of tracks {placed}, expected each once and of a track with a drone's ID"
        )
    check_covariances("tracks: relatives: cov", [relative.cov for relative in message.relatives], 6)


def track_cov(track: TrackMessage) -> Array:
    """The covariance (4, 4) of [u, vu, v, vv], px and px/s."""
    cov: Array = symmetric(np.array([track.cov_upper]), 4)[0]
    return cov


class _NumberedMessage(msgspec.Struct, array_like=True, frozen=True):
    """The first fields of `TracksMessage`."""

    version: Literal[1]
    t_utc_s: float
    t_sigma_s: float
    sequence: int


_NUMBERED = msgspec.msgpack.Decoder(_NumberedMessage)


def tracks_sequence(data: bytes) -> int:
    """Sequence number of a tracks message; the rest is not decoded. Raises DecodeError."""
    try:
        return _NUMBERED.decode(data).sequence
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise DecodeError(f"{TracksMessage.what}: {error} in {len(data)} bytes") from None
