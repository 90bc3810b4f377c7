"""Parameters of a formation: leader, references, slots, and limits of a command."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields

from swarmtrack.formation.margins import LIMIT_BOUNDS

Place = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightLimits:
    """What no command ever exceeds. The autopilot's own limits stay as they are."""

    speed: float = 2.5
    """m/s, of the whole velocity."""
    climb: float = 1.0
    """m/s, up and down."""
    acceleration: float = 1.5
    """m/s²: how fast a command changes, but for evading. A drone tilts for it, and so does its camera: by 9° here."""
    evasion: float = 6.0
    """m/s²: how fast a command changes where it evades somebody, or a fence. No command ever changes faster."""
    yaw_rate: float = 0.8
    """rad/s"""
    yaw_acceleration: float = 3.0
    """rad/s²: how fast a yaw rate changes."""
    least_height: float = 2.0
    """m above the team frame's origin: nothing is commanded that leads below."""
    fence_radius: float = 50.0
    """m, level, around where it was engaged."""
    fence_height: float = 10.0
    """m above and below where it was engaged."""

    def __post_init__(self) -> None:
        for entry in fields(self):
            low, high = LIMIT_BOUNDS[entry.name]
            value = getattr(self, entry.name)
            if not low <= value <= high:
                raise ValueError(f"limits.{entry.name}: found {value!r}, expected {low:g} to {high:g}")


"""Least and most of each limit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FormationParameters:
    """Parameters of one drone in its formation.

    slots: by drone, [north, east, down] m from the leader, in team axes; the leader's own is (0, 0, 0). references: the
    drones by which this one finds its slot. height [m]: of the leader's slot above the team frame's origin; each drone
    holds its own slot's height by its own autopilot.
    """

    drone_id: int
    leader: int
    slots: Mapping[int, Place]
    references: tuple[int, ...]
    height: float
    limits: FlightLimits = field(default_factory=FlightLimits)
    gain: float = 0.6
    """1/s, on the error of the place. From 0.4 to 1.2 nobody was lost."""
    approach: float = 1.5
    """m/s: as fast a slot is flown to, beside the references' own velocity."""
    clearance: float = 1.5
    """m: nobody is to come nearer than this."""
    sure: float = 0.998
    """Of a reference's name, for a second, before it is flown by. By places alone no name of several is surer than
    0.997: more means that motion has shown it, so that swapped pads lead nobody astray."""

    def __post_init__(self) -> None:
        for drone in (self.drone_id, self.leader, *self.references):
            if drone not in self.slots:
                raise ValueError(
                    f"formation: drone {drone} has no slot, expected one of {sorted(self.slots)}"
                )
        if self.drone_id in self.references:
            raise ValueError(f"formation: drone {self.drone_id} is its own reference, expected others")
        if self.drone_id != self.leader and not self.references:
            raise ValueError(f"formation: drone {self.drone_id} has no reference, expected one or two")
        if not 0.9 <= self.sure < 1.0:
            raise ValueError(f"formation.sure: found {self.sure!r}, expected 0.9 to 1")
        numbers = [x for place in self.slots.values() for x in place]
        numbers += [self.height, self.gain, self.approach, self.clearance]
        if not all(map(math.isfinite, numbers)):
            raise ValueError("formation: holds NaN or infinity, expected numbers")

    @property
    def down(self) -> float:
        """Height of this drone's slot: m, down in the team frame."""
        return self.slots[self.drone_id][2] - self.height

    def wanted(self, reference: int) -> Place:
        """Wanted position of a reference relative to this drone's slot: m, team axes."""
        there, here = self.slots[reference], self.slots[self.drone_id]
        return there[0] - here[0], there[1] - here[1], there[2] - here[2]
