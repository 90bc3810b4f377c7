"""Reader of recordings, complete or cut off: delivers every intact message and reports damage.

`mcap`'s own readers want an index at the end of the file, or stop with an exception in the middle of a chunk. A live
or broken recording has no index, so files are read from their beginning, record by record, in the order of writing.
"""

from __future__ import annotations

import contextlib
import json
import struct
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, NamedTuple

import zstandard
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Schema

from swarmtrack.errors import RecordingError
from swarmtrack.plain_text import plain
from swarmtrack.recording.limits import (
    LARGEST_NOTES_BYTES,
    LARGEST_RECORD_BYTES,
    MOST_DECLARED_CHANNELS,
    MOST_NOTES,
    READ_AHEAD_BYTES,
)
from swarmtrack.recording.records import (
    check_end,
    read_attachment,
    read_channel,
    read_metadata,
    read_schema,
    unpacked_chunk,
)
from swarmtrack.recording.writer import ACTIVE, PREFACE, RECORDING_SUFFIX

MCAP_MAGIC = b"\x89MCAP0\r\n"
RECORDING_FORMAT = "1"
FLIGHT_PLAN = "flight_plan.json"  # attached to the recording of a simulated flight
_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_IS_MESSAGE = int(Opcode.MESSAGE)
# A footer is none of them: it stands behind the end of the data.
_KNOWN = frozenset(map(int, Opcode)) - {int(Opcode.FOOTER)}
PRIVATE_OPCODES = 0x80  # from here on, opcodes are an application's own
_UNREADABLE = (ValueError, struct.error, OverflowError, MemoryError, zstandard.ZstdError)


class Message(NamedTuple):
    """One message of a file. data: as written, in the channel's encoding."""

    channel: Channel
    log_time_ns: int
    data: bytes

    @property
    def topic(self) -> str:
        return str(self.channel.topic)


@dataclass(slots=True)
class Segment:
    """One file, which may be iterated several times; damage and metadata are known after the iteration."""

    path: Path
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, Attachment] = field(default_factory=dict)
    damage: str | None = None
    """What is wrong with the file, in words; None: nothing, it is complete."""
    _declared: int = 0
    _noted: int = 0

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """Messages of these topics (None: all) in the order of writing. Raises RecordingError for a file that is not
        MCAP.
        """
        with self._opened() as file:
            if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
                raise RecordingError(f"{self.path}: is not an MCAP file, expected a recording")
            self.damage, self._declared, self._noted = None, 0, 0
            yield from self._records(file, topics)

    def _opened(self) -> IO[bytes]:
        """By its last name where its writer has completed it since it was found."""
        try:
            with contextlib.suppress(FileNotFoundError):
                return self.path.open("rb", buffering=READ_AHEAD_BYTES)
            if self.path.suffix == ACTIVE:
                self.path = self.path.with_suffix("")
            return self.path.open("rb", buffering=READ_AHEAD_BYTES)
        except OSError as error:
            raise RecordingError(f"{self.path}: {error.strerror}, expected a recording") from error

    def _records(self, file: IO[bytes], topics: Collection[str] | None) -> Iterator[Message]:
        checksum, chunked = zlib.crc32(MCAP_MAGIC), False
        while True:
            at = file.tell()
            head = file.read(_HEAD.size)
            if len(head) < _HEAD.size:
                self.damage = f"is cut off after {at} bytes"
                return
            opcode, length = _HEAD.unpack(head)
            if length > LARGEST_RECORD_BYTES:
                self.damage = f"has no record at byte {at}"
                return
            body = file.read(length)
            if len(body) < length:
                self.damage = f"is cut off after {at} bytes"
                return
            try:
                if opcode == Opcode.DATA_END:
                    check_end(body, checksum)
                    return  # what follows is an index of what we read
                if opcode not in _KNOWN and opcode < PRIVATE_OPCODES:
                    raise ValueError("a record of no known kind")
                if opcode == Opcode.MESSAGE and chunked:  # who writes chunks writes all messages into them
                    raise ValueError("a message between chunks")
                checksum = zlib.crc32(body, zlib.crc32(head, checksum))
                if opcode == Opcode.CHUNK:
                    chunked = True
                    yield from self._chunk(unpacked_chunk(body), topics)
                else:
                    yield from self._record(opcode, body, topics)
            except _UNREADABLE as error:
                self.damage = (
                    f"holds what cannot be read at byte {at} ({plain(str(error)) or type(error).__name__})"
                )
                return

    def _chunk(self, data: bytes, topics: Collection[str] | None) -> Iterator[Message]:
        at = 0
        while at < len(data):
            opcode, length = _HEAD.unpack_from(data, at)
            at += _HEAD.size
            if at + length > len(data):
                raise ValueError("a record that ends beyond its chunk")
            body = data[at : at + length]
            at += length
            yield from self._record(opcode, body, topics)

    def _record(self, opcode: int, body: bytes, topics: Collection[str] | None) -> Iterable[Message]:
        """The message in it, if it is one that is wanted."""
        if opcode == _IS_MESSAGE:  # nearly all are
            number, _, log_time, _ = _MESSAGE.unpack_from(body)
            channel = self.channels.get(number)
            if channel is None:
                raise ValueError(f"a message of channel {number}, which was not declared")
            if topics is None or channel.topic in topics:
                return (Message(channel, log_time, body[_MESSAGE.size :]),)
        else:
            self._note(opcode, body)
        return ()

    def _note(self, opcode: int, body: bytes) -> None:
        """Take in what explains the messages."""
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._declared += 1
            if self._declared > MOST_DECLARED_CHANNELS:
                raise ValueError(f"more than {MOST_DECLARED_CHANNELS} schemas and channels")
            if opcode == Opcode.SCHEMA:
                schema = read_schema(body)
                self.schemas[schema.id] = schema
            else:
                channel = read_channel(body)
                self.channels[channel.id] = channel
        elif opcode in (Opcode.METADATA, Opcode.ATTACHMENT):
            self._noted += len(body)
            if self._noted > LARGEST_NOTES_BYTES or len(self.metadata) + len(self.attachments) >= MOST_NOTES:
                raise ValueError(f"more than {MOST_NOTES} notes, or {LARGEST_NOTES_BYTES} bytes of them")
            if opcode == Opcode.METADATA:
                metadata = read_metadata(body)
                self.metadata[metadata.name] = metadata.metadata
            else:
                attachment = read_attachment(body)
                self.attachments[attachment.name] = attachment


