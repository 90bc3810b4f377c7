"""ROS 2's types and their encoding (CDR, little-endian), from the table `types.json`.

A message is the flat tuple of its leaves in the order of its definition. A header is `(sec, nanosec, frame_id)`, and a
pose `(x, y, z, qx, qy, qz, qw)`. A sequence is one leaf: a list of such tuples, or of numbers, or bytes.

`tests/support/ros2_types.py` makes the table.
"""

from __future__ import annotations

import itertools
import json
import struct
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from importlib import resources
from typing import Any, Final

Leaves = Sequence[Any]
"""Numbers, strings and sequences."""

Step = Callable[[bytearray, Leaves, int], int]
"""Appends the leaves that begin at an index; returns the index after them."""

_TABLE: Final = json.loads(resources.files(__package__).joinpath("types.json").read_text("utf-8"))
TYPE_HASHES: Final[dict[str, str]] = _TABLE["hashes"]
"""RIHS01 hashes of the types that are published; the same in Humble, Jazzy and Kilted."""

_ENCAPSULATION: Final = b"\x00\x01\x00\x00"
_CODES: Final = {
    "bool": "?", "byte": "B", "uint8": "B", "int8": "b", "uint16": "H", "int16": "h", "uint32": "I", "int32": "i",
    "uint64": "Q", "int64": "q", "float32": "f", "float64": "d",
}  # fmt: skip


def encode(name: str, leaves: Leaves) -> bytes:
    """A message with its encapsulation. Raises struct.error where a leaf is not of its type, ValueError where leaves
    are missing or left over.
    """
    out = bytearray()
    used = 0
    for step in _steps(name):
        used = step(out, leaves, used)
    if used != len(leaves):
        raise ValueError(f"{name}: found {len(leaves)} leaves, expected {used}")
    return _ENCAPSULATION + bytes(out)


@cache
def _steps(kind: str) -> tuple[Step, ...]:
    """Runs of numbers, and between them texts and sequences."""
    steps: list[Step] = []
    for is_number, group in itertools.groupby(_flat(kind), key=lambda code: len(code) == 1):
        codes = list(group)
        steps += [_run("".join(codes))] if is_number else map(_step, codes)
    return tuple(steps)


def _flat(kind: str) -> Iterator[str]:
    """Codes of numbers, as `struct` has them; `string`, and `KIND[]` of sequences."""
    inner, bracket, count = kind.partition("[")
    if bracket and count != "]":
        yield from itertools.chain.from_iterable(itertools.repeat(list(_flat(inner)), int(count[:-1])))
    elif bracket or kind == "string":
        yield kind
    elif kind in _CODES:
        yield _CODES[kind]
    else:
        for _, field in _TABLE["fields"][kind]:
            yield from _flat(field)


def _run(codes: str) -> Step:
    """Numbers one after the other. Where each lies depends on where the first does."""
    formats = [struct.Struct(_padded(codes, start)) for start in range(8)]
    count = len(codes)

    def step(out: bytearray, leaves: Leaves, i: int) -> int:
        out += formats[len(out) % 8].pack(*leaves[i : i + count])
        return i + count

    return step


def _padded(codes: str, start: int) -> str:
    """Format with the pad bytes that align each number to its size, behind `start` bytes."""
    text, at = "<", start
    for code in codes:
        size = struct.calcsize(f"<{code}")
        pad = -at % size
        text += "x" * pad + code
        at += pad + size
    return text


def _step(code: str) -> Step:
    return _text if code == "string" else _sequence(code.removesuffix("[]"))


def _text(out: bytearray, leaves: Leaves, i: int) -> int:
    raw = leaves[i].encode("utf-8") + b"\0"
    out += bytes(-len(out) % 4) + len(raw).to_bytes(4, "little") + raw
    return i + 1


def _sequence(kind: str) -> Step:
    code = _CODES.get(kind)

    def step(out: bytearray, leaves: Leaves, i: int) -> int:
        items = leaves[i]
        out += bytes(-len(out) % 4) + len(items).to_bytes(4, "little")
        if isinstance(items, bytes):
            out += items
        elif code is not None:
            if items:
                out += struct.pack(_padded(code, len(out) % 8)[:-1] + f"{len(items)}{code}", *items)
        else:
            for item in items:
                used = 0
                for inner in _steps(kind):
                    used = inner(out, item, used)
                if used != len(item):
                    raise ValueError(f"{kind}: found {len(item)} leaves, expected {used}")
        return i + 1

    return step
