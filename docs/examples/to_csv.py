"""Record where every drone sees its teammates: FILE.csv for people, FILE.npz for NumPy.

`python docs/examples/to_csv.py flight --team red --seconds 60` writes flight.csv and flight.npz.
"""

import argparse
import asyncio
import csv
from pathlib import Path

import numpy as np

from swarmtrack.client import Sight, Swarm
from swarmtrack.errors import SwarmtrackError

COLUMNS = (
    "t_utc_s", "observer", "track", "identity", "probability", "north_m", "east_m", "down_m", "sigma_m",
    "forward", "right", "down", "sigma_rad",
)  # fmt: skip
NOTHING = [float("nan")] * 4


def rows(sight: Sight) -> list[list[float]]:
    """A row per track; identity 0 is unknown, -1 foreign. What is not known is NaN."""
    found = []
    for target in sight.targets:
        identity = -1 if target.identity == "foreign" else target.identity or 0
        relative, body = target.relative, target.direction_body
        metres = NOTHING if relative is None else [*relative.position.tolist(), relative.distance_sigma]
        ray = NOTHING if body is None else [*body.tolist(), target.direction_sigma or 0.0]
        found.append(
            [sight.t_utc_s, sight.drone_id, target.id, identity, target.identity_probability, *metres, *ray]
        )
    return found


async def record(table: list[list[float]], team: str | None, seconds: float | None) -> None:
    async with asyncio.timeout(seconds), Swarm(team) as swarm:
        async for sight in swarm.tracks():
            table += rows(sight)


def main(name: str, team: str | None, seconds: float | None) -> None:
    table: list[list[float]] = []
    try:
        asyncio.run(record(table, team, seconds))
    except SwarmtrackError as error:
        raise SystemExit(str(error)) from None
    except (TimeoutError, KeyboardInterrupt):
        pass
    with Path(f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([COLUMNS, *table])
    columns = np.array(table).reshape(-1, len(COLUMNS)).T
    np.savez(f"{name}.npz", **dict(zip(COLUMNS, columns, strict=True)))
    print(f"{len(table)} rows in {name}.csv and {name}.npz")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", metavar="FILE", help="without its ending")
    parser.add_argument("--team")
    parser.add_argument("--seconds", type=float, help="end after so long")
    args = parser.parse_args()
    main(args.name, args.team, args.seconds)
