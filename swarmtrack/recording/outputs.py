"""Outputs of a drone: the tracks of every scan, in full, and digests that a replay is compared with."""

from __future__ import annotations

import hashlib
import struct
from typing import Any, NamedTuple

import msgspec
import numpy as np

from swarmtrack.errors import RecordingError
from swarmtrack.follower import Engagement, LocalSetpoint
from swarmtrack.messages import (
    IdentifiedTrack,
    LocatedStranger,
    RelativeState,
    ScanReport,
    Track,
    TrackList,
    TrackStatus,
)
from swarmtrack.recording.inputs import numbers, plain

TRACKS_TOPIC = "/tracks"
ASKED_TOPIC = "/asked"
SETPOINTS_TOPIC = "/setpoints"
FRAMES_TOPIC, IMAGES_TOPIC = "/camera/frames", "/camera/image"

_ENCODER = msgspec.json.Encoder()
_DECODER = msgspec.json.Decoder(dict[str, Any])


def image_topic(camera: int) -> str:
    """Topic of one camera's images, by its index in the config."""
    return IMAGES_TOPIC if camera == 0 else f"/camera/{camera + 1}/image"


def digest(tracks: TrackList) -> str:
    """16 hex digits over every bit of a list of tracks."""
    state = hashlib.blake2b(digest_size=8)
    state.update(struct.pack("<dd", tracks.t, tracks.scan_t))
    for entry in tracks.tracks:
        track = entry.track
        since = -1.0 if track.coasting_since is None else track.coasting_since
        # As ever while there is one camera.
        camera = f" {track.camera}" if track.camera else ""
        words = f"{track.id} {track.status} {entry.identity}{camera}".encode()
        state.update(
            words + struct.pack("<dddd", track.t, track.probability, entry.identity_probability, since)
        )
        for part in (track.mean, track.cov, track.size):
            state.update(np.ascontiguousarray(part, dtype=np.float64).tobytes())
    return state.hexdigest()


def relative_digest(tracks: TrackList) -> str:
    """16 hex digits over every bit of the relative states; separate, because older recordings do not have them."""
    state = hashlib.blake2b(digest_size=8)
    for entry in tracks.tracks:
        found = entry.relative
        if found is not None:
            state.update(f"{entry.track.id} {found.drone_id} {' '.join(found.sources)}".encode())
            state.update(struct.pack("<dd", found.t, found.range_sigma_log))
            for part in (found.position, found.velocity, found.cov):
                state.update(part.tobytes())
    return state.hexdigest()


def strangers_digest(strangers: tuple[LocatedStranger, ...]) -> str:
    """16 hex digits over every bit of where the team finds strangers."""
    state = hashlib.blake2b(digest_size=8)
    for one in strangers:
        observers = " ".join(map(str, one.observers))
        state.update(f"{one.number} {observers} {one.remote_id}".encode() + struct.pack("<d", one.t))
        for part in (one.position, one.velocity, one.cov):
            state.update(part.tobytes())
    return state.hexdigest()


def encode_report(report: ScanReport) -> bytes:
    tracks, strangers = report.tracks, report.strangers
    found = {
        "strangers_digest": strangers_digest(strangers),
        "strangers": [_stranger_record(one) for one in strangers],
    }
    return _ENCODER.encode(
        {
            "t_s": tracks.t,
            "sequence": int(report.sequence),
            **_other_camera(report.camera),
            "digest": digest(tracks),
            "relative_digest": relative_digest(tracks),
            "tracks": [_track_record(entry) for entry in tracks.tracks],
            # As ever while there is none.
            **(found if strangers else {}),
        }
    )


class RecordedReport(NamedTuple):
    """Report of a scan with its digests as computed in flight; relative_digest: None in an older recording.
    strangers_digest: None without strangers."""

    digest: str
    relative_digest: str | None
    strangers_digest: str | None
    report: ScanReport


def decode_report(data: bytes) -> RecordedReport:
    """Inverse of the report's encoding. Raises RecordingError."""
    try:
        record = _DECODER.decode(data)
        t = float(record["t_s"])
        entries = tuple(_identified(part) for part in record["tracks"])
        strangers = tuple(_stranger(part, t) for part in record.get("strangers", ()))
        camera = int(record.get("camera", 0))
        report = ScanReport(record["sequence"], TrackList(t, t, entries), camera, strangers)
        digests = record["digest"], record.get("relative_digest"), record.get("strangers_digest")
        return RecordedReport(*digests, report)
    except (msgspec.MsgspecError, KeyError, TypeError, ValueError) as error:
        raise RecordingError(f"{TRACKS_TOPIC}: a record that is not swarmtrack.Tracks: {error}") from None


def encode_asked(n: int, tracks: TrackList) -> bytes:
    """Record of a query for the tracks as of `tracks.t`: an input as well, the n-th of the recording."""
    return _ENCODER.encode(
        {"n": n, "t_s": tracks.t, "digest": digest(tracks), "tracks": len(tracks.tracks)},
    )


