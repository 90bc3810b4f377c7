"""Parameters of an autopilot, read by name (PARAM_REQUEST_READ). Nothing is ever written.

Most firmwares do not answer for a parameter that does not exist, and PARAM_ERROR of newer ones is not read. So each is
requested a few times, and then counts as unknown.
"""

from __future__ import annotations

import asyncio
import math
import struct
from collections.abc import Callable, Iterable
from typing import Any

from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.candidates import AutopilotAddress

# Of these types PX4 sends the bits of an integer in the place of a float.
INTEGERS = {common.MAV_PARAM_TYPE_INT32: "<i", common.MAV_PARAM_TYPE_UINT32: "<I"}


class ParameterReader:
    """Reads parameters of one autopilot; `values`: by name. names_of: names per MAV_AUTOPILOT; asks: False: only
    listen; every_s, attempts: interval and number of requests for a missing one.
    """

    def __init__(
        self,
        names_of: Callable[[int], Iterable[str]],
        *,
        asks: bool = True,
        every_s: float = 0.5,
        attempts: int = 4,
    ) -> None:
        self.values: dict[str, float] = {}
        self.kind: int | None = None
        """MAV_AUTOPILOT; None before a heartbeat."""
        self._names_of, self._asks = names_of, asks
        self._every_s, self._most = every_s, attempts
        self._attempts: dict[str, int] = {}
        self._next = -math.inf
        self._done = asyncio.Event()

    @property
    def waits(self) -> bool:
        """Whether an answer is due."""
        return bool(self._attempts)

    async def done(self) -> None:
        """Wait until every parameter is known, or was requested often enough."""
        await self._done.wait()

    def meet(self, kind: int) -> None:
        """The first heartbeat has come, with its MAV_AUTOPILOT."""
        self.kind = kind
        self.restart()

    def restart(self) -> None:
        """The autopilot has restarted, perhaps with other values: request again; meanwhile the earlier ones hold."""
        if self.kind is not None and self._asks:
            self._wait_for(dict.fromkeys(self._names_of(self.kind), 0))

    def tick(self, now: float, target: AutopilotAddress) -> list[Any]:
        """Requests to send now."""
        if not self._attempts or now < self._next:
            return []
        self._next = now + self._every_s
        self._wait_for({name: n + 1 for name, n in self._attempts.items() if n < self._most})
        return [
            common.MAVLink_param_request_read_message(
                target_system=target.system,
                target_component=target.component,
                param_id=name.encode(),
                param_index=-1,
            )
            for name in self._attempts
        ]

    def on_value(self, t: float, m: Any) -> None:
        """PARAM_VALUE has come, whichever process asked for it. NaN is ignored."""
        if self.kind is None or m.param_id not in self._names_of(self.kind):
            return
        value = float(m.param_value)
        if self.kind == common.MAV_AUTOPILOT_PX4 and m.param_type in INTEGERS:
            (value,) = struct.unpack(INTEGERS[m.param_type], struct.pack("<f", value))
        if math.isfinite(value):
            self.values[m.param_id] = float(value)
            self._wait_for({name: n for name, n in self._attempts.items() if name != m.param_id})

    def _wait_for(self, attempts: dict[str, int]) -> None:
        self._attempts = attempts
        if not attempts:
            self._done.set()
