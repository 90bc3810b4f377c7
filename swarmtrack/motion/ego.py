"""Pose of this drone over the last seconds, in the team frame."""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from swarmtrack.geometry import rotation
from swarmtrack.geometry.covariance import worst_sigma
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Array, EgoPose, FlightState, LeapNews, MotionReport
from swarmtrack.motion.carried_place import CarriedPlace
from swarmtrack.motion.heading import HeadingKnowledge, HeadingSigma
from swarmtrack.motion.leap import has_leapt
from swarmtrack.motion.priors import (
    EGO_ACCELERATION_SIGMA_M_S2,
    EGO_FLIES_ON_S,
    EGO_POSITION_JITTER_M,
    EGO_SPEED_SIGMA_M_S,
    EGO_TURN_RATE_SIGMA_RAD_S,
    EGO_VELOCITY_SPAN_S,
    FASTEST_YAW_RATE_RAD_S,
    HOVER_POSITION_SIGMA_M,
    HOVER_TILT_SIGMA_RAD,
    YAW_COMPARED_WITHIN_S,
    YAW_JUMP_RAD,
)

_EYE = np.eye(3)
_EYE.setflags(write=False)


@dataclass(frozen=True, slots=True, eq=False)
class TeamPose:
    """This drone in the team frame at t: position (3,) m, world_from_body (3, 3).

    position_cov (3, 3) m²; attitude_cov (3, 3) rad², of a small turn about the team's axes: the third is the heading's.
    t_sigma [s]: standard deviation of when it was there. is_carried: the position is by its teammates; is_stated: the
    autopilot stated one.
    """

    t: float
    position: Array
    world_from_body: Array
    position_cov: Array
    attitude_cov: Array
    t_sigma: float = 0.0
    is_carried: bool = False
    is_stated: bool = True

    @property
    def pose(self) -> Pose:
        """world_from_body, without its errors."""
        return Pose(self.world_from_body, self.position)

    @property
    def position_sigma(self) -> float:
        """Standard deviation of the worst axis [m], where one number must do for all."""
        return worst_sigma(self.position_cov)

    @property
    def attitude_sigma(self) -> float:
        """Standard deviation of the worst axis [rad]."""
        return worst_sigma(self.attitude_cov)

    @property
    def tilt_sigma(self) -> float:
        """Standard deviation of the tilt, per axis [rad]."""
        return math.sqrt(float(self.attitude_cov[0, 0]))

    def vaguer(self, sigma_m: float) -> TeamPose:
        """The same, with so much more uncertainty of the position, m per axis."""
        return replace(self, position_cov=self.position_cov + sigma_m**2 * _EYE)

    def moved(self, by: Array) -> TeamPose:
        """The same pose moved by (3,) m."""
        return replace(self, position=self.position + by)


class AutopilotPlace(NamedTuple):
    """A carried drone at t [s] in the frame of its autopilot's positions, NED: position (3,) m, velocity (3,) m/s, each
    with its covariance (3, 3); world_from_body (3, 3), by the autopilot itself, and attitude_cov (3, 3) rad². held_t
    [s]: the newest ray of a teammate or to one; by: the teammates that hold it."""

    t: float
    position: Array
    position_cov: Array
    velocity: Array
    velocity_cov: Array
    world_from_body: Array
    attitude_cov: Array
    held_t: float
    by: tuple[int, ...]


class _Line(NamedTuple):
    """A straight line through some poses: its middle [s] and place there (3,) m, its slope (3,) m/s; of how many poses,
    and the sum of their squared distances from the middle [s²]."""

    middle: float
    place: Array
    velocity: Array
    poses: int
    spread: float

    @property
    def velocity_cov(self) -> Array:
        """(3, 3) m²/s²."""
        return EGO_POSITION_JITTER_M**2 / self.spread * _EYE

    def leverage(self, t: float) -> float:
        """Variance of the line's place at t, over that of a single pose."""
        return 1.0 / self.poses + (t - self.middle) ** 2 / self.spread


