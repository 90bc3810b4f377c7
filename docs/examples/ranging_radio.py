"""Tell a drone what its ranging radio measures: lines "ID METRES" on standard input, as a radio's driver prints them.

`uwb-driver | python docs/examples/ranging_radio.py --team red --drone 1 --sigma 0.1`
"""

import argparse
import asyncio
import sys

from swarmtrack.client import Ranging
from swarmtrack.errors import SwarmtrackError


async def main(team: str | None, drone: int, sigma: float) -> None:
    async with Ranging(drone, team) as ranging:
        while line := await asyncio.to_thread(sys.stdin.readline):
            try:
                other, metres = line.split()
                await ranging.say(int(other), float(metres), sigma)
            except ValueError as error:
                # A radio that stutters is no reason to stop.
                print(f"{line.strip()!r} is no distance: {error}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--team")
    parser.add_argument("--drone", type=int, required=True, help="the ID of the one that carries the radio")
    parser.add_argument("--sigma", type=float, default=0.1, help="m: standard deviation (default: 0.1)")
    args = parser.parse_args()
    try:
        asyncio.run(main(args.team, args.drone, args.sigma))
    except SwarmtrackError as error:
        raise SystemExit(str(error)) from None
    except KeyboardInterrupt:
        pass
