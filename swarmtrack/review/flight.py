"""A recorded flight of a team as plain series over time, on one clock that begins at 0 s."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from swarmtrack.messages import Array, Identity
from swarmtrack.wire.health import HealthMessage


class ConfirmedLook(NamedTuple):
    """One confirmed track. probability: of its name.

    bearing (3,): unit vector in the axes of its camera; position (3,) m and cov (3, 3) m²: of its teammate from the
    observer's camera, team axes (NED); None while unknown. camera: its index in the config.
    """

    identity: Identity
    probability: float
    bearing: Array | None = None
    position: Array | None = None
    cov: Array | None = None
    camera: int = 0


class Stand(NamedTuple):
    """Own pose by the drone's own belief. position (3,) m, team frame; world_from_body (3, 3)."""

    position: Array
    world_from_body: Array


class ReviewedScan(NamedTuple):
    """One scan, some of all: confirmed tracks at t [s], and where the drone stood; None where it did not know."""

    t: float
    stand: Stand | None
    looks: tuple[ConfirmedLook, ...]
    camera: int = 0


class Life(NamedTuple):
    """One run of the drone's agent, from begin to end [s]."""

    boot: str
    begin: float
    end: float


class ReportedPlace(NamedTuple):
    """A teammate's report of its place that arrived at t [s]. sent_t: when it was exposed. key: which report it is."""

    t: float
    sent_t: float
    observer: int
    position: Array
    key: tuple[int, str, int]


class FollowerCommand(NamedTuple):
    """A follower's set point. holds: the drone stops and stays; text: why."""

    t: float
    holds: bool
    why: str
    text: str


class ReviewedLens(NamedTuple):
    """One camera as its config has it. body_from_camera (3, 3); half_field (2,): tangents of half its field of view."""

    body_from_camera: Array
    half_field: tuple[float, float]


@dataclass(slots=True)
class DroneFlight:
    """What one drone recorded, or what was heard of it (`recorded` is False). Times [s] on the flight's clock.

    frames (n, 2): t, number of detections.
    asked_fps: by the camera's address; None where nothing is asked for.
    """

    drone_id: int
    lives: list[Life] = field(default_factory=list)
    recorded: bool = True
    asked_fps: float | None = None
    max_age_s: float = math.inf
    lenses: tuple[ReviewedLens, ...] = ()
    health: list[tuple[float, HealthMessage]] = field(default_factory=list)
    scans: list[ReviewedScan] = field(default_factory=list)
    frames: Array = field(default_factory=lambda: np.empty((0, 2)))
    imu: Array = field(default_factory=lambda: np.empty(0))
    placeless: Array = field(default_factory=lambda: np.empty(0))
    """Times of poses without a position."""
    placed: Array = field(default_factory=lambda: np.empty(0))
    heard: list[ReportedPlace] = field(default_factory=list)
    sent: dict[tuple[int, str, int], float] = field(default_factory=dict)
    """Its own reports, with their times."""
    alive: list[tuple[float, int, bool]] = field(default_factory=list)
    """Which teammates came and left, as it noticed."""
    reboots: list[float] = field(default_factory=list)
    clashes: list[tuple[float, int, tuple[str, ...]]] = field(default_factory=list)
    announced: list[tuple[float, int]] = field(default_factory=list)
    commands: list[FollowerCommand] = field(default_factory=list)
    damage: list[str] = field(default_factory=list)
    refused: int = 0

    _reports: dict[int, list[ReportedPlace]] = field(default_factory=dict)

    def reports_of(self, teammate: int) -> list[ReportedPlace]:
        """Reports of one teammate, in the order of sending; complete only once all have been read."""
        if teammate not in self._reports:
            said = [one for one in self.heard if one.observer == teammate]
            self._reports[teammate] = sorted(said, key=lambda one: one.sent_t)
        return self._reports[teammate]

    @property
    def begin(self) -> float:
        return min((life.begin for life in self.lives), default=0.0)

    @property
    def end(self) -> float:
        return max((life.end for life in self.lives), default=0.0)


class NameSpan(NamedTuple):
    """From begin to end [s]. state: named, wrong, unnamed (a track without a name may be it), undetected (in view, and
    there is no track), away (out of view), blind (the camera or the agent is silent). why: in words."""

    begin: float
    end: float
    state: str
    why: str


class Naming(NamedTuple):
    """How one observer named one teammate over the flight."""

    observer: int
    teammate: int
    spans: tuple[NameSpan, ...]


@dataclass(slots=True)
class ReviewedFlight:
    """A flight. begin_utc_s: when its clock began; truth: rows of t, north, east, down by drone, empty where unknown;
    clock_shifts: by drone, how far its wall clock was from the first one's, where messages show it [s]."""

    team: str
    begin_utc_s: float
    seconds: float
    drones: dict[int, DroneFlight]
    truth: Mapping[int, Array] = field(default_factory=dict)
    clock_shifts: Mapping[int, float] = field(default_factory=dict)
    swarm_damage: list[str] = field(default_factory=list)
    namings: dict[int, list[Naming]] = field(default_factory=dict)
    """By observer, as far as `names` has made them."""

    def true_place(self, drone_id: int, t: float) -> Array | None:
        rows = self.truth.get(drone_id)
        if rows is None or not rows[0, 0] <= t <= rows[-1, 0]:
            return None
        return np.array([np.interp(t, rows[:, 0], rows[:, k]) for k in (1, 2, 3)])