class EgoHistory:
    """Ego poses of the autopilot, moved into the team frame by where the drone was told it starts.

    The autopilot's local frame begins wherever it was switched on. `start` says where that is for the team; both frames
    are level, so one yaw and one translation, taken from the first attitude and the first position, connect them. Until
    the autopilot knows a position, and without an autopilot, the drone is where it started. Without `start` the
    autopilot's own frame is the team's, moved to `origin` (3,) m and turned by `origin_yaw` rad, clockwise from above:
    an estimator without a compass begins wherever it looks. `absolute`: the poses are in the team frame already, also
    those after a reboot (GPS).

    Heading and place are continuous in the team frame: when the estimator's heading jumps (it aligns itself seconds
    after boot, and again in flight) the connection is turned along, and a rebooted autopilot, whose frame has a new
    origin, goes on from where the drone was last.

    So does one whose place leaps, as a receiver's does that loses its satellites: the drone did not fly that way, and
    a velocity across it is wrong. Whether the place was right before the leap or is so since, the leap does not tell.
    `leapt` is what was taken off; a caller that finds the drone elsewhere calls `believe_leaps`. By GPS a drone that
    stands on the ground is where its autopilot says: there places leap to where they are better known.

    heading: how well the autopilot knows its heading.
    """

    def __init__(
        self,
        *,
        start: Pose | None = None,
        origin: Array | None = None,
        origin_yaw: float = 0.0,
        absolute: bool = False,
        history_s: float = 2.0,
        heading: HeadingSigma | None = None,
    ) -> None:
        self.start = start
        self.origin = np.zeros(3) if origin is None else origin
        self.origin_yaw = origin_yaw
        self.absolute = absolute
        self.history_s = history_s
        self.heading = HeadingKnowledge(heading or HeadingSigma())
        self.out_of_order = 0
        self.without_position = 0
        self.heading_jumps = self.place_leaps = 0
        self.leaps_believed_at = -math.inf
        """When the place was last moved by leaps that were believed, s."""
        self.leapt = np.zeros(3)
        """(3,) m, team frame: by so much the drone is elsewhere if its autopilot's leaps were right."""
        self._turn: Array | None = None
        self._turn_sigma = 0.0
        self._jumped_at = -math.inf
        self._shift: Array | None = None
        self._yaw: tuple[float, float] | None = None
        self._first_place: Array | None = None
        self._placed: TeamPose | None = None  # the last whose position the autopilot knew
        self._lost_velocity: Array | None = None
        """(3,) m/s, when the autopilot stated its last place; None: it still does."""
        self._poses: list[TeamPose] = []
        self._newest_velocity: tuple[Array, Array] | None = None
        """At the newest pose; None: not asked for since that came."""
        self.carried: CarriedPlace | None = None
        """Where the drone is by its teammates; None: where its autopilot says."""

    @property
    def counters(self) -> dict[str, int]:
        """Corrected and rejected poses."""
        return {
            "poses_out_of_order": self.out_of_order,
            "poses_without_place": self.without_position,
            "heading_jumps": self.heading_jumps,
            "place_leaps": self.place_leaps,
        }

    @property
    def newest_t(self) -> float | None:
        """When the newest pose held whose place the autopilot knew, s."""
        return None if self._placed is None else self._placed.t

    @property
    def stated_t(self) -> float | None:
        """`newest_t`; None while the autopilot states that it knows no place."""
        return self.newest_t if self._poses and self._poses[-1].is_stated else None

    @property
    def newest_pose_t(self) -> float | None:
        """When the newest pose held, with or without a place, s."""
        return self._poses[-1].t if self._poses else None

    @property
    def may_be_carried(self) -> bool:
        """Whether teammates may tell where this drone is: it has an autopilot, which once knew a position, or flies."""
        return bool(self._poses) and (self._placed is not None or not self.heading.is_on_ground)

    @property
    def team_from_local(self) -> Array:
        """(3, 3): from the axes of the autopilot's local frame to the team's: a turn about the vertical."""
        return _EYE if self._turn is None else self._turn

    def append(self, pose: EgoPose) -> LeapNews | None:
        """Add a pose in the autopilot's frame. One that is older than the history is dropped and counted. Returns the
        leap that was taken off, if any."""
        if self._poses and pose.t <= self._poses[-1].t - self.history_s:
            self.out_of_order += 1
            return None
        self.heading.add_pose(pose)
        turn, leapt = self._connect_heading(pose), self.leapt
        place = self._place(pose)
        if place is None:
            self.without_position += 1
            return None
        position, cov = place
        tilt, heading = pose.attitude_sigma**2, self.heading.sigma(pose.t) ** 2
        turned = turn @ pose.world_from_body
        attitude_cov, is_stated = _diagonal(tilt, tilt, heading), pose.position is not None
        placed = TeamPose(pose.t, position, turned, cov, attitude_cov, pose.t_sigma, is_stated=is_stated)
        if not self._poses or pose.t >= self._poses[-1].t:
            self._poses.append(placed)
        else:
            insort(self._poses, placed, key=lambda kept: kept.t)
        self._newest_velocity = None
        if pose.position is not None:
            self._placed, self._lost_velocity = placed, None
        if len(self._poses) > 2 and self._poses[1].t < pose.t - self.history_s:
            del self._poses[0]
        return None if self.leapt is leapt else LeapNews(pose.t, float(np.linalg.norm(self.leapt - leapt)))

    def fly(self, state: FlightState) -> None:
        """Set whether the drone flies, from its autopilot."""
        self.heading.fly(state)

    def restart(self) -> None:
        """The autopilot has rebooted: its frame may begin anywhere, the drone goes on from where it was."""
        if self._poses:
            self.heading.restart(self._poses[-1].t)
        if self.absolute:
            self.believe_leaps()
        else:
            self._shift = None

    def believe_leaps(self) -> None:
        """The drone is where its autopilot says, whatever was taken off, and so it was over the last seconds."""
        by, self.leapt = self.leapt, np.zeros(3)
        if not by.any():
            return
        self.leaps_believed_at = self._poses[-1].t if self._poses else -math.inf
        self._poses = [pose.moved(by) for pose in self._poses]
        if self._placed is not None:
            self._placed = self._placed.moved(by)
        if self._shift is not None:
            self._shift = self._shift + by
        if self._first_place is not None:
            self._first_place = self._first_place + by

    def step_heading(self, t: float, step: float) -> float:
        """By t the estimator's heading has stepped by so much [rad], and the drone has not: where the team frame was
        connected by a measured heading, it stays where it was. A jump that was seen here counts once. Returns by how
        much the axes have turned in which this drone sees others [rad], clockwise from above."""
        self.heading.step(t, step)
        if self.start is None:
            return step
        if t - self._jumped_at > YAW_COMPARED_WITHIN_S:
            self._turn_along(step)
        return 0.0

    def standing_at(self, pose: EgoPose) -> TeamPose | None:
        """Where the drone stands on the ground by GPS, as of a pose that has just been added; None where it flies, or
        where its place comes from elsewhere."""
        stands = self.absolute and self.heading.is_on_ground and pose.position is not None
        return self.at(pose.t) if stands else None

    def at(self, t: float) -> TeamPose | None:
        """The pose at t: interpolated, or the nearest one with the uncertainty that its age brings; of a carried drone
        at the place where its teammates see it."""
        return self._carried(self._stated(t))

    def _carried(self, pose: TeamPose | None) -> TeamPose | None:
        if pose is None or self.carried is None:
            return pose
        position, cov = self.carried.at(pose.t)
        return replace(pose, position=position, position_cov=cov, is_carried=True)

    def _stated(self, t: float) -> TeamPose | None:
        """`at`, by the autopilot alone."""
        if not self._poses:
            if self.start is None:
                return None
            held, level = HOVER_POSITION_SIGMA_M**2 * np.eye(3), HOVER_TILT_SIGMA_RAD**2 * np.eye(3)
            return TeamPose(t, self.start.position, self.start.rotation, held, level)
        newest = self._poses[-1]
        # Who publishes asks for now: that is past the newest pose, and asked for most often.
        k = len(self._poses) if t > newest.t else bisect_left(self._poses, t, key=lambda kept: kept.t)
        if k in (0, len(self._poses)):
            nearest = self._poses[min(k, len(self._poses) - 1)]
            age = abs(t - nearest.t)
            return TeamPose(
                t,
                nearest.position,
                nearest.world_from_body,
                nearest.position_cov + (EGO_SPEED_SIGMA_M_S * age) ** 2 * _EYE,
                nearest.attitude_cov + (EGO_TURN_RATE_SIGMA_RAD_S * age) ** 2 * _EYE,
                nearest.t_sigma,
                is_stated=nearest.is_stated,
            )
        before, after = self._poses[k - 1], self._poses[k]
        fraction = (t - before.t) / (after.t - before.t) if after.t > before.t else 1.0
        turn = rotation.log(before.world_from_body.T @ after.world_from_body)
        return TeamPose(
            t,
            before.position + fraction * (after.position - before.position),
            before.world_from_body @ rotation.exp(fraction * turn),
            max(before.position_cov, after.position_cov, key=np.trace),
            max(before.attitude_cov, after.attitude_cov, key=np.trace),
            max(before.t_sigma, after.t_sigma),
            is_stated=before.is_stated and after.is_stated,
        )

    def steady(self, t: float) -> TeamPose | None:
        """The pose at t, with a place that does not jitter from one pose to the next: that of a straight line
        through those around it, or through the newest, where that is steadier than a single pose: after a gap there are
        too few for a line. A comparison of positions within one second mistakes the jitter for motion.
        """
        return self._carried(self.stated(t))

    def stated(self, t: float) -> TeamPose | None:
        """`steady`, by the autopilot alone."""
        pose, line = self._stated(t), self._line_around(t)
        if pose is None or line is None:
            return pose
        if line.leverage(t) > 1.0:
            newest = self._poses[-1].t
            line = self._line(newest - EGO_VELOCITY_SPAN_S, newest) or line
        if line.leverage(t) > 1.0:
            return pose
        return replace(pose, position=line.place + (t - line.middle) * line.velocity)

    def from_start(self, pose: TeamPose) -> TeamPose:
        """A pose of this drone as off as its start: where a sound autopilot would have it."""
        if self.carried is None:
            return pose
        position, cov = self.carried.by_autopilot(pose.t)
        return replace(pose, position=position, position_cov=cov)

    def moved(self, drone_id: int, boot: str, sequence: int) -> MotionReport | None:
        """Velocity and displacement of this drone since its first known position; None while unknown.

        As of the middle of the last `EGO_VELOCITY_SPAN_S` of poses: their difference is the velocity of that time.
        """
        if self._placed is None or self._poses[-1].t - self._poses[0].t < EGO_VELOCITY_SPAN_S:
            return None
        if self.carried is not None:
            # Its velocity rests on what teammates said: from it they would learn nothing.
            return None
        newest = self._poses[-1]
        if newest.t - self._placed.t > EGO_VELOCITY_SPAN_S:
            return None
        line = self._line(newest.t - EGO_VELOCITY_SPAN_S, newest.t)
        if line is None:
            return None
        if self._first_place is None:
            self._first_place = line.place
        return MotionReport(
            drone_id,
            boot,
            sequence,
            t=line.middle,
            t_sigma=newest.t_sigma,
            displacement=line.place - self._first_place,
            displacement_cov=newest.position_cov,
            velocity=line.velocity,
            velocity_cov=line.velocity_cov,
        )

    @property
    def for_autopilot(self) -> AutopilotPlace | None:
        """Place of a carried drone as its autopilot would state it; None where that frame is unknown, or not needed."""
        carried = self.carried
        if carried is None or not carried.is_lost or self._turn is None or self._shift is None:
            return None
        newest, back = self._poses[-1], self._turn.T
        position, cov = carried.by_autopilot(newest.t)
        return AutopilotPlace(
            newest.t,
            back @ (position - self._shift),
            back @ cov @ back.T,
            back @ carried.velocity,
            back @ carried.cov[3:, 3:] @ back.T,
            back @ newest.world_from_body,
            newest.attitude_cov,
            held_t=carried.held_t,
            by=carried.by,
        )

    def velocity(self, t: float) -> tuple[Array, Array]:
        """How this drone itself moves at t: (3,) m/s in the team frame, and its covariance (3, 3)."""
        if self.carried is not None:
            return self.carried.velocity, self.carried.cov[3:, 3:]
        line = self._line_around(t)
        if line is None:
            return np.zeros(3), EGO_SPEED_SIGMA_M_S**2 * np.eye(3)
        ahead = t - line.middle
        return line.velocity, line.velocity_cov + (EGO_ACCELERATION_SIGMA_M_S2 * ahead) ** 2 * np.eye(3)

    def flown_on(self, t: float) -> tuple[Array, Array, Array]:
        """What came after the newest pose: the way from there to t, straight on (3,) m; and `velocity` at t. No way
        where t is within the history."""
        ahead = t - self._poses[-1].t if self._poses else 0.0
        if ahead <= 0.0 or self.carried is not None:
            # A carried place is carried on with its velocity already.
            return np.zeros(3), *self.velocity(t)
        if self._newest_velocity is None:
            self._newest_velocity = self.velocity(self._poses[-1].t)
        velocity, cov = self._newest_velocity
        return ahead * velocity, velocity, cov + (EGO_ACCELERATION_SIGMA_M_S2 * ahead) ** 2 * _EYE

    def _line_around(self, t: float) -> _Line | None:
        """`_line` of the poses on both sides of t, or of those before it; None where no place was ever known."""
        if self._placed is None:
            return None
        span, last = EGO_VELOCITY_SPAN_S, self._placed.t
        around = self._line(t - 0.5 * span, t + 0.5 * span) or self._line(t - span, t)
        # Of one that has lost its place since, as it flew then.
        return around or (self._line(last - span, last) if t > last else None)

    def _line(self, begin: float, end: float) -> _Line | None:
        """A straight line through the places of that time that the autopilot stated; None of fewer than two."""
        within = []
        for pose in reversed(self._poses):
            if pose.t < begin:
                break
            if pose.t <= end and pose.is_stated:
                within.append(pose)
        if len(within) < 2:
            return None
        times, places = [pose.t for pose in within], np.array([pose.position for pose in within])
        middle = math.fsum(times) / len(times)
        off = np.array(times) - middle
        spread = float(off @ off)
        if spread <= 0.0:
            return None
        return _Line(middle, places.sum(axis=0) / len(times), off @ places / spread, len(times), spread)

    def _place(self, pose: EgoPose) -> tuple[Array, Array] | None:
        """Position in the team frame and its covariance (3, 3); None where nobody can tell."""
        start = None if self.start is None else self.start.position
        last = self._poses[-1].position if self._poses else start
        if pose.position is None:
            if last is None:
                return None
            if self._placed is None:
                return last, HOVER_POSITION_SIGMA_M**2 * np.eye(3)
            return self._moved_on(self._placed, abs(pose.t - self._placed.t))
        assert self._turn is not None
        if self._shift is None:
            self._shift = self.origin if last is None else last - self._turn @ pose.position
        position = self._turn @ pose.position + self._shift
        leap = self._leap(pose.t, position)
        if leap is not None:
            self._shift, position = self._shift - leap, position - leap
            self.leapt = self.leapt + leap
            self.place_leaps += 1
        vertical = pose.position_sigma if pose.vertical_sigma is None else pose.vertical_sigma
        level = pose.position_sigma**2
        cov = _diagonal(level, level, vertical**2)
        if start is not None:
            # The way from there was turned along with a heading that is not exact.
            north, east, _ = (self._turn_sigma * (position - start)).tolist()
            across = np.array([-east, north, 0.0])
            cov += np.outer(across, across)
        return position, cov

    def _moved_on(self, placed: TeamPose, age: float) -> tuple[Array, Array]:
        """Place (3,) m and covariance (3, 3) of a drone whose autopilot stated its last place `age` [s] ago: it flies
        on as it did, for a while, or wherever it likes."""
        if self._lost_velocity is None:
            line = self._line(placed.t - EGO_VELOCITY_SPAN_S, placed.t)
            self._lost_velocity = np.zeros(3) if line is None else line.velocity
        flown = -EGO_FLIES_ON_S * math.expm1(-age / EGO_FLIES_ON_S)
        cov = placed.position_cov + (EGO_SPEED_SIGMA_M_S * age) ** 2 * _EYE
        return placed.position + flown * self._lost_velocity, cov

    def _leap(self, t: float, position: Array) -> Array | None:
        """(3,) m: by how much a place in the team frame is elsewhere than the drone can have flown since the last that
        its autopilot knew; None where it is not, or where nobody knows how fast that flew."""
        last = self._placed
        if last is None or (self.absolute and self.heading.is_on_ground):
            return None
        dt = t - last.t
        if not 0.0 < dt <= EGO_VELOCITY_SPAN_S or not has_leapt(last.position, position, dt):
            return None
        line = self._line(last.t - EGO_VELOCITY_SPAN_S, last.t)
        if line is None:
            return None
        expected = last.position + dt * line.velocity
        return position - expected if has_leapt(expected, position, dt) else None

    def _connect_heading(self, pose: EgoPose) -> Array:
        """team_from_local (3, 3), made with the first pose and turned along with a heading that jumps."""
        yaw = _heading(pose.world_from_body)
        if self._turn is None:
            turn = self.origin_yaw if self.start is None else _heading(self.start.rotation) - yaw
            self._turn_sigma = self.heading.sigma(pose.t)
            self._turn = rotation.from_euler(0.0, 0.0, turn)
        elif self._yaw is not None and self.start is not None:
            t, before = self._yaw
            jump = math.remainder(yaw - before, 2.0 * math.pi)
            dt = abs(pose.t - t)
            if dt < YAW_COMPARED_WITHIN_S and abs(jump) > YAW_JUMP_RAD + FASTEST_YAW_RATE_RAD_S * dt:
                self._turn_along(jump)
                self._jumped_at = pose.t
                self.heading_jumps += 1
        self._yaw = (pose.t, yaw)
        return self._turn

    def _turn_along(self, jump: float) -> None:
        """Heading and place stay what they were, although the estimator's heading is another by jump [rad]."""
        assert self._turn is not None
        self._turn = self._turn @ rotation.from_euler(0.0, 0.0, -jump)
        # The old one was made with the old heading.
        self._shift = None


def _diagonal(x: float, y: float, z: float) -> Array:
    return np.array([[x, 0.0, 0.0], [0.0, y, 0.0], [0.0, 0.0, z]])


def _heading(world_from_body: Array) -> float:
    return math.atan2(world_from_body[1, 0], world_from_body[0, 0])
