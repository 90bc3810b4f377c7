"""Repeated attempts to open links."""

from __future__ import annotations

import asyncio
import itertools
import logging
from collections.abc import Awaitable, Callable

from swarmtrack.errors import TransportError
from swarmtrack.transport.limits import REJOIN_PERIOD_S

log = logging.getLogger(__name__)


async def keep_joining(join: Callable[[], Awaitable[None]]) -> None:
    """Retry until `join` raises no TransportError. The first failure is a warning, the others are debug output."""
    for attempt in itertools.count():
        try:
            return await join()
        except TransportError as error:
            log.log(logging.INFO if attempt else logging.WARNING, "%s; we keep trying", error)
        await asyncio.sleep(REJOIN_PERIOD_S)
