"""A newer roster or certificate reaches an agent in flight."""

from __future__ import annotations

import asyncio
import contextlib
import logging

from swarmtrack.errors import TransportError
from swarmtrack.security.roster_watch import ROSTER_PERIOD_S, RosterWatch
from swarmtrack.transport.zenoh_transport import ZenohTransport

log = logging.getLogger(__name__)


class KeyRenewal:
    """Watches the key files, and has the links reopened."""

    def __init__(self, watch: RosterWatch, transport: ZenohTransport) -> None:
        self._watch = watch
        self._transport = transport
        self._now = asyncio.Event()

    def look_now(self) -> None:
        """Not only at the next look."""
        self._now.set()

    async def run(self) -> None:
        """Until cancelled."""
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(ROSTER_PERIOD_S):
                    await self._now.wait()
            self._now.clear()
            found = await asyncio.to_thread(self._watch.news)
            if found is None:
                continue
            log.warning(
                "roster number %d, certificate until %s UTC: links are renewed",
                found.roster.number,
                found.expires.strftime("%Y-%m-%d %H:%M"),
            )
            try:
                await self._transport.renew(found)
            except TransportError as error:
                log.error("%s: the old roster stays in use", error)
