"""A team with real keys on loopback: made once, for the tests of what keys protect."""

from __future__ import annotations

import asyncio
import secrets
import socket
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from support.patience import PATIENCE
from swarmtrack.clock import SystemClock
from swarmtrack.messages import Announcement, PeerEvent
from swarmtrack.security import names
from swarmtrack.security.authority import Authority, create_authority
from swarmtrack.security.credentials import Credentials
from swarmtrack.security.loading import load_credentials
from swarmtrack.transport import keys
from swarmtrack.transport.settings import NetworkSettings
from swarmtrack.transport.zenoh_transport import ZenohTransport

CLOCK = SystemClock()


def now() -> datetime:
    return datetime.fromtimestamp(CLOCK.utc(), UTC)


def free_addresses(n: int) -> list[str]:
    """n addresses HOST:PORT whose ports and the next ones were free a moment ago, below the ephemeral ones."""
    found: list[str] = []
    first = 20000 + secrets.randbelow(5000)
    while len(found) < n:
        try:
            for port in (first, first + 1):
                for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM):
                    with socket.socket(socket.AF_INET, kind) as probe:
                        probe.bind(("127.0.0.1", port))
            found.append(f"127.0.0.1:{first}")
        except OSError:
            pass
        first += 2
    return found


class Team:
    """A CA in `folder`, and the keys it issued."""

    def __init__(self, folder: Path, *who: str, name: str = "") -> None:
        self.folder = folder
        self.authority: Authority = create_authority(folder, name or f"test-{secrets.token_hex(4)}", now())
        self.issue(*who)

    @property
    def name(self) -> str:
        return self.authority.roster.team

    def issue(self, *who: str) -> None:
        self.authority.issue(map(names.from_user, who), now())

    def credentials(self, who: str) -> Credentials:
        name = names.from_user(who)
        return load_credentials(self.folder / name, name, CLOCK.utc())


class Drone:
    """One drone's transport, and all it was ever told."""

    def __init__(self, network: NetworkSettings, drone_id: int, boot: str = "") -> None:
        self.drone_id, self.boot = drone_id, boot or keys.new_boot()
        self.network = network
        credentials = network.credentials
        sign = None if credentials is None else credentials.sign
        verify = None if credentials is None else credentials.verify
        self.transport = ZenohTransport(network, drone_id, self.boot, CLOCK, sign=sign, verify=verify)
        self.told: list[PeerEvent] = []
        self._news = asyncio.Condition()
        self._listening: asyncio.Task[None] | None = None

    async def start(self, sequence: int = 1) -> Drone:
        self._listening = asyncio.create_task(self._listen())
        await self.transport.open()
        await self.announce(sequence)
        return self

    async def announce(self, sequence: int) -> None:
        await self.transport.announce(announcement(self.drone_id, self.boot, sequence))

    async def knows(self, *others: Drone, sequence: int = 1) -> None:
        """Waits until the announcements of the others were told."""
        for other in others:
            await self.until(
                lambda told, other=other: (other.drone_id, other.boot, sequence) in announcements(told)  # type: ignore[misc]
            )

    async def until(self, holds: Callable[[list[PeerEvent]], bool]) -> None:
        async with self._news:
            await asyncio.wait_for(self._news.wait_for(lambda: holds(self.told)), PATIENCE)

    def counter(self, name: str) -> float:
        return dict(self.transport.status().counters).get(name, 0)

    async def stop(self) -> None:
        await self.transport.close()
        if self._listening is not None:
            await asyncio.wait_for(self._listening, PATIENCE)

    async def _listen(self) -> None:
        async for event in self.transport.events():
            async with self._news:
                self.told.append(event)
                self._news.notify_all()


def announcement(drone_id: int, boot: str, sequence: int) -> Announcement:
    position = np.array([drone_id, sequence, -1.5])
    return Announcement(drone_id, boot, sequence, CLOCK.now(), 0.01, position, np.eye(3), 0.01 * np.eye(3))


def announcements(told: list[PeerEvent]) -> list[tuple[int, str, int]]:
    return [(e.drone_id, e.boot, e.sequence) for e in told if isinstance(e, Announcement)]
