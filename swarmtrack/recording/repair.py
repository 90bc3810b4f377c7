"""Repair of a recording that was cut off: makes a complete, indexed file of it."""

from __future__ import annotations

import fcntl
from pathlib import Path
from typing import NamedTuple

from mcap.writer import Writer

from swarmtrack.errors import RecordingError
from swarmtrack.recording.limits import RECORDING_CHUNK_BYTES
from swarmtrack.recording.reader import Segment
from swarmtrack.recording.writer import ACTIVE

ORIGINAL = ".cut"
"""What the file is called afterwards that was repaired; nothing is thrown away."""


class Repaired(NamedTuple):
    """target: the complete file; damage: of the original, in words; messages: number of messages saved."""

    target: Path
    damage: str
    messages: int


def repair(path: Path) -> Repaired | None:
    """Repair a file in place; None where there is nothing to do. Raises RecordingError."""
    segment = Segment(path)
    if _is_being_written(path):
        raise RecordingError(f"{path}: is being written just now, expected a recording that has ended")
    for _ in segment.messages():
        pass
    path = segment.path  # its writer may have completed it meanwhile
    is_active = path.name.endswith(ACTIVE)
    if segment.damage is None and not is_active:
        return None
    target = path.with_suffix("") if is_active else path
    draft = target.with_name(f"{target.name}.draft")
    try:
        count = rewrite(segment, draft)
        path.rename(path.with_name(path.name + ORIGINAL))
        draft.rename(target)
    except OSError as error:
        raise RecordingError(f"{target}: {error.strerror}, expected a folder with room to write") from error
    return Repaired(target, segment.damage or "was complete, but not closed", count)


def rewrite(segment: Segment, target: Path) -> int:
    """Copy everything readable of a segment into a new file; returns the number of messages."""
    with target.open("wb") as file:
        writer = Writer(file, chunk_size=RECORDING_CHUNK_BYTES)
        writer.start(profile="swarmtrack")
        schemas: dict[int, int] = {0: 0}
        channels: dict[int, int] = {}
        count = 0
        for message in segment.messages():
            channel = message.channel
            if channel.id not in channels:
                if channel.schema_id not in schemas:
                    schema = segment.schemas.get(channel.schema_id)
                    schemas[channel.schema_id] = (
                        0
                        if schema is None
                        else writer.register_schema(schema.name, schema.encoding, schema.data)
                    )
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[channel.schema_id], channel.metadata
                )
            if count == 0:
                _preface(segment, writer)  # before the first message, where readers look for it
            writer.add_message(
                channels[channel.id], message.log_time_ns, message.data, publish_time=message.log_time_ns
            )
            count += 1
        if count == 0:
            _preface(segment, writer)
        writer.finish()  # type: ignore[no-untyped-call]
    return count


def _preface(segment: Segment, writer: Writer) -> None:
    for name, metadata in segment.metadata.items():
        writer.add_metadata(name, metadata)
    for attachment in segment.attachments.values():
        writer.add_attachment(
            attachment.create_time,
            attachment.log_time,
            attachment.name,
            attachment.media_type,
            attachment.data,
        )


def _is_being_written(path: Path) -> bool:
    """The writer holds a lock for as long as it lives."""
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}, expected a recording") from error
    return False
