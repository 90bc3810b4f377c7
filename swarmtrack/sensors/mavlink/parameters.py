"""Parameters of an autopilot, read by name. Nothing is ever written.

A parameter that does not exist is passed over in silence by most firmwares, and PARAM_ERROR of newer ones is not read.
So each is asked for a few times, and then counts as not told.
"""

from __future__ import annotations

import asyncio
import math
import struct
from collections.abc import Callable, Iterable
from typing import Any

from pymavlink.dialects.v20 import common

ASK_EVERY_S, ATTEMPTS = 0.5, 4
# Of these types PX4 sends the bits of an integer in the place of a float.
INTEGERS = {
    common.MAV_PARAM_TYPE_INT32: "<i",
    common.MAV_PARAM_TYPE_UINT32: "<I",
}


class ParameterReader:
    """Asks one autopilot; `values`: by name, what it told. names_of: what is asked of which MAV_AUTOPILOT."""

    def __init__(self, names_of: Callable[[int], Iterable[str]]) -> None:
        self.values: dict[str, float] = {}
        self.kind: int | None = None
        """MAV_AUTOPILOT; None before a heartbeat."""
        self._names_of = names_of
        self._attempts: dict[str, int] = {}
        self._next = -math.inf
        self._done = asyncio.Event()

    async def done(self) -> None:
        """Until everything has been told, or asked for often enough."""
        await self._done.wait()

    def meet(self, kind: int) -> None:
        """The first heartbeat says of which MAV_AUTOPILOT it is."""
        self.kind = kind
        self._attempts = dict.fromkeys(self._names_of(kind), 0)

    def tick(self, now: float, system: int) -> list[Any]:
        """The questions to send now."""
        if not self._attempts or now < self._next:
            return []
        self._next = now + ASK_EVERY_S
        self._attempts = {name: n + 1 for name, n in self._attempts.items() if n < ATTEMPTS}
        self._look()
        return [
            common.MAVLink_param_request_read_message(
                target_system=system,
                target_component=common.MAV_COMP_ID_AUTOPILOT1,
                param_id=name.encode(),
                param_index=-1,
            )
            for name in self._attempts
        ]

    def on_value(self, t: float, m: Any) -> None:
        """PARAM_VALUE, whoever asked for it."""
        if self.kind is None or m.param_id not in self._names_of(self.kind):
            return
        value = float(m.param_value)
        if self.kind == common.MAV_AUTOPILOT_PX4 and m.param_type in INTEGERS:
            (value,) = struct.unpack(INTEGERS[m.param_type], struct.pack("<f", value))
        if math.isfinite(value):
            self.values[m.param_id] = float(value)
            self._attempts.pop(m.param_id, None)
            self._look()

    def _look(self) -> None:
        if not self._attempts:
            self._done.set()
