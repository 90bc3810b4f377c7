"""A ULog's definitions, checked in front of the library that reads it.

The library writes each format out field by field, nested ones within, and steps back where a length is impossible. So
two thousand bytes make it work for ever: a format within itself, arrays of arrays of arrays, a length that leads beyond
the end.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

from swarmtrack.autopilot.limits import (
    ULOG_DEEPEST_FORMAT,
    ULOG_LARGEST_DEFINITION,
    ULOG_LONGEST_END,
    ULOG_MOST_DAMAGED_BYTES,
    ULOG_MOST_FIELDS,
    ULOG_MOST_SUBSCRIBED_FIELDS,
)
from swarmtrack.errors import SourceError

ULOG_HEADER = 16
UNWRITTEN = b"\0\xff"  # what blocks hold that a card has reserved, or erased
# Types of messages: of the definitions; and of what ends them.
DEFINITION_TYPES, DATA_TYPES = frozenset(b"BFIMPQ"), frozenset(b"ALC")
SUBSCRIPTION = ord("A")
BASIC_TYPES = frozenset(
    (
        "int8_t",
        "uint8_t",
        "int16_t",
        "uint16_t",
        "int32_t",
        "uint32_t",
        "int64_t",
        "uint64_t",
        "float",
        "double",
    )
) | {"bool", "char"}

Format = Sequence[tuple[str, int]]  # of each field: its type, and how many


def written_size(path: Path) -> int:
    """Bytes of a log, without most of a tail that was never written: the library goes through that byte by byte."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        end = len(data)
        while end > 0 and not data[max(end - ULOG_LONGEST_END, 0) : end].strip(UNWRITTEN):
            end -= ULOG_LONGEST_END
        return min(max(end, 0) + ULOG_LONGEST_END, len(data))


def check_definitions(path: Path, size: int) -> None:
    """Raises SourceError where a log's definitions are damaged, or such as no PX4 has. size: how much of it to read."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), size, access=mmap.ACCESS_READ) as data:
        formats, position = _formats(path, data)
        fields: dict[str, int] = {}
        for name in formats:
            _count(path, formats, name, fields, ())
        _check_subscriptions(path, data, position, fields)


def _formats(path: Path, data: mmap.mmap) -> tuple[dict[str, Format], int]:
    """By name; and where the definitions end."""
    position, damaged = ULOG_HEADER, 0
    formats: dict[str, Format] = {}
    while position + 3 <= len(data):
        length, kind = struct.unpack_from("<HB", data, position)
        end = position + 3 + length
        if kind in DATA_TYPES:
            break
        if kind not in DEFINITION_TYPES and (kind == 0 or not 0 < length <= ULOG_LARGEST_DEFINITION):
            damaged += 1
            if end > len(data) or damaged > ULOG_MOST_DAMAGED_BYTES:
                raise SourceError(
                    f"{path}: is broken or cut off in its header, at byte {position}, expected a ULog of PX4"
                )
            position += 1
            continue
        if kind == ord("F"):
            name, _, text = data[position + 3 : end].decode("utf-8", "replace").partition(":")
            formats[name] = [_field(field) for field in text.split(";") if field]
        position = end
    return formats, position


def _check_subscriptions(path: Path, data: mmap.mmap, position: int, fields: Mapping[str, int]) -> None:
    """The library keeps all fields of each subscription, however often one comes again."""
    total, size, header = 0, len(data), struct.Struct("<HB")
    while position + 3 <= size:
        length, kind = header.unpack_from(data, position)
        if kind == SUBSCRIPTION:
            name = data[position + 6 : position + 3 + length].decode("utf-8", "replace")
            total += fields.get(name, 1)
            if total > ULOG_MOST_SUBSCRIBED_FIELDS:
                most = ULOG_MOST_SUBSCRIBED_FIELDS
                raise SourceError(
                    f"{path}: its topics have more than {most} fields in all, expected a ULog of PX4"
                )
        position += 1 if kind == 0 or length == 0 else 3 + length


def _field(text: str) -> tuple[str, int]:
    kind, bracket, count = text.split(" ", maxsplit=1)[0].partition("[")
    digits = count.rstrip("]")
    return kind, int(digits) if bracket and digits.isdecimal() and len(digits) < 9 else 1


def _count(
    path: Path, formats: Mapping[str, Format], name: str, known: dict[str, int], within: tuple[str, ...]
) -> int:
    """Fields of a format, with those of the formats in it; known: those counted already."""
    if name in known or name in BASIC_TYPES or name not in formats:
        return known.get(name, 1)
    if name in within:
        raise SourceError(f"{path}: format {name} contains itself, expected a ULog of PX4")
    if len(within) == ULOG_DEEPEST_FORMAT:
        raise SourceError(
            f"{path}: format {within[0]} nests others more than {ULOG_DEEPEST_FORMAT} deep, expected a ULog of PX4"
        )
    total = sum(count * _count(path, formats, kind, known, (*within, name)) for kind, count in formats[name])
    if total > ULOG_MOST_FIELDS:
        raise SourceError(
            f"{path}: format {name} has {total} fields, expected a ULog of PX4, with {ULOG_MOST_FIELDS} at most"
        )
    known[name] = total
    return total
