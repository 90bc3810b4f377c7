"""Where this drone is by its teammates, with or without a position of its own autopilot.

The filter (`filter.py`) runs all the time, so what lasts of widths, headings and stated places is known when the
autopilot's position ends. While that is sound it is only watched: the drone is where its autopilot says. Without it, or
once it has drifted off, the drone is where the filter says, carried by its teammates.

Rumours do not go round. A report of a carried drone states on whom its place leans: those that hold it, and those on
whom they lean. A teammate whose place leans on this drone is no evidence of where this drone is.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from swarmtrack.carried.filter import (
    AUTOPILOT_OFFSET,
    OWN_PLACE,
    OWN_SPEED,
    OWN_TURN,
    Moments,
    OwnPlaceFilter,
    OwnRay,
    TheirRay,
)
from swarmtrack.carried.priors import (
    ADRIFT_GATE,
    ADRIFT_LEAST_M,
    ANCHOR_CARRIED_LASTS_S,
    ANCHOR_VAGUE_M,
    ANCHORS_MOST,
    COMPARED_EVERY_S,
    FITTED_RAYS,
    HELD_S,
    LEANS_S,
    NEAREST_ANCHOR_M,
    NO_POSITION_S,
    OWN_PLACE_WHITE_M,
    OWN_RAY_WHITE_RAD,
    OWN_SPEED_LASTS_S,
    OWN_SPEED_SIGMA_M_S,
    P_CONFIGURED,
    P_RAY_SURE,
    P_SOUND,
    P_SUSPECT,
    REPORT_ACCELERATION_M_S2,
    REPORT_NEAR_S,
    REPORTED_HELD_S,
    REPORTED_RAY_LASTING_RAD,
    REPORTED_RAY_WHITE_RAD,
    SOUND_AGAIN_S,
)
from swarmtrack.carried.thrust import TiltedThrust
from swarmtrack.messages import Announcement, Array, SightingReport
from swarmtrack.motion.carried_place import CarriedPlace
from swarmtrack.motion.ego import TeamPose
from swarmtrack.relative.box_width import BoxWidth
from swarmtrack.relative.log_range import SizeErrors
from swarmtrack.relative.looks import TeamLook
from swarmtrack.relative.parameters import RelativeParameters
from swarmtrack.team.reported_places import SaidPlace

_EYE = np.eye(3)


class CarriedNews(NamedTuple):
    """Holders of this drone's position, ± sigma_m [m, worst axis]; empty: it is only extrapolated; None: its
    autopilot's position counts again. off_m: error of that, where it is wrong."""

    t: float
    by: tuple[int, ...] | None
    sigma_m: float = 0.0
    off_m: float | None = None


class TeamKnowledge(Protocol):
    """Knowledge of the team's posterior."""

    def said_place(self, drone_id: int, t: float) -> SaidPlace | None: ...
    def p_as_configured(self) -> float: ...
    def is_confirmed(self, drone_id: int) -> bool: ...


@dataclass(slots=True)
class _Anchor:
    """A teammate: how well it knows its start, m² per axis, and its place, m; on whom that leans; when it last held us,
    s, by a ray of ours and by its own."""

    place_var: float
    sigma: float = 0.0
    leans_on: tuple[int, ...] = ()
    seen_t: float = -math.inf
    saw_t: float = -math.inf

    def holds(self, t: float) -> bool:
        return t - self.seen_t <= HELD_S or t - self.saw_t <= REPORTED_HELD_S

    @property
    def last_t(self) -> float:
        return max(self.seen_t, self.saw_t)


