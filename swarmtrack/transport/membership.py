"""Who is in the team right now. Told of liveliness tokens and messages; answers with events.

Theory of operation. A process is alive from the moment its token `alive/<id>/<boot>` is seen until it goes. The boot
names one life of the process, so a restart is a new boot, and two boots of one ID at the same time are two
processes that speak as one drone: an `IdClash`, told again for each further one, which ends with the `PeerDeparted` of
all but one. A message counts once its boot is alive, and if its sequence is higher than the last of that boot; whoever
is alive without an announcement is `missing` and to be asked, again and again, because whatever was put before the
links stood is lost. Whoever departs is forgotten, so that after a healed partition its announcement is asked for and
told anew.

While two clash both their announcements are told. When one is left, its announcement is told once more: whoever
believed neither during the clash has something to start from, and whoever believed the later one is put right.

A clone of our own ID is reported as clash and departure only: we have no teammate of our own name.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from swarmtrack.messages import Announcement, IdClash, PeerArrived, PeerDeparted, PeerEvent
from swarmtrack.transport.sender_clock import SenderClock
from swarmtrack.wire.announcement import AnnouncementMessage
from swarmtrack.wire.motion import MotionMessage
from swarmtrack.wire.sightings import SightingsMessage

Numbered = AnnouncementMessage | SightingsMessage | MotionMessage

MAX_PEERS = 1024  # live IDs; beyond it is an attack or a mistake
# As counters name them.
_NAMES = {AnnouncementMessage: "announcements", SightingsMessage: "sightings", MotionMessage: "motion"}
MAX_BOOTS = 4  # of one ID at a time


@dataclass(slots=True)
class LiveBoot:
    """What is known of one live boot."""

    announcement: Announcement | None = None
    reported: dict[type[Numbered], int] = field(default_factory=dict)
    """The sequence of its last report of each kind."""
    clock: SenderClock = field(default_factory=SenderClock)


class Membership:
    """Pure state. `counters` holds, by reason, how often something was refused."""

    def __init__(self, drone_id: int, boot: str) -> None:
        self._drone_id = drone_id
        self._boot = boot
        self._lives: dict[int, dict[str, LiveBoot]] = {}  # by ID, by boot
        self.counters: Counter[str] = Counter()

    def arrived(self, drone_id: int, boot: str) -> list[PeerEvent]:
        """A token was seen."""
        ours = drone_id == self._drone_id
        if ours and boot == self._boot:
            return []
        lives = self._lives.get(drone_id, {})
        if boot in lives:
            return []
        if len(lives) >= MAX_BOOTS or (not lives and len(self._lives) >= MAX_PEERS):
            self.counters["tokens_beyond_limit"] += 1
            return []
        self._lives[drone_id] = {**lives, boot: LiveBoot()}
        events: list[PeerEvent] = [] if ours else [PeerArrived(drone_id, boot)]
        alive = self.alive(drone_id)
        if len(alive) > 1:
            events.append(IdClash(drone_id, alive, ours))
        return events

    def departed(self, drone_id: int, boot: str) -> list[PeerEvent]:
        """A token went."""
        lives = self._lives.get(drone_id, {})
        if boot not in lives:
            return []
        del lives[boot]
        if not lives:
            del self._lives[drone_id]
        events: list[PeerEvent] = [PeerDeparted(drone_id, boot)]
        if len(lives) == 1 and drone_id != self._drone_id:
            (left,) = lives.values()
            if left.announcement is not None:
                events.append(left.announcement)
        return events

    def life(self, key_id: int, message: Numbered) -> LiveBoot | None:
        """Whose message it is that came on a key of `key_id`; None where it does not count, and is counted."""
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
        """The live boots of one ID, our own among them."""
        boots = tuple(self._lives.get(drone_id, {}))
        return (self._boot, *boots) if drone_id == self._drone_id else boots

    @property
    def peers(self) -> tuple[int, ...]:
        """The IDs of all live teammates."""
        return tuple(i for i in self._lives if i != self._drone_id)

    @property
    def missing(self) -> tuple[int, ...]:
        """The IDs whose announcement is to be asked for."""
        return tuple(
            i
            for i, lives in self._lives.items()
            if i != self._drone_id and any(life.announcement is None for life in lives.values())
        )
