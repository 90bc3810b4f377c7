"""Follow a teammate at a distance: prints set-points, JSON lines, for whoever flies the drone.

A set-point says by how much to move from here, north, east and down, and how sure that is. It says "hold" while the
teammate is not known well enough. `python docs/examples/follow_me.py --team red --drone 1 --follow 2 --distance 5`
"""

import argparse
import asyncio
import json
from typing import Any

import numpy as np

from swarmtrack.client import Sight, Swarm
from swarmtrack.errors import SwarmtrackError

# Above these the place is no ground to fly on: share of the distance, and s without a detection.
VAGUE, STALE_S = 0.25, 1.0
# m: of one set-point, whatever the estimate says.
LONGEST = 5.0


def set_point(sight: Sight, follow: int, distance: float) -> dict[str, Any]:
    """How to move so as to be `distance` m from the teammate, on the line between the two."""
    target = sight.of(follow)
    relative = None if target is None else target.relative
    if target is None or relative is None:
        return {"hold": f"drone {follow} is not identified, or its distance is not known"}
    if relative.range_sigma_log > VAGUE:
        return {"hold": f"distance known to {100 * relative.range_sigma_log:.0f} % only"}
    if (target.coasting_s or 0.0) > STALE_S:
        return {"hold": f"not seen for {target.coasting_s:.1f} s"}
    move = relative.position * (1.0 - distance / relative.distance)
    move *= min(1.0, LONGEST / max(float(np.linalg.norm(move)), 1e-9))
    return {
        "move_m": [round(float(value), 3) for value in move],
        "teammate_velocity_m_s": [round(float(value), 3) for value in relative.velocity],
        "sigma_m": round(relative.distance_sigma, 3),
    }


async def main(team: str | None, drone: int, follow: int, distance: float, seconds: float | None) -> None:
    async with asyncio.timeout(seconds), Swarm(team) as swarm:
        # keep=1: a controller wants the newest, and nothing that is late.
        async for sight in swarm.tracks(drone, keep=1):
            print(json.dumps({"t_utc_s": sight.t_utc_s, **set_point(sight, follow, distance)}), flush=True)
            await asyncio.sleep(0.1)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--team")
    parser.add_argument("--drone", type=int, required=True, help="the ID of the one that follows")
    parser.add_argument("--follow", type=int, required=True, help="the ID of the one that is followed")
    parser.add_argument("--distance", type=float, default=5.0, help="m (default: 5)")
    parser.add_argument("--seconds", type=float, help="end after so long")
    args = parser.parse_args()
    try:
        asyncio.run(main(args.team, args.drone, args.follow, args.distance, args.seconds))
    except SwarmtrackError as error:
        raise SystemExit(str(error)) from None
    except (TimeoutError, KeyboardInterrupt):
        pass
