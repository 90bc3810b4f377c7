"""What a teammate says of itself, and what its ended tracks said of its frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from swarmtrack.messages import AgreedMotion, Announcement, Array, MotionReport, SightingReport
from swarmtrack.team.adrift import Adrift, sigma_per_axis
from swarmtrack.team.evidence import fading
from swarmtrack.team.last_seen import LastSeenRay
from swarmtrack.team.priors import (
    AGREED_WHITE_M,
    BOX_SPAN_SIGMA_LN,
    CODED_DEVIATION,
    DOUBTS_M,
    PLACE_LASTS_S,
    PLANNED_DEVIATION,
    REPORT_WAIT_S,
    SOMEWHERE_SIGMA_M,
    WAITING_HALF_S,
)
from swarmtrack.team.reported_places import Report, ReportedPlaces, SaidPlace
from swarmtrack.team.teammate_rays import TeammateRays

# s: so long after the last motion report a place in a report is what tells where it is.
_MOTION_LASTS_S = 3.0


@dataclass(slots=True, eq=False)
class Teammate:
    """column: where it stands in all arrays; start (3,) m and start_cov: its first announcement."""

    drone_id: int
    column: int
    boot: str
    start: Array
    start_cov: Array
    knows_start: bool = True
    """Whether that says anything: if not, it is somewhere around this drone."""
    doubting: bool = False
    path: ReportedPlaces = field(default_factory=ReportedPlaces)
    log_span: float = 0.0
    """ln of its box's larger side over `BOX_SPAN_M`, as learned; and the variance."""
    span_variance: float = BOX_SPAN_SIGMA_LN**2
    sized_t: float = -math.inf
    adrift: Adrift = field(init=False)
    _origin: Array | None = None
    _motion_t: float = -math.inf
    motions: list[AgreedMotion] = field(default_factory=list)
    """How it moves by what was agreed before the flight, whichever of its processes lives."""
    _told: Array = field(default_factory=lambda: np.zeros((8, 8)))
    _told_t: float = 0.0
    seen: LastSeenRay | None = None
    rays: TeammateRays = field(default_factory=TeammateRays)
    """Between it and others, by what it and they report."""
    p_supposed: float = 0.0
    """The probability that the last track that may have been it was it."""
    supposed_t: float = 0.0
    """When that track was seen last, s."""
    _supposed: Array = field(default_factory=lambda: np.zeros((8, 8)))

    @classmethod
    def of(cls, announcement: Announcement, column: int, motions: list[AgreedMotion]) -> Teammate:
        made = cls(
            announcement.drone_id,
            column,
            announcement.boot,
            announcement.position.copy(),
            announcement.position_cov.copy(),
            motions=motions,
        )
        if float(np.trace(made.start_cov)) > 3.0 * SOMEWHERE_SIGMA_M**2:
            made.start_cov, made.knows_start = SOMEWHERE_SIGMA_M**2 * np.eye(3), False
        made.announce(announcement)
        return made

    def __post_init__(self) -> None:
        self.adrift = Adrift(sigma_per_axis(self.start_cov))

    def announce(self, announcement: Announcement) -> None:
        """It says where it is, and perhaps that it doubts it."""
        sigma = sigma_per_axis(announcement.position_cov)
        self.doubting = sigma > DOUBTS_M and self.knows_start
        lost = self.doubting or self.adrift.is_at(announcement.t, sigma)
        if not self.path or not (lost or self._measures_motion(announcement.t)):
            t, place = announcement.t, announcement.position
            # Of whoever announces itself and reports nothing, it is not known how it came there.
            velocity = self.path.velocity_to(place, t) if self._reports else None
            self.path.append(Report(t, place, velocity))

    def report(self, report: SightingReport) -> None:
        """It says with what it sees where it is. Of another process of its, nothing is known of the frame."""
        if report.boot != self.boot or self.adrift.is_at(report.t, report.position_sigma):
            return
        if self._measures_motion(report.t):
            return
        velocity = self.path.velocity_to(report.position, report.t)
        sigma = report.position_sigma if report.leans_on else 0.0
        self.path.append(Report(report.t, report.position, velocity, t_sigma=report.t_sigma, sigma=sigma))

    def _measures_motion(self, t: float) -> bool:
        """Whether it has said how it moves shortly before t [s]: what it says of its place then is vaguer."""
        return t - self._motion_t <= _MOTION_LASTS_S

    def move(self, report: MotionReport) -> None:
        """It says how it moves: its displacement is counted from one place as long as its process lives."""
        if report.boot != self.boot or self.adrift.is_at(report.t, sigma_per_axis(report.displacement_cov)):
            return
        if self._origin is None:
            last = self.path.last
            on = np.zeros(3) if last.velocity is None else (report.t - last.t) * last.velocity
            self._origin = last.place + on - report.displacement
        self._motion_t = report.t
        place = self._origin + report.displacement
        self.path.append(Report(report.t, place, report.velocity, measured=True, t_sigma=report.t_sigma))

    def at(self, t: float) -> SaidPlace:
        """Where it says that it was at t, in its own frame."""
        motion = self._agreed_at(t)
        if motion is not None:
            now = np.array([np.interp(t, motion.t, axis) for axis in motion.displacement.T])
            sigma, bandwidth = PLANNED_DEVIATION if motion.planned else CODED_DEVIATION
            return SaidPlace(self.start + now - motion.displacement[0], sigma, bandwidth, AGREED_WHITE_M**2)
        return self.path.at(t)

    def knows(self, t: float) -> bool:
        """Whether it has said anything of where it was at about t."""
        return self._agreed_at(t) is not None or t - self.path.last.t <= PLACE_LASTS_S

    def log_waits(self, t: float) -> float:
        """Log prior that it is still about where it was when it last said so."""
        return 0.0 if self.knows(t) else -math.log1p((t - self.path.last.t) / WAITING_HALF_S)

    def has_said(self, t: float) -> bool:
        """Whether nothing has to be waited for to know where it was at t."""
        return self._agreed_at(t) is not None or self.path.last.t >= t

    def is_followed(self, t: float) -> bool:
        """Whether any scan at about t can be compared with its motion: an agreed one."""
        return self._agreed_at(t) is not None

    def _agreed_at(self, t: float) -> AgreedMotion | None:
        return next((motion for motion in self.motions if motion.t[0] <= t <= motion.t[-1]), None)

    def has_spoken_since(self, t: float) -> bool:
        """Whether it has said where it was after t."""
        return self.path.last.t > t

    def goes_on(self, t: float) -> bool:
        """Whether it reports regularly, so that another report follows within REPORT_WAIT_S."""
        return self._reports and self.has_spoken_since(t - REPORT_WAIT_S)

    @property
    def _reports(self) -> bool:
        """Whether it has said where it is again and again, and not only announced itself."""
        return bool(self.path) and self.path.last.velocity is not None

    def told(self, t: float) -> Array:
        """(8, 8): what its ended tracks say of its frame at t."""
        return fading(max(t - self._told_t, 0.0)) * self._told

    def supposed(self, t: float) -> Array:
        """(8, 8): what they say, and the track that only may have been it."""
        return fading(max(t - self._told_t, 0.0)) * (self._told + self._supposed)

    def keep(self, M: Array, t: float) -> None:
        """A track of it has ended that said this of its frame."""
        self._told, self._told_t = self.told(t) + M, t
        self.p_supposed = 0.0

    def suppose(self, M: Array, p: float, t: float, last_t: float) -> None:
        """A track has ended that was this drone with probability p, and was seen at last_t [s]."""
        self._told, self._told_t, self.supposed_t = self.told(t), t, last_t
        self._supposed, self.p_supposed = M, p

    @property
    def is_placed(self) -> bool:
        """Whether it says where it is, and does not doubt that."""
        return self.knows_start and not self.doubting and not self.adrift.lost

    def begin_frame(self) -> None:
        """It has found a place again. From there on it flies as it says; where that is, is as uncertain as it was."""
        self.start = self.path.last.place.copy()
        self.start_cov = self.adrift.begin_frame() ** 2 * np.eye(3)
        self.path.begin_at_last()
        self._origin = None
        self.forget_frame()

    def forget_frame(self) -> None:
        """What its ended tracks said was of another start of this drone."""
        self._told, self.p_supposed = np.zeros((8, 8)), 0.0
        self.rays.forget()

    def turn(self, to_old: Array, forward: Array) -> None:
        """The axes of the own rays have turned: forward (3, 3) takes directions along, to_old (8, 8) z back."""
        self.seen = None if self.seen is None else self.seen.turned(forward)
        self._told = to_old.T @ self._told @ to_old
        self._supposed = to_old.T @ self._supposed @ to_old
