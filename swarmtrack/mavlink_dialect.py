"""CURRENT_MODE (436), which pymavlink's `common` does not know yet: once this is imported it is read and written there.

Of MAVLink's development dialect: `standard_mode`; `custom_mode`, as in a heartbeat; `intended_custom_mode`, which the
pilot asked for last, whatever a failsafe has made of it; 0: not told.
"""

from __future__ import annotations

import struct
from typing import Any

from pymavlink.dialects.v20 import common

CURRENT_MODE = 436


class CurrentMode(common.MAVLink_message):  # type: ignore[misc]
    """As pymavlink generates it."""

    id = CURRENT_MODE
    msgname = "CURRENT_MODE"
    fieldnames = ("standard_mode", "custom_mode", "intended_custom_mode")
    ordered_fieldnames = ("custom_mode", "intended_custom_mode", "standard_mode")
    fieldtypes = ("uint8_t", "uint32_t", "uint32_t")
    fielddisplays_by_name: dict[str, str] = {}  # noqa: RUF012 (as pymavlink has them)
    fieldenums_by_name: dict[str, str] = {}  # noqa: RUF012
    fieldunits_by_name: dict[str, str] = {}  # noqa: RUF012
    native_format = bytearray(b"<IIB")
    orders = (2, 0, 1)
    lengths = (1, 1, 1)
    array_lengths = (0, 0, 0)
    crc_extra = 193
    unpacker = struct.Struct("<IIB")
    instance_field = None
    instance_offset = -1

    def __init__(self, standard_mode: int, custom_mode: int, intended_custom_mode: int) -> None:
        super().__init__(CURRENT_MODE, self.msgname)
        self._fieldnames = self.fieldnames
        self._instance_field, self._instance_offset = self.instance_field, self.instance_offset
        self.standard_mode = standard_mode
        self.custom_mode = custom_mode
        self.intended_custom_mode = intended_custom_mode

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        payload = self.unpacker.pack(self.custom_mode, self.intended_custom_mode, self.standard_mode)
        return bytes(self._pack(mav, self.crc_extra, payload, force_mavlink1=force_mavlink1))


common.mavlink_map.setdefault(CURRENT_MODE, CurrentMode)
