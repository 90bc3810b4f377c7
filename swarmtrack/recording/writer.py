"""Writer of recordings: MCAP segments in one folder, each closed, fsynced and renamed when it is complete.

    0001.mcap  0002.mcap  0003.mcap.active

A file that ends in `.active` is being written, or was when its process died; every reader here accepts it, and
`swarmtrack log repair` completes it. A chunk is written whole and at least every `CHUNK_FLUSH_S`, so that a file that
was cut contains all but its last moments. Nothing here reads a clock or starts a thread: `runtime/recording_thread.py`
does.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import foxglove
from foxglove import Channel, Context, Schema
from foxglove.mcap import MCAPWriteOptions

from swarmtrack.errors import RecordingError
from swarmtrack.recording.limits import CHUNK_FLUSH_S, LEAST_SEGMENTS, RECORDING_CHUNK_BYTES, WRITE_RETRY_S

ACTIVE = ".active"
RECORDING_SUFFIX = ".mcap"
# Until its preface is written: a reader beside us finds no file without one.
_BEGUN = ".begun"

PREFACE = "swarmtrack.recording"
"""Name of the metadata that every segment begins with."""


class Topic(NamedTuple):
    """A channel of the file. schema: of its messages, JSON schema or a compiled protobuf description."""

    name: str
    schema_name: str
    schema: bytes
    encoding: str = "json"
    schema_encoding: str = "jsonschema"

    @classmethod
    def of_json(cls, name: str, schema: dict[str, Any]) -> Topic:
        return cls(name, schema.get("title", name), json.dumps(schema).encode())

    @classmethod
    def well_known(cls, name: str, message: Any) -> Topic:
        """Topic of a `foxglove.messages` type, which every viewer displays without a plugin."""
        schema = message.get_schema()
        return cls(name, schema.name, schema.data, "protobuf", schema.encoding)

    def channel(self, context: Context) -> Channel:
        """Opened in a context of the SDK, whose sinks get what is logged to it."""
        schema = Schema(name=self.schema_name, encoding=self.schema_encoding, data=self.schema)
        return Channel(self.name, schema=schema, message_encoding=self.encoding, context=context)


@dataclass(frozen=True, slots=True)
class Attachment:
    name: str
    media_type: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Preface:
    """Metadata at the beginning of every segment, so that each one is self-contained."""

    metadata: Mapping[str, str]
    attachments: tuple[Attachment, ...] = ()


@dataclass(frozen=True, slots=True)
class Bounds:
    """segment_s: length of a segment; max_bytes: of all recordings below `root`, including this drone's earlier runs.

    drop_oldest: at the limit, delete the oldest segments; otherwise the recording stops.
    """

    root: Path
    segment_s: float = 30.0
    max_bytes: int = 1_000_000_000
    drop_oldest: bool = True


class _File:
    """What foxglove writes to. It never fails: what the disk does not take is noted, and nothing more is written."""

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        # Held as long as we live, so that nobody repairs it.
        fcntl.flock(self._descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        self.size = 0
        self.sound = 0
        """Bytes up to the end of the last chunk."""
        self.error: OSError | None = None

    def write(self, data: bytes | bytearray) -> int:
        rest = memoryview(data)
        while rest and self.error is None:
            try:
                written = os.write(self._descriptor, rest)
            except OSError as error:
                self.error = error
                break
            self.size += written
            rest = rest[written:]
        return len(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        return self.size

    def flush(self) -> None:
        """Called at the end of a chunk, too; there is no buffer."""

    def close(self, *, complete: bool) -> None:
        try:
            if complete and self.error is None:
                os.fsync(self._descriptor)
            elif not complete:
                os.ftruncate(self._descriptor, self.sound)
        except OSError as error:
            self.error = self.error or error
        finally:
            os.close(self._descriptor)


@dataclass(slots=True)
class WriterCounters:
    """Counters of messages written and lost."""

    written: int = 0
    lost: int = 0
    """While the disk took nothing."""
    segments: int = 0
    segments_dropped: int = 0
    """Oldest ones, for the bound on the total size."""
    bytes: int = 0


@dataclass(slots=True)
class _Open:
    path: Path
    file: _File
    writer: Any
    since: float
    flushed: float = field(default=0.0)


class RecordingWriter:
    """One recording: `folder` is created and must not exist. All times `now` are seconds of one clock that never
    steps.
    """

    def __init__(self, folder: Path, preface: Preface, bounds: Bounds) -> None:
        """Raises RecordingError where nothing can be written."""
        self.folder = folder
        self.counters = WriterCounters()
        self.trouble: str | None = None
        """Why nothing is being written; None: all is well."""
        self._preface = preface
        self._bounds = bounds
        self._context = Context()
        self._channels: dict[str, Channel] = {}
        self._open: _Open | None = None
        self._number = 0
        self._closed_bytes = 0
        """Of all complete segments below the root."""
        self._retry_at = 0.0
        self._stopped = False
        try:
            folder.mkdir(parents=True)
        except OSError as error:
            raise RecordingError(
                f"{folder}: {error.strerror}, expected a folder that can be made and written"
            ) from error
        foxglove.set_log_level("ERROR")
        self._make_room()

    def write(self, topic: Topic, log_time_ns: int, data: bytes, now: float) -> None:
        """Add a message; a message that the disk does not take is counted."""
        if self._open is None and not self._begin(now):
            self.counters.lost += 1
            return
        channel = self._channels.get(topic.name)
        if channel is None:
            channel = self._channels[topic.name] = topic.channel(self._context)
        channel.log(data, log_time=log_time_ns)
        self.counters.written += 1

    def tick(self, now: float) -> None:
        """Flush, and begin a new segment when it is due. To be called a few times per second."""
        current = self._open
        if current is None:
            return
        if now - current.flushed >= CHUNK_FLUSH_S:
            current.writer.flush()
            current.flushed = now
            if current.file.error is None:
                current.file.sound = current.file.size
        if current.file.error is not None:
            self._give_up(current, now)
        elif (
            now - current.since >= self._bounds.segment_s
            or current.file.size > self._bounds.max_bytes / LEAST_SEGMENTS
            or self._closed_bytes + current.file.size > self._bounds.max_bytes
        ):
            self._complete(current, now)
            self._make_room()

    def close(self, now: float) -> None:
        """Complete the last segment."""
        if self._open is not None:
            self._complete(self._open, now)
        for channel in self._channels.values():
            channel.close()

    def _begin(self, now: float) -> bool:
        if self._stopped or now < self._retry_at:
            return False
        self._number += 1
        begun = self.folder / f"{self._number:04}{_BEGUN}"
        try:
            file = _File(begun)
        except OSError as error:
            self._fail(error, now)
            return False
        options = MCAPWriteOptions(
            chunk_size=RECORDING_CHUNK_BYTES,
            compression_threads=0,
            disable_seeking=True,
            profile="swarmtrack",
        )
        writer = foxglove.open_mcap(file, context=self._context, writer_options=options)
        writer.write_metadata(PREFACE, {**self._preface.metadata, "segment": str(self._number)})
        for attachment in self._preface.attachments:
            writer.attach(
                log_time=0,
                create_time=0,
                name=attachment.name,
                media_type=attachment.media_type,
                data=attachment.data,
            )
        writer.flush()
        path = begun
        if file.error is None:
            try:
                path = begun.rename(begun.with_suffix(f"{RECORDING_SUFFIX}{ACTIVE}"))
            except OSError as error:
                file.error = error
        self._open = _Open(path, file, writer, since=now, flushed=now)
        if file.error is not None:
            self._give_up(self._open, now)
            return False
        file.sound = file.size
        self.counters.segments += 1
        self.trouble = None
        return True

    def _complete(self, current: _Open, now: float) -> None:
        current.writer.close()
        current.file.close(complete=True)
        self._open = None
        if current.file.error is not None:
            self._fail(current.file.error, now)
            return
        self.counters.bytes += current.file.size
        self._closed_bytes += current.file.size
        try:
            current.path.rename(current.path.with_suffix(""))
            _sync_folder(self.folder)
        except OSError as error:
            self._fail(error, now)

    def _give_up(self, current: _Open, now: float) -> None:
        """The disk takes no more: what is there stays, cut behind its last whole chunk."""
        error = current.file.error
        assert error is not None
        current.writer.close()
        current.file.close(complete=False)
        self._open = None
        if current.file.sound == 0:
            current.path.unlink(missing_ok=True)
        self._fail(error, now)

    def _fail(self, error: OSError, now: float) -> None:
        self.trouble = f"{self.folder}: {error.strerror}; trying again every {WRITE_RETRY_S:g} s"
        self._retry_at = now + WRITE_RETRY_S

    def _make_room(self) -> None:
        """Keep below the bound, with room for a segment more."""
        root = self._bounds.root
        kept = sorted(
            (
                path
                for pattern in (f"*{RECORDING_SUFFIX}", f"*{RECORDING_SUFFIX}{ACTIVE}")
                for path in root.rglob(pattern)
            ),
            key=lambda path: (path.parent, path.name),
        )
        sizes = {path: path.stat().st_size for path in kept}
        total = sum(sizes.values())
        room = self._bounds.max_bytes * (1.0 - 1.0 / LEAST_SEGMENTS)
        if total > room and not self._bounds.drop_oldest:
            self._stopped = True
            self.trouble = (
                f"{root}: holds {total / 1e6:.0f} MB, as much as recording.max_mb allows; stopped recording"
            )
        while total > room and self._bounds.drop_oldest and kept:
            oldest = kept.pop(0)
            total -= sizes[oldest]
            oldest.unlink(missing_ok=True)
            self.counters.segments_dropped += 1
            if oldest.parent != self.folder and not any(oldest.parent.iterdir()):
                oldest.parent.rmdir()
        self._closed_bytes = total


def _sync_folder(folder: Path) -> None:
    """So that the new name survives a power cut, too."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
