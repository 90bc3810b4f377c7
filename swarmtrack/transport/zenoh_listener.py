"""Hearing a team without being of it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from functools import partial
from typing import Any

import zenoh

from swarmtrack.errors import TransportError
from swarmtrack.transport import keys, settings
from swarmtrack.transport.base import Kind
from swarmtrack.transport.link_watch import LinksUp, links_up
from swarmtrack.transport.settings import NetworkSettings
from swarmtrack.transport.zenoh_bridge import BRIDGE_CAPACITY, Bridge, Sample
from swarmtrack.transport.zenoh_session import (
    OPEN_S,
    ask_for_announcement,
    bounded,
    close_session,
    open_session,
    plain,
)


class ZenohListener:
    """Hears a team without being of it: for echo, monitor and recorder.

    key_expression: a full one; `*` is one part of a key, `**` any number. Announcements made before we came are
    asked for, so each is heard, if now and then twice.
    """

    def __init__(
        self,
        network: NetworkSettings,
        key_expression: str,
        capacity: int = BRIDGE_CAPACITY,
        newest_per_key: bool = False,
    ) -> None:
        settings.check(network)
        try:
            self._expression = zenoh.KeyExpr(key_expression)
        except zenoh.ZError as error:
            raise TransportError(f"{key_expression!r} is no key expression: {plain(error)}") from None
        self._network = network
        self._capacity = capacity
        self._newest_per_key = newest_per_key
        self._session: zenoh.Session | None = None
        self._declared: list[Any] = []
        self._samples: asyncio.Queue[Sample | None] = asyncio.Queue(capacity)
        self._bridge: Bridge | None = None
        self._dropped = 0

    async def open(self) -> None:
        bridge = Bridge(self._take, self._capacity, int(self._newest_per_key))
        tokens = Bridge(self._on_token, 65536, newest_per_key=1)
        self._bridge = bridge
        self._session = await open_session(self._network, listening=False)

        def declare(session: zenoh.Session) -> None:
            everyone = keys.key(self._network.team, Kind.ALIVE, "*", "*")
            self._declared = [
                session.declare_subscriber(self._expression, bridge.handler()),
                session.liveliness().declare_subscriber(everyone, tokens.handler(), history=True),
            ]

        await bounded(partial(declare, self._session), OPEN_S, "declare")

    async def samples(self) -> AsyncIterator[Sample]:
        """Until closed."""
        while (sample := await self._samples.get()) is not None:
            yield sample

    def links(self) -> LinksUp:
        """To whom we are linked."""
        return links_up(self._session)

    @property
    def dropped(self) -> int:
        """Samples that came faster than they were taken."""
        return self._dropped + (self._bridge.dropped if self._bridge else 0)

    async def close(self) -> None:
        session, self._session = self._session, None
        if session is not None:
            await close_session(session, self._declared)
        self._make_room()
        self._samples.put_nowait(None)

    def _take(self, sample: Sample) -> None:
        self._make_room()
        self._samples.put_nowait(sample)

    def _make_room(self) -> None:
        if self._samples.full():
            self._samples.get_nowait()
            self._dropped += 1

    def _on_token(self, token: Sample) -> None:
        if self._expression.intersects(token.key):
            self._take(token)
        address = keys.parse(token.key)
        if not token.alive or address is None or self._session is None or self._bridge is None:
            return
        if self._expression.intersects(keys.key(address.team, Kind.POSE, address.drone_id)):
            ask_for_announcement(self._session, address.team, address.drone_id, self._bridge)
