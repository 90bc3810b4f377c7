"""Do the others see the same drone where this one sees it?

Every drone reports on which rays it sees which drones, and where it stands itself. Two rays to one drone must meet in
front of both observers; a ray to the reporter itself must pass through where it says it stands. Where they do not, one
of the two is wrong, and that is news. A report too vague to be wrong is none.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from swarmtrack.geometry.pose import Pose
from swarmtrack.identity.reprojection import LastSeen
from swarmtrack.messages import Array, Sighting, SightingReport
from swarmtrack.motion.ego import TeamPose

# s of own rays: a report arrives within it.
MEMORY_S = 2.0
# s between two rays that may be compared.
SIMULTANEOUS = 0.3
# m/s: how far a drone goes in between.
SPEED = 1.5
# rad: how well two autopilots agree on north, and cameras on their mounting.
FRAME_SIGMA = 0.03
# Squared Mahalanobis distance: 4 σ.
GATE = 16.0
# m along a ray.
NEAREST, FARTHEST = 0.3, 300.0
# rad: an observer whose autopilot is silent for so long does not know where it looks.
LOST_ATTITUDE = 0.3
# Vaguer than this a report agrees with everything: s, m, rad.
VAGUE_T, VAGUE_PLACE, VAGUE_RAY = 0.5, 10.0, 0.3


class OwnSighting(NamedTuple):
    """The ray to an identified drone, how surely it is that drone, and whether motion alone says so."""

    ray: LastSeen
    probability: float
    is_confirmed: bool = False


class Disagreement(NamedTuple):
    """observer and this drone see drone_id on rays that miss each other by miss_m metres."""

    observer: int
    drone_id: int
    miss_m: float


@dataclass(frozen=True, slots=True, eq=False)
class OwnView:
    """What this drone saw in one scan: position (3,) m of its camera, and its sightings by drone. t_sigma [s]: of when
    it was there, by its autopilot's clock. leans_on: on whom its position rests, where teammates carry it.
    """

    t: float
    position: Array
    position_sigma: float
    sightings: dict[int, Sighting]
    t_sigma: float = 0.0
    leans_on: tuple[int, ...] = ()

    @classmethod
    def of(
        cls,
        observer: TeamPose,
        body_from_camera: Pose,
        seen: Iterable[OwnSighting],
        leans_on: tuple[int, ...] = (),
    ) -> OwnView:
        """seen: the rays to identified drones; of none who does not know where it looks."""
        sightings = {
            ray.drone_id: Sighting(
                ray.drone_id, p, ray.direction, math.hypot(ray.sigma, observer.attitude_sigma), is_confirmed
            )
            for ray, p, is_confirmed in seen
            if observer.attitude_sigma < LOST_ATTITUDE
        }
        position = observer.position + observer.world_from_body @ body_from_camera.position
        return cls(observer.t, position, observer.position_sigma, sightings, observer.t_sigma, leans_on)

    def report(self, drone_id: int, boot: str, sequence: int, known: Iterable[int]) -> SightingReport:
        """The same as its team hears it. known: whose announcements the drone has."""
        return SightingReport(
            observer=drone_id,
            boot=boot,
            sequence=sequence,
            t=self.t,
            t_sigma=self.t_sigma,
            position=self.position,
            position_sigma=self.position_sigma,
            known=tuple(sorted(known)),
            sightings=tuple(self.sightings.values()),
            leans_on=self.leans_on,
        )


class Consensus:
    """Compares reports with this drone's own rays."""

    def __init__(self) -> None:
        self._views: deque[OwnView] = deque()
        self.agreed = 0
        self.disagreed = 0

    @property
    def counters(self) -> dict[str, int]:
        """What others said of what this drone sees."""
        return {"sightings_agreed": self.agreed, "sightings_disagreed": self.disagreed}

    def remember(self, view: OwnView) -> None:
        """The rays of a scan of our own."""
        self._views.append(view)
        while self._views[0].t < view.t - MEMORY_S:
            self._views.popleft()

    def compare(self, report: SightingReport) -> list[Disagreement]:
        """What the report says against our own rays."""
        view = min(self._views, key=lambda view: abs(view.t - report.t), default=None)
        if view is None or abs(view.t - report.t) > SIMULTANEOUS + report.t_sigma:
            return []
        if report.t_sigma > VAGUE_T or report.position_sigma > VAGUE_PLACE:
            return []
        moved = SPEED * (abs(view.t - report.t) + report.t_sigma)
        reported = {seen.drone_id: seen for seen in report.sightings if seen.sigma <= VAGUE_RAY}
        found = []
        for drone_id, ours in view.sightings.items():
            if drone_id == report.observer:
                miss, distance = miss_of_point(view, ours, report, moved)
            elif drone_id in reported:
                miss, distance = miss_of_rays(view, ours, report, reported[drone_id], moved)
            else:
                continue
            if distance <= GATE:
                self.agreed += 1
            else:
                self.disagreed += 1
                found.append(Disagreement(report.observer, drone_id, miss))
        return found


