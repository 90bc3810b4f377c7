"""Who is in the team, as far as this drone has heard: who has announced itself, who lives and has not, whose process is
gone, and as whom two processes speak."""

from __future__ import annotations

from collections.abc import Set

from swarmtrack.identity.own_clash import OwnClash
from swarmtrack.identity.whereabouts import Whereabouts
from swarmtrack.messages import Announcement, IdClash, Membership, PeerArrived, PeerDeparted, PeerExpelled

# s after which a drone whose process is gone, and which no track was since, is no candidate any more. A radio that
# parts a team may do so for minutes.
DEPARTED_S = 300.0


class Teammates:
    """Told of announcements and of who lives. whereabouts: where those are that have announced themselves."""

    def __init__(self, drone_id: int) -> None:
        """drone_id: our own."""
        self.whereabouts = Whereabouts()
        self.own_clash = OwnClash(drone_id)
        self._drone_id = drone_id
        self._unannounced: set[int] = set()
        self._departed: dict[int, float | None] = {}
        """By drone whose process is gone: since when it has had no track, s; None: not known yet."""
        self._clashing: dict[int, set[str]] = {}
        """By drone that several processes speak as: their boots."""

    @property
    def announced(self) -> dict[int, Announcement]:
        """The latest announcement of each."""
        return self.whereabouts.announced

    @property
    def clashing(self) -> Set[int]:
        """As whom two processes speak: nobody can tell which pose is its own."""
        return self._clashing.keys()

    @property
    def unplaced(self) -> Set[int]:
        """Who is alive with no pose that we know: these may be any track."""
        return self._unannounced | self._clashing.keys()

    @property
    def unlocated(self) -> int:
        """How many are `unplaced`."""
        return len(self.unplaced)

    def is_heard(self, drone_id: int) -> bool:
        """Whether what is said in its name counts: no word in ours does, and none of one that clashes."""
        return drone_id != self._drone_id and drone_id not in self._clashing

    def is_news(self, announcement: Announcement) -> bool:
        """Whether it counts, and is newer than what was heard before."""
        known = self.announced.get(announcement.drone_id)
        repeated = known and known.boot == announcement.boot and known.sequence >= announcement.sequence
        return self.is_heard(announcement.drone_id) and not repeated

    def announce(self, announcement: Announcement) -> None:
        """A drone says where it is."""
        self.whereabouts.announce(announcement)
        self._unannounced.discard(announcement.drone_id)

    def on_membership(self, event: Membership) -> None:
        """Who lives."""
        self.own_clash.on_membership(event)
        drone = event.drone_id
        match event:
            case PeerArrived():
                self._departed.pop(drone, None)
                if drone != self._drone_id and drone not in self.announced:
                    # Until it announces itself it may be any track.
                    self._unannounced.add(drone)
            case IdClash(boots=boots, ours=False):
                self._clashing[drone] = set(boots)
                self.whereabouts.forget(drone)
            case PeerExpelled():
                self.whereabouts.forget(drone)
                self._unannounced.discard(drone)
                self._departed.pop(drone, None)
            case PeerDeparted(boot=boot):
                clash = self._clashing.get(drone, set())
                clash.discard(boot)
                if len(clash) == 1:
                    del self._clashing[drone]
                    # The pose of the one that remains is yet to be heard.
                    self._unannounced.add(drone)
                elif not clash:
                    # The drone is still where it is, and so, for a while, is its pose.
                    self._unannounced.discard(drone)
                    self._departed[drone] = None

    def forget(self, t: float, named: Set[int]) -> None:
        """Drop the poses of drones that are long gone, unless a track has their name."""
        for drone, since in self._departed.items():
            if since is None or drone in named:
                self._departed[drone] = t
            elif t - since > DEPARTED_S:
                self.whereabouts.forget(drone)
        self._departed = {drone: since for drone, since in self._departed.items() if drone in self.announced}
