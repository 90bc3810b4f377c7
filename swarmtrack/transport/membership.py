"""Who is in the team right now. Told of liveliness tokens and announcements; answers with events.

Theory of operation. A process is alive from the moment its token `alive/<id>/<boot>` is seen until it goes. The boot
names one life of the process, so a restart is a new boot, and two boots of one ID at the same time are two
processes that speak as one drone: an `IdClash`, which ends with the `PeerDeparted` of all but one. An announcement
counts once its boot is alive; whoever is alive without one is `missing` and to be asked, again and again, because
whatever was put before the links stood is lost. Whoever departs is forgotten, so that after a healed partition its
announcement is asked for and told anew.

A clone of our own ID is reported as clash and departure only: we have no teammate of our own name.
"""

from __future__ import annotations

from collections import Counter

from swarmtrack.messages import Announcement, IdClash, PeerArrived, PeerDeparted, PeerEvent

MAX_PEERS = 1024  # live IDs; beyond it is an attack or a mistake
MAX_BOOTS = 4  # of one ID at a time


class Membership:
    """Pure state. `counters` holds, by reason, how often something was refused."""

    def __init__(self, drone_id: int, boot: str) -> None:
        self._drone_id = drone_id
        self._boot = boot
        self._sequences: dict[
            int, dict[str, int | None]
        ] = {}  # id -> live boot -> last announcement's sequence
        self.counters: Counter[str] = Counter()

    def arrived(self, drone_id: int, boot: str) -> list[PeerEvent]:
        """A token was seen."""
        ours = drone_id == self._drone_id
        if ours and boot == self._boot:
            return []
        boots = self._sequences.get(drone_id, {})
        if boot in boots:
            return []
        if len(boots) >= MAX_BOOTS or (not boots and len(self._sequences) >= MAX_PEERS):
            self.counters["tokens_beyond_limit"] += 1
            return []
        self._sequences[drone_id] = {**boots, boot: None}
        events: list[PeerEvent] = [] if ours else [PeerArrived(drone_id, boot)]
        alive = self.alive(drone_id)
        if len(alive) > 1:
            events.append(IdClash(drone_id, alive, ours))
        return events

    def departed(self, drone_id: int, boot: str) -> list[PeerEvent]:
        """A token went."""
        boots = self._sequences.get(drone_id, {})
        if boot not in boots:
            return []
        del boots[boot]
        if not boots:
            del self._sequences[drone_id]
        return [PeerDeparted(drone_id, boot)]

    def heard(self, key_id: int, announcement: Announcement) -> list[PeerEvent]:
        """An announcement came on the key of `key_id`: news, or counted."""
        reason = self._refusal(key_id, announcement)
        if reason is not None:
            self.counters[reason] += 1
            return []
        self._sequences[key_id][announcement.boot] = announcement.sequence
        return [announcement]

    def _refusal(self, key_id: int, announcement: Announcement) -> str | None:
        if announcement.drone_id != key_id:
            return "announcements_on_wrong_key"
        if key_id == self._drone_id:
            return "announcements_of_own_id"
        boots = self._sequences.get(key_id, {})
        if announcement.boot not in boots:
            return "announcements_before_token"  # no loss: it is asked for as soon as the token is there
        last = boots[announcement.boot]
        if last is not None and announcement.sequence <= last:
            return "announcements_repeated"
        return None

    def alive(self, drone_id: int) -> tuple[str, ...]:
        """The live boots of one ID, our own among them."""
        boots = tuple(self._sequences.get(drone_id, {}))
        return (self._boot, *boots) if drone_id == self._drone_id else boots

    @property
    def peers(self) -> tuple[int, ...]:
        """The IDs of all live teammates."""
        return tuple(i for i in self._sequences if i != self._drone_id)

    @property
    def missing(self) -> tuple[int, ...]:
        """The IDs whose announcement is to be asked for."""
        return tuple(
            i for i, boots in self._sequences.items() if i != self._drone_id and None in boots.values()
        )