def stands_there(own: SightingReport, ray: Sighting, report: SightingReport) -> bool:
    """Whether our ray to a teammate leads to where it says it stands, within `FARTHEST`; a vague report is no place."""
    vague = report.t_sigma > VAGUE_T or report.position_sigma > VAGUE_PLACE
    if vague or float(np.linalg.norm(report.position - own.position)) > FARTHEST:
        return False
    moved = SPEED * (abs(own.t - report.t) + report.t_sigma)
    return miss_of_point(own, ray, report, moved)[1] <= GATE


def miss_of_point(
    view: OwnView | SightingReport, ours: Sighting, report: SightingReport, moved: float
) -> tuple[float, float]:
    """How far our ray passes by where the reporter says it stands: metres, and squared Mahalanobis distance."""
    towards = report.position - view.position
    length = max(float(np.linalg.norm(towards)), NEAREST)
    place = math.hypot(view.position_sigma, report.position_sigma, moved)
    return _off_axis(ours, towards, length, place)


def miss_of_rays(
    view: OwnView, ours: Sighting, report: SightingReport, theirs: Sighting, moved: float
) -> tuple[float, float]:
    """How far apart two rays pass, both looked along from their observers: metres, squared Mahalanobis distance.

    They pass closest at `NEAREST` ahead of each observer or more, and at `FARTHEST` or less. Rays that errors turned
    apart pass closest right there and may yet be to one drone far off, so that is tried as well.
    """
    between = report.position - view.position
    cosine = float(ours.direction @ theirs.direction)
    a, b = float(between @ ours.direction), float(between @ theirs.direction)
    sine2 = max(1.0 - cosine**2, 1e-9)
    s = min(max((a - cosine * b) / sine2, NEAREST), FARTHEST)
    r = min(max((cosine * a - b) / sine2, NEAREST), FARTHEST)

    def miss_at(s: float, r: float) -> tuple[float, float]:
        """s [m] along our ray and r along theirs, if both see what is halfway between."""
        on_ours, on_theirs = view.position + s * ours.direction, report.position + r * theirs.direction
        middle = 0.5 * (on_ours + on_theirs)
        _, by_ours = _off_axis(ours, middle - view.position, s, math.hypot(view.position_sigma, moved))
        _, by_theirs = _off_axis(theirs, middle - report.position, r, report.position_sigma)
        return float(np.linalg.norm(on_ours - on_theirs)), by_ours + by_theirs

    miss, distance = miss_at(s, r)
    return miss, min(distance, miss_at(FARTHEST, FARTHEST)[1])


def _off_axis(ray: Sighting, towards: Array, length: float, place: float) -> tuple[float, float]:
    """By how much a ray misses the point `towards` (3,) m from its origin; place [m]: sigma of both ends."""
    along = float(ray.direction @ towards)
    across = float(np.linalg.norm(towards - along * ray.direction))
    angle = math.atan2(across, along)
    sigma = math.hypot(ray.sigma, FRAME_SIGMA, place / length)
    return across if along > 0.0 else length, (angle / sigma) ** 2
