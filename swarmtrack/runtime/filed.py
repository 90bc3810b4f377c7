"""What the team's file tells of the teammates: announcements that were never on the air."""

from __future__ import annotations

import numpy as np

from swarmtrack.config import DroneConfig
from swarmtrack.geometry import rotation
from swarmtrack.messages import Announcement

# Of nobody's process: the announcement of a living one replaces what was filed.
NO_BOOT = "00000000"


def filed_announcements(config: DroneConfig, t: float) -> list[Announcement]:
    """Where the teammates start by [team.drones], as if they had said so at t [s, monotonic]."""
    found = []
    for drone_id, filed in config.team.drones.items():
        if int(drone_id) == config.drone.id or filed.position_m is None or filed.position_sigma_m is None:
            continue
        found.append(
            Announcement(
                drone_id=int(drone_id),
                boot=NO_BOOT,
                sequence=1,
                t=t,
                t_sigma=0.0,
                position=np.array(filed.position_m),
                world_from_body=rotation.from_euler(0.0, 0.0, np.radians(filed.yaw_deg)),
                position_cov=filed.position_sigma_m**2 * np.eye(3),
            )
        )
    return found
