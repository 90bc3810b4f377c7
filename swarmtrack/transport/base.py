"""What the network is, to the agent."""

from __future__ import annotations

import enum
from collections.abc import AsyncIterator
from typing import Protocol

from swarmtrack.messages import Announcement, LinkStatus, PeerEvent


class Kind(enum.StrEnum):
    """The third part of every key, `swarmtrack/<team>/v1/<kind>/<id>`."""

    POSE = "pose"
    ALIVE = "alive"
    TRACKS = "tracks"
    IDENTITIES = "identities"
    HEALTH = "health"
    VIDEO = "video"


class Transport(Protocol):
    """Carries announcements surely, tracks and health as well as it can."""

    async def open(self) -> None: ...

    async def announce(self, announcement: Announcement) -> None:
        """Make our announcement known to all, now and later; one with a higher `sequence` replaces it."""
        ...

    def publish(self, kind: Kind, payload: bytes) -> None:
        """Send our newest tracks or health; never blocks, may drop."""
        ...

    def events(self) -> AsyncIterator[PeerEvent]:
        """What teammates said and whether they live, in order of arrival. Ends when closed."""
        ...

    def status(self) -> LinkStatus: ...

    async def close(self) -> None: ...
