"""Listener to a team without being a member."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import zenoh

from swarmtrack.clock import Clock
from swarmtrack.errors import TransportError
from swarmtrack.security.credentials import Credentials
from swarmtrack.transport import keys, settings
from swarmtrack.transport.base import Kind, Sample
from swarmtrack.transport.following import follow_roster
from swarmtrack.transport.joining import keep_joining
from swarmtrack.transport.limits import BRIDGE_CAPACITY, SESSION_OPEN_S, TEAMS_ANSWER_S
from swarmtrack.transport.link_watch import LinksUp, links_up
from swarmtrack.transport.settings import NetworkSettings
from swarmtrack.transport.tcp_options import keep_options
from swarmtrack.transport.zenoh_bridge import Bridge
from swarmtrack.transport.zenoh_session import ask, bounded, close_session, open_session, plain

log = logging.getLogger(__name__)


class ZenohListener:
    """Receives a team's messages without being a member: for echo, monitor and recorder.

    key_expressions: full ones; `*` is one part of a key, `**` any number. `listen_to` and `leave` change them later,
    for kinds that are sent only while there is a subscriber. Announcements and cameras that were sent earlier are
    requested, so each arrives, at times twice. clock: of the samples' arrivals.
    """

    def __init__(
        self,
        network: NetworkSettings,
        key_expressions: str | Sequence[str],
        clock: Clock,
        capacity: int = BRIDGE_CAPACITY,
        newest_per_key: bool = False,
    ) -> None:
        settings.check(network)
        texts = [key_expressions] if isinstance(key_expressions, str) else key_expressions
        self._expressions = [_expression(text) for text in texts]
        self._network = network
        self._clock = clock
        self._capacity = capacity
        self._newest_per_key = newest_per_key
        self._session: zenoh.Session | None = None
        self._declared: list[Any] = []
        self._later: dict[str, Any] = {}
        self._samples: asyncio.Queue[Sample | None] = asyncio.Queue(capacity)
        self._bridge: Bridge | None = None
        self._dropped = 0
        self._tokens: Bridge | None = None
        self._tasks: list[asyncio.Task[None]] = []

    async def open(self) -> None:
        self._bridge = Bridge(self._take, self._capacity, int(self._newest_per_key), clock=self._clock)
        self._tokens = Bridge(self._on_token, 65536, newest_per_key=1, clock=self._clock)
        await self._join()
        following = follow_roster(self._network.credentials, self._clock, self._renew)
        self._tasks = [
            asyncio.create_task(keep_options(), name="TCP options"),
            asyncio.create_task(following, name="roster"),
        ]

    async def _join(self) -> None:
        bridge, tokens = self._bridge, self._tokens
        assert bridge is not None
        assert tokens is not None
        session = await open_session(self._network, listening=False)
        # Whoever lives may be told of before all is declared, and is asked by this session.
        self._session, later = session, list(self._later)

        def declare(session: zenoh.Session) -> None:
            everyone = keys.key(self._network.team, Kind.ALIVE, "*", "*")
            self._declared = [
                *(session.declare_subscriber(e, bridge.handler()) for e in self._expressions),
                session.liveliness().declare_subscriber(everyone, tokens.handler(), history=True),
            ]
            for text in later:
                self._later[text] = session.declare_subscriber(_expression(text), bridge.handler())

        try:
            await bounded(partial(declare, session), SESSION_OPEN_S, "declare")
        except BaseException:
            self._session = None
            await close_session(session, [])
            raise

    async def _renew(self, found: Credentials) -> None:
        """Links are closed and made anew."""
        log.warning("roster number %d: links are renewed", found.roster.number)
        await self._leave()
        self._network = replace(self._network, credentials=found)
        await keep_joining(self._join)

    async def _leave(self) -> None:
        session, self._session = self._session, None
        if session is not None:
            await close_session(session, [*filter(None, self._later.values()), *self._declared])
        self._later = dict.fromkeys(self._later)

    async def listen_to(self, key_expression: str) -> None:
        """Subscribe to a further key expression. Raises TransportError."""
        session, bridge = self._session, self._bridge
        if bridge is None or key_expression in self._later:
            return
        expression = _expression(key_expression)
        self._later[key_expression] = None
        if session is None:  # links are being made anew, with this
            return
        try:
            self._later[key_expression] = await bounded(
                lambda: session.declare_subscriber(expression, bridge.handler()), SESSION_OPEN_S, "declare"
            )
        except TransportError:
            del self._later[key_expression]
            raise

    async def leave(self, key_expression: str) -> None:
        """Undo `listen_to`. Raises TransportError."""
        subscriber = self._later.pop(key_expression, None)
        if subscriber is not None:
            await bounded(subscriber.undeclare, SESSION_OPEN_S, "undeclare")

    async def samples(self) -> AsyncIterator[Sample]:
        """Received samples, until closed."""
        while (sample := await self._samples.get()) is not None:
            yield sample

    async def teams(self) -> set[str]:
        """Names of all teams with live drones in reach; with keys, our own only. Raises TransportError."""
        session = self._session
        if session is None:
            return set()
        anyone = f"{keys.ROOT}/*/{keys.KEY_VERSION}/{Kind.ALIVE}/*/*"

        def look() -> list[str]:
            replies = session.liveliness().get(anyone, timeout=TEAMS_ANSWER_S)
            return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

        found = map(keys.parse, await bounded(look, SESSION_OPEN_S, "ask for live agents"))
        return {address.team for address in found if address is not None}

    def links(self) -> LinksUp:
        """Links of the session."""
        return links_up(self._session)

    @property
    def dropped(self) -> int:
        """Number of samples dropped because they came faster than they were taken."""
        return self._dropped + (self._bridge.dropped if self._bridge else 0)

    async def close(self) -> None:
        for task in self._tasks:
            task.cancel()
        await self._leave()
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
        if self._hears(token.key):
            self._take(token)
        address = keys.parse(token.key)
        if token.alive and address is not None:
            for kind in keys.ASKED_KINDS:
                self.request(kind, address.drone_id)

    def request(self, kind: Kind, drone_id: int) -> None:
        """Request a message that a drone sends once (`keys.ASKED_KINDS`), if it is subscribed to. Returns at once."""
        key = keys.key(self._network.team, kind, drone_id)
        if self._session is not None and self._bridge is not None and self._hears(key):
            ask(self._session, key, self._bridge)

    def _hears(self, key: str) -> bool:
        return any(expression.intersects(key) for expression in self._expressions)


def _expression(text: str) -> zenoh.KeyExpr:
    try:
        return zenoh.KeyExpr(text)
    except zenoh.ZError as error:
        raise TransportError(f"{text!r} is not a key expression: {plain(error)}") from None
