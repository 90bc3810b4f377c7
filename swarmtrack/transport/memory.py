"""A network inside one process, with scripted faults. For tests and simulations.

It carries the same bytes on the same keys as Zenoh does, and loses them by script: `hub.lose`, `hub.partition`,
`hub.kill`.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterable

from swarmtrack.clock import Clock
from swarmtrack.messages import Announcement, LinkStatus, PeerEvent
from swarmtrack.transport import keys
from swarmtrack.transport.base import PUBLISHED, Kind
from swarmtrack.transport.limits import MEMORY_CLASH_S
from swarmtrack.transport.outgoing import Outgoing, Sign
from swarmtrack.transport.peers import REPORTS, SUBSCRIBED, Peers, Verify


class MemoryHub:
    """The medium between `MemoryTransport`s.

    lose(sender, receiver, key): whether this message, query or answer gets lost; tokens never do, as in Zenoh.
    listeners: called with every (key, payload) published, like a monitor.
    """

    def __init__(self) -> None:
        self.lose: Callable[[int, int, str], bool] = lambda sender, receiver, key: False
        self.listeners: list[Callable[[str, bytes], None]] = []
        self._members: list[MemoryTransport] = []
        self._islands: list[frozenset[int]] = []

    def partition(self, *islands: Iterable[int]) -> None:
        """Split the network: each island of drone IDs receives only itself; a drone on no island receives all."""
        self._change_links([frozenset(island) for island in islands])

    def heal(self) -> None:
        self._change_links([])

    def kill(self, transport: MemoryTransport) -> None:
        """As kill -9: without a farewell, only the token disappears."""
        self._leave(transport)
        transport._stop()

    def put(self, key: str, payload: bytes) -> None:
        """Publish anything, from any sender, to all."""
        for member in self._members:
            member._receive(key, payload)

    # --- for MemoryTransport ---

    def _join(self, newcomer: MemoryTransport) -> None:
        self._members.append(newcomer)
        for member in self._members:
            if self._linked(member, newcomer):
                member._receive_token(newcomer.token, True)
                newcomer._receive_token(member.token, True)

    def _leave(self, leaver: MemoryTransport) -> None:
        if leaver in self._members:
            self._members.remove(leaver)
            for member in self._members:
                if self._linked(member, leaver):
                    member._receive_token(leaver.token, False)

    def _send(self, sender: MemoryTransport, key: str, payload: bytes) -> None:
        for listener in self.listeners:
            listener(key, payload)
        for member in self._members:
            if member is not sender and self._carries(sender, member, key):
                member._receive(key, payload)

    def _ask(self, asker: MemoryTransport, drone_id: int, anew: bool) -> None:
        for member in self._members:
            key = member._key(Kind.POSE)
            if member.drone_id != drone_id or member is asker or not self._carries(asker, member, key):
                continue
            answer = member._answer(anew)
            if answer is not None and self._carries(member, asker, key):
                asker._receive(key, answer)

    def _carries(self, sender: MemoryTransport, receiver: MemoryTransport, key: str) -> bool:
        return self._linked(sender, receiver) and not self.lose(sender.drone_id, receiver.drone_id, key)

    def _linked(self, a: MemoryTransport, b: MemoryTransport) -> bool:
        if a.team != b.team:
            return False
        return all((a.drone_id in island) == (b.drone_id in island) for island in self._islands)

    def _change_links(self, islands: list[frozenset[int]]) -> None:
        pairs = [(a, b) for a in self._members for b in self._members if a is not b]
        before = [self._linked(a, b) for a, b in pairs]
        self._islands = islands
        for (a, b), was in zip(pairs, before, strict=True):
            if self._linked(a, b) != was:
                a._receive_token(b.token, not was)


class MemoryTransport:
    """One drone's end of a `MemoryHub`. sign, verify: of announcements; None: unsigned."""

    def __init__(
        self,
        hub: MemoryHub,
        team: str,
        drone_id: int,
        boot: str,
        clock: Clock,
        *,
        sign: Sign | None = None,
        verify: Verify | None = None,
    ) -> None:
        self.team = team
        self.drone_id = drone_id
        self.token = keys.key(team, Kind.ALIVE, drone_id, boot)
        self._hub = hub
        self._clock = clock
        self._peers = Peers(
            team, drone_id, boot, clock, verify, clash_s=MEMORY_CLASH_S, lease_s=MEMORY_CLASH_S
        )
        self._outgoing = Outgoing(team, drone_id, boot, clock, sign)
        self._reconciliation: asyncio.Task[None] | None = None
        self._published: Counter[str] = Counter()

    async def open(self) -> None:
        self._hub._join(self)
        if self._outgoing.camera is not None:
            self._hub._send(self, self._outgoing.camera_key, self._outgoing.camera)
        self._reconciliation = asyncio.create_task(
            self._peers.ask_for_missing(lambda drone_id: self._hub._ask(self, drone_id, anew=False)),
            name="reconciliation",
        )

    async def announce(self, announcement: Announcement) -> None:
        self._outgoing.replace(announcement)
        payload = self._outgoing.encode()
        assert payload is not None
        self._hub._send(self, self._key(Kind.POSE), payload)

    def request_announcement(self, drone_id: int) -> None:
        if self._peers.may_request(drone_id):
            self._hub._ask(self, drone_id, anew=True)

    def describe(self, camera: bytes) -> None:
        self._outgoing.camera = camera

    def publish(self, kind: Kind, payload: bytes, camera: int = 0) -> bool:
        if kind not in PUBLISHED:
            raise ValueError(f"publish: found {kind}, expected one of {', '.join(PUBLISHED)}")
        self._published[f"{kind}_sent"] += 1
        key = keys.video_key(self.team, self.drone_id, camera) if kind is Kind.VIDEO else self._key(kind)
        self._hub._send(self, key, payload)
        return True

    def receive_only(self, drones: frozenset[int] | None) -> None:
        self._peers.reports_of = drones

    def has_listener(self, kind: Kind, camera: int = 0) -> bool:
        return bool(self._hub.listeners)

    is_narrow = False

    def events(self) -> AsyncIterator[PeerEvent]:
        return self._peers.events()

    def status(self) -> LinkStatus:
        alive, missing = self._peers.alive, self._peers.missing
        counters = {
            "peers": len(alive),
            "missing": len(missing),
            **self._outgoing.counters,
            **self._published,
            **self._peers.counters,
        }
        text = f"{len(alive)} peers, {len(missing)} of them unannounced"
        return LinkStatus("memory", self._reconciliation is not None, text, tuple(counters.items()))

    async def close(self) -> None:
        self._hub._leave(self)
        self._stop()
        if self._reconciliation is not None:
            with contextlib.suppress(asyncio.CancelledError):
                await self._reconciliation
            self._reconciliation = None

    def _stop(self) -> None:
        if self._reconciliation is not None:
            self._reconciliation.cancel()
        self._peers.close()

    def _key(self, kind: Kind) -> str:
        return keys.key(self.team, kind, self.drone_id)

    def _answer(self, anew: bool) -> bytes | None:
        if anew and self._outgoing.accept_request():
            self._peers.on_request()
        return self._outgoing.answer()

    def _receive(self, key: str, payload: bytes) -> None:
        address = keys.parse(key)
        if address is None or address.team != self.team or address.kind not in SUBSCRIBED:
            return
        of = self._peers.reports_of
        if of is None or address.kind not in REPORTS or address.drone_id in of | {self.drone_id}:
            self._peers.on_message(key, payload, self._clock.now())

    def _receive_token(self, key: str, alive: bool) -> None:
        self._peers.on_token(key, alive)
