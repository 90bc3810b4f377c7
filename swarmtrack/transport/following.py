"""Follows the roster in a process with keys: a drone that left the team is disconnected when the file changes."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from swarmtrack.clock import Clock
from swarmtrack.security.credentials import Credentials


async def follow_roster(
    credentials: Credentials | None, clock: Clock, renew: Callable[[Credentials], Awaitable[None]]
) -> None:
    """Run until cancelled; returns at once without keys. renew: called with each newer roster or renewed
    certificate.
    """
    if credentials is None:
        return
    # Not above: who has no keys need not load cryptography.
    from swarmtrack.security.roster_watch import ROSTER_PERIOD_S, RosterWatch  # noqa: PLC0415

    watch = RosterWatch(credentials.ca.parent, credentials, clock)
    while True:
        await asyncio.sleep(ROSTER_PERIOD_S)
        found = await asyncio.to_thread(watch.news)
        if found is not None:
            await renew(found)
