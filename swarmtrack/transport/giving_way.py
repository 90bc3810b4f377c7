"""Rate limit for tracks and pictures on a full radio: `pacing` with the figures of one Zenoh session."""

from __future__ import annotations

import asyncio
import logging
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Final

import zenoh

from swarmtrack.clock import Clock
from swarmtrack.transport.base import Kind
from swarmtrack.transport.congestion import Congestion, look_at_links
from swarmtrack.transport.limits import PACE_CHECK_PERIOD_S, PACE_LOG_QUIET_S
from swarmtrack.transport.pacing import Pacing
from swarmtrack.transport.settings import Mode, NetworkSettings

log = logging.getLogger(__name__)

PACED: Final = (Kind.TRACKS, Kind.VIDEO)
Channel = tuple[Kind, int]
"""A kind of message, and of pictures of which camera."""


class RateLimiter:
    """Rate limit of one agent's publishers, across its sessions."""

    def __init__(self, network: NetworkSettings, clock: Clock) -> None:
        budget = network.tracks_kbit_s
        self._pacing = Pacing(None if budget is None else 125.0 * budget)
        self._mesh = network.mode is Mode.PEER
        self._clock = clock
        self._congestion = Congestion()
        self._listened: set[Channel] = set()
        # Of the radio; behind a router, it is the router that says all again.
        self._listeners = 0 if self._mesh else 1
        self._streams: set[str] = set()
        self._gave_way_at = -math.inf
        self.counters: Counter[str] = Counter()

    def declare(self, publishers: Mapping[Channel, zenoh.Publisher]) -> list[Any]:
        """Declare a listener to the subscribers of each rate-limited publisher."""
        self._listened.clear()
        return [
            publisher.declare_matching_listener(
                zenoh.handlers.Callback(partial(self._on_listeners, channel), indirect=False)
            )
            for channel, publisher in publishers.items()
            if channel[0] in PACED
        ]

    def _on_listeners(self, channel: Channel, status: zenoh.MatchingStatus) -> None:
        """In Zenoh's thread."""
        if status.matching:
            self._listened.add(channel)
            self._pacing.begin()
        else:
            self._listened.discard(channel)

    def has_listener(self, channel: Channel) -> bool:
        """Whether there is a subscriber to a rate-limited kind."""
        return channel in self._listened

    def lets_go(self, channel: Channel, size: int) -> bool:
        """Whether a message may be sent now; a refused one is counted."""
        if channel not in self._listened:
            return True
        kind, _ = channel
        allowed = self._pacing.allows(size, self._listeners, self._clock.now(), tracks=kind is Kind.TRACKS)
        self.counters[f"{kind}_held_back"] += not allowed
        return allowed

    @property
    def note(self) -> str:
        """Remark for the status; empty where everything goes through."""
        if not self._listened or not self._pacing.gives_way:
            return ""
        return f"; the radio is full, tracks give way: {self._pacing.bytes_s / 125.0:.0f} kbit/s"

    @property
    def finds_a_queue(self) -> bool:
        """Whether packets wait, as far as tracks show it."""
        return bool(self._listened) and self._pacing.may_be_full

    @property
    def is_limited(self) -> bool:
        """Whether messages had better be short."""
        return bool(self._listened) and self._listeners > 0 and self._pacing.is_limited

    async def run(self, session: zenoh.Session, teammates: Callable[[], int]) -> None:
        """Run until cancelled. teammates: number of live ones."""
        while True:
            await asyncio.sleep(PACE_CHECK_PERIOD_S)
            if self._listened:
                self._look(session, teammates())

    def _look(self, session: zenoh.Session, teammates: int) -> None:
        now = self._clock.now()
        links = [link for link in session.info.links() if not _is_within(str(link.dst))]
        if self._mesh:
            # Teammates do not listen to tracks, and whoever is on board costs no radio.
            self._listeners = max(0, len({str(link.zid) for link in links}) - teammates)
        self._streams, before = _streams(links), self._streams
        if self._streams != before:
            self._pacing.begin()
        self._pacing.adjust(self._congestion.measure(look_at_links(self._streams)), now)
        if self._pacing.gives_way:
            if now - self._gave_way_at > PACE_LOG_QUIET_S:
                log.warning("network: the radio is full: tracks are published less often")
            self._gave_way_at = now


def _is_within(locator: str) -> bool:
    """Whether a link stays within this machine."""
    return locator.partition("/")[2].startswith(("127.", "[::1]"))


def _streams(links: Sequence[zenoh.Link]) -> set[str]:
    """HOST:PORT at the other end of each link that is TCP."""
    ends = [str(link.dst) for link in links]
    return {end.partition("/")[2].partition("?")[0] for end in ends if end.startswith(("tls/", "tcp/"))}
