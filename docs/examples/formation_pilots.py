"""The pilots of a rehearsal in formation, one for each drone of a world file with [formation] (docs/rehearse.md).

All take off. The followers' pilots hold in LOITER, and change to GUIDED: from then on their agents fly them. The
leader's pilot flies a square, by which it is known, then away, round a quarter turn, and stops. Then all land.

    python docs/examples/formation_pilots.py configs/worlds/formation.toml tcp:127.0.0.1:5760 tcp:127.0.0.1:5770 …

The links are those of ground stations, in the order of the world's drones.
"""

import argparse
import time
import tomllib
from pathlib import Path

from pymavlink import mavutil

GUIDED, LOITER, LAND = 4, 5, 9
DO_SET_MODE, ARM, TAKE_OFF = 176, 400, 22
VELOCITY_AND_YAW_RATE = 0b010111000111
PATIENCE_S = 20.0
CLIMBS_M_S = 2.0
# s, and m/s to the north and to the east.
SQUARE = ((2.0, 0.8, 0.0), (2.0, 0.0, 0.8), (2.0, -0.8, 0.0), (2.0, 0.0, -0.8), (3.0, 0.0, 0.0))
AWAY = ((10.0, 1.5, 0.0), (2.5, 1.06, 1.06), (8.0, 0.0, 1.5), (8.0, 0.0, 0.0))


class Pilot:
    """Of one drone, by its ground station's link."""

    def __init__(self, drone: int, link: str) -> None:
        self.drone = drone
        self._link = mavutil.mavlink_connection(link, source_system=255)
        self._beat()
        if self._link.wait_heartbeat(timeout=PATIENCE_S) is None:
            raise SystemExit(f"drone {drone}: {link} is silent")

    def command(self, number: int, *values: float) -> bool:
        """Whether the autopilot accepts it."""
        self._link.mav.command_long_send(
            self._link.target_system, 1, number, 0, *values, *[0] * (7 - len(values))
        )
        asked = f"COMMAND_ACK.command=={number}"
        answer = self._link.recv_match(type="COMMAND_ACK", condition=asked, blocking=True, timeout=5)
        return answer is not None and answer.result == 0

    def change_mode(self, mode: int) -> None:
        if not self.command(DO_SET_MODE, 1, mode):
            raise SystemExit(f"drone {self.drone}: mode {mode} is refused")

    def take_off(self, height: float) -> None:
        """In GUIDED, as soon as it knows where it is."""
        self.change_mode(GUIDED)
        while not self.command(ARM, 1):
            print(f"drone {self.drone}: does not arm yet", flush=True)
            time.sleep(1.0)
        if not self.command(TAKE_OFF, 0, 0, 0, 0, 0, 0, height):
            raise SystemExit(f"drone {self.drone}: refuses to take off")

    def steer(self, north: float, east: float) -> None:
        """A velocity, m/s, the heading as it is."""
        self._link.mav.set_position_target_local_ned_send(
            0, self._link.target_system, 1, 1, VELOCITY_AND_YAW_RATE, 0, 0, 0, north, east, 0, 0, 0, 0, 0, 0
        )

    def hold_sticks(self) -> None:
        """In the middle, for LOITER; and what came meanwhile is read away."""
        self._beat()
        self._link.mav.rc_channels_override_send(self._link.target_system, 1, *[1500] * 4, *[0] * 4)
        while self._link.recv_match() is not None:
            pass

    def _beat(self) -> None:
        self._link.mav.heartbeat_send(6, 8, 0, 0, 4)


def main() -> None:
    parser = argparse.ArgumentParser(description="The pilots of a rehearsal in formation.")
    parser.add_argument("world", type=Path, help="the world file, with [formation]")
    parser.add_argument("links", nargs="+", metavar="LINK", help="of each [[drone]], as pymavlink has it")
    parser.add_argument(
        "--hover", type=float, default=20.0, metavar="S", help="in LOITER: headings align in flight"
    )
    arguments = parser.parse_args()
    try:
        world = tomllib.loads(arguments.world.read_text(encoding="utf-8"))
        plan, drones = world["formation"], [drone["id"] for drone in world["drone"]]
    except (OSError, ValueError, KeyError) as error:
        parser.error(f"{arguments.world}: {error!r}, expected a world file with [[drone]] and [formation]")
    if len(drones) != len(arguments.links):
        parser.error(
            f"{len(arguments.links)} links, expected {len(drones)}: one for each drone of {arguments.world}"
        )
    pilots = {drone: Pilot(drone, link) for drone, link in zip(drones, arguments.links, strict=True)}
    leader = pilots[plan["leader"]]
    followers = [pilot for pilot in pilots.values() if pilot is not leader]

    def fly(seconds: float, north: float = 0.0, east: float = 0.0, *, leading: bool = False) -> None:
        ends = time.monotonic() + seconds
        while time.monotonic() < ends:
            for pilot in pilots.values():
                pilot.hold_sticks()
            if leading:
                leader.steer(north, east)
            time.sleep(0.1)

    def say(what: str) -> None:
        print(what, flush=True)

    input("all autopilots are there. Start swarmtrack sim, and press Enter when the agents see each other: ")
    heights = {int(drone): plan["height_m"] - slot[2] for drone, slot in plan["slots"].items()}
    for pilot in pilots.values():
        pilot.take_off(heights.get(pilot.drone, plan["height_m"]))
    say("all take off")
    fly(5.0 + max(heights.values()) / CLIMBS_M_S)
    for pilot in followers:
        pilot.change_mode(LOITER)
    fly(arguments.hover)
    say("the followers' agents fly")
    for pilot in followers:
        pilot.change_mode(GUIDED)
    fly(3.0, leading=True)
    for seconds, north, east in SQUARE:
        fly(seconds, north, east, leading=True)
    say("the leader flies off")
    for seconds, north, east in AWAY:
        fly(seconds, north, east, leading=True)
    say("all land")
    for pilot in followers:
        pilot.change_mode(LOITER)
    for pilot in pilots.values():
        pilot.change_mode(LAND)


if __name__ == "__main__":
    main()
