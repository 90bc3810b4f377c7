"""Which drones to ask to announce their pose again."""

from __future__ import annotations

from dataclasses import dataclass

from swarmtrack.messages import Announcement

# s since a drone said where it is: beyond, it is worth asking. Who reports, does so once a second.
STALE_S = 1.5
# s between two requests to one drone that did not settle the matter, doubled with each.
FIRST_WAIT_S = 3.0
# s: no longer, since what could not be told apart may have flown apart since.
LAST_WAIT_S = 48.0


@dataclass(slots=True)
class _Asked:
    t: float
    wait_s: float


class PoseRequests:
    """Collects the requests of one scan. One that settles nothing is repeated, more and more rarely."""

    def __init__(self) -> None:
        self._waiting: set[int] = set()
        self._asked: dict[int, _Asked] = {}

    def ask_again(self, place: Announcement, t: float) -> None:
        """Ask whoever was there when it said so, unless that is not long ago, or it was asked not long ago."""
        if t - place.t <= STALE_S:
            return
        before = self._asked.get(place.drone_id)
        if before is not None and t - before.t < before.wait_s:
            return
        wait_s = min(2.0 * before.wait_s, LAST_WAIT_S) if before else FIRST_WAIT_S
        self._asked[place.drone_id] = _Asked(t, wait_s)
        self._waiting.add(place.drone_id)

    def answered(self, drone_id: int) -> None:
        """The matter is settled."""
        self._asked.pop(drone_id, None)

    def of_this_scan(self) -> tuple[int, ...]:
        """The drones to ask, each once; the next scan begins with none."""
        if not self._waiting:
            return ()
        waiting, self._waiting = tuple(sorted(self._waiting)), set()
        return waiting
