"""Teammates that are linked but silent: whom to ask, and when links or declarations are to be made again.

A teammate is judged by its reliable messages: its reports, once per second, its announcements, and answers.
Keep-alives of a link mean little. Where one of the two links of a pair breaks, Zenoh loses what was on its way there:
a drone's token, or its subscription, is then never sent again, and the two stay half disconnected behind a link that
stands.

Questions. Any word is life. A teammate that reports is asked once it is silent for longer than a report takes; its
transport answers, whatever its autopilot does. While no word of its own comes, the next question comes after twice the
time, whether it answers or not. One that never reported owes no word, so of all those only one is asked at a time.

Silence. A teammate is *not heard* after a lease without the word that it owes: a report, an answer, its token.

Remedies. Zenoh cannot close a link to a single peer. Links are closed, all of them, only where nothing at all is heard
over them: a teammate that is silent while others are heard is deaf or mute itself. What may have been lost of *our*
declarations is cheaper: where a linked teammate is silent, or reports without having our announcement, we declare
ourselves again over the links that stand. Each has a budget per teammate that no word of it renews: links are closed
once in ten minutes, declarations repeated once in half a minute, and then after twice that time, and so on. Where
packets wait in a full radio (`pacing`), a word may be among them, and both come much later: they would be more for the
radio to carry.

Pure state; times by any clock [s].
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

from swarmtrack.transport.limits import (
    ASK_AFTER_SILENCE_S,
    QUESTION_BACK_OFFS,
    QUESTION_REST_S,
    QUEUE_PATIENCE,
    REOPEN_LEASES,
    REOPEN_PERIOD_S,
    REOPEN_REST_S,
    REPEAT_PERIOD_S,
    REPORT_PERIOD_S,
)


@dataclass(slots=True)
class _Heard:
    """heard: time of the last word; at first, when it was first seen to be present. asked, asked_last: times of the
    first and the last question since then. questions: how many since the last word of its own. lacks_us: since when
    it reports without having our announcement.
    """

    heard: float
    is_heard: bool = False
    reports: bool = False
    asked: float | None = None
    asked_last: float = -math.inf
    questions: int = 0
    lacks_us: float | None = None

    @property
    def owes_a_word(self) -> bool:
        """Whether it is expected to speak without being asked: it reports, or it never said that it is there."""
        return self.reports or not self.is_heard

    def silent_s(self, now: float) -> float:
        """Time without a word that it owes."""
        if self.owes_a_word:
            return now - self.heard
        return 0.0 if self.asked is None else now - self.asked + ASK_AFTER_SILENCE_S

    def is_due(self, now: float) -> bool:
        """Whether to ask it, were it alone."""
        last = self.heard if self.asked is None else self.asked_last
        return now - last > ASK_AFTER_SILENCE_S * 2.0 ** min(self.questions, QUESTION_BACK_OFFS)


class _RemedyBudget:
    """Limit of one remedy: per teammate once in its period, then in twice that time, and so on."""

    def __init__(self, period_s: float) -> None:
        self._first_period_s = period_s
        self._spent: dict[int, tuple[float, float]] = {}
        """By teammate: until when there is none left, and the period after that, s."""

    def allows(self, drone_id: int, now: float) -> bool:
        return now >= self._spent.get(drone_id, (-math.inf, 0.0))[0]

    def spend(self, drone_ids: Iterable[int], now: float) -> None:
        for drone_id in drone_ids:
            _, period = self._spent.get(drone_id, (0.0, self._first_period_s))
            self._spent[drone_id] = now + period, 2.0 * period


@dataclass(slots=True)
class Silence:
    """present: IDs of teammates that are alive, by their tokens, or linked; `news` takes note of who comes and goes."""

    lease_s: float
    _all: dict[int, _Heard] = field(default_factory=dict)
    _told: set[int] = field(default_factory=set)
    _reopening: _RemedyBudget = field(default_factory=lambda: _RemedyBudget(REOPEN_PERIOD_S))
    _repeating: _RemedyBudget = field(default_factory=lambda: _RemedyBudget(REPEAT_PERIOD_S))
    _reopened_at: float = -math.inf
    _stranger_asked_at: float = -math.inf
    """When one was asked last that owed no word."""

    @property
    def _patience_s(self) -> float:
        return max(self.lease_s, 2.0 * REPORT_PERIOD_S)

    def mark_heard(self, drone_id: int, now: float, *, report: bool = False) -> None:
        """A word of its own. report: one of those that come each second."""
        one = self._all.setdefault(drone_id, _Heard(now))
        one.heard, one.is_heard, one.asked, one.questions = now, True, None, 0
        one.reports |= report

    def mark_answered(self, drone_id: int, now: float) -> None:
        """An answer to a question: it lives, but does not speak by itself, so the next question comes later."""
        one = self._all.setdefault(drone_id, _Heard(now))
        one.heard, one.is_heard, one.asked = now, True, None

    def mark_known(self, drone_id: int, now: float, *, known: bool) -> None:
        """A report says whether that teammate has our announcement."""
        one = self._all.setdefault(drone_id, _Heard(now))
        if known:
            one.lacks_us = None
        elif one.lacks_us is None:
            one.lacks_us = now

    def clear(self) -> None:
        """All links are closed."""
        self._all.clear()
        self._told.clear()

    def silent(self, present: Iterable[int], now: float) -> dict[int, float]:
        """Silent teammates, and for how long each [s]."""
        here = {d: self._all[d].silent_s(now) for d in present if d in self._all}
        return {d: s for d, s in here.items() if s > self._patience_s}

    def to_ask(self, present: Iterable[int], now: float) -> list[int]:
        """Teammates to ask now; they count as asked."""
        due = [d for d in present if d in self._all and self._all[d].is_due(now)]
        owing = [d for d in due if self._all[d].owes_a_word]
        others = sorted(set(due).difference(owing), key=lambda d: self._all[d].heard)
        if others and now - self._stranger_asked_at >= QUESTION_REST_S:
            self._stranger_asked_at = now
            owing.append(others[0])
        for drone_id in owing:
            one = self._all[drone_id]
            one.asked = now if one.asked is None else one.asked
            one.asked_last = now
            one.questions += 1
        return owing

    def news(self, present: Iterable[int], now: float) -> list[str]:
        """A sentence for each teammate that became silent, or ended its silence. A new teammate counts as just
        heard.
        """
        here = set(present)
        for gone in self._all.keys() - here:
            del self._all[gone]
        for new in here - self._all.keys():
            self._all[new] = _Heard(now)
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

    def to_reopen(self, present: Iterable[int], now: float, *, queued: bool = False) -> list[int]:
        """Teammates for which all links are to be closed and opened again; none while any is heard. queued: packets
        wait, and words may be among them."""
        here = set(present)
        silent = self.silent(here, now)
        bearable = self._bearable_s(queued)
        # One that is silent for good, and a short silence of all others, are not yet a session without a word.
        is_deaf = silent.keys() == here and all(s > bearable for s in silent.values())
        if not is_deaf or now - self._reopened_at < REOPEN_REST_S:
            return []
        deaf = sorted(d for d in silent if self._reopening.allows(d, now))
        if deaf:
            self._reopening.spend(deaf, now)
            self._reopened_at = now
        return deaf

    def to_repeat(self, linked: Iterable[int], now: float, *, queued: bool = False) -> list[int]:
        """Teammates for whose sake we are to declare ourselves again, over the links that stand."""
        bearable = self._bearable_s(queued)

        def lacks_us_s(drone_id: int) -> float:
            since = self._all[drone_id].lacks_us if drone_id in self._all else None
            return 0.0 if since is None else now - since

        silent = self.silent(linked, now)
        missing = sorted(
            drone_id
            for drone_id in set(linked)
            if max(silent.get(drone_id, 0.0), lacks_us_s(drone_id)) > bearable
            and self._repeating.allows(drone_id, now)
        )
        self._repeating.spend(missing, now)
        return missing

    def _bearable_s(self, queued: bool) -> float:
        """How long a silence lasts until something is done."""
        return REOPEN_LEASES * self._patience_s * (QUEUE_PATIENCE if queued else 1.0)
