"""What an ONNX file holds, by the framing of its protobuf alone: looked at before ONNX Runtime loads it.

A few hundred bytes can ask for any amount of memory and time: a sparse tensor is spread out when it is read, functions
that call each other twice are written out, and nodes with constant inputs are computed. The first two are refused here,
for no detector has them; for the third, the nodes are counted.
"""

from __future__ import annotations

import enum
import mmap
from pathlib import Path
from typing import NamedTuple

from swarmtrack.errors import ModelError

MOST_FIELDS = 500_000
"""Visited in one file, half a second of work; a DETR has some 50 000."""
LARGEST_KEY = 1 << 32
"""Beyond it parsers disagree about which field it is."""
LONGEST_VARINT = 10  # bytes


class _OnnxMessage(enum.Enum):
    """Messages of onnx.proto."""

    MODEL = enum.auto()
    GRAPH = enum.auto()
    NODE = enum.auto()
    ATTRIBUTE = enum.auto()
    FUNCTION = enum.auto()
    SPARSE_TENSOR = enum.auto()


INSIDE: dict[_OnnxMessage, dict[int, _OnnxMessage]] = {
    _OnnxMessage.MODEL: {7: _OnnxMessage.GRAPH, 25: _OnnxMessage.FUNCTION},
    _OnnxMessage.GRAPH: {1: _OnnxMessage.NODE, 15: _OnnxMessage.SPARSE_TENSOR},
    _OnnxMessage.NODE: {5: _OnnxMessage.ATTRIBUTE},
    _OnnxMessage.ATTRIBUTE: {
        6: _OnnxMessage.GRAPH,
        11: _OnnxMessage.GRAPH,
        22: _OnnxMessage.SPARSE_TENSOR,
        23: _OnnxMessage.SPARSE_TENSOR,
    },
}
"""Of a message, the fields that hold further messages that matter here, by their numbers."""


PYTORCH = (".pt", ".pth")


class _OnnxField(NamedTuple):
    """number; begin, end: offsets of its content."""

    number: int
    begin: int
    end: int


def count_nodes(path: Path) -> int:
    """Nodes of its graphs. Raises `ModelError` for what is no ONNX file, and for one that only an attack looks like."""
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            return _count(path, data)
    except (OSError, ValueError) as error:  # ValueError: also where the file is empty
        if path.suffix.lower() in PYTORCH:
            raise ModelError(
                f"{path}: is a PyTorch checkpoint, expected an ONNX file: yolo export model={path.name} format=onnx"
            ) from None
        raise ModelError(f"{path}: is no ONNX file, or a damaged one ({error})") from None


def _count(path: Path, data: mmap.mmap) -> int:
    """Raises ValueError where that is no protobuf."""
    nodes = visited = 0
    waiting = [(_OnnxMessage.MODEL, 0, len(data))]
    while waiting:
        kind, at, end = waiting.pop()
        inside = INSIDE[kind]
        while at < end:
            field = _field(data, at, end)
            at = field.end
            visited += 1
            if visited > MOST_FIELDS:
                raise ValueError(f"more than {MOST_FIELDS} fields")
            match inside.get(field.number):
                case None:
                    continue
                case _OnnxMessage.SPARSE_TENSOR:
                    raise ModelError(
                        f"{path}: holds a sparse tensor, which takes any amount of memory, expected dense ones: export "
                        "it without sparse weights"
                    )
                case _OnnxMessage.FUNCTION:
                    raise ModelError(
                        f"{path}: holds functions of its own, which can unfold to any size, expected plain nodes: "
                        "write them out with onnx.inliner.inline_local_functions"
                    )
                case found:
                    nodes += found is _OnnxMessage.NODE
                    waiting.append((found, field.begin, field.end))
    return nodes


def _field(data: mmap.mmap, at: int, end: int) -> _OnnxField:
    key, begin = _varint(data, at, end)
    if key >= LARGEST_KEY:
        raise ValueError("field number too large")
    match key & 7:
        case 0:
            _, after = _varint(data, begin, end)
        case 1:
            after = begin + 8
        case 2:
            length, begin = _varint(data, begin, end)
            after = begin + length
        case 5:
            after = begin + 4
        case wire_type:
            raise ValueError(f"wire type {wire_type}")
    if after > end:
        raise ValueError("cut short")
    return _OnnxField(key >> 3, begin, after)


def _varint(data: mmap.mmap, at: int, end: int) -> tuple[int, int]:
    """The number there, and the offset behind it."""
    value = 0
    for shift in range(0, 7 * LONGEST_VARINT, 7):
        if at >= end:
            raise ValueError("cut short")
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise ValueError("number too long")
