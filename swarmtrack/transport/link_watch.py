"""Links that are up, by the names in their certificates. Zenoh fails silently: missing links are reported here."""

from __future__ import annotations

import asyncio
import itertools
import logging
from collections.abc import Callable
from dataclasses import dataclass, field

import zenoh

from swarmtrack.transport.limits import (
    DATAGRAM_LINK_CHECKS,
    LINK_CHECK_PERIOD_S,
    LINK_NAMES_SHOWN,
    LINK_START_CHECKS,
)
from swarmtrack.transport.settings import Mode, NetworkSettings, parse_endpoint

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LinksUp:
    """names: in the certificates at the other ends; links without keys have none. count: number of links.
    datagrams: names at the other ends of links that are not streams. hosts: of the other ends.
    """

    names: frozenset[str] = frozenset()
    count: int = 0
    datagrams: frozenset[str] = frozenset()
    hosts: frozenset[str] = frozenset()


def links_up(session: zenoh.Session | None) -> LinksUp:
    links = [] if session is None else session.info.links()
    named = [(link.auth_identifier, link.is_streamed) for link in links]
    return LinksUp(
        frozenset(name for name, _ in named if name),
        len(links),
        frozenset(name for name, is_streamed in named if name and not is_streamed),
        frozenset(parse_endpoint(str(link.dst), "link").host for link in links),
    )


@dataclass
class LinkWatch:
    """Reports once per name an expected link that never came up, or a link to a name outside the team."""

    network: NetworkSettings
    _unseen: set[str] = field(init=False)
    _strangers: set[str] = field(init=False, default_factory=set)
    _streams_only: dict[str, int] = field(init=False, default_factory=dict)
    """By name, for how many periods a peer has had no link for datagrams."""

    def __post_init__(self) -> None:
        self._unseen = set(self.network.expected)

    async def run(self, look: Callable[[], LinksUp]) -> None:
        """Run until cancelled."""
        for period in itertools.count(1):
            await asyncio.sleep(LINK_CHECK_PERIOD_S)
            for line in self.news(look(), patient=period < LINK_START_CHECKS):
                log.warning(line)

    def news(self, up: LinksUp, *, patient: bool) -> list[str]:
        """New log lines; patient: names that are merely late are left out."""
        strangers = self.strangers(up) - self._strangers
        self._strangers |= strangers
        lines = [
            f"network: {name} has a certificate of our CA but is not in our roster, its messages are ignored: "
            f"is {self._roster_number}the newest?"
            for name in sorted(strangers)
        ]
        self._unseen -= up.names
        if not patient and self._unseen and self.network.credentials is not None:
            lines.append(
                f"network: no link to {_listed(self._unseen)} yet: not started, not in reach, or without a certificate "
                f"of this team's CA that is valid by our clock"
            )
            self._unseen.clear()
        return lines + self._without_datagrams(up)

    def _without_datagrams(self, up: LinksUp) -> list[str]:
        """Once for each peer that has had none for a while."""
        without = self.streams_only(up)
        self._streams_only = {name: self._streams_only.get(name, 0) + 1 for name in without}
        new = {name for name, periods in self._streams_only.items() if periods == DATAGRAM_LINK_CHECKS}
        if not new:
            return []
        return [
            f"network: no datagrams with {_listed(new)}: is UDP let through on the port after that of network.peers? "
            "Until then tracks wait behind every lost packet"
        ]

    def streams_only(self, up: LinksUp) -> frozenset[str]:
        """Names whose second link, for datagrams, is missing."""
        endpoints = (*self.network.listen, *self.network.connect)
        wanted = self.network.mode is Mode.PEER and any(text.startswith("quic/") for text in endpoints)
        return (up.names & set(self.network.expected)) - up.datagrams if wanted else frozenset()

    def strangers(self, up: LinksUp) -> frozenset[str]:
        credentials = self.network.credentials
        return frozenset() if credentials is None else up.names - set(credentials.roster.names)

    def describe(self, up: LinksUp) -> str:
        """Text for the status: `linked to drone-2, monitor; not to drone-3`."""
        if self.network.credentials is None:
            return f"{up.count} links"
        missing = set(self.network.expected) - up.names
        linked = f"linked to {_listed(up.names)}" if up.names else "no link"
        text = f"{linked}; not to {_listed(missing)}" if missing and up.names else linked
        without = self.streams_only(up)
        return f"{text}; no datagrams with {_listed(without)}" if without else text

    def is_connected(self, up: LinksUp) -> bool:
        """Whether the process is connected: a client without a router is not; a peer alone may be the first one."""
        return self.network.mode != Mode.CLIENT or up.count > 0

    @property
    def _roster_number(self) -> str:
        credentials = self.network.credentials
        return "" if credentials is None else f"ours, number {credentials.roster.number}, "


def _listed(names: set[str] | frozenset[str]) -> str:
    shown = sorted(names, key=lambda name: (len(name), name))
    more = f" and {len(shown) - LINK_NAMES_SHOWN} more" if len(shown) > LINK_NAMES_SHOWN else ""
    return ", ".join(shown[:LINK_NAMES_SHOWN]) + more
