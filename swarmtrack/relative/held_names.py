"""Tracks whose names have just ended, for a while with these names.

A name ends when its teammate is no longer where it should be, as seen from the own place. If the own place is what is
wrong, a filter that doubts it needs the rays to those teammates, and more of them than come until the names end. A
track rarely goes over to another target, so within some seconds it still is whose it was.
"""

from __future__ import annotations

from dataclasses import replace

from swarmtrack.messages import IdentifiedTrack
from swarmtrack.relative.priors import NAME_HELD_S


class HeldNames:
    """Asked for every scan."""

    def __init__(self) -> None:
        self._named: dict[int, tuple[int, float]] = {}
        """By track: its last name, and when it had that [s]."""

    def of(self, tracks: tuple[IdentifiedTrack, ...], t: float) -> tuple[IdentifiedTrack, ...]:
        """The tracks after a scan at t; each that is unknown or foreign with the name that it had until just now, if no
        other track has it. The same object, if there is none."""
        names = {entry.track.id: entry.identity for entry in tracks if isinstance(entry.identity, int)}
        taken = set(names.values())
        held = {
            track: (drone, since)
            for track, (drone, since) in self._named.items()
            if t - since < NAME_HELD_S and track not in names and drone not in taken
        }
        self._named = held | {track: (drone, t) for track, drone in names.items()}
        if held.keys().isdisjoint(entry.track.id for entry in tracks):
            return tracks
        return tuple(
            replace(entry, identity=held[entry.track.id][0]) if entry.track.id in held else entry
            for entry in tracks
        )
