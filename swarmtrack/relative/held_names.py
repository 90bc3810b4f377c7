"""Tracks that had a name until just now, for a while with that name.

A name ends when its teammate is no longer where it should be, as seen from the own place. If the own place is what is
wrong, a filter that doubts it needs the rays to those teammates, and more of them than come until the names end. A
track rarely goes over to another target, so within some seconds it still is whose it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from swarmtrack.messages import IdentifiedTrack
from swarmtrack.relative.priors import NAME_HELD_S


class HeldNames:
    """Asked for every scan."""

    def __init__(self) -> None:
        self._named: dict[int, tuple[int, float]] = {}
        """By track: its last name, and when it had that [s]."""

    def of(self, tracks: Sequence[IdentifiedTrack], t: float) -> tuple[IdentifiedTrack, ...]:
        """Tracks after a scan at t that are unknown or foreign, each with the name that it had until just now, if no
        other track has it."""
        names = {entry.track.id: entry.identity for entry in tracks if isinstance(entry.identity, int)}
        taken = set(names.values())
        held = {
            track: (drone, since)
            for track, (drone, since) in self._named.items()
            if t - since < NAME_HELD_S and track not in names and drone not in taken
        }
        self._named = held | {track: (drone, t) for track, drone in names.items()}
        return tuple(
            replace(entry, identity=held[entry.track.id][0]) for entry in tracks if entry.track.id in held
        )