class OwnPlace:
    """Takes every look and report; `carried` is the position where the autopilot has none, or a wrong one."""

    def __init__(
        self,
        drone_id: int,
        parameters: RelativeParameters,
        *,
        cameras: Sequence[Array],
        start_sigma_m: float,
    ) -> None:
        """cameras: where each sits, (3,) m in the body. start_sigma_m: how well this drone knows where it starts, m per
        axis."""
        self._drone_id = drone_id
        self._cameras = tuple(cameras)
        self._p = parameters
        self._start_var = start_sigma_m**2
        self._filter: OwnPlaceFilter | None = None
        self._thrust = TiltedThrust()
        self._anchors: dict[int, _Anchor] = {}
        self._compared: dict[int, float] = {}
        """By camera, when its scan was compared last, s."""
        self._placed_t = -math.inf
        """When the autopilot last knew a position, s."""
        self._fitted = self._fitted_as_configured = 0
        """Rays that fitted while all positions were sound; and of these, to drones whose names motion confirmed
        while names found nothing wrong."""
        self._is_suspect = self._adrift = False
        """Whether the autopilot's position may be wrong; and whether it surely is."""
        self._sound: Moments | None = None
        """By how much the autopilot's position was off while it was sound."""
        self._off_m = 0.0
        self._misfit_t = -math.inf
        self._told: tuple[bool, bool] | None = None
        """Whether by anybody, and whether without a position of the autopilot: what was told last."""
        self.refused = 0

    @property
    def is_suspect(self) -> bool:
        """Whether the autopilot's position is taken for none, because it may have drifted off."""
        return self._is_suspect

    @property
    def off_m(self) -> float:
        """How far off the autopilot's position is, m."""
        return self._off_m

    @property
    def counters(self) -> dict[str, int]:
        """Rays and places that no hypothesis explains."""
        return {"own_place_refused": self.refused}

    # --- what teammates say ---

    def announce(self, said: Announcement) -> None:
        """A teammate says where it starts."""
        known = self._anchors.get(said.drone_id)
        if known is None:
            self._anchors[said.drone_id] = _Anchor(float(np.trace(said.position_cov)) / 3.0)

    def hear(self, report: SightingReport) -> None:
        """Where a teammate is, on whom it leans, and on which ray it sees us."""
        anchor = self._anchors.get(report.observer)
        if anchor is None or report.observer == self._drone_id:
            return
        anchor.sigma, anchor.leans_on = report.position_sigma, report.leans_on
        ours = next((seen for seen in report.sightings if seen.drone_id == self._drone_id), None)
        if ours is None:
            anchor.saw_t = -math.inf
            return
        found, drone = self._filter, report.observer
        if (
            found is None
            or drone not in found
            or not self._is_anchor(anchor)
            or ours.probability < P_RAY_SURE
        ):
            return
        dt = report.t - found.t
        if abs(dt) > REPORT_NEAR_S:
            return
        white = max(ours.sigma**2 - REPORTED_RAY_LASTING_RAD**2, 0.0) + REPORTED_RAY_WHITE_RAD**2
        speed = float(np.linalg.norm(found.moments(OWN_SPEED).mean)) + 0.5
        place_var = OWN_PLACE_WHITE_M**2 + self._leaning_var(anchor) + (speed * report.t_sigma) ** 2
        ray = TheirRay(report.position, place_var, ours.direction, math.sqrt(white), dt)
        if found.hear_ray(drone, ray, (0.5 * REPORT_ACCELERATION_M_S2 * dt * dt) ** 2):
            anchor.saw_t = found.t
        else:
            self.refused += 1

    def forget(self, drone_id: int) -> None:
        """Nothing said in its name counts any more."""
        if (anchor := self._anchors.get(drone_id)) is not None:
            anchor.sigma = math.inf

    # --- what this drone sees ---

    def observe(
        self, look: TeamLook, camera: int, own: TeamPose, newest: float | None, team: TeamKnowledge
    ) -> None:
        """A look of one camera. own: by the autopilot alone, with `newest` [s] the last time that it knew a position,
        None while it states that it knows none; team: where teammates are, and whether all is as configured."""
        t, before = look.t, self._compared.get(camera, -math.inf)
        is_placed = newest is not None and t - newest <= NO_POSITION_S
        # While it is only watched, less often is enough.
        if t - before < (COMPARED_EVERY_S if is_placed and not self._is_suspect else 0.0):
            return
        self._compared[camera] = t
        rays = self._rays(look, camera, own, team)
        if self._filter is None:
            if not rays:
                return
            self._filter = _begun(own, look.velocity, self._start_var, self._p.box_width)
        found = self._filter
        found.predict(max(t, found.t), self._thrust.push(t, own.world_from_body))
        self._placed_t = -math.inf if newest is None else newest
        if (
            is_placed
            and not self._is_suspect
            and not found.hear_autopilot(own.position, OWN_PLACE_WHITE_M**2)
        ):
            self.refused += 1
        fitted = [drone for drone, ray in rays.items() if self._fold(drone, ray)]
        self._fitted += len(fitted)
        # A name that rests on stated places fits them, whatever they are.
        confirmed = 0 if self._was_right else sum(map(team.is_confirmed, fitted))
        if confirmed and team.p_as_configured() > P_CONFIGURED:
            self._fitted_as_configured += confirmed
        if is_placed:
            self._watch(own.position, team)

    def _rays(self, look: TeamLook, camera: int, own: TeamPose, team: TeamKnowledge) -> dict[int, OwnRay]:
        """To teammates that can hold us, by drone."""
        rays = {}
        # While as many as there may be hold us, no others are needed.
        holders = self._filter if self._is_full(look.t) else None
        for i, (drone, _) in enumerate(look.keys):
            if holders is not None and drone not in holders:
                continue
            anchor = self._anchors.get(drone)
            where = team.said_place(drone, look.t) if math.isfinite(float(look.ray[i, 0])) else None
            if anchor is None or where is None or not self._is_anchor(anchor):
                continue
            gain = float(look.gain[i])
            rays[drone] = OwnRay(
                where.place,
                where.white + where.sigma**2 + self._leaning_var(anchor),
                look.ray[i],
                look.ray_cov[i] + OWN_RAY_WHITE_RAD**2 * _EYE,
                own.world_from_body @ self._cameras[camera],
                math.log(self._p.width_m / float(look.width[i])),
                float(self._p.lasting_by(np.array([gain]))[0]),
                gain,
                (gain * self._p.box_width.white_sigma) ** 2,
            )
        return rays

    def _is_full(self, t: float) -> bool:
        """Whether as many teammates hold us at t [s] as there may be."""
        found = self._filter
        return (
            found is not None and len(found) >= ANCHORS_MOST and self._anchors[self._oldest(found)].holds(t)
        )

    def _oldest(self, drones: Iterable[int]) -> int:
        return min(drones, key=lambda drone: self._anchors[drone].last_t)

    @property
    def _was_right(self) -> bool:
        return self._fitted_as_configured >= FITTED_RAYS

    def _fold(self, drone: int, ray: OwnRay) -> bool:
        """Returns whether it fitted, all positions being sound."""
        found, anchor = self._filter, self._anchors[drone]
        assert found is not None
        if drone not in found:
            if self._is_full(found.t):
                return False
            if len(found) >= ANCHORS_MOST:
                found.remove_teammate(self._oldest(found))
            found.add_teammate(drone, anchor.place_var * _EYE, self._p.lasting)
        if ray.log_range < math.log(NEAREST_ANCHOR_M):
            return False
        if not found.see(drone, ray):
            self.refused += 1
            return False
        anchor.seen_t = found.t
        return bool(found.weights[0] > 0.9)

    def _is_anchor(self, anchor: _Anchor) -> bool:
        """Whether it knows where it is, and not from us."""
        return anchor.sigma <= ANCHOR_VAGUE_M and self._drone_id not in anchor.leans_on

    def _leaning_var(self, anchor: _Anchor) -> float:
        """m² per axis, as white noise at every comparison: the error of a teammate that is itself carried lasts."""
        if not anchor.leans_on:
            return 0.0
        return 2.0 * ANCHOR_CARRIED_LASTS_S / COMPARED_EVERY_S * anchor.sigma**2

    def _watch(self, autopilot: Array, team: TeamKnowledge) -> None:
        """Has the autopilot's position (3,) m drifted off? From the suspicion on it is no evidence, until it has fitted
        again for `SOUND_AGAIN_S`."""
        found = self._filter
        assert found is not None
        if not self._is_suspect:
            held = any(anchor.holds(found.t) for anchor in self._anchors.values())
            # Wrong pads, headings and starts are no drift: names allow for them. They are wrong from the beginning, so
            # what begins after all has fitted is none of them, whatever names make of it.
            self._is_suspect = held and self._was_right and found.weights[1] > P_SUSPECT
            self._misfit_t = found.t
            if found.weights[1] < P_SOUND or self._sound is None:
                self._sound = found.moments(AUTOPILOT_OFFSET)
        assert self._sound is not None
        place = found.moments(OWN_PLACE)
        off = autopilot - place.mean - self._sound.mean
        gate = float(off @ np.linalg.solve(place.cov + self._sound.cov, off))
        self._off_m = float(np.linalg.norm(off))
        if not self._is_suspect:
            return
        if gate > ADRIFT_GATE:
            self._misfit_t = found.t
            self._adrift = self._adrift or self._off_m > ADRIFT_LEAST_M
        elif found.t - self._misfit_t > SOUND_AGAIN_S:
            self._is_suspect = self._adrift = False
            found.trust_autopilot(self._sound)

    def carried(self, t: float) -> CarriedPlace | None:
        """Position by teammates, at t; None while the autopilot's is sound, and before any teammate has held it."""
        found = self._filter
        if found is None or not self._fitted or not (self._is_suspect or t - self._placed_t > NO_POSITION_S):
            return None
        place, speed, turn = (found.moments(part) for part in (OWN_PLACE, OWN_SPEED, OWN_TURN))
        both = found.moments(slice(0, 6))
        offset, offset_cov = self._offset(both)
        holding = [drone for drone, anchor in sorted(self._anchors.items()) if anchor.holds(found.t)]
        recent = [drone for drone, anchor in self._anchors.items() if found.t - anchor.last_t <= LEANS_S]
        leans = set(recent).union(*(self._anchors[drone].leans_on for drone in recent))
        return CarriedPlace(
            found.t,
            place.mean,
            speed.mean,
            both.cov,
            2.0 * OWN_SPEED_SIGMA_M_S**2 / OWN_SPEED_LASTS_S,
            float(turn.mean[2]),
            math.sqrt(float(turn.cov[2, 2])),
            by=tuple(holding),
            leans_on=tuple(sorted(leans)),
            off_m=self._off_m if self._adrift else None,
            held_t=max((anchor.last_t for anchor in self._anchors.values()), default=-math.inf),
            offset=offset,
            offset_cov=offset_cov,
            is_lost=t - self._placed_t > NO_POSITION_S,
        )

    def _offset(self, both: Moments) -> tuple[Array, Array]:
        """See `CarriedPlace`. both: place and velocity."""
        assert self._filter is not None
        if self._is_suspect:
            # The state follows the drift.
            assert self._sound is not None
            cov = both.cov.copy()
            cov[:3, :3] += self._sound.cov
            return self._sound.mean, cov
        with_offset = self._filter.moments(slice(0, AUTOPILOT_OFFSET.stop))
        T = np.eye(6, AUTOPILOT_OFFSET.stop)
        T[:3, AUTOPILOT_OFFSET] = _EYE
        return with_offset.mean[AUTOPILOT_OFFSET], T @ with_offset.cov @ T.T

    def news(self, t: float) -> CarriedNews | None:
        """Change of holders since the last news, at t."""
        carried = self.carried(t)
        if carried is not None and carried.off_m is None and t - self._placed_t <= NO_POSITION_S:
            # Suspected, and not sure yet.
            carried = None
        now = None if carried is None else (bool(carried.by), carried.off_m is None)
        if now == self._told:
            return None
        self._told = now
        if carried is None:
            return CarriedNews(t, None)
        return CarriedNews(t, carried.by, carried.sigma_m, carried.off_m)


def _begun(own: TeamPose, velocity: Array, start_var: float, width: BoxWidth) -> OwnPlaceFilter:
    """own: by the autopilot; it may be off by what it states, and by the start's error, for good."""
    return OwnPlaceFilter(
        own.t,
        Moments(own.position, OWN_PLACE_WHITE_M**2 * _EYE),
        Moments(velocity, 0.5**2 * _EYE),
        own.position_cov + start_var * _EYE,
        own.attitude_cov,
        width=SizeErrors(width.wander_sigma, width.wander_s),
    )
