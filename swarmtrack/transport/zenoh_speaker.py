"""Saying something of a drone without being its agent: for what else on board measures."""

from __future__ import annotations

from typing import Final

import zenoh

from swarmtrack.errors import TransportError
from swarmtrack.transport import keys, settings
from swarmtrack.transport.base import Kind
from swarmtrack.transport.link_watch import LinksUp, links_up
from swarmtrack.transport.settings import NetworkSettings
from swarmtrack.transport.zenoh_session import OPEN_S, bounded, close_session, open_session

MAX_KEYS: Final = 1024


class ZenohSpeaker:
    """Puts messages of one kind on keys of its own. Never blocks; what the link does not take is lost and counted."""

    def __init__(self, network: NetworkSettings, kind: Kind, drone_id: int) -> None:
        settings.check(network)
        self._network = network
        self._kind = kind
        self._drone_id = drone_id
        self._session: zenoh.Session | None = None
        self._publishers: dict[int, zenoh.Publisher] = {}
        self.unsent = 0

    async def open(self) -> None:
        """Raises TransportError where no router answers."""
        self._session = await open_session(self._network, listening=False)

    async def prepare(self, other: int) -> None:
        """To be awaited once before what is said about another drone. Raises TransportError."""
        session = self._session
        if session is None:
            raise TransportError("network: not open")
        if other in self._publishers or len(self._publishers) >= MAX_KEYS:
            return
        key = keys.key(self._network.team, self._kind, self._drone_id, other)
        self._publishers[other] = await bounded(
            lambda: session.declare_publisher(
                key,
                encoding=keys.ENCODINGS[self._kind],
                reliability=zenoh.Reliability.BEST_EFFORT,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.DATA_HIGH,
            ),
            OPEN_S,
            "declare",
        )

    def put(self, other: int, payload: bytes) -> None:
        """About another drone."""
        try:
            self._publishers[other].put(payload)
        except (KeyError, zenoh.ZError):
            self.unsent += 1

    def links(self) -> LinksUp:
        """To whom we are linked."""
        return links_up(self._session)

    async def close(self) -> None:
        session, self._session = self._session, None
        publishers, self._publishers = list(self._publishers.values()), {}
        if session is not None:
            await close_session(session, publishers)
