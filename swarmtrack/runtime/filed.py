"""What the team's file tells of the teammates: announcements that were never on the air."""

from __future__ import annotations

import math
from collections.abc import Collection

import numpy as np

from swarmtrack.config.drone import DroneConfig
from swarmtrack.config.trajectories import read_trajectories
from swarmtrack.errors import ConfigError
from swarmtrack.geometry import rotation
from swarmtrack.messages import AgreedMotion, Announcement, Array
from swarmtrack.motion.priors import SWAY_LASTS_S
from swarmtrack.motion.sway import sway

# Of a code, Hz: between the samples it is 2 mm off at most.
SAMPLED_HZ = 20.0
# m: of who starts somewhere.
SOMEWHERE_M = 1e4
# Of nobody's process: the announcement of a living one replaces what was filed.
NO_BOOT = "00000000"


def filed_announcements(config: DroneConfig, t: float) -> list[Announcement]:
    """Where the teammates start by [team.drones], as if they had said so at t [s, monotonic]."""
    return [
        filed_announcement(
            int(drone_id),
            t,
            position=np.array(filed.position_m or (0.0, 0.0, 0.0)),
            yaw=math.radians(filed.yaw_deg),
            sigma=filed.position_sigma_m or SOMEWHERE_M,
        )
        for drone_id, filed in config.team.drones.items()
        if int(drone_id) != config.drone.id
    ]


def filed_announcement(drone_id: int, t: float, *, position: Array, yaw: float, sigma: float) -> Announcement:
    """Announcement of a drone that starts at position (3,) m, team frame, ± sigma [m] per axis, with its nose at
    yaw [rad].
    """
    return Announcement(
        drone_id=drone_id,
        boot=NO_BOOT,
        sequence=1,
        t=t,
        t_sigma=0.0,
        position=position,
        world_from_body=rotation.from_euler(0.0, 0.0, yaw),
        position_cov=sigma**2 * np.eye(3),
    )


def agreed_motions(config: DroneConfig, monotonic_from_utc: float) -> list[AgreedMotion]:
    """How the teammates move by their codes and by the plan, and this drone itself by its code. monotonic_from_utc [s]:
    what is added to UTC.

    Raises ConfigError where the file of the plan is wrong, or has a drone that is not of the team.
    """
    team, own = [int(drone_id) for drone_id in config.team.drones], config.drone.id
    found = [
        coded_motion(drone_id, team, begin.timestamp() + monotonic_from_utc)
        for begin in (config.team.code.begins if config.team.code else ())
        for drone_id in team
    ]
    if config.team.plan is None:
        return found
    planned = read_trajectories(config.team.plan.file)
    strangers = sorted(planned.keys() - set(team))
    if strangers:
        text = f"{config.team.plan.file} has drone {strangers[0]}, expected those of [team.drones]"
        raise ConfigError([config.problem(("team", "plan", "file"), text)])
    begin = config.team.plan.begins.timestamp() + monotonic_from_utc
    return found + [
        AgreedMotion(drone_id, begin + way.t, way.position, planned=True)
        for drone_id, way in planned.items()
        if drone_id != own
    ]


def coded_motion(drone_id: int, team: Collection[int], begin: float, *, tried: bool = False) -> AgreedMotion:
    """The code of a drone of the team, as all sway from `begin` [s, monotonic] on; tried: if they do."""
    t = np.linspace(0.0, SWAY_LASTS_S, round(SWAY_LASTS_S * SAMPLED_HZ) + 1)
    displacement = np.array([sway(drone_id, team, one)[0] for one in t.tolist()])
    return AgreedMotion(drone_id, begin + t, displacement, planned=False, tried=tried)
