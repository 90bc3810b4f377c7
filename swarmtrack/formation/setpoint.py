"""Input of a formation about the own drone, and its output."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from typing import NamedTuple

from swarmtrack.formation.margins import FARTHEST_FROM_ORIGIN_M, FASTEST_OWN_SPEED_M_S
from swarmtrack.relative.heights import HeightSight

Velocity = tuple[float, float, float]
STANDSTILL: Velocity = (0.0, 0.0, 0.0)


class Why(enum.StrEnum):
    """Reason of a set point."""

    FOLLOW = "follow"  # flies to its slot, and along with its references
    HEIGHT = "height"  # climbs or descends to its slot's height first
    ENTRY = "entry"  # a reference is named, not for long enough
    FADE = "fade"  # the last reference has just been lost: slows down
    NO_REFERENCE = "no_reference"  # holds its place
    OWN_POSE = "own_pose"  # the own pose is old, or none
    VAGUE = "vague"  # the own place is not known well enough
    HEIGHT_VAGUE = "height_vague"  # the own height is not, and that above a reference is not measured
    GYRO = "gyro"
    CAMERA = "camera"
    CLASH = "clash"
    DOUBT = "doubt"
    HEADING = "heading"
    HEIGHT_DOUBT = "height_doubt"  # the own height drifts, or that of who is followed
    DIVERGES = "diverges"  # it flies otherwise than it was told
    CLOCK = "clock"
    NOT_ENGAGED = "not_engaged"
    BROKEN = "broken"  # what came of it was no number

    @property
    def holds(self) -> bool:
        """Whether the drone stops and stays."""
        return self not in (Why.FOLLOW, Why.HEIGHT)


class OwnSway(NamedTuple):
    """Current sway about the own height by the drone's code (`motion.sway`): m and m/s, down."""

    down: float
    speed: float


NO_SWAY = OwnSway(0.0, 0.0)


@dataclass(frozen=True, slots=True)
class OwnFlight:
    """This drone itself, by its own autopilot, at the time of a command.

    position [m] and velocity [m/s] in the team frame; position_sigma [m], level, and height_sigma [m]; heading [rad]:
    where its camera looks, clockwise from north. Ages [s]: of the newest pose, of the newest gyro sample, by camera of
    the exposure of its newest scan that showed anything new, since the heading last stepped and since `position` last
    followed a leap; inf where there was none.
    clash: another process uses this drone's ID; doubted: what it sees tells that its own start or heading is wrong;
    clock_known: the autopilot's clock is mapped. sways: as its code has it. ground [m]: what is below it, by the last
    measurement of its range finder; None where there is none, or none of the last second. height_sights: of the last
    scan, by which the own height is tried. is_carried: position and velocity are by teammates, and velocity_sigma [m/s]
    is the velocity's worst axis; 0 by the autopilot.
    """

    position: Velocity
    velocity: Velocity
    heading: float
    position_sigma: float = 0.1
    height_sigma: float = 0.1
    pose_age: float = 0.0
    gyro_age: float = 0.0
    scan_ages: tuple[float, ...] = (0.0,)
    heading_step_age: float = math.inf
    leap_age: float = math.inf
    clash: bool = False
    doubted: bool = False
    clock_known: bool = True
    sways: OwnSway = NO_SWAY
    ground: float | None = None
    height_sights: tuple[HeightSight, ...] = ()
    is_carried: bool = False
    velocity_sigma: float = 0.0

    @property
    def is_possible(self) -> bool:
        """Whether these numbers are possible for a drone."""
        north, east, down = self.velocity
        near = all(abs(x) < FARTHEST_FROM_ORIGIN_M for x in self.position)
        return near and math.hypot(north, east, down) < FASTEST_OWN_SPEED_M_S and math.isfinite(self.heading)


class Setpoint(NamedTuple):
    """Set point from t [s] on. velocity [m/s] NED in team axes; yaw_rate [rad/s], clockwise seen from above.

    text: why, for people. error [m]: how far off its slot the drone is, level; None if unknown. clear_of: the tracks
    that the velocity was bent away from. nearest [m]: lower bound of the smallest range to a track; None without one
    nearby, or if unknown.
    """

    t: float
    velocity: Velocity
    yaw_rate: float
    why: Why
    text: str
    error: float | None = None
    clear_of: tuple[int, ...] = ()
    nearest: float | None = None

    @property
    def holds(self) -> bool:
        return self.why.holds
