"""The records of an MCAP file, parsed with bounds: an untrusted file may contain anything.

`mcap`'s own parsers believe every length that they read, and the size that a compressed chunk claims for itself. Here a
field that ends beyond its record is a ValueError, and what is unpacked is bounded before it is.
"""

from __future__ import annotations

import struct
import zlib
from io import BytesIO

import zstandard
from mcap.records import Attachment, Channel, Metadata, Schema

from swarmtrack.plain_text import LONGEST_OF_SEVERAL, plain
from swarmtrack.recording.limits import (
    LARGEST_ATTACHMENT_BYTES,
    LARGEST_CHUNK_BYTES,
    LARGEST_NOTE_BYTES,
    LONGEST_RECORD_NAME,
)


class Fields:
    """Fields of a record, read one after the other. Raises ValueError where one ends beyond the record."""

    def __init__(self, body: bytes) -> None:
        self._body = body
        self._at = 0

    def read(self, size: int) -> bytes:
        end = self._at + size
        if end > len(self._body):
            raise ValueError("a field that ends beyond its record")
        field, self._at = self._body[self._at : end], end
        return field

    def number(self, size: int) -> int:
        """Unsigned integer of `size` bytes."""
        return int.from_bytes(self.read(size), "little")

    def text(self) -> str:
        return self.read(self.number(4)).decode()

    def name(self) -> str:
        return plain(self.text(), LONGEST_RECORD_NAME)

    def entries(self) -> dict[str, str]:
        """A map of strings."""
        inner = Fields(self.read(self.number(4)))
        entries = {}
        while inner._at < len(inner._body):
            key = inner.name()
            entries[key] = plain(inner.text(), LONGEST_OF_SEVERAL)
        return entries


def read_schema(body: bytes) -> Schema:
    fields = _noted(body, "a schema")
    number, name, encoding = fields.number(2), fields.name(), fields.name()
    return Schema(id=number, name=name, encoding=encoding, data=fields.read(fields.number(4)))


def read_channel(body: bytes) -> Channel:
    fields = _noted(body, "a channel")
    number, schema = fields.number(2), fields.number(2)
    topic, encoding = fields.name(), fields.name()
    return Channel(
        id=number, topic=topic, message_encoding=encoding, metadata=fields.entries(), schema_id=schema
    )


def read_metadata(body: bytes) -> Metadata:
    fields = _noted(body, "metadata")
    name = fields.name()
    return Metadata(name=name, metadata=fields.entries())


def read_attachment(body: bytes) -> Attachment:
    if len(body) > LARGEST_ATTACHMENT_BYTES:
        raise ValueError(f"an attachment of {len(body)} bytes, expected {LARGEST_ATTACHMENT_BYTES} at most")
    fields = Fields(body)
    log_time, create_time = fields.number(8), fields.number(8)
    name, media_type = fields.name(), fields.name()
    data = fields.read(fields.number(8))
    return Attachment(create_time=create_time, log_time=log_time, name=name, media_type=media_type, data=data)


def _noted(body: bytes, what: str) -> Fields:
    if len(body) > LARGEST_NOTE_BYTES:
        raise ValueError(f"{what} of {len(body)} bytes, expected {LARGEST_NOTE_BYTES} at most")
    return Fields(body)


def check_end(body: bytes, checksum: int) -> None:
    """Check the end-of-data record. checksum: CRC of all bytes before it. Raises ValueError."""
    fields = Fields(body)
    written = fields.number(4)
    if written and written != checksum:
        raise ValueError("bytes before it are not what was written: their checksum differs")


_CHUNK = struct.Struct("<QQQI")  # first and last log time, bytes unpacked, their CRC or 0


def unpacked_chunk(body: bytes) -> bytes:
    """Records of a chunk. Raises ValueError, or ZstdError for invalid compressed data."""
    fields = Fields(body)
    _, _, size, checksum = _CHUNK.unpack(fields.read(_CHUNK.size))
    compression, packed = fields.name(), fields.read(fields.number(8))
    if size > LARGEST_CHUNK_BYTES:
        raise ValueError(f"a chunk of {size} bytes, expected {LARGEST_CHUNK_BYTES} at most")
    match compression:
        case "zstd":
            data = _decompressed(packed, size)
        case "":
            data = packed
        case _:
            raise ValueError(f"compressed by {compression!r}")
    if len(data) != size:
        raise ValueError(f"a chunk of other than the {size} bytes that it claims")
    if checksum and zlib.crc32(data) != checksum:
        raise ValueError("a chunk that is not what was written: its checksum differs")
    return data


def _decompressed(packed: bytes, size: int) -> bytes:
    """`size` bytes, one more where there are more, or fewer. A frame's own word of its size is not believed."""
    unpacker = zstandard.ZstdDecompressor(max_window_size=LARGEST_CHUNK_BYTES)
    with unpacker.stream_reader(BytesIO(packed)) as reader:
        return bytes(reader.read(size + 1))
