"""Publisher of a drone's messages by another program on board, such as the reader of a sensor."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import replace

import zenoh

from swarmtrack.clock import Clock
from swarmtrack.errors import TransportError
from swarmtrack.security.credentials import Credentials
from swarmtrack.transport import keys, settings
from swarmtrack.transport.base import Kind
from swarmtrack.transport.following import follow_roster
from swarmtrack.transport.joining import keep_joining
from swarmtrack.transport.limits import MAX_SPOKEN_KEYS, SESSION_OPEN_S
from swarmtrack.transport.link_watch import LinksUp, links_up
from swarmtrack.transport.settings import NetworkSettings
from swarmtrack.transport.zenoh_session import bounded, close_session, open_session

log = logging.getLogger(__name__)


class ZenohSpeaker:
    """Puts messages of one kind on its own keys. Never blocks; what the link does not take is lost and counted."""

    def __init__(self, network: NetworkSettings, kind: Kind, drone_id: int, clock: Clock) -> None:
        settings.check(network)
        self._network = network
        self._kind = kind
        self._drone_id = drone_id
        self._clock = clock
        self._following: asyncio.Task[None] | None = None
        self._session: zenoh.Session | None = None
        self._publishers: dict[int, zenoh.Publisher] = {}
        self.unsent = 0

    async def open(self) -> None:
        """Open the session. Raises TransportError where no router answers."""
        await self._join()
        following = follow_roster(self._network.credentials, self._clock, self._renew)
        self._following = asyncio.create_task(following, name="roster")

    async def _join(self) -> None:
        self._session = await open_session(self._network, listening=False)

    async def _renew(self, found: Credentials) -> None:
        """Links are closed and made anew; what is said meanwhile is lost and counted."""
        log.warning("roster number %d: links are renewed", found.roster.number)
        await self._leave()
        self._network = replace(self._network, credentials=found)
        await keep_joining(self._join)

    async def prepare(self, other: int) -> None:
        """Declare the key of another drone; to be awaited before `put`. Raises TransportError."""
        session = self._session
        if session is None:
            if self._following is None:
                raise TransportError("network: not open")
            return  # links are being made anew
        if other in self._publishers or len(self._publishers) >= MAX_SPOKEN_KEYS:
            return
        key = keys.key(self._network.team, self._kind, self._drone_id, other)
        publisher = await bounded(
            lambda: session.declare_publisher(
                key,
                encoding=keys.ENCODINGS[self._kind],
                reliability=zenoh.Reliability.BEST_EFFORT,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.DATA_HIGH,
            ),
            SESSION_OPEN_S,
            "declare",
        )
        if session is self._session:
            self._publishers[other] = publisher

    def put(self, other: int, payload: bytes) -> None:
        """Publish a message about another drone."""
        try:
            self._publishers[other].put(payload)
        except (KeyError, zenoh.ZError):
            self.unsent += 1

    def links(self) -> LinksUp:
        """Links of the session."""
        return links_up(self._session)

    async def close(self) -> None:
        following, self._following = self._following, None
        if following is not None:
            following.cancel()
        await self._leave()

    async def _leave(self) -> None:
        session, self._session = self._session, None
        publishers, self._publishers = list(self._publishers.values()), {}
        if session is not None:
            await close_session(session, publishers)
