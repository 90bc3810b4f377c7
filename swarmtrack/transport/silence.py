"""Who lives, by its token, and yet says nothing any more.

Each teammate reports whom it sees once a second, reliably. One that did so and stops, while its link stands, has lost
its autopilot, hangs, or is not heard by us: all three are worth a word. Where that is so of everybody, it is we who are
deaf, and the links are made anew, once until somebody is heard again. Pure state; times by any clock [s].
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

REPORTS_S: Final = 1.0  # between two of a teammate's reports
DEAF_S: Final = 10.0  # without a word of anybody


class Silence:
    """lease_s: a report may be so late."""

    def __init__(self, lease_s: float) -> None:
        self._patience_s = lease_s + REPORTS_S
        self._heard: dict[int, float] = {}
        self._told: set[int] = set()
        self._reopened = False

    def heard(self, drone_id: int, now: float) -> None:
        self._heard[drone_id] = now
        self._reopened = False

    def forget(self) -> None:
        """All links are closed."""
        self._heard.clear()
        self._told.clear()

    def silent(self, alive: Iterable[int], now: float) -> dict[int, float]:
        """Those of the living who were heard before, and for how long they have not been [s]."""
        since = {drone_id: now - self._heard[drone_id] for drone_id in alive if drone_id in self._heard}
        return {drone_id: seconds for drone_id, seconds in since.items() if seconds > self._patience_s}

    def news(self, alive: Iterable[int], now: float) -> list[str]:
        """A sentence for each who has just fallen silent, or is heard again."""
        living = set(alive)
        for gone in self._heard.keys() - living:
            del self._heard[gone]
        self._told &= living
        silent = self.silent(living, now)
        new, back = silent.keys() - self._told, self._told - silent.keys()
        self._told = set(silent)
        return [
            *(
                f"network: drone {d} is linked and has said nothing for {silent[d]:.0f} s"
                for d in sorted(new)
            ),
            *(f"network: drone {d} is heard again" for d in sorted(back)),
        ]

    def is_deaf(self, alive: Iterable[int], now: float) -> bool:
        """Whether nobody has been heard for so long that the links are to be made anew; said once."""
        living = set(alive)
        silent = self.silent(living, now)
        if self._reopened or not living or len(silent) < len(living) or min(silent.values()) < DEAF_S:
            return False
        self._reopened = True
        return True
