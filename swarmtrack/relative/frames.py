"""Frame errors: each teammate's sightings are aligned with its reported positions.

An announced start is measured by hand, and a compass may be wrong by degrees. A teammate that reports its place while
it flies across our view tells, by `alignment.py`, how its frame really stands to ours, and nothing of that uses the
start. Where it contradicts what was announced, that is said, and until it fits again what the teammate says is turned
and shifted into our frame. Which of the two is wrong, one pair of drones cannot tell.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from swarmtrack.messages import Announcement, Array, MotionReport, SightingReport
from swarmtrack.relative.alignment import WINDOW_S, FrameSight, FrameTransform, SightErrors, align
from swarmtrack.relative.gates import GATE
from swarmtrack.relative.looks import TeamLook
from swarmtrack.relative.parameters import RelativeParameters

# s of own rays; how far from a report's time a ray may be; and between two sightings that are used.
MEMORY_S, SIMULTANEOUS_S, APART_S = 2.0, 0.12, 0.4
# s between two solutions of one teammate.
SOLVE_S = 1.5
# m: of two places that are compared, as clocks and scans are apart, and as nobody tells where its camera is.
PLACE_M = 0.1
# rad: of a ray, one sigma; the observer's attitude lasts, but not for the window.
RAY_SIGMA = 8e-3
# How often in a row a frame must contradict, or fit, before that is said.
SURE_AFTER = 3
# How large the least is that is worth a word: m, rad.
WORTH_M, WORTH_RAD = 0.5, math.radians(4.0)


class FrameNews(NamedTuple):
    """A teammate's start is off_m [m] and turn [rad] from where it was announced, in our frame; None: no more."""

    t: float
    drone_id: int
    off_m: float | None
    turn: float


@dataclass(slots=True)
class _Teammate:
    boot: str = ""
    sights: deque[FrameSight] = field(default_factory=deque)
    solved_t: float = -math.inf
    found: FrameTransform | None = None
    contradicts: bool = False
    otherwise: int = 0
    """How often in a row it was otherwise than `contradicts`."""


class Frames:
    """Transforms to teammates' frames, from looks, announcements and reports."""

    def __init__(self, drone_id: int, parameters: RelativeParameters | None = None) -> None:
        self._drone_id = drone_id
        self._p = p = parameters or RelativeParameters()
        white = math.hypot(p.box_width.wander_sigma, p.box_width.white_sigma)
        self._errors = SightErrors(RAY_SIGMA, PLACE_M, white, p.lasting, p.place_drift, p.turn_drift)
        self._looks: deque[TeamLook] = deque()
        self._starts: dict[int, Announcement] = {}
        self._teammates: dict[int, _Teammate] = {}

    def add_look(self, look: TeamLook) -> None:
        """Add a scan's look."""
        self._looks.append(look)
        while self._looks[0].t < look.t - MEMORY_S:
            self._looks.popleft()

    def announce(self, said: Announcement) -> None:
        """A teammate announced its start. A new boot of its process resets all."""
        before = self._starts.get(said.drone_id)
        if before is None or before.boot != said.boot:
            self._starts[said.drone_id] = said
            self._teammates.pop(said.drone_id, None)

    def add_report(self, said: SightingReport) -> FrameNews | None:
        """Add a teammate's report of its position; returns what changed."""
        drone = said.observer
        start, sight = self._starts.get(drone), self._sight(said)
        if start is None or sight is None or said.boot != start.boot:
            return None
        mate = self._teammates.setdefault(drone, _Teammate())
        if mate.sights and sight.t - mate.sights[-1].t < APART_S:
            return None
        mate.sights.append(sight)
        while mate.sights[0].t < sight.t - WINDOW_S:
            mate.sights.popleft()
        if sight.t - mate.solved_t < SOLVE_S:
            return None
        mate.solved_t = sight.t
        found = align(mate.sights, sight.t, self._errors)
        if found is None:
            return None
        mate.found = found
        off, distance2 = self._off(found, start)
        worth = float(np.linalg.norm(off)) > WORTH_M or abs(found.turn) > WORTH_RAD
        contradicts = distance2 > GATE[4] and worth
        mate.otherwise = mate.otherwise + 1 if contradicts != mate.contradicts else 0
        if mate.otherwise < SURE_AFTER:
            return None
        mate.contradicts, mate.otherwise = contradicts, 0
        return FrameNews(said.t, drone, float(np.linalg.norm(off)) if contradicts else None, found.turn)

    def transform(self, drone_id: int) -> FrameTransform | None:
        """Transform from a teammate's frame to ours; None where its frame is taken as announced."""
        mate = self._teammates.get(drone_id)
        return mate.found if mate is not None and mate.contradicts else None

    def report_in_ours(self, said: SightingReport) -> SightingReport:
        """The report transformed into our frame."""
        found = self.transform(said.observer)
        if found is None:
            return said
        seen = tuple(replace(one, direction=found.rotation @ one.direction) for one in said.sightings)
        return replace(said, position=found.place(said.position)[0], sightings=seen)

    def motion_in_ours(self, said: MotionReport) -> MotionReport:
        """The motion transformed to our axes."""
        found = self.transform(said.drone_id)
        if found is None:
            return said
        turned = found.rotation
        return replace(
            said,
            displacement=turned @ said.displacement,
            displacement_cov=turned @ said.displacement_cov @ turned.T,
            velocity=turned @ said.velocity,
            velocity_cov=turned @ said.velocity_cov @ turned.T,
        )

    def _off(self, found: FrameTransform, start: Announcement) -> tuple[Array, float]:
        """(3,) m by which its start is elsewhere, and how unlikely that and the turn are: squared Mahalanobis."""
        place, _ = found.place(start.position)
        off = place - start.position
        J = np.eye(4)
        J[:3, 3] = -(place - found.shift)[1], (place - found.shift)[0], 0.0
        cov = J @ found.cov @ J.T
        cov[:3, :3] += 2.0 * start.position_cov + PLACE_M**2 * np.eye(3)
        cov[3, 3] += self._p.turn_sigma**2
        miss = np.append(off, found.turn)
        return off, float(miss @ np.linalg.solve(cov, miss))

    def _sight(self, said: SightingReport) -> FrameSight | None:
        """What we saw of the teammate when it said where it is, with the camera that showed it then."""
        near = [look for look in self._looks if abs(look.t - said.t) < SIMULTANEOUS_S]
        for look in sorted(near, key=lambda look: abs(look.t - said.t)):
            row = _row_of(said.observer, look)
            if row is not None:
                return self._seen(said, look, row)
        return None

    def _seen(self, said: SightingReport, look: TeamLook, row: int) -> FrameSight:
        back = next((seen.direction for seen in said.sightings if seen.drone_id == self._drone_id), None)
        log_range = math.log(self._p.width_m / look.width[row]) if look.width[row] > 0.0 else math.nan
        gain = float(look.gain[row])
        return FrameSight(said.t, look.camera, said.position, look.ray[row], log_range, back, gain)


def _row_of(drone_id: int, look: TeamLook) -> int | None:
    """Of a teammate in a look; None where another camera saw it, or nobody."""
    row = next((i for i, key in enumerate(look.keys) if key[0] == drone_id), None)
    return row if row is not None and math.isfinite(float(look.ray[row, 0])) else None
