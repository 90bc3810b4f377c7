"""Writes ArduPilot's own log: https://ardupilot.org/dev/docs/code-overview-adding-a-new-log-message.html."""

from __future__ import annotations

import struct

MARKS = b"\xa3\x95"
CODES = {
    "Q": "Q", "B": "B", "b": "b", "H": "H", "I": "I", "f": "f", "d": "d", "n": "4s", "N": "16s", "Z": "64s",
    "c": "h", "C": "H", "L": "i", "M": "B",
}  # fmt: skip
SCALES = {"c": 100.0, "C": 100.0, "L": 1e7}


class DataflashLog:
    """Its FMT messages stand where a type is first used, those of units and multipliers behind them."""

    def __init__(self) -> None:
        self._formats: dict[str, tuple[int, str]] = {}
        self._parts: list[bytes] = []
        self._format(0x80, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")
        self.define("FMTU", "QBNN", "TimeUS,FmtType,UnitIds,MultIds")

    def define(self, name: str, types: str, columns: str, units: str = "") -> None:
        """units: one letter for each column, `#` for the one that counts sensors."""
        kind = 0x81 + len(self._formats)
        self._formats[name] = kind, types
        self._format(kind, name, types, columns)
        if units:
            self.add("FMTU", 1, kind, units.encode(), b"-" * len(units))

    def _format(self, kind: int, name: str, types: str, columns: str) -> None:
        length = 3 + struct.calcsize("<" + "".join(CODES[letter] for letter in types))
        body = struct.pack("<BB4s16s64s", kind, length, name.encode(), types.encode(), columns.encode())
        self._parts.append(MARKS + b"\x80" + body)

    def add(self, name: str, *values: float | bytes) -> None:
        kind, types = self._formats[name]
        fields = [
            round(value * SCALES[letter]) if letter in SCALES else value
            for value, letter in zip(values, types, strict=True)
        ]
        body = struct.pack("<" + "".join(CODES[letter] for letter in types), *fields)
        self._parts.append(MARKS + bytes((kind,)) + body)

    def raw(self, data: bytes) -> None:
        self._parts.append(data)

    def bytes(self) -> bytes:
        return b"".join(self._parts)
