"""What the network is, to the agent."""

from __future__ import annotations

import enum
from collections.abc import AsyncIterator
from typing import Final, NamedTuple, Protocol

from swarmtrack.messages import Announcement, LinkStatus, PeerEvent


class Kind(enum.StrEnum):
    """The third part of every key, `swarmtrack/<team>/v1/<kind>/<id>`."""

    POSE = "pose"
    ALIVE = "alive"
    CAMERA = "camera"
    TRACKS = "tracks"
    IDENTITIES = "identities"
    MOTION = "motion"
    RANGE = "range"
    HEALTH = "health"
    VIDEO = "video"


PUBLISHED: Final = (Kind.IDENTITIES, Kind.MOTION, Kind.TRACKS, Kind.HEALTH, Kind.VIDEO)
"""What `Transport.publish` takes."""


class Sample(NamedTuple):
    """What was heard, and when by our monotonic clock.

    alive: False for a deletion, such as a token that went; payload is cut after MAX_BYTES + 1.
    """

    key: str
    payload: bytes
    alive: bool
    arrived: float


class Transport(Protocol):
    """Carries announcements surely, identities nearly so, tracks and health as well as it can."""

    async def open(self) -> None: ...

    async def announce(self, announcement: Announcement) -> None:
        """Make our announcement known to all, now and later; one with a higher `sequence` replaces it."""
        ...

    def request_announcement(self, drone_id: int) -> None:
        """Ask a teammate to say anew where it is; what it says comes as any announcement, if it does.

        It gets an `AnnouncementRequested`. Never blocks; both ends let pass one a second, the rest is counted.
        """
        ...

    def describe(self, camera: bytes) -> None:
        """Our `camera/<id>`: said once when the network opens, and to whoever asks. To be called before that."""
        ...

    def publish(self, kind: Kind, payload: bytes, camera: int = 0) -> bool:
        """Send our newest message of a kind in `PUBLISHED`; never blocks, may drop. Whether it was let go.

        camera: whose picture it is, of `Kind.VIDEO`.
        """
        ...

    def has_listener(self, kind: Kind, camera: int = 0) -> bool:
        """Whether anybody listens to what we publish of this kind; costs nothing to ask. camera: as of `publish`."""
        ...

    def events(self) -> AsyncIterator[PeerEvent]:
        """What teammates said and whether they live, in order of arrival. Ends when closed.

        A new boot of a drone ends the one before. Where both live on for longer than a restart takes, that is an
        `IdClash`, and both live. It lasts until a `PeerDeparted` leaves one boot alone, whose announcement is then told
        again.
        """
        ...

    def status(self) -> LinkStatus: ...

    async def close(self) -> None: ...
