"""How this drone itself flies: what its autopilot, its gyro and its range finder report, and how old that is."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from swarmtrack.formation.margins import GROUND_STALE_S, OWN_CODES_KEPT, SWAY_DIFFERENCE_S
from swarmtrack.formation.setpoint import NO_SWAY, OwnFlight, OwnSway
from swarmtrack.geometry.covariance import worst_sigma
from swarmtrack.messages import AgreedMotion, Array, EgoPose
from swarmtrack.motion.ego import EgoHistory, TeamPose
from swarmtrack.motion.gyro import GyroHistory
from swarmtrack.relative.heights import HeightSight


class _GroundBelow(NamedTuple):
    """Where the range finder found the ground at t [s]: m, down in the team frame."""

    t: float
    down: float


class OwnFlightRecord:
    """Receives what bears on the own flight and is kept nowhere else; `at` joins it with the pose and the ages."""

    def __init__(self, ego: EgoHistory, gyro: GyroHistory, body_from_camera: Array) -> None:
        """body_from_camera (3, 3): of the camera whose optical axis is the drone's heading."""
        self._ego = ego
        self._gyro = gyro
        self._body_from_camera = body_from_camera
        self._codes: deque[AgreedMotion] = deque(maxlen=OWN_CODES_KEPT)
        self._ground: _GroundBelow | None = None
        self._heading_stepped_at = -math.inf

    def add_pose(self, pose: EgoPose) -> None:
        """A pose that `ego` has already; only its range finder's measurement counts."""
        here = self._ego.at(pose.t) if pose.ground else None
        if here is not None and pose.ground is not None:
            self._ground = _GroundBelow(pose.t, float(here.position[2]) + pose.ground)

    def agree(self, code: AgreedMotion) -> None:
        """This drone sways so, as was agreed before the flight."""
        self._codes.append(code)

    def step_heading(self, t: float) -> None:
        """By t [s] the autopilot's heading has stepped."""
        self._heading_stepped_at = t

    def at(
        self,
        pose: TeamPose,
        *,
        scan_ages: tuple[float, ...],
        clash: bool,
        doubted: bool,
        height_sights: tuple[HeightSight, ...],
    ) -> OwnFlight:
        """At the time of `pose`, which is as uncertain as the drone states it; the rest: see `OwnFlight`."""
        now = pose.t
        path, velocity, velocity_cov = self._ego.flown_on(now)
        axis = pose.world_from_body @ self._body_from_camera[:, 2]
        # A carried place is carried on with its velocity, and states how vague that makes it.
        newest = self._ego.newest_pose_t if pose.is_carried else self._ego.newest_t
        gyro = self._gyro.newest
        north, east, down = (pose.position + path).tolist()
        vn, ve, vd = velocity.tolist()
        return OwnFlight(
            (north, east, down),
            (vn, ve, vd),
            math.atan2(float(axis[1]), float(axis[0])),
            position_sigma=worst_sigma(pose.position_cov[:2, :2]),
            height_sigma=math.sqrt(float(pose.position_cov[2, 2])),
            pose_age=math.inf if newest is None else now - newest,
            gyro_age=math.inf if gyro is None else now - gyro,
            scan_ages=scan_ages,
            heading_step_age=now - self._heading_stepped_at,
            leap_age=now - self._ego.leaps_believed_at,
            clash=clash,
            doubted=doubted,
            sways=self._sway(now),
            ground=self._ground_below(now, pose.position[2] + path[2]),
            height_sights=height_sights,
            is_carried=pose.is_carried,
            velocity_sigma=worst_sigma(velocity_cov) if pose.is_carried else 0.0,
        )

    def _sway(self, now: float) -> OwnSway:
        for code in self._codes:
            if code.t[0] < now < code.t[-1]:
                times = [now - SWAY_DIFFERENCE_S, now, now + SWAY_DIFFERENCE_S]
                before, at, after = np.interp(times, code.t, code.displacement[:, 2]).tolist()
                return OwnSway(at, (after - before) / (2.0 * SWAY_DIFFERENCE_S))
        return NO_SWAY

    def _ground_below(self, now: float, down: float) -> float | None:
        """m below a drone that is at `down` [m]; None without a recent measurement."""
        ground = self._ground
        fresh = ground is not None and 0.0 <= now - ground.t <= GROUND_STALE_S
        return float(ground.down - down) if ground is not None and fresh else None
