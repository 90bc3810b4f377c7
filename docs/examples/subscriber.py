"""What one drone, or every drone, tracks now: a line per second and drone.

`python docs/examples/subscriber.py --team red`
"""

import argparse
import asyncio

from swarmtrack.client import Sight, Swarm
from swarmtrack.errors import SwarmtrackError


def words(sight: Sight) -> str:
    """One line: who is where."""
    told = []
    for target in sight.targets:
        name = "unknown" if target.identity is None else str(target.identity)
        if target.relative is not None:
            north, east, down = target.relative.position
            name += f" at [{north:.1f} {east:.1f} {down:.1f}] m, sigma {target.relative.distance_sigma:.1f} m"
        elif target.direction_body is not None:
            forward, right, down = target.direction_body
            name += f" towards [{forward:.2f} {right:.2f} {down:.2f}] (body)"
        told.append(name)
    return f"drone {sight.drone_id} sees: {', '.join(told) or 'nobody'}"


async def main(team: str | None, drone: int | None, seconds: float | None) -> None:
    due: dict[int, float] = {}
    async with asyncio.timeout(seconds), Swarm(team) as swarm:
        async for sight in swarm.tracks(drone):
            if sight.arrived >= due.get(sight.drone_id, 0.0):
                due[sight.drone_id] = sight.arrived + 1.0
                print(words(sight), flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--team")
    parser.add_argument("--drone", type=int, help="its ID (default: all)")
    parser.add_argument("--seconds", type=float, help="end after so long")
    args = parser.parse_args()
    try:
        asyncio.run(main(args.team, args.drone, args.seconds))
    except SwarmtrackError as error:
        raise SystemExit(str(error)) from None
    except (TimeoutError, KeyboardInterrupt):
        pass
