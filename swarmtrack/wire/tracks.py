"""`tracks/<id>`: what a drone tracks now."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import msgspec
import numpy as np
from msgspec import Meta

from swarmtrack.messages import Array, IdentifiedTrack, TrackList
from swarmtrack.wire.checks import DecodeError, check_covariances, symmetric, upper_triangle
from swarmtrack.wire.fields import (
    MAX_TRACKS,
    VERSION,
    DroneId,
    Length,
    Moment,
    Pixels,
    Probability,
    Record,
    Seconds,
    Sequence,
    UtcSeconds,
)


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
    """That how a track moves says alone who it is: how surely, and for how long already."""

    what: ClassVar[str] = "proof"
    track_id: Annotated[int, Meta(ge=0, le=2**53)]
    probability: Probability
    proved_s: Seconds


class TracksMessage(Record, frozen=True):
    """`tracks/<id>`: all that one drone tracks at `t_utc_s`; its last scan was exposed `scan_age_s` earlier.

    sequence counts what this boot published, so a jump by more than one is a lost message. proofs: of the tracks whose
    motion proves their name; without any, the field is not on the wire (`shortened`).
    """

    what: ClassVar[str] = "tracks"
    version: Literal[1]
    t_utc_s: UtcSeconds
    t_sigma_s: Seconds
    sequence: Sequence
    scan_age_s: Seconds
    tracks: Annotated[tuple[TrackMessage, ...], Meta(max_length=MAX_TRACKS)]
    proofs: Annotated[tuple[ProofMessage, ...], Meta(max_length=MAX_TRACKS)] = ()


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
        proofs=tuple(
            ProofMessage(
                int(k.track.id), float(k.proof.probability), max(0.0, float(tracks.t - k.proof.since))
            )
            for k in kept
            if k.proof is not None
        ),
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


# A message of seven fields whose last is an empty array; and the head of one of six.
_ARRAY_OF_7, _ARRAY_OF_6, _EMPTY = b"\x97", b"\x96", b"\x90"


def shortened(data: bytes, message: TracksMessage) -> bytes:
    """The bytes of a message without its proofs where there are none: those that readers from before they came know."""
    if message.proofs:
        return data
    assert data[:1] == _ARRAY_OF_7, "as encode makes it"
    assert data[-1:] == _EMPTY, "as encode makes it"
    return _ARRAY_OF_6 + data[1:-1]


def check(message: TracksMessage) -> None:
    """Raises DecodeError."""
    proved = [proof.track_id for proof in message.proofs]
    if len(set(proved)) < len(proved) or not set(proved) <= {track.id for track in message.tracks}:
        raise DecodeError(f"tracks: proofs: of tracks {proved}, expected each once and among the tracks")
    if message.tracks:
        check_covariances("tracks: cov_upper", [track.cov_upper for track in message.tracks], 4)


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
    """The number of a tracks message, whatever else is in it. Raises DecodeError."""
    try:
        return _NUMBERED.decode(data).sequence
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise DecodeError(f"{TracksMessage.what}: {error} in {len(data)} bytes") from None