def decode_asked(data: bytes) -> tuple[int, float, str]:
    """Number and time of a recorded query for tracks, and the digest of its answer. Raises RecordingError."""
    try:
        record = _DECODER.decode(data)
        return record["n"], float(record["t_s"]), str(record["digest"])
    except (msgspec.MsgspecError, KeyError, TypeError, ValueError) as error:
        raise RecordingError(f"{ASKED_TOPIC}: a record that is not swarmtrack.Asked: {error}") from None


class RecordedCommand(NamedTuple):
    """The n-th input, a query for a set point as of t: its arguments, and the digest of the answer."""

    n: int
    t: float
    engagement: Engagement
    digest: str


def setpoint_digest(told: LocalSetpoint) -> str:
    """16 hex digits over every bit of a set point and its reason."""
    setpoint = told.setpoint
    state = hashlib.blake2b(f"{setpoint.why} {setpoint.clear_of}".encode(), digest_size=8)
    state.update(struct.pack("<8d", setpoint.t, *told.velocity, *setpoint.velocity, told.yaw_rate))
    return state.hexdigest()


def encode_command(n: int, engagement: Engagement, told: LocalSetpoint) -> bytes:
    """Record of a query for a set point: an input as well, the n-th of the recording."""
    setpoint = told.setpoint
    return _ENCODER.encode(
        {
            "n": n,
            "t_s": float(setpoint.t),
            "engagement": engagement.number,
            "clock_known": engagement.clock_known,
            "why": str(setpoint.why),
            "text": setpoint.text,
            "velocity_m_s": list(map(float, setpoint.velocity)),
            "sent_velocity_m_s": list(map(float, told.velocity)),
            "yaw_rate_rad_s": float(told.yaw_rate),
            "error_m": setpoint.error,
            "clear_of": list(setpoint.clear_of),
            "digest": setpoint_digest(told),
        }
    )


def decode_command(data: bytes) -> RecordedCommand:
    """Inverse of `encode_command`. Raises RecordingError."""
    try:
        record = _DECODER.decode(data)
        engagement = Engagement(int(record["engagement"]), bool(record["clock_known"]))
        return RecordedCommand(record["n"], float(record["t_s"]), engagement, str(record["digest"]))
    except (msgspec.MsgspecError, KeyError, TypeError, ValueError) as error:
        raise RecordingError(
            f"{SETPOINTS_TOPIC}: a record that is not swarmtrack.Setpoint: {error}"
        ) from None


def _track_record(entry: IdentifiedTrack) -> dict[str, Any]:
    track = entry.track
    return {
        "id": int(track.id),
        **_other_camera(track.camera),
        "t_s": float(track.t),
        "identity": entry.identity,
        "identity_probability": float(entry.identity_probability),
        "status": str(track.status),
        "probability": plain(float(track.probability)),
        "mean_px": numbers(track.mean),
        "cov": numbers(track.cov),
        "size_px": numbers(track.size),
        "coasting_since_s": None if track.coasting_since is None else float(track.coasting_since),
        "relative": None if entry.relative is None else _relative_record(entry.relative),
    }


def _other_camera(camera: int) -> dict[str, int]:
    """Nothing of the first one: that is the only one of most drones."""
    return {"camera": camera} if camera else {}


def _relative_record(state: RelativeState) -> dict[str, Any]:
    return {
        "drone_id": state.drone_id,
        "t_s": float(state.t),
        "position_m": numbers(state.position),
        "velocity_m_s": numbers(state.velocity),
        "cov": numbers(state.cov),
        "range_sigma_log": float(state.range_sigma_log),
        "sources": list(state.sources),
    }


def _stranger_record(one: LocatedStranger) -> dict[str, Any]:
    return {
        "number": one.number,
        "position_m": numbers(one.position),
        "velocity_m_s": numbers(one.velocity),
        "cov": numbers(one.cov),
        "observers": list(one.observers),
        "remote_id": one.remote_id,
    }


def _stranger(record: dict[str, Any], t: float) -> LocatedStranger:
    return LocatedStranger(
        record["number"],
        t,
        np.array(record["position_m"], dtype=np.float64),
        np.array(record["velocity_m_s"], dtype=np.float64),
        np.array(record["cov"], dtype=np.float64).reshape(6, 6),
        tuple(record["observers"]),
        str(record["remote_id"]),
    )


def _identified(record: dict[str, Any]) -> IdentifiedTrack:
    track = Track(
        id=record["id"],
        t=record["t_s"],
        mean=np.array(record["mean_px"], dtype=np.float64).reshape(4),
        cov=np.array(record["cov"], dtype=np.float64).reshape(4, 4),
        status=TrackStatus(record["status"]),
        probability=float(record["probability"]),
        size=np.array(record["size_px"], dtype=np.float64).reshape(2),
        coasting_since=record["coasting_since_s"],
        camera=int(record.get("camera", 0)),
    )
    found = record.get("relative")
    relative = None if found is None else _relative(found)
    return IdentifiedTrack(track, record["identity"], record["identity_probability"], relative=relative)


def _relative(record: dict[str, Any]) -> RelativeState:
    return RelativeState(
        record["drone_id"],
        record["t_s"],
        np.array(record["position_m"], dtype=np.float64),
        np.array(record["velocity_m_s"], dtype=np.float64),
        np.array(record["cov"], dtype=np.float64).reshape(6, 6),
        record["range_sigma_log"],
        tuple(record["sources"]),
    )
