"""Frame errors: which teammates' reports are to be turned and shifted into our frame.

An announced start is measured by hand, and a compass may be wrong by degrees. The posterior of the team has, for each
teammate in view, how its frame stands to ours. Where that contradicts what was announced, that is reported, and until
it fits again the teammate's reports are turned and shifted into our frame. One pair of drones cannot tell which of the
two is wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from swarmtrack.geometry.frame_transform import FrameTransform
from swarmtrack.messages import Announcement, Array, MotionReport, SightingReport
from swarmtrack.relative.gates import GATE
from swarmtrack.relative.priors import (
    FRAME_JUDGED_EVERY_S,
    FRAME_JUDGED_TIMES,
    FRAME_OFF_LEAST_M,
    FRAME_OFF_LEAST_RAD,
    FRAME_PLACE_SIGMA_M,
)

FrameOf = Callable[[int], FrameTransform | None]
"""How the frame of a teammate stands to ours, by drone; None where it is not in view."""


class FrameNews(NamedTuple):
    """A teammate's start is off_m [m] and turn [rad] from where it was announced, in our frame; None: no more."""

    t: float
    drone_id: int
    off_m: float | None
    turn: float


@dataclass(slots=True)
class _Teammate:
    start: Announcement
    found: FrameTransform | None = None
    judged_t: float = float("-inf")
    contradicts: bool = False
    otherwise: int = 0
    """How often in a row it was otherwise than `contradicts`."""


class Frames:
    """Which teammates' frames are not as announced, and how these stand to ours."""

    def __init__(self, turn_sigma: float) -> None:
        """turn_sigma [rad]: by which two drones' headings disagree."""
        self._turn_sigma = turn_sigma
        self._teammates: dict[int, _Teammate] = {}

    def announce(self, said: Announcement) -> None:
        """A teammate announced its start. A new boot of its process resets all."""
        before = self._teammates.get(said.drone_id)
        if before is None or before.start.boot != said.boot:
            self._teammates[said.drone_id] = _Teammate(said)

    def judge(self, said: SightingReport, frame: FrameOf) -> FrameNews | None:
        """A teammate reports; frame: how its frame stands to ours by now. Returns what changed."""
        mate = self._teammates.get(said.observer)
        if mate is None or said.boot != mate.start.boot or said.t - mate.judged_t < FRAME_JUDGED_EVERY_S:
            return None
        found = frame(said.observer)
        if found is None:
            return None
        mate.judged_t, mate.found = said.t, found
        off, distance2 = self._off(found, mate.start)
        is_worth_it = float(np.linalg.norm(off)) > FRAME_OFF_LEAST_M or abs(found.turn) > FRAME_OFF_LEAST_RAD
        contradicts = distance2 > GATE[4] and is_worth_it
        mate.otherwise = mate.otherwise + 1 if contradicts != mate.contradicts else 0
        if mate.otherwise < FRAME_JUDGED_TIMES:
            return None
        mate.contradicts, mate.otherwise = contradicts, 0
        off_m = float(np.linalg.norm(off)) if contradicts else None
        return FrameNews(said.t, said.observer, off_m, found.turn)

    def transform(self, drone_id: int) -> FrameTransform | None:
        """Transform from a teammate's frame to ours; None where its frame is taken as announced."""
        mate = self._teammates.get(drone_id)
        return mate.found if mate is not None and mate.contradicts else None

    def report_in_ours(self, said: SightingReport) -> tuple[SightingReport, float | None]:
        """The report transformed into our frame, and the variance that its place has by that, of the worst axis, m²;
        None where its frame is taken as announced."""
        found = self.transform(said.observer)
        if found is None:
            return said, None
        place, cov = found.place(said.position)
        seen = tuple(replace(one, direction=found.rotation @ one.direction) for one in said.sightings)
        return replace(said, position=place, sightings=seen), float(np.linalg.eigvalsh(cov)[-1])

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
        cov[:3, :3] += 2.0 * start.position_cov + FRAME_PLACE_SIGMA_M**2 * np.eye(3)
        cov[3, 3] += self._turn_sigma**2
        miss = np.append(off, found.turn)
        return off, float(miss @ np.linalg.solve(cov, miss))
