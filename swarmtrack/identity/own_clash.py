"""Whether another process uses this drone's ID."""

from __future__ import annotations

from swarmtrack.messages import IdClash, Membership, PeerDeparted


class OwnClash:
    """A clash is announced with the boots of all processes, and is over once all but one have departed."""

    def __init__(self, drone_id: int) -> None:
        """drone_id: our own."""
        self._drone_id = drone_id
        self._boots: frozenset[str] = frozenset()

    def __bool__(self) -> bool:
        return bool(self._boots)

    def on_membership(self, event: Membership) -> None:
        """Events about teammates change nothing."""
        if isinstance(event, IdClash) and event.ours:
            self._boots = frozenset(event.boots)
        elif isinstance(event, PeerDeparted) and event.drone_id == self._drone_id:
            left = self._boots - {event.boot}
            self._boots = left if len(left) > 1 else frozenset()
