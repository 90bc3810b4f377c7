"""What the monitor plays: everything a recording holds for its page, in the order in which it was heard.

All times are UTC [s] of the first recording's clock. Pictures and tracks wait in a temporary file, since ten minutes of
them are too much to hold; they are read when they are shown.
"""

from __future__ import annotations

import heapq
import math
import os
import tempfile
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import msgspec

from swarmtrack.errors import RecordingError
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind, Sample
from swarmtrack.wire import codec
from swarmtrack.wire.checks import DecodeError
from swarmtrack.wire.tracks import TracksMessage
from swarmtrack.wire.video import VideoMessage

SEEN_FLIGHT_EVENTS = 300_000  # of a flight that is kept to be played again: ten minutes of eight drones
SEEN_FLIGHT_BYTES = 256 * 2**20  # of their tracks and pictures


class Blob(NamedTuple):
    """Where bytes lie in the file."""

    offset: int
    length: int


class BlobFile:
    """A private temporary file, deleted at the end of the process."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile(prefix="swarmtrack-")  # noqa: SIM115 - it lives as long as we do
        self.size = 0

    def append(self, data: bytes) -> Blob:
        """Append bytes. Raises RecordingError where the disk is full."""
        try:
            self._file.write(data)
        except OSError as error:
            raise RecordingError(
                f"{tempfile.gettempdir()}: {error.strerror}, expected room for the recording's pictures (TMPDIR)"
            ) from error
        blob = Blob(self.size, len(data))
        self.size += len(data)
        return blob

    def close(self) -> None:
        self._file.close()

    def get(self, blob: Blob) -> bytes:
        self._file.flush()
        return os.pread(self._file.fileno(), blob.length, blob.offset)


class TimelineEvent(NamedTuple):
    """Something a drone said, and when. sample None: no more than that it spoke.

    picture: of a view, whose own is empty.
    """

    t: float
    drone_id: int
    sample: Sample | None
    picture: Blob | None = None


@dataclass(slots=True)
class Tracked:
    """What one life of a drone tracked. times: by its own UTC, ascending [s]; read: what a blob says. told: when that
    was heard, as events have it but for `shift` [s], which brings it on the timeline's clock."""

    read: Callable[[bytes], TracksMessage]
    times: list[float] = field(default_factory=list)
    blobs: list[Blob] = field(default_factory=list)
    told: list[float] = field(default_factory=list)
    shift: float = 0.0
    is_wire: bool = False
    """Whether a blob is the message as it was sent."""

    def add(self, t_utc_s: float, blob: Blob, told: float) -> None:
        if not self.times or t_utc_s > self.times[-1]:  # what comes out of order is nobody's newest
            self.times.append(t_utc_s)
            self.blobs.append(blob)
            self.told.append(told)

    def nearest(self, t_utc_s: float) -> tuple[float, Blob] | None:
        """To the instant of a frame: how far off it is, and what was tracked."""
        k = bisect_left(self.times, t_utc_s)
        near = range(max(0, k - 1), min(len(self.times), k + 1))
        return min(((abs(self.times[i] - t_utc_s), self.blobs[i]) for i in near), default=None)

    def newest(self, t: float) -> tuple[float, Blob] | None:
        """Newest tracks received by t on the timeline's clock, with their time."""
        k = bisect_right(self.told, t - self.shift)
        return (self.told[k - 1] + self.shift, self.blobs[k - 1]) if k else None


class _TracksHead(msgspec.Struct, array_like=True):
    """As much of `TracksMessage` as tells its time."""

    version: int
    t_utc_s: float


class HeardWords:
    """What was heard of a swarm as events. Raises DecodeError and MsgspecError for what cannot be read."""

    def __init__(self, blob_file: BlobFile) -> None:
        self.tracked: dict[int, Tracked] = {}
        self._blob_file = blob_file

    def event(self, sample: Sample, address: keys.Address, t: float) -> TimelineEvent:
        """t: on the timeline's clock, s."""
        drone_id, sample = address.drone_id, sample._replace(arrived=t)
        match address.kind:
            case Kind.TRACKS:
                head = msgspec.msgpack.decode(sample.payload, type=_TracksHead)
                tracked = self.tracked.setdefault(
                    drone_id, Tracked(partial(codec.decode, TracksMessage), is_wire=True)
                )
                tracked.add(head.t_utc_s, self._blob_file.append(sample.payload), t)
                return TimelineEvent(t, drone_id, None)
            case Kind.VIDEO:
                view = codec.decode(VideoMessage, sample.payload)
                payload = codec.encode(msgspec.structs.replace(view, jpeg=b""))
                picture = self._blob_file.append(view.jpeg) if view.jpeg else None
                return TimelineEvent(t, drone_id, sample._replace(payload=payload), picture)
        return TimelineEvent(t, drone_id, sample)


