"""The part that all transports share: keys and bytes in, `PeerEvent`s out, on the event loop.

A transport passes its input to `on_token`, `on_message` and `on_request`, runs `ask_for_missing`, and exposes
`events`.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from collections import Counter, deque
from collections.abc import AsyncIterator, Callable, Collection, Iterable
from typing import NamedTuple, TypeVar

from swarmtrack.clock import Clock, utc_offset
from swarmtrack.messages import AnnouncementRequested, PeerEvent, PeerExpelled
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind
from swarmtrack.transport.limits import (
    ANNOUNCED_CLOCKS_AGREE_S,
    ANNOUNCEMENT_REQUEST_PERIOD_S,
    ASK_AFTER_SILENCE_S,
    MAX_WAITING_EVENTS,
    NEWCOMER_GRACE_S,
    PUT_ON_ITS_WAY_S,
    QUESTION_BACK_OFFS,
    REPORTED_CLOCKS_AGREE_S,
    REQUEST_BACK_OFFS,
)
from swarmtrack.transport.membership import LiveBoot, Membership, Numbered
from swarmtrack.transport.ranging_radios import RangingRadios
from swarmtrack.transport.silence import Silence
from swarmtrack.wire import codec
from swarmtrack.wire.announcement import AnnouncementMessage, announcement_from, signed_part
from swarmtrack.wire.checks import DecodeError
from swarmtrack.wire.motion import MotionMessage, motion_from
from swarmtrack.wire.ranging import RangeMessage, range_from
from swarmtrack.wire.sightings import SightingsMessage, is_from_nowhere, report_from
from swarmtrack.wire.strangers import StrangersMessage, strangers_from

R = TypeVar("R", SightingsMessage, MotionMessage, StrangersMessage)
Verify = Callable[[int, bytes, bytes], bool]
"""Whether the drone of this ID signed these bytes with this signature."""

log = logging.getLogger(__name__)


class Remedies(NamedTuple):
    """For the sake of which teammates all links are to be reopened, and those to which we are to declare ourselves
    again.
    """

    reopen: list[int]
    repeat: list[int]


class _Request(NamedTuple):
    """The last request to one teammate to announce again: t [s], and how many in a row were not fulfilled."""

    t: float
    times: int

    @property
    def period_s(self) -> float:
        return ANNOUNCEMENT_REQUEST_PERIOD_S * 2.0 ** max(0, self.times - 1)


SUBSCRIBED = {
    Kind.POSE: "announcements",
    Kind.IDENTITIES: "sightings",
    Kind.MOTION: "motion",
    Kind.RANGE: "ranges",
    Kind.STRANGER: "strangers",
}  # for `on_message`, as counters name them


REPORTS = (Kind.IDENTITIES, Kind.MOTION, Kind.STRANGER)
"""What teammates say again and again."""


def subscriptions(team: str, drone_id: int) -> list[str]:
    """Key expressions of a drone's subscriptions, apart from tokens and reports: all teammates' announcements, and
    ranges of its own radio only."""
    return [keys.key(team, Kind.POSE, "*"), keys.key(team, Kind.RANGE, drone_id, "*")]


def report_subscriptions(team: str, drone_id: int, of: frozenset[int] | None) -> set[str]:
    """Key expressions of the reports of some teammates, None: of all; and of those of a clone, under our own ID."""
    drones = ["*"] if of is None else of | {drone_id}
    return {keys.key(team, kind, drone) for kind in REPORTS for drone in drones}


class Peers:
    """Messages of the team, queued until the agent takes them. Only the event loop may call."""

    def __init__(
        self,
        team: str,
        drone_id: int,
        boot: str,
        clock: Clock,
        verify: Verify | None,
        *,
        clash_s: float,
        lease_s: float,
    ) -> None:
        """clash_s: after so long two boots of one ID are no restart; lease_s: a report may be so late."""
        self._team = team
        self._drone_id = drone_id
        self._clock = clock
        self._verify = verify
        self._membership = Membership(drone_id, boot, clash_s)
        self._radios = RangingRadios()
        self._silence = Silence(lease_s)
        self._events: deque[PeerEvent] = deque()
        self._news = asyncio.Event()
        self._newcomer = asyncio.Event()
        self._requested: dict[int, _Request] = {}
        self._announced = False
        self.reports_of: frozenset[int] | None = None
        """The teammates whose reports are received; None: all."""
        self._due: dict[int, float] = {}
        """When to ask whom whose announcement is missing."""
        self._closed = False
        self._counters: Counter[str] = Counter()

    def on_token(self, key: str, alive: bool) -> None:
        address = self._address(key)
        if (
            address is None
            or address.kind != Kind.ALIVE
            or len(address.rest) not in (1, 2)
            or not keys.is_boot(address.rest[0])
        ):
            self._counters["tokens_malformed"] += 1
            return
        drone_id, boot = address.drone_id, address.rest[0]
        if alive:
            self._silence.mark_heard(drone_id, asyncio.get_running_loop().time())
            self._tell(self._membership.arrived(drone_id, boot, asyncio.get_running_loop().time()))
        else:
            self._tell(self._membership.departed(drone_id, boot))
        if self._membership.missing or self._membership.settles_at is not None:
            self._newcomer.set()

    def on_message(self, key: str, payload: bytes, arrived: float) -> None:
        """An announcement, a report of sightings or motion, or a range. arrived: on our monotonic clock."""
        address = self._address(key)
        if (
            address is None
            or address.kind not in SUBSCRIBED
            or len(address.rest) != (address.kind is Kind.RANGE)
        ):
            self._counters["messages_on_no_key"] += 1
            return
        try:
            match address.kind:
                case Kind.POSE:
                    self._on_announcement(address.drone_id, key, payload, arrived)
                case Kind.IDENTITIES:
                    self._on_report(
                        address.drone_id, codec.decode(SightingsMessage, payload), report_from, arrived
                    )
                case Kind.MOTION:
                    self._on_report(
                        address.drone_id, codec.decode(MotionMessage, payload), motion_from, arrived
                    )
                case Kind.STRANGER:
                    self._on_report(
                        address.drone_id, codec.decode(StrangersMessage, payload), strangers_from, arrived
                    )
                case Kind.RANGE if address.drone_id == self._drone_id:  # what others measure is theirs
                    self._on_range(address, codec.decode(RangeMessage, payload), arrived)
        except DecodeError as error:
            self._counters[f"{SUBSCRIBED[address.kind]}_malformed"] += 1
            log.debug("message refused key=%s: %s", key, error)

    def renew(self, verify: Verify, expelled: Iterable[int]) -> None:
        """All links were closed because of a newer roster, which verifies announcements from now on. expelled:
        names that left the team.
        """
        self._verify = verify
        self.part()
        self._tell([PeerExpelled(drone_id) for drone_id in expelled])

    def part(self) -> None:
        """All links were closed."""
        self._silence.clear()
        self._tell(self._membership.part())

    def silent(self, linked: Collection[int]) -> tuple[int, ...]:
        """Teammates that are alive or linked but silent."""
        now = asyncio.get_running_loop().time()
        return tuple(sorted(self._silence.silent(self._present(linked), now)))

    def listen_for_silence(
        self, linked: Collection[int], ask: Callable[[int], None], *, queued: bool
    ) -> Remedies:
        """Log silent teammates, query them, and return what is to be done for whom. To be called twice per second.
        linked: names whose links are up, by their certificates; ask: queries whether a drone lives; queued: packets
        wait.
        """
        now = asyncio.get_running_loop().time()
        present = self._present(linked)
        for line in self._silence.news(present, now):
            log.warning("%s", line)
        for drone_id in self._silence.to_ask(present, now):
            ask(drone_id)
        reopen = self._silence.to_reopen(present, now, queued=queued)
        return Remedies(reopen, self._silence.to_repeat(present, now, queued=queued))

    def _present(self, linked: Collection[int]) -> set[int]:
        """Of whom words are expected."""
        present = {*self._membership.peers, *linked} - {self._drone_id}
        return present if self.reports_of is None else present & self.reports_of

    def on_answer(self, drone_id: int, word: bytes = b"") -> None:
        """A teammate answered a query. A drone whose token is lost may answer too, and is not a teammate for that
        reason. word: what it said instead of a pose.
        """
        now = asyncio.get_running_loop().time()
        if drone_id in self._membership.peers:
            self._silence.mark_answered(drone_id, now)
        if (
            word == keys.IS_HERE and drone_id in self._due
        ):  # it has just put what we ask for: is it on its way?
            self._due[drone_id] = min(self._due[drone_id], now + PUT_ON_ITS_WAY_S)
            self._newcomer.set()

    def on_announced(self) -> None:
        """We announced ourselves, so teammates should come to know us."""
        self._announced = True

    def _on_word(self, drone_id: int, *, report: bool = False) -> None:
        """A live teammate sent a message without being asked."""
        self._silence.mark_heard(drone_id, asyncio.get_running_loop().time(), report=report)

    def on_request(self) -> None:
        """Another process requests that we announce again."""
        self._tell([AnnouncementRequested()])

    def _on_announcement(self, drone_id: int, key: str, payload: bytes, arrived: float) -> None:
        message = codec.decode(AnnouncementMessage, payload)
        life = self._life(drone_id, message)
        if life is None or not self._is_genuine(drone_id, key, payload):
            return
        t, t_sigma = life.clock.time_of(
            message, arrived=arrived, utc_offset=self._utc_offset, tolerance=ANNOUNCED_CLOCKS_AGREE_S
        )
        self._counters["clocks_off"] += abs(life.clock.apart_s) > ANNOUNCED_CLOCKS_AGREE_S
        life.announcement = announcement_from(message, t, t_sigma)
        if drone_id in self._requested:
            self._requested[drone_id] = self._requested[drone_id]._replace(times=0)
        self._on_word(drone_id)
        self._tell([life.announcement])

    def _on_report(
        self, drone_id: int, message: R, understood: Callable[[R, float, float], PeerEvent], arrived: float
    ) -> None:
        """understood: the report in a message, by when it held on our clock [s], and how well we know when [s]."""
        life = self._life(drone_id, message)
        if life is None:
            return
        life.reported[type(message)] = message.sequence
        self._on_word(drone_id, report=True)
        if isinstance(message, SightingsMessage):
            if is_from_nowhere(message):
                return
            if self._announced:
                now, known = asyncio.get_running_loop().time(), self._drone_id in message.known
                self._silence.mark_known(drone_id, now, known=known)
        t, t_sigma = life.clock.time_of(
            message, arrived=arrived, utc_offset=self._utc_offset, tolerance=REPORTED_CLOCKS_AGREE_S
        )
        self._tell([understood(message, t, t_sigma)])

    def _life(self, drone_id: int, message: Numbered) -> LiveBoot | None:
        life = self._membership.life(drone_id, message, asyncio.get_running_loop().time())
        if self._membership.settles_at is not None:
            self._newcomer.set()
        return life

    def _on_range(self, address: keys.Address, message: RangeMessage, arrived: float) -> None:
        """Of our own ranging radio."""
        if (message.drone_id, str(message.other)) != (address.drone_id, *address.rest):
            self._counters["ranges_on_wrong_key"] += 1
            return
        stamped = self._radios.time_of(message, arrived=arrived, utc_offset=self._utc_offset)
        if stamped is not None:
            self._tell([range_from(message, *stamped)])

    def _is_genuine(self, drone_id: int, key: str, payload: bytes) -> bool:
        """Whether an announcement is signed by whom it names, where that is asked for."""
        if self._verify is None:
            return True
        part = signed_part(payload, key)
        if part is None:
            self._counters["announcements_unsigned"] += 1
            return False
        genuine = self._verify(drone_id, part.signed, part.signature)
        self._counters["announcements_forged"] += not genuine
        return genuine

    def may_request(self, drone_id: int) -> bool:
        """Whether to ask this teammate to announce again: if it is alive, once per second, and ever more rarely while
        it does not; counted as asked.
        """
        now = self._clock.now()
        self._requested = {i: r for i, r in self._requested.items() if i in self._membership.peers}
        last = self._requested.get(drone_id, _Request(-math.inf, 0))
        if drone_id not in self._membership.peers or now - last.t < last.period_s:
            self._counters["requests_withheld"] += 1
            return False
        self._requested[drone_id] = _Request(now, min(last.times + 1, REQUEST_BACK_OFFS))
        self._counters["requests"] += 1
        return True

    async def ask_for_missing(self, ask: Callable[[int], None]) -> None:
        """Run until cancelled: query a moment after each newcomer, then after 1.2, 2.4, 4.8 s and so on while its
        announcement is missing: one that has none yet will put it. Also reports IDs whose apparent restart is a clash.
        """
        loop = asyncio.get_running_loop()
        asked: Counter[int] = Counter()
        while True:
            now = loop.time()
            due = self._due = {
                drone_id: self._due.get(drone_id, now + NEWCOMER_GRACE_S)
                for drone_id in self._membership.missing
            }
            asked = Counter({drone_id: n for drone_id, n in asked.items() if drone_id in due})
            for drone_id in [drone_id for drone_id, t in due.items() if t <= now]:
                ask(drone_id)
                due[drone_id] = now + ASK_AFTER_SILENCE_S * 2.0 ** min(asked[drone_id], QUESTION_BACK_OFFS)
                asked[drone_id] += 1
            self._tell(self._membership.settle(now))
            self._newcomer.clear()
            settles_at = self._membership.settles_at
            wakes = [*due.values(), *([] if settles_at is None else [settles_at])]
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(min(wakes) - now if wakes else None):
                    await self._newcomer.wait()

    async def events(self) -> AsyncIterator[PeerEvent]:
        while True:
            while self._events:
                yield self._events.popleft()
            if self._closed:
                return
            self._news.clear()
            await self._news.wait()

    def close(self) -> None:
        """End `events` after the queued ones."""
        self._closed = True
        self._news.set()

    @property
    def alive(self) -> tuple[int, ...]:
        return self._membership.peers

    @property
    def missing(self) -> tuple[int, ...]:
        return self._membership.missing

    @property
    def counters(self) -> Counter[str]:
        """Rejected and lost messages, by reason."""
        return self._counters + self._membership.counters + self._radios.counters

    @property
    def _utc_offset(self) -> float:
        """What added to our monotonic time gives UTC, as of now."""
        return utc_offset(self._clock)

    def _address(self, key: str) -> keys.Address | None:
        address = keys.parse(key)
        return address if address and address.team == self._team else None

    def _tell(self, events: list[PeerEvent]) -> None:
        for event in events:
            if len(self._events) >= MAX_WAITING_EVENTS:
                self._events.popleft()
                self._counters["events_dropped"] += 1
            self._events.append(event)
        self._news.set()
