"""The agent's interface to the network."""

from __future__ import annotations

import enum
from collections.abc import AsyncIterator
from typing import Final, NamedTuple, Protocol

from swarmtrack.messages import Announcement, LinkStatus, PeerEvent


class Kind(enum.StrEnum):
    """Third part of every key, `swarmtrack/<team>/v1/<kind>/<id>`."""

    POSE = "pose"
    ALIVE = "alive"
    CAMERA = "camera"
    TRACKS = "tracks"
    IDENTITIES = "identities"
    MOTION = "motion"
    RANGE = "range"
    STRANGER = "stranger"
    HEALTH = "health"
    VIDEO = "video"


PUBLISHED: Final = (Kind.IDENTITIES, Kind.MOTION, Kind.STRANGER, Kind.TRACKS, Kind.HEALTH, Kind.VIDEO)
"""What `Transport.publish` takes."""


class Sample(NamedTuple):
    """A received message, and its arrival on our monotonic clock.

    alive: False for a deletion, such as a liveliness token that disappeared; payload is cut after MAX_BYTES + 1.
    """

    key: str
    payload: bytes
    alive: bool
    arrived: float


class Transport(Protocol):
    """Network of one drone: announcements are reliable, identities nearly so, tracks and health best effort."""

    async def open(self) -> None: ...

    async def announce(self, announcement: Announcement) -> None:
        """Publish our announcement to all present and future peers; one with a higher `sequence` replaces it."""
        ...

    def request_announcement(self, drone_id: int) -> None:
        """Ask a teammate to announce its pose again; the answer, if any, arrives like any announcement.

        The teammate gets an `AnnouncementRequested`. Never blocks; both ends pass one request per second, the rest is
        counted.
        """
        ...

    def describe(self, camera: bytes) -> None:
        """Set our `camera/<id>`: sent once when the network opens, and on request. To be called before that."""
        ...

    def publish(self, kind: Kind, payload: bytes, camera: int = 0) -> bool:
        """Send our newest message of a kind in `PUBLISHED`; never blocks, may drop. Returns whether it was sent.

        camera: number of the camera, for `Kind.VIDEO`.
        """
        ...

    def receive_only(self, drones: frozenset[int] | None) -> None:
        """Receive reports, motion and strangers of these teammates only; None: of all. Never blocks."""
        ...

    def has_listener(self, kind: Kind, camera: int = 0) -> bool:
        """Whether there is a subscriber to what we publish of this kind; cheap. camera: as in `publish`."""
        ...

    @property
    def is_narrow(self) -> bool:
        """Whether tracks had better be encoded in their short form, because not all of them can be sent."""
        ...

    def events(self) -> AsyncIterator[PeerEvent]:
        """Announcements, reports, arrivals and departures of teammates, in order. Ends when closed.

        A new boot of a drone ends the one before. Where both live on for longer than a restart takes, that is an
        `IdClash`, and both live. It lasts until a `PeerDeparted` leaves one boot alone, whose announcement is then
        delivered again.
        """
        ...

    def status(self) -> LinkStatus: ...

    async def close(self) -> None: ...
