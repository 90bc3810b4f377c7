"""Teammates that are linked but silent.

A teammate is judged by its reliable messages: its reports, once per second, its announcements, and answers.
Keep-alives of a link mean little. Where one of the two links of a pair breaks, Zenoh loses what was on its way there:
a drone's token, or its subscription, is then never sent again, and the two stay half disconnected behind a link that
stands. So a teammate that is silent for longer than a reporting interval is queried, which its transport answers
whatever its autopilot does. One that has been silent for a lease is reported as *not heard*; after two, the links are
reopened.

Zenoh cannot close a link to a single peer, so all are closed, and not again within `REOPEN_REST_S`. A teammate that
stays silent afterwards may have reasons of its own: for it, the interval grows fourfold each time. Pure state; times by
any clock [s].
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable

from swarmtrack.transport.limits import (
    ASK_AFTER_SILENCE_S,
    REOPEN_BACK_OFF,
    REOPEN_LEASES,
    REOPEN_REST_S,
    REPORT_PERIOD_S,
)


class Silence:
    """present: IDs of teammates that are alive, by their tokens, or linked."""

    def __init__(self, lease_s: float) -> None:
        self._patience_s = max(lease_s, 2.0 * REPORT_PERIOD_S)
        self._heard: dict[int, float] = {}
        """When last; at first, when it was first seen to be present."""
        self._told: set[int] = set()
        self._tried: Counter[int] = Counter()
        """How often all links were made again since this one was heard last."""
        self._reopened_at = -math.inf

    def mark_heard(self, drone_id: int, now: float) -> None:
        self._heard[drone_id] = now
        del self._tried[drone_id]

    def clear(self) -> None:
        """All links are closed."""
        self._heard.clear()
        self._told.clear()

    def silent(self, present: Iterable[int], now: float) -> dict[int, float]:
        """Silent teammates, and for how long each [s]."""
        return {d: s for d, s in self._since(present, now).items() if s > self._patience_s}

    def to_ask(self, present: Iterable[int], now: float) -> list[int]:
        """Teammates that have been silent for longer than usual."""
        return [d for d, s in self._since(present, now).items() if s > ASK_AFTER_SILENCE_S]

    def news(self, present: Iterable[int], now: float) -> list[str]:
        """A sentence for each teammate that became silent, or ended its silence. A new teammate counts as just
        heard.
        """
        here = set(present)
        for gone in self._heard.keys() - here:
            del self._heard[gone]
        for new in here - self._heard.keys():
            self._heard[new] = now
        self._told &= here
        silent = self.silent(here, now)
        new_ones, back = silent.keys() - self._told, self._told - silent.keys()
        self._told = set(silent)
        return [
            *(
                f"network: drone {d} is linked but silent: no reliable message for {silent[d]:.1f} s"
                for d in sorted(new_ones)
            ),
            *(f"network: drone {d} is received again" for d in sorted(back)),
        ]

    def to_reopen(self, present: Iterable[int], now: float) -> list[int]:
        """Teammates for which all links are to be reopened."""
        if now - self._reopened_at < REOPEN_REST_S:
            return []
        silent = self.silent(present, now)
        bearable = REOPEN_LEASES * self._patience_s
        deaf = sorted(d for d, s in silent.items() if s > bearable * REOPEN_BACK_OFF ** self._tried[d])
        if deaf:
            self._tried.update(deaf)
            self._reopened_at = now
        return deaf

    def _since(self, present: Iterable[int], now: float) -> dict[int, float]:
        return {d: now - self._heard[d] for d in present if d in self._heard}
