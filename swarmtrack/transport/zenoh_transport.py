"""The network of one drone over Zenoh.

An announcement is put once, served by a queryable, and queried by every process that sees a liveliness token without
one: a put alone is lost where it overtakes the links, and a query alone where it overtakes the queryable's
declaration. Tokens converge by themselves, so they drive the rest. Where many ask at once, as in a start, they get one
put (`outgoing.JointAnswers`).
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from collections import Counter
from collections.abc import AsyncIterator
from dataclasses import replace
from functools import partial
from typing import Any, Final, NamedTuple

import zenoh

from swarmtrack.clock import Clock
from swarmtrack.errors import TransportError
from swarmtrack.messages import Announcement, LinkStatus, PeerEvent
from swarmtrack.security import names
from swarmtrack.security.credentials import Credentials
from swarmtrack.transport import keys, settings
from swarmtrack.transport.base import PUBLISHED, Kind, Sample
from swarmtrack.transport.giving_way import PACED, Channel, RateLimiter
from swarmtrack.transport.joining import keep_joining
from swarmtrack.transport.knocking import keep_knocking
from swarmtrack.transport.limits import (
    CLASH_MARGIN_S,
    MAX_BOOTS_PER_ID,
    MAX_LIVELINESS_TOKENS,
    NEWCOMER_GRACE_S,
    SESSION_OPEN_S,
    SESSION_PUT_S,
    SILENCE_CHECK_PERIOD_S,
)
from swarmtrack.transport.link_watch import LinksUp, LinkWatch, links_up
from swarmtrack.transport.outgoing import JointAnswers, Outgoing, Sign
from swarmtrack.transport.peers import Peers, Verify, report_subscriptions, subscriptions
from swarmtrack.transport.settings import Mode, NetworkSettings
from swarmtrack.transport.tcp_options import keep_options
from swarmtrack.transport.zenoh_bridge import Bridge
from swarmtrack.transport.zenoh_session import (
    ask_for_announcement,
    bounded,
    close_session,
    open_session,
)

log = logging.getLogger(__name__)


class Carriage(NamedTuple):
    """Quality of service of a message kind; none ever blocks us."""

    reliability: zenoh.Reliability
    priority: zenoh.Priority


CARRIAGE: Final = {
    Kind.IDENTITIES: Carriage(zenoh.Reliability.RELIABLE, zenoh.Priority.DATA_HIGH),
    Kind.MOTION: Carriage(zenoh.Reliability.BEST_EFFORT, zenoh.Priority.DATA_HIGH),
    Kind.STRANGER: Carriage(zenoh.Reliability.BEST_EFFORT, zenoh.Priority.DATA_HIGH),
    Kind.TRACKS: Carriage(zenoh.Reliability.BEST_EFFORT, zenoh.Priority.DATA),
    Kind.HEALTH: Carriage(zenoh.Reliability.BEST_EFFORT, zenoh.Priority.DATA_LOW),
    Kind.VIDEO: Carriage(zenoh.Reliability.BEST_EFFORT, zenoh.Priority.BACKGROUND),
}


class ZenohTransport:
    """One drone's end of the network. `boot` identifies this run of the process (`keys.new_boot`).

    sign, verify: of announcements; None: unsigned. cameras: number of cameras, each with its own video.
    """

    def __init__(
        self,
        network: NetworkSettings,
        drone_id: int,
        boot: str,
        clock: Clock,
        *,
        sign: Sign | None = None,
        verify: Verify | None = None,
        cameras: int = 1,
    ) -> None:
        settings.check(network)
        self._network = network
        self._cameras = cameras
        self._drone_id = drone_id
        self._boot = boot
        self._clock = clock
        clash_s = network.lease_s + CLASH_MARGIN_S
        self._peers = Peers(
            network.team, drone_id, boot, clock, verify, clash_s=clash_s, lease_s=network.lease_s
        )
        self._outgoing = Outgoing(network.team, drone_id, boot, clock, sign)
        self._session: zenoh.Session | None = None
        self._publishers: dict[Channel, zenoh.Publisher] = {}
        self._giving_way = RateLimiter(network, clock)
        self._renewed = False
        self._declared: list[Any] = []
        self._reports: dict[str, Any] = {}
        """By key expression, the subscribers to reports."""
        self._other_reports = asyncio.Event()
        """Of other teammates are wanted than are subscribed to."""
        self._tokens_declared = 0
        self._put_at = -math.inf
        self._together = JointAnswers[zenoh.Query]()
        self._answering: set[asyncio.Task[None]] = set()
        self._bridges: list[Bridge] = []
        self._watch = LinkWatch(network)
        self._tasks: list[asyncio.Task[None]] = []
        self._listening: asyncio.Task[None] | None = None
        self._changing = asyncio.Lock()
        self._counters: Counter[str] = Counter()

    async def open(self) -> None:
        # A token's key says all, so the last two words on each are enough: whether it is alive, and whether it was away
        # before, when it may have announced itself anew. No flood of tokens can push a departure out.
        tokens = Bridge(
            lambda s: self._peers.on_token(s.key, s.alive),
            MAX_LIVELINESS_TOKENS,
            newest_per_key=2,
            clock=self._clock,
        )

        def on_message(sample: Sample) -> None:
            tokens.hand_over()  # nobody is believed before its token, and it may wait beside us
            self._peers.on_message(sample.key, sample.payload, sample.arrived)

        # Clones speak on one key, and each must be heard.
        messages = Bridge(on_message, newest_per_key=MAX_BOOTS_PER_ID, clock=self._clock)
        self._bridges = [tokens, messages]
        self._tokens, self._messages = tokens, messages
        self._loop = asyncio.get_running_loop()
        self._listening = asyncio.create_task(self._listen_for_silence(), name="silence")
        if self._network.mode == Mode.CLIENT:  # a router that is not there yet is no reason not to fly
            self._tasks = [asyncio.create_task(keep_joining(self._join), name="joining")]
            return
        try:
            await self._join()
        except BaseException:
            await self.close()
            raise

    async def renew(self, credentials: Credentials) -> None:
        """Close all links and reopen them with the members of a newer roster."""
        before = self._network.credentials
        assert before is not None, "who had no keys gets none in flight"
        network = replace(self._network, credentials=credentials)
        settings.check(network)
        expelled = sorted(before.roster.drones.keys() - credentials.roster.drones.keys())
        async with self._changing:
            await self._leave()
            self._network = network
            self._peers.renew(credentials.verify, expelled)
            self._join_again()

    def _join_again(self) -> None:
        self._watch, self._renewed = LinkWatch(self._network), True
        self._tasks = [asyncio.create_task(keep_joining(self._join), name="joining")]

    async def _listen_for_silence(self) -> None:
        """Until cancelled. Links that stand and carry nothing are made anew."""
        while True:
            await asyncio.sleep(SILENCE_CHECK_PERIOD_S)
            if self._session is None:
                continue
            ask = partial(self._ask, (keys.LIFE,))
            linked, queued = self._linked(links_up(self._session)), self._giving_way.finds_a_queue
            remedies = self._peers.listen_for_silence(linked, ask, queued=queued)
            if remedies.reopen:
                whom = ", ".join(map(str, remedies.reopen))
                log.warning("network: drone %s is still silent, though linked: links are renewed", whom)
                self._counters["links_renewed"] += 1
                async with self._changing:
                    await self._leave()
                    self._peers.part()
                    self._join_again()
            elif remedies.repeat:
                whom = ", ".join(map(str, remedies.repeat))
                log.info(
                    "network: drone %s does not know us yet, though linked: we declare ourselves again", whom
                )
                self._counters["declared_again"] += 1
                async with self._changing:
                    await self._declare_again()

    def _linked(self, up: LinksUp) -> set[int]:
        """Whose links stand, by their certificates; without keys, and by way of a router, nobody can tell."""
        expected = up.names & set(self._network.expected)
        return {names.drone_id(name) for name in expected}

    async def _join(self) -> None:
        session = await open_session(self._network, again=self._renewed)
        try:
            await bounded(partial(self._declare, session), SESSION_OPEN_S, "declare")
        except BaseException:
            await close_session(session, [], self._network.listen)
            raise
        self._session = session
        self._tasks += [
            asyncio.create_task(self._giving_way.run(session, lambda: len(self._peers.alive)), name="pace"),
            asyncio.create_task(
                self._peers.ask_for_missing(partial(self._ask, (keys.SUBSCRIBED_TOO,))), name="reconciliation"
            ),
            asyncio.create_task(self._watch.run(lambda: links_up(self._session)), name="links"),
            asyncio.create_task(keep_options(), name="TCP options"),
            asyncio.create_task(self._follow_reports(), name="reports"),
            asyncio.create_task(
                keep_knocking(self._network.callers, lambda: links_up(self._session).hosts), name="knocking"
            ),
        ]

    def _declare(self, session: zenoh.Session) -> None:
        team, me = self._network.team, self._drone_id
        channels = [*((kind, 0) for kind in CARRIAGE), *((Kind.VIDEO, k) for k in range(1, self._cameras))]
        for kind, camera in channels:
            carriage = CARRIAGE[kind]
            self._publishers[kind, camera] = session.declare_publisher(
                keys.video_key(team, me, camera) if kind is Kind.VIDEO else keys.key(team, kind, me),
                encoding=keys.ENCODINGS[kind],
                reliability=carriage.reliability,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=carriage.priority,
            )
        # The token comes last: it makes others ask, and the queryable must be there to answer.
        self._tokens_declared = 0
        self._declared = [
            *self._publishers.values(),
            *self._giving_way.declare(self._publishers),
            *self._declare_exchange(session),
            session.liveliness().declare_token(keys.key(team, Kind.ALIVE, me, self._boot)),
        ]
        self._reports = {}  # those of an earlier session ended with it
        self._subscribe_to_reports(session)
        if self._outgoing.camera is not None:
            session.put(
                self._outgoing.camera_key,
                self._outgoing.camera,
                encoding=keys.ENCODINGS[Kind.CAMERA],
                congestion_control=zenoh.CongestionControl.DROP,  # who misses it asks
            )

    def _declare_exchange(self, session: zenoh.Session) -> list[Any]:
        """What we answer and what we listen to."""
        team, me = self._network.team, self._drone_id
        queryables = {self._outgoing.key: self._answer, self._outgoing.camera_key: self._answer_camera}
        return [
            *(
                session.declare_queryable(key, zenoh.handlers.Callback(answer, indirect=False))
                for key, answer in queryables.items()
            ),
            *(self._subscribe(session, expression) for expression in subscriptions(team, me)),
            session.liveliness().declare_subscriber(
                keys.key(team, Kind.ALIVE, "*", "**"), self._tokens.handler(), history=True
            ),
        ]

    def _subscribe(self, session: zenoh.Session, expression: str) -> Any:
        return session.declare_subscriber(
            expression, self._messages.handler(), allowed_origin=zenoh.Locality.REMOTE
        )

    def _subscribe_to_reports(self, session: zenoh.Session) -> None:
        """Of those that are to be received, and of no others."""
        wanted = report_subscriptions(self._network.team, self._drone_id, self._peers.reports_of)
        declared = self._reports
        for expression in declared.keys() - wanted:
            with contextlib.suppress(zenoh.ZError):  # undeclared already
                declared.pop(expression).undeclare()
        for expression in wanted - declared.keys():
            declared[expression] = self._subscribe(session, expression)

    def receive_only(self, drones: frozenset[int] | None) -> None:
        if drones != self._peers.reports_of:
            self._peers.reports_of = drones
            self._other_reports.set()

    async def _follow_reports(self) -> None:
        """Until cancelled: subscriptions follow `receive_only`."""
        while True:
            await self._other_reports.wait()
            self._other_reports.clear()
            async with self._changing:
                if (session := self._session) is None:
                    continue  # links are being made anew, with this
                try:
                    await bounded(partial(self._subscribe_to_reports, session), SESSION_OPEN_S, "subscribe")
                except TransportError as error:
                    log.info("%s", error)
                    self._other_reports.set()
            if self._other_reports.is_set():
                await asyncio.sleep(SILENCE_CHECK_PERIOD_S)

    async def _declare_again(self) -> None:
        """Declare again what Zenoh may have lost with a link, and never repeats by itself. The token stays, for those
        that have it; a further one joins it.
        """
        session = self._session
        if session is None:
            return

        def declare(open_session: zenoh.Session) -> None:
            kept: list[Any] = []
            ended: list[Any] = []
            for entity in self._declared:
                (ended if isinstance(entity, zenoh.Queryable | zenoh.Subscriber) else kept).append(entity)
            ended += self._reports.values()
            self._reports = {}
            for entity in ended:
                with contextlib.suppress(zenoh.ZError):  # undeclared already
                    entity.undeclare()
            self._declared = [*self._declare_exchange(open_session), *kept]
            self._subscribe_to_reports(open_session)
            self._tokens_declared += 1
            further = keys.key(
                self._network.team, Kind.ALIVE, self._drone_id, self._boot, self._tokens_declared
            )
            self._declared.append(open_session.liveliness().declare_token(further))

        try:
            await bounded(partial(declare, session), SESSION_OPEN_S, "declare")
        except TransportError as error:
            log.info("%s", error)

    async def announce(self, announcement: Announcement) -> None:
        self._outgoing.replace(announcement)
        self._peers.on_announced()
        session = self._session
        if session is None:
            return  # not open yet, or no more: those who come ask for it

        try:
            await bounded(partial(self._put, session), SESSION_PUT_S, "announce")
        except TransportError as error:
            self._counters["announcements_unsent"] += 1
            log.warning("announcement not put, teammates will ask for it: %s", error)

    def _put(self, session: zenoh.Session) -> None:
        """Our announcement, to all."""
        self._put_at = self._loop.time()
        payload = self._outgoing.encode()
        assert payload is not None
        session.put(
            self._outgoing.key,
            payload,
            encoding=keys.ENCODINGS[Kind.POSE],
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.INTERACTIVE_HIGH,
        )

    def request_announcement(self, drone_id: int) -> None:
        if self._session is not None and self._peers.may_request(drone_id):
            self._ask((keys.ANEW, keys.SUBSCRIBED_TOO), drone_id)

    def describe(self, camera: bytes) -> None:
        self._outgoing.camera = camera

    def publish(self, kind: Kind, payload: bytes, camera: int = 0) -> bool:
        if kind not in PUBLISHED:
            raise ValueError(f"publish: found {kind}, expected one of {', '.join(PUBLISHED)}")
        publisher = self._publishers.get((kind, camera))
        if publisher is None:
            self._counters[f"{kind}_unsent"] += 1
            return False
        if not self._giving_way.lets_go((kind, camera), len(payload)):
            return False
        try:
            # An encoding's name takes forty bytes of each message. Readers go by the key.
            publisher.put(payload, encoding=zenoh.Encoding.ZENOH_BYTES if self.is_narrow else None)
        except zenoh.ZError:
            self._counters[f"{kind}_unsent"] += 1
            return False
        self._counters[f"{kind}_sent"] += 1
        return True

    def has_listener(self, kind: Kind, camera: int = 0) -> bool:
        # Of what is cheap nobody asks: it is said anyway.
        channel = (kind, camera)
        return channel in self._publishers and (kind not in PACED or self._giving_way.has_listener(channel))

    @property
    def is_narrow(self) -> bool:
        return self._giving_way.is_limited

    def events(self) -> AsyncIterator[PeerEvent]:
        return self._peers.events()

    def status(self) -> LinkStatus:
        up = links_up(self._session)
        alive, missing = self._peers.alive, self._peers.missing
        silent = self._peers.silent(self._linked(up))
        counters = {
            "peers": len(alive),
            "missing": len(missing),
            "silent": len(silent),
            "links": up.count,
            "strangers": len(self._watch.strangers(up)),
            **({} if self._peers.reports_of is None else {"reports_from": len(self._peers.reports_of)}),
            **self._certificate(),
            **self._outgoing.counters,
            "samples_dropped": sum(bridge.dropped for bridge in self._bridges),
            "samples_superseded": sum(bridge.superseded for bridge in self._bridges),
            **self._counters,
            **self._giving_way.counters,
            **self._peers.counters,
        }
        text = (
            f"team {self._network.team}: {len(alive)} peers, {len(missing)} of them unannounced, "
            f"{self._watch.describe(up)}{self._giving_way.note}"
        )
        if silent:
            text += f"; silent: drone {', '.join(map(str, silent))}"
        ok = self._session is not None and self._watch.is_connected(up)
        return LinkStatus("zenoh", ok, text, tuple(counters.items()))

    def _certificate(self) -> dict[str, float]:
        """For how long our certificate is valid yet, s; nothing without keys."""
        credentials = self._network.credentials
        return (
            {}
            if credentials is None
            else {"certificate_s": credentials.expires.timestamp() - self._clock.utc()}
        )

    async def close(self) -> None:
        if self._listening is not None:
            self._listening.cancel()
        await self._leave()
        self._peers.close()

    async def _leave(self) -> None:
        for task in self._tasks:
            task.cancel()
        self._tasks = []
        session, self._session = self._session, None
        declared = [*self._declared[::-1], *self._reports.values()]  # the token first: it is our farewell
        self._declared, self._reports = [], {}
        self._publishers = {}
        if session is not None:
            await close_session(session, declared, self._network.listen)

    def _answer(self, query: zenoh.Query) -> None:
        """In Zenoh's thread."""
        words = query.parameters
        with contextlib.suppress(RuntimeError):  # the loop is closed
            if keys.ANEW in words and self._outgoing.accept_request():
                self._loop.call_soon_threadsafe(self._peers.on_request)
            if keys.LIFE in words:
                query.reply_err(keys.IS_HERE)
            elif not self._outgoing.announced:
                query.reply_err(keys.NOTHING_YET)
            elif keys.SUBSCRIBED_TOO not in words:
                self._reply(query)
            elif self._network.mode is Mode.PEER and self._loop.time() - self._put_at < NEWCOMER_GRACE_S:
                query.reply_err(
                    keys.IS_HERE
                )  # it was linked before it asked, and so before that put, which is on its way
            else:
                wait_s = self._together.add(query)
                if wait_s is not None:
                    self._loop.call_soon_threadsafe(self._loop.call_later, wait_s, self._answer_together)

    def _reply(self, query: zenoh.Query) -> None:
        payload = self._outgoing.answer()
        if payload is not None:
            query.reply(self._outgoing.key, payload, encoding=keys.ENCODINGS[Kind.POSE])

    def _answer_together(self) -> None:
        """One that asks gets an answer, several get one put."""
        queries, session = self._together.take(), self._session
        if session is None or not queries:
            return
        answer = partial(self._reply, queries[0]) if len(queries) == 1 else partial(self._put, session)

        async def give() -> None:
            try:
                await bounded(answer, SESSION_PUT_S, "answer")
            except TransportError as error:  # who misses it asks again
                log.info("%s", error)

        task = asyncio.create_task(give(), name="answer")
        self._answering.add(task)
        task.add_done_callback(self._answering.discard)

    def _answer_camera(self, query: zenoh.Query) -> None:
        """In Zenoh's thread."""
        payload = self._outgoing.camera_answer()
        if payload is not None:
            query.reply(self._outgoing.camera_key, payload, encoding=keys.ENCODINGS[Kind.CAMERA])

    def _ask(self, words: tuple[str, ...], drone_id: int) -> None:
        """words: parameters of the query."""
        if self._session is not None:
            ask_for_announcement(
                self._session,
                self._network.team,
                drone_id,
                self._messages,
                *words,
                on_answer=partial(self._peers.on_answer, drone_id),
            )
