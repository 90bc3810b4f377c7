"""Drones that others see elsewhere than we do: for how long they have no name here, and what brings it back."""

from __future__ import annotations

from collections import Counter

# s that an overruled drone stays unnamed, unless it is heard.
DISPUTE_S = 5.0
# Times overruled from which on only motion names a drone.
DISPROVED = 2


class Disputes:
    """By drone, since when it is overruled, and how often it was in this life."""

    def __init__(self) -> None:
        self._since: dict[int, float] = {}
        self._times: Counter[int] = Counter()

    def __contains__(self, drone_id: int) -> bool:
        """Whether nobody is to be taken for it now."""
        return drone_id in self._since

    def overrule(self, drone_id: int, t: float) -> None:
        self._since[drone_id] = t
        self._times[drone_id] += 1

    def settle(self, drone_id: int) -> None:
        """It has announced itself again."""
        self._since.pop(drone_id, None)

    def begin_life(self, drone_id: int) -> None:
        """Its process has started again, with another config perhaps."""
        self._times.pop(drone_id, None)

    def forget(self, t: float) -> None:
        """Disputes that nobody settled are old."""
        self._since = {drone: since for drone, since in self._since.items() if t - since < DISPUTE_S}

    def needs_proof(self, drone_id: int) -> bool:
        """Whether its place has misled us more than once."""
        return self._times[drone_id] >= DISPROVED
