"""Current members of the team. Takes liveliness tokens and messages; returns events.

Theory of operation. A process is alive while its token `alive/<id>/<boot>` exists. The boot identifies one run of the
process. A second boot of an ID is a restart, so the first has departed: the token of a killed process remains until
its links notice. Where both tokens remain for longer, or a message of the first boot arrives, it is not a restart but
two processes with one ID: an `IdClash`, reported again for each further one, which ends with the `PeerDeparted` of all
but one.

A message counts once its boot is alive, and if its sequence is higher than the last of that boot; a live boot without
an announcement is `missing` and to be asked, again and again, because a message that was put before the links stood is
lost. A departed boot is deleted, so that after a healed partition its announcement is requested and delivered again.

Of two boots both announcements are delivered. When one is left, its announcement is delivered once more: a receiver
that trusted neither during a clash has something to start from, and one that trusted the later is corrected.

A clone of our own ID is reported as clash and departure only: no teammate has our ID.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from swarmtrack.messages import Announcement, IdClash, PeerArrived, PeerDeparted, PeerEvent
from swarmtrack.transport.limits import MAX_BOOTS_PER_ID, MAX_PEERS, OLD_BOOT_ON_ITS_WAY_S
from swarmtrack.transport.sender_clock import SenderClock
from swarmtrack.wire.announcement import AnnouncementMessage
from swarmtrack.wire.motion import MotionMessage
from swarmtrack.wire.sightings import SightingsMessage
from swarmtrack.wire.strangers import StrangersMessage

Numbered = AnnouncementMessage | SightingsMessage | MotionMessage | StrangersMessage

# As counters name them.
_NAMES = {
    AnnouncementMessage: "announcements",
    SightingsMessage: "sightings",
    MotionMessage: "motion",
    StrangersMessage: "strangers",
}


@dataclass(slots=True)
class LiveBoot:
    """State of one live boot."""

    announcement: Announcement | None = None
    reported: dict[type[Numbered], int] = field(default_factory=dict)
    """The sequence of its last report of each kind."""
    clock: SenderClock = field(default_factory=SenderClock)


class Membership:
    """Pure state. `counters` counts rejected messages by reason."""

    def __init__(self, drone_id: int, boot: str, clash_s: float) -> None:
        """clash_s: after so long two boots of one ID are two processes."""
        self._drone_id = drone_id
        self._boot = boot
        self._clash_s = clash_s
        self._lives: dict[int, dict[str, LiveBoot]] = {}  # by ID, by boot
        self._believed: dict[int, str] = {}
        """By ID, the boot that was told to be alive; of a clash the last."""
        self._contested: dict[int, float] = {}
        """By ID of several boots that may be one restart: when the last one came [s]."""
        self._clashing: set[int] = set()
        self.counters: Counter[str] = Counter()

    def arrived(self, drone_id: int, boot: str, t: float) -> list[PeerEvent]:
        """A token appeared at t [s], by any clock."""
        ours = drone_id == self._drone_id
        if ours and boot == self._boot:
            return []
        lives = self._lives.get(drone_id, {})
        if boot in lives:
            return []
        if len(lives) >= MAX_BOOTS_PER_ID or (not lives and len(self._lives) >= MAX_PEERS):
            self.counters["tokens_beyond_limit"] += 1
            return []
        self._lives[drone_id] = {**lives, boot: LiveBoot()}
        events: list[PeerEvent] = []
        if not ours:
            if lives and drone_id not in self._clashing:
                events.append(PeerDeparted(drone_id, self._believed[drone_id]))
            events.append(PeerArrived(drone_id, boot))
            self._believed[drone_id] = boot
        if drone_id in self._clashing:
            events.append(self._clash(drone_id))
        elif len(self.alive(drone_id)) > 1:
            self._contested[drone_id] = t
        return events

    def departed(self, drone_id: int, boot: str) -> list[PeerEvent]:
        """A token disappeared."""
        lives = self._lives.get(drone_id, {})
        if boot not in lives:
            return []
        del lives[boot]
        if not lives:
            del self._lives[drone_id]
        clashed = drone_id in self._clashing
        if len(self.alive(drone_id)) < 2:
            self._clashing.discard(drone_id)
            self._contested.pop(drone_id, None)
        believed = self._believed.get(drone_id)
        if not clashed and boot != believed:
            return []  # a life that had ended, or one of our own ID
        events: list[PeerEvent] = [PeerDeparted(drone_id, boot)]
        if drone_id == self._drone_id:
            return events
        if not lives:
            del self._believed[drone_id]
            return events
        left = self._believed[drone_id] = list(lives)[-1]
        if not clashed:
            events.append(PeerArrived(drone_id, left))
        announcement = lives[left].announcement
        if announcement is not None and len(lives) == 1:
            events.append(announcement)
        return events

    def part(self) -> list[PeerEvent]:
        """All links are closed: live boots have to appear again."""
        events: list[PeerEvent] = []
        for drone_id, lives in self._lives.items():
            boots = list(lives) if drone_id in self._clashing else [self._believed.get(drone_id)]
            events += [PeerDeparted(drone_id, boot) for boot in boots if boot is not None]
        for of_each in (self._lives, self._believed, self._contested, self._clashing):
            of_each.clear()
        return events

    def settle(self, t: float) -> list[PeerEvent]:
        """Decide at t [s] which IDs have had several boots for too long to be restarting."""
        clashes = [drone for drone, since in self._contested.items() if t - since >= self._clash_s]
        for drone_id in clashes:
            del self._contested[drone_id]
            self._clashing.add(drone_id)
        return [self._clash(drone_id) for drone_id in clashes]

    @property
    def settles_at(self) -> float | None:
        """Next time at which `settle` has something to report [s]; None: never."""
        return min(self._contested.values()) + self._clash_s if self._contested else None

    def _clash(self, drone_id: int) -> IdClash:
        return IdClash(drone_id, self.alive(drone_id), drone_id == self._drone_id)

    def life(self, key_id: int, message: Numbered, t: float) -> LiveBoot | None:
        """Boot of a message that came on a key of `key_id` at t [s]; None where it does not count, and is counted."""
        since = self._contested.get(key_id, t)
        is_older = message.boot != self._believed.get(key_id) and message.boot in self._lives.get(key_id, {})
        if is_older and t - since > OLD_BOOT_ON_ITS_WAY_S:
            self._contested[key_id] = t - self._clash_s
        reason = self._refusal(key_id, message)
        if reason is not None:
            self.counters[f"{_NAMES[type(message)]}_{reason}"] += 1
            return None
        return self._lives[key_id][message.boot]

    def _refusal(self, key_id: int, message: Numbered) -> str | None:
        if message.drone_id != key_id:
            return "on_wrong_key"
        if key_id == self._drone_id:
            return "of_own_id"
        life = self._lives.get(key_id, {}).get(message.boot)
        if life is None:
            return "before_token"  # no loss: an announcement is asked for as soon as the token is there
        last = life.reported.get(type(message))
        if isinstance(message, AnnouncementMessage):
            last = None if life.announcement is None else life.announcement.sequence
        return "repeated" if last is not None and message.sequence <= last else None

    def alive(self, drone_id: int) -> tuple[str, ...]:
        """Live boots of one ID, including our own."""
        boots = tuple(self._lives.get(drone_id, {}))
        return (self._boot, *boots) if drone_id == self._drone_id else boots

    def speaking(self, drone_id: int) -> tuple[str, ...]:
        """Boots of one ID that are taken to be alive: one, or all of a clash."""
        if drone_id in self._clashing:
            return self.alive(drone_id)
        return (self._believed[drone_id],) if drone_id in self._believed else ()

    @property
    def peers(self) -> tuple[int, ...]:
        """IDs of all live teammates."""
        return tuple(i for i in self._lives if i != self._drone_id)

    @property
    def missing(self) -> tuple[int, ...]:
        """IDs whose announcement is to be requested."""
        return tuple(
            i
            for i, lives in self._lives.items()
            if i != self._drone_id and any(life.announcement is None for life in lives.values())
        )
