"""Edit lists of MP4 and MOV files: what is to be shown of a file that a phone has trimmed (ISO/IEC 14496-12, 8.6.6).

OpenCV plays by the edit list, but counts frames by the whole file. Only the list's duration is read here.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

MAX_INDEX_BYTES = 64 << 20  # of the `moov` box: that of hours
MOST_EDITS = 10_000


def edited_duration_s(path: Path) -> float | None:
    """Duration that the longest edit list of a file shows [s]; None without one, or where it makes no sense."""
    try:
        with path.open("rb") as file:
            index = _index(file, path.stat().st_size)
        return None if index is None else _longest(index)
    except (OSError, struct.error, IndexError, OverflowError, ZeroDivisionError):
        return None


def _index(file: BinaryIO, size: int) -> bytes | None:
    """Content of the `moov` box."""
    at = 0
    while at + 8 <= size:
        file.seek(at)
        head = file.read(16)
        length, kind = struct.unpack_from(">I4s", head)
        header = 8
        if length == 1:
            length, header = struct.unpack_from(">Q", head, 8)[0], 16
        if at == 0 and kind != b"ftyp":
            return None
        if kind == b"moov":
            file.seek(at + header)
            return file.read(max(0, min(length - header, MAX_INDEX_BYTES)))
        if length < header:
            return None
        at += length
    return None


def _longest(index: bytes) -> float | None:
    movie = index.find(b"mvhd")
    if movie < 0:
        return None
    scale = struct.unpack_from(">I", index, movie + (24 if index[movie + 4] == 1 else 16))[0]
    longest, at = 0, index.find(b"elst")
    while at >= 0:
        version, count = index[at + 4], struct.unpack_from(">I", index, at + 8)[0]
        entry = ">QqI" if version == 1 else ">IiI"
        edits = [
            struct.unpack_from(entry, index, at + 12 + k * struct.calcsize(entry))
            for k in range(min(count, MOST_EDITS))
        ]
        # A media time of -1 is a pause.
        longest = max(longest, sum(duration for duration, media, _ in edits if media >= 0))
        at = index.find(b"elst", at + 4)
    return longest / scale if longest else None