@dataclass(slots=True)
class Recording:
    """Recording of one run of one process: its segments in order."""

    folder: Path
    segments: list[Segment]
    preface: dict[str, str] = field(default_factory=dict)
    attachments: dict[str, Attachment] = field(default_factory=dict)

    @property
    def kind(self) -> str:
        """ "drone", or "swarm" for what `swarmtrack record` and `sim` received from the team."""
        return self.preface["kind"]

    @property
    def drone_id(self) -> int:
        return int(self.preface["drone_id"])

    @property
    def first_segment(self) -> int:
        """Number of the first segment: 1 if complete, more where the oldest segments were deleted."""
        return int(self.preface["segment"])

    @property
    def damage(self) -> list[str]:
        """Damage of its files, a sentence each; known after they were read."""
        return [f"{segment.path} {segment.damage}" for segment in self.segments if segment.damage]

    @property
    def is_simulated_flight(self) -> bool:
        """Whether it is of a simulated flight, with its truth."""
        return self.kind == "swarm" and FLIGHT_PLAN in self.attachments

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """Messages of all segments; topics: of these only."""
        for segment in self.segments:
            yield from segment.messages(topics)

    def attached(self, name: str) -> Any:
        """A JSON attachment. Raises RecordingError."""
        try:
            return json.loads(self.attachments[name].data)
        except (KeyError, ValueError, RecursionError, MemoryError):
            raise RecordingError(
                f"{self.segments[0].path}: its attachment {name} is missing or not JSON, expected that of an agent"
            ) from None


def files_below(path: Path) -> list[Path]:
    """All MCAP files at or below a path, in order. Raises RecordingError where there is none."""
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise RecordingError(f"{path}: no such file or folder, expected a recording")
    named = {p for p in path.rglob("*") if p.name.endswith((RECORDING_SUFFIX, RECORDING_SUFFIX + ACTIVE))}
    # One that is completed just now may be listed by both of its names.
    found = sorted(p for p in named if p.is_file() or (p.suffix == ACTIVE and p.with_suffix("") not in named))
    if not found:
        raise RecordingError(f"{path}: holds no {RECORDING_SUFFIX} file, expected a recording")
    return found


def recordings_below(*paths: Path) -> list[Recording]:
    """Every recording at or below these paths, by folder. Raises RecordingError for files of another origin."""
    by_folder: dict[Path, dict[str, Path]] = {}
    for file in (file for path in paths for file in files_below(path)):
        by_folder.setdefault(file.parent.absolute(), {}).setdefault(file.name, file)
    return [_opened([Segment(files[name]) for name in sorted(files)]) for files in by_folder.values()]


def _opened(segments: list[Segment]) -> Recording:
    recording = Recording(segments[0].path.parent, segments)
    for segment in segments:
        for _ in segment.messages():
            break  # the preface stands before the first message
        if PREFACE in segment.metadata:
            recording.preface, recording.attachments = segment.metadata[PREFACE], segment.attachments
            break
    else:
        raise RecordingError(
            f"{segments[0].path}: is not a swarmtrack recording, expected metadata {PREFACE!r}"
        )
    found = recording.preface.get("format")
    if found != RECORDING_FORMAT:
        raise RecordingError(
            f"{segments[0].path}: is of format {found}, this program reads format {RECORDING_FORMAT}"
        )
    _check_preface(segments[0].path, recording.preface)
    return recording


def _check_preface(path: Path, preface: Mapping[str, str]) -> None:
    """What all who read a recording count on. Raises RecordingError."""
    for key, expected, judge in _PREFACE:
        if key in ("drone_id", "boot") and preface.get("kind") == "swarm":
            continue
        try:
            right = judge(preface[key])
        except (KeyError, ValueError):
            right = False
        if not right:
            found = f'"{preface[key]}"' if key in preface else "missing"
            raise RecordingError(f"{path}: {PREFACE}.{key}: {found}, expected {expected}")


_PREFACE: tuple[tuple[str, str, Callable[[str], bool]], ...] = (
    ("kind", "drone or swarm", lambda text: text in ("drone", "swarm")),
    ("drone_id", "1 … 65535", lambda text: 1 <= int(text) <= 65535),
    ("team", "the team's name", lambda text: True),
    ("boot", "which life of the process it is", lambda text: True),
    ("segment", "a number from 1 on", lambda text: 1 <= int(text) < 2**31),
    ("utc_s", "UTC of its beginning, s", lambda text: 0.0 <= float(text) <= 2.0**32),
    ("monotonic_s", "the clock at its beginning, s", lambda text: abs(float(text)) <= 2.0**33),
)
