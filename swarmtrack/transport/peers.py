"""The part every transport shares: keys and bytes in, `PeerEvent`s out, on the event loop.

A transport brings what it hears to `on_token` and `on_announcement`, runs `ask_for_missing`, and lends `events`.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import Counter, deque
from collections.abc import AsyncIterator, Callable

from swarmtrack import codec
from swarmtrack.messages import Announcement, IdClash, PeerEvent
from swarmtrack.runtime.clock import Clock
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind
from swarmtrack.transport.membership import Membership

log = logging.getLogger(__name__)

RECONCILE_S = 0.5  # between two questions to a teammate whose announcement is missing
MAX_EVENTS = (
    8192  # waiting for the agent: more than MAX_PEERS can cause at once, so only a stalled agent loses any
)


def utc_offset(clock: Clock) -> float:
    """What added to our monotonic time gives UTC, as of now."""
    return clock.utc() - clock.now()


class Peers:
    """What the team told us, until the agent takes it. Only the event loop may call."""

    def __init__(self, team: str, drone_id: int, boot: str, clock: Clock) -> None:
        self._team = team
        self._clock = clock
        self._membership = Membership(drone_id, boot)
        self._events: deque[PeerEvent] = deque()
        self._news = asyncio.Event()
        self._asked_for = asyncio.Event()
        self._closed = False
        self._counters: Counter[str] = Counter()

    def on_token(self, key: str, alive: bool) -> None:
        address = self._address(key, Kind.ALIVE)
        if address is None or len(address.rest) != 1 or not keys.is_boot(address.rest[0]):
            self._counters["tokens_malformed"] += 1
            return
        tell = self._membership.arrived if alive else self._membership.departed
        self._tell(tell(address.drone_id, address.rest[0]))
        if self._membership.missing:
            self._asked_for.set()

    def on_announcement(self, key: str, payload: bytes) -> None:
        address = self._address(key, Kind.POSE)
        if address is None or address.rest:
            self._counters["announcements_malformed"] += 1
            return
        try:
            announcement = codec.decode_announcement(payload, utc_offset(self._clock))
        except codec.DecodeError as error:
            self._counters["announcements_malformed"] += 1
            log.debug("announcement refused key=%s: %s", key, error)
            return
        self._tell(self._membership.heard(address.drone_id, announcement))

    async def ask_for_missing(self, ask: Callable[[int], None]) -> None:
        """Until cancelled: at once for each newcomer, then every `RECONCILE_S` while its announcement is missing."""
        while True:
            for drone_id in self._membership.missing:
                ask(drone_id)
            self._asked_for.clear()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._asked_for.wait(), RECONCILE_S)

    async def events(self) -> AsyncIterator[PeerEvent]:
        while True:
            while self._events:
                yield self._events.popleft()
            if self._closed:
                return
            self._news.clear()
            await self._news.wait()

    def close(self) -> None:
        """Ends `events` after what is waiting."""
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
        """What was refused or lost, by reason."""
        return self._counters + self._membership.counters

    def _address(self, key: str, kind: Kind) -> keys.Address | None:
        address = keys.parse(key)
        return address if address and (address.team, address.kind) == (self._team, kind) else None

    def _tell(self, events: list[PeerEvent]) -> None:
        for event in events:
            if isinstance(event, IdClash):
                log.warning("ID clash drone=%d boots=%s ours=%s", event.drone_id, event.boots, event.ours)
            if len(self._events) >= MAX_EVENTS:
                self._events.popleft()
                self._counters["events_dropped"] += 1
            self._events.append(event)
        self._news.set()


class Outgoing:
    """Our own announcement: checked, and only ever replaced by a later one."""

    def __init__(self, drone_id: int, boot: str, clock: Clock) -> None:
        self._drone_id = drone_id
        self._boot = boot
        self._clock = clock
        self._sequence = -1
        self.payload: bytes | None = None

    def replace(self, announcement: Announcement) -> bytes:
        """The bytes to send. Raises ValueError where the announcement is not ours, not newer, or not sound."""
        if (announcement.drone_id, announcement.boot) != (self._drone_id, self._boot):
            raise ValueError(
                f"announcement of drone {announcement.drone_id} boot {announcement.boot}, "
                f"expected our own: {self._drone_id} {self._boot}"
            )
        if announcement.sequence <= self._sequence:
            raise ValueError(
                f"announcement {announcement.sequence} follows {self._sequence}, expected a higher one"
            )
        payload = codec.encode_announcement(announcement, utc_offset(self._clock))
        self._sequence = announcement.sequence
        self.payload = payload
        return payload