class SeenFlight:
    """What a monitor heard of a flight from its beginning, to play it once more; of a long one nothing is kept."""

    def __init__(self, team: str) -> None:
        self._team = team
        self._blob_file = BlobFile()
        self._words = HeardWords(self._blob_file)
        self._events: list[TimelineEvent] = []
        self._is_too_long = False

    def add(self, sample: Sample, t: float) -> None:
        """t: UTC, s."""
        address = keys.parse(sample.key)
        if address is None or self._is_too_long:
            return
        try:
            self._events.append(self._words.event(sample, address, t))
        except (DecodeError, RecordingError, msgspec.MsgspecError):
            return
        if len(self._events) > SEEN_FLIGHT_EVENTS or self._blob_file.size > SEEN_FLIGHT_BYTES:
            self._is_too_long = True
            self._events.clear()
            self._blob_file.close()

    @property
    def timeline(self) -> Timeline | None:
        """None where there is nothing to play."""
        if not self._events:
            return None
        tracked = {drone_id: [one] for drone_id, one in self._words.tracked.items()}
        return Timeline(
            self._team, sorted(self._events, key=lambda event: event.t), tracked, self._blob_file, []
        )


@dataclass(slots=True)
class Timeline:
    """events: in order, never empty. notes: what people should know of the recording, a sentence each."""

    team: str
    events: list[TimelineEvent]
    tracked: dict[int, list[Tracked]]
    blob_file: BlobFile
    notes: list[str]

    @property
    def begin(self) -> float:
        return self.events[0].t

    @property
    def seconds(self) -> float:
        return self.events[-1].t - self.events[0].t

    def tracks_at(self, drone_id: int, t_utc_s: float) -> TracksMessage | None:
        """What a drone tracked at the instant of a frame, or nearest to it; None also where it cannot be read."""
        found = [(*near, life) for life in self.tracked.get(drone_id, ()) if (near := life.nearest(t_utc_s))]
        if not found:
            return None
        _, blob, life = min(found, key=lambda one: one[0])
        return self._read(life, blob)

    def newest_tracks(self, drone_id: int, t: float, max_age: float) -> TracksMessage | None:
        """What a drone was last heard to track at t, no longer than max_age [s] ago; None also where it cannot be
        read."""
        found = [(*last, life) for life in self.tracked.get(drone_id, ()) if (last := life.newest(t))]
        told, blob, life = max(found, key=lambda one: one[0], default=(-math.inf, None, None))
        if blob is None or life is None or t - told > max_age:
            return None
        return self._read(life, blob)

    def samples(self, *, pictures: bool = False) -> Iterator[Sample]:
        """All messages as on the wire, in order of arrival [UTC, s]; what cannot be read is left out. pictures: in
        video messages.
        """
        told = (self._told(drone_id, life) for drone_id, lives in self.tracked.items() for life in lives)
        yield from heapq.merge(self._said(pictures=pictures), *told, key=lambda sample: sample.arrived)

    def _told(self, drone_id: int, life: Tracked) -> Iterator[Sample]:
        key = keys.key(self.team, Kind.TRACKS, drone_id)
        for number, (t, blob) in enumerate(zip(life.told, life.blobs, strict=True)):
            if life.is_wire:
                payload = self.blob_file.get(blob)
            elif (message := self._read(life, blob)) is not None:
                payload = codec.encode(
                    msgspec.structs.replace(message, sequence=number, t_utc_s=message.t_utc_s + life.shift)
                )
            else:
                continue
            yield Sample(key, payload, True, t + life.shift)

    def _said(self, *, pictures: bool) -> Iterator[Sample]:
        for number, event in enumerate(self.events):
            if event.sample is None:
                continue
            address = keys.parse(event.sample.key)
            if address is None or address.kind is not Kind.VIDEO:
                yield event.sample
                continue
            view = codec.decode(VideoMessage, event.sample.payload)
            jpeg = self.blob_file.get(event.picture) if pictures and event.picture is not None else b""
            yield event.sample._replace(
                payload=codec.encode(msgspec.structs.replace(view, frame=number, jpeg=jpeg))
            )

    def _read(self, life: Tracked, blob: Blob) -> TracksMessage | None:
        try:
            return life.read(self.blob_file.get(blob))
        except (DecodeError, RecordingError):
            return None
