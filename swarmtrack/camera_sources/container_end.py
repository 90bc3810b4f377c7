"""The end of a video file by its container: complete, cut off, or not shown.

A header's duration is that of the longest track in Matroska (WebM) and FLV, and that of sound as often as not; MPEG
streams and Ogg have none, and FFmpeg takes it from the last times in the file. Such a duration does not show how long
the video should be, but the container shows whether its end is there.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

TS_PACKET_BYTES, TS_SYNC, TS_SYNCS_COMPARED = 188, 0x47, 5
TS_STRIDES_BYTES = (188, 192)  # from packet to packet; the longer with a time in front of each
PROGRAM_STREAM, OGG, FLV, EBML = b"\0\0\x01\xba", b"OggS", b"FLV", b"\x1a\x45\xdf\xa3"
SEGMENT, TRACKS, TRACK, CLUSTER = b"\x18\x53\x80\x67", b"\x16\x54\xae\x6b", b"\xae", b"\x1f\x43\xb6\x75"
FLV_SOUND_AND_VIDEO = 0b101
FLV_TAG_HEADER_BYTES = 11
MOST_ELEMENTS = 10_000


def is_complete(path: Path) -> bool | None:
    """Whether a file's end is there; None where only the header's duration, which then is the video's, can show it."""
    size = path.stat().st_size
    try:
        with path.open("rb") as file:
            head = file.read(TS_STRIDES_BYTES[-1] * (TS_SYNCS_COMPARED + 1))
            if head.startswith(EBML):
                return _is_complete_matroska(file, size)
            if head.startswith(FLV):
                return _is_complete_flv(file, head, size)
    except (OSError, struct.error, IndexError):
        return None
    if head.startswith((PROGRAM_STREAM, OGG)):
        return True
    return _is_complete_transport_stream(head, size)


def _is_complete_transport_stream(head: bytes, size: int) -> bool | None:
    for stride in TS_STRIDES_BYTES:
        for first in range(min(stride, max(0, len(head) - stride * (TS_SYNCS_COMPARED - 1)))):
            if set(head[first : first + stride * TS_SYNCS_COMPARED : stride]) == {TS_SYNC}:
                return (size - first - TS_PACKET_BYTES) % stride == 0
    return None


def _is_complete_flv(file: BinaryIO, head: bytes, size: int) -> bool | None:
    """Behind each tag stands its size, behind the last one too."""
    file.seek(size - 4)
    tag = struct.unpack(">I", file.read(4))[0]
    file.seek(max(0, size - 4 - tag))
    content = struct.unpack(">I", b"\0" + file.read(4)[1:])[0]
    has_sound = head[4] & FLV_SOUND_AND_VIDEO == FLV_SOUND_AND_VIDEO
    return True if has_sound and content == tag - FLV_TAG_HEADER_BYTES else None


def _is_complete_matroska(file: BinaryIO, size: int) -> bool | None:
    for kind, start, end in _elements(file, 0, size):
        if kind == SEGMENT and end <= size:
            return True if _track_count(file, start, end) > 1 else None
    return None


def _track_count(file: BinaryIO, start: int, end: int) -> int:
    for kind, inner, inner_end in _elements(file, start, end):
        if kind == TRACKS:
            return sum(kind == TRACK for kind, _, _ in _elements(file, inner, inner_end))
        if kind == CLUSTER:
            break
    return 0


def _elements(file: BinaryIO, at: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Elements of EBML (RFC 8794) between two offsets: identifier, and where its content begins and ends."""
    for _ in range(MOST_ELEMENTS):
        if at >= end:
            return
        file.seek(at)
        head = file.read(12)
        kind = head[: _length(head[0])]
        width = _length(head[len(kind)])
        number = head[len(kind) : len(kind) + width]
        start = at + len(kind) + width
        # All ones: of unknown size, as while it is written.
        at = start + (int.from_bytes(number, "big") & ((1 << 7 * width) - 1))
        yield kind, start, at


def _length(first: int) -> int:
    """Bytes of a number, or of an identifier, by its first."""
    return 9 - first.bit_length()
