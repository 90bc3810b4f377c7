"""A drone that flies in formation: what it perceives, handed to the law; and the law's answer, in its autopilot's axes.

Pure, like all that it reads. What was perceived, the time and `Engagement` decide a setpoint, and nothing else: so a
recording gives the same ones.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

from swarmtrack.formation.formation import Formation, lowest
from swarmtrack.formation.parameters import FormationParameters
from swarmtrack.formation.setpoint import STANDSTILL, Setpoint, Velocity, Why
from swarmtrack.messages import TrackList
from swarmtrack.perceived import FormationView


class Engagement(NamedTuple):
    """number: counts how often a pilot has engaged it, 0: not now; clock_known: of the autopilot, mapped to ours."""

    number: int
    clock_known: bool = True


class LocalSetpoint(NamedTuple):
    """What is sent: velocity [m/s] in the axes of the autopilot's local frame (NED), yaw_rate [rad/s]; and whose
    `setpoint` it is, in the team's axes. room [m]: from the drone down to its least height, NaN if unknown.
    """

    velocity: Velocity
    yaw_rate: float
    setpoint: Setpoint
    room: float = math.nan


class Follower:
    """One follower. Ask it ten times per second; `tracks` are those of the same time."""

    def __init__(self, parameters: FormationParameters) -> None:
        self.formation = Formation(parameters)
        self._engaged = 0

    def command(self, perceived: FormationView, tracks: TrackList, engagement: Engagement) -> LocalSetpoint:
        """What to fly from `tracks.t` on; standing still where it is not engaged."""
        t = tracks.t
        if engagement.number != self._engaged:
            self._engaged = engagement.number
            self.formation.engage()
        if not engagement.number:
            return LocalSetpoint(
                STANDSTILL, 0.0, Setpoint(t, STANDSTILL, 0.0, Why.NOT_ENGAGED, "not engaged")
            )
        own = perceived.own_flight(t)
        if own is None:
            return LocalSetpoint(
                STANDSTILL, 0.0, Setpoint(t, STANDSTILL, 0.0, Why.OWN_POSE, "own position is unknown")
            )
        own = replace(own, clock_known=engagement.clock_known)
        states = perceived.anybody(t)
        states |= {entry.track.id: entry.relative for entry in tracks.tracks if entry.relative is not None}
        setpoint = self.formation.command(states, own, tracks.tracks, t)
        north, east, down = (setpoint.velocity @ perceived.team_from_local).tolist()
        room = lowest(self.formation.parameters.limits, own) - own.position[2]
        return LocalSetpoint((north, east, down), setpoint.yaw_rate, setpoint, room)
