"""The pilots of a rehearsal in formation, one for each drone of a world file with [formation] (docs/rehearse.md).

All take off. The followers' pilots hold in LOITER (PX4: HOLD), and change to GUIDED (OFFBOARD): from then on their
agents fly them. The leader's pilot flies a square, by which it is known, then away, round a quarter turn, and stops.
Then all land. ArduCopter and PX4 may fly together. The leader flies away `judged_from_s` after the take-off.
With --without-gps 2, the simulated GPS of drone 2, an ArduCopter, is off for a minute from just before that on, and its
pilot selects EKF source set 2 (docs/feeding.md).

    python docs/examples/formation_pilots.py configs/worlds/formation.toml tcp:127.0.0.1:5760 tcp:127.0.0.1:5770 …

The links are those of ground stations, in the order of the world's drones.
"""

import argparse
import math
import time
import tomllib
from pathlib import Path
from typing import Any

from pymavlink import mavutil

DO_SET_MODE, ARM, TAKE_OFF, SET_MESSAGE_INTERVAL, DO_AUX_FUNCTION = 176, 400, 22, 511, 218
GLOBAL_POSITION_INT, EVERY_200_MS = 33, 200_000
ARDUPILOT, PX4 = 3, 12  # MAV_AUTOPILOT
# What DO_SET_MODE asks for: ArduCopter's numbers, and PX4's main mode and sub-mode. PX4's 4 is AUTO.
MODES: dict[int, dict[str, tuple[int, ...]]] = {
    ARDUPILOT: {"fly": (4,), "hold": (5,), "land": (9,)},  # GUIDED, LOITER, LAND
    PX4: {"fly": (6,), "hold": (4, 3), "land": (4, 6)},  # OFFBOARD, HOLD, LAND
}
VELOCITY_AND_YAW_RATE = 0b010111000111
EKF_SOURCE_SET, LOW, MIDDLE = 90, 0, 1  # an auxiliary function, and positions of its switch: set 1, set 2
GPS_OF_SITL = b"SIM_GPS1_ENABLE"
WITHOUT_GPS_S, BLIND_BEFORE_S, SOUND_AGAIN_S = 60.0, 5.0, 15.0
STREAMS_S = 1.0  # before OFFBOARD, into which PX4 lets nobody who does not stream yet
# ArduCopter aligns its heading in the air. PX4's drifts in hover, until it has flown ten metres.
HOVER_S = {ARDUPILOT: 20.0, PX4: 5.0}
TAKEN_OFF_M = 1.0
ARRIVED_M_S = 0.3
PATIENCE_S = 20.0
MODE_ATTEMPTS = 5  # a second apart
CLIMBS_M_S = 1.0  # at least: PX4 takes off at 1.5 m/s, ArduCopter at 2.5
# s, and m/s to the north and to the east.
STILL = ((3.0, 0.0, 0.0),)
SQUARE = ((2.0, 0.8, 0.0), (2.0, 0.0, 0.8), (2.0, -0.8, 0.0), (2.0, 0.0, -0.8), (3.0, 0.0, 0.0))
AWAY = ((10.0, 1.0, 0.0), (2.5, 0.71, 0.71), (8.0, 0.0, 1.0), (8.0, 0.0, 0.0))  # times --speed
SPEED_M_S = 1.5
BEFORE_S = STREAMS_S + sum(leg[0] for leg in (*STILL, *SQUARE))  # from engaging to flying away


class Pilot:
    """Of one drone, by its ground station's link."""

    def __init__(self, drone: int, link: str) -> None:
        self.drone = drone
        self.height, self.climb = 0.0, 0.0  # m above the point where it was armed, m/s upwards
        self._link = mavutil.mavlink_connection(link, source_system=255)
        self._system, self.kind = self._meet(link)
        self._sea = math.nan  # m, its height above mean sea level
        self.command(SET_MESSAGE_INTERVAL, GLOBAL_POSITION_INT, EVERY_200_MS)

    def _meet(self, link: str) -> tuple[int, int]:
        """System and MAV_AUTOPILOT of the autopilot there."""
        ends = time.monotonic() + PATIENCE_S
        while time.monotonic() < ends:
            self._beat()
            heard = self._link.recv_match(type="HEARTBEAT", blocking=True, timeout=1)
            if heard is not None and heard.autopilot in MODES:
                return heard.get_srcSystem(), heard.autopilot
        raise SystemExit(f"drone {self.drone}: {link} is silent, expected an ArduPilot or a PX4")

    def command(self, number: int, *values: float) -> bool:
        """Whether the autopilot accepts it."""
        self._link.mav.command_long_send(self._system, 1, number, 0, *values, *[0] * (7 - len(values)))
        asked = f"COMMAND_ACK.command=={number}"
        answer = self._link.recv_match(type="COMMAND_ACK", condition=asked, blocking=True, timeout=5)
        return answer is not None and answer.result == 0

    def change_mode(self, mode: str) -> None:
        """Again, where it is refused: PX4 does not enter OFFBOARD in a second without set points."""
        for _ in range(MODE_ATTEMPTS):
            if self.command(DO_SET_MODE, 1, *MODES[self.kind][mode]):
                return
            time.sleep(1.0)
        raise SystemExit(f"drone {self.drone}: refuses to {mode}")

    def take_off(self, height: float) -> None:
        """As soon as it knows where it is: an EKF needs 40 s after its start."""
        if self.kind == PX4:
            # Its take-off is a mode, begins when it is armed, and wants a height above the sea.
            while math.isnan(self._sea):
                self.listen()
                time.sleep(0.1)
            self._begin(TAKE_OFF, 0, 0, 0, math.nan, math.nan, math.nan, self._sea + height)
            self._arm()
        else:
            self.change_mode("fly")
            self._arm()
            self._begin(TAKE_OFF, 0, 0, 0, 0, 0, 0, height)

    def switch_gps(self, on: bool) -> None:
        """Of an ArduCopter's simulator; and the source set that its EKF shall use then."""
        self._link.mav.param_set_send(self._system, 1, GPS_OF_SITL, float(on), 2)
        if not self.command(DO_AUX_FUNCTION, EKF_SOURCE_SET, LOW if on else MIDDLE):
            print(f"drone {self.drone}: does not change its EKF source set", flush=True)

    def is_up(self, height: float) -> bool:
        """Whether its climb is over. How high it is for itself depends on its barometer and its receiver."""
        return self.height > 0.5 * height and abs(self.climb) < ARRIVED_M_S

    def _arm(self) -> None:
        while not self.command(ARM, 1):
            print(f"drone {self.drone}: does not arm yet", flush=True)
            self.listen()
            time.sleep(1.0)

    def _begin(self, *command: float) -> None:
        if not self.command(int(command[0]), *command[1:]):
            raise SystemExit(f"drone {self.drone}: refuses to take off")

    def steer(self, north: float, east: float) -> None:
        """A velocity, m/s, the heading as it is."""
        self._link.mav.set_position_target_local_ned_send(
            0, self._system, 1, 1, VELOCITY_AND_YAW_RATE, 0, 0, 0, north, east, 0, 0, 0, 0, 0, 0
        )

    def listen(self) -> None:
        """Sticks in the middle, for LOITER; and what came meanwhile is read."""
        self._beat()
        # ArduCopter does not arm with the throttle there.
        if self.kind == ARDUPILOT and self.height > TAKEN_OFF_M:
            self._link.mav.rc_channels_override_send(self._system, 1, *[1500] * 4, *[0] * 4)
        while (message := self._link.recv_match()) is not None:
            self._on_message(message)

    def _on_message(self, message: Any) -> None:
        if message.get_type() == "GLOBAL_POSITION_INT" and message.get_srcSystem() == self._system:
            self.height, self.climb = 1e-3 * message.relative_alt, -1e-2 * message.vz
            self._sea = 1e-3 * message.alt
        elif message.get_type() == "STATUSTEXT" and message.get_srcComponent() == 1:
            print(f"drone {self.drone}: {message.text}", flush=True)

    def _beat(self) -> None:
        self._link.mav.heartbeat_send(6, 8, 0, 0, 4)


class Team:
    """All pilots, who act in turn."""

    def __init__(self, pilots: dict[int, Pilot], leader: int) -> None:
        self.pilots = list(pilots.values())
        self.leader = pilots[leader]
        self.followers = [pilot for pilot in self.pilots if pilot is not self.leader]
        self.took_off_at = math.inf  # on our clock, s

    def fly(self, seconds: float, north: float = 0.0, east: float = 0.0, *, leading: bool = False) -> None:
        """leading: the leader flies at this velocity, m/s."""
        ends = time.monotonic() + seconds
        while time.monotonic() < ends:
            for pilot in self.pilots:
                pilot.listen()
                if pilot.height > TAKEN_OFF_M:
                    self.took_off_at = min(self.took_off_at, time.monotonic())
            if leading:
                self.leader.steer(north, east)
            time.sleep(0.1)

    def climb(self, heights: dict[int, float]) -> None:
        for pilot in self.pilots:
            pilot.take_off(heights[pilot.drone])
            self.fly(0.1)
        ends = time.monotonic() + PATIENCE_S + max(heights.values()) / CLIMBS_M_S
        while climbing := [pilot.drone for pilot in self.pilots if not pilot.is_up(heights[pilot.drone])]:
            self.fly(0.5)
            if time.monotonic() > ends:
                raise SystemExit(f"not at their heights: {climbing}")


def main() -> None:
    parser = argparse.ArgumentParser(description="The pilots of a rehearsal in formation.")
    parser.add_argument("world", type=Path, help="the world file, with [formation]")
    parser.add_argument("links", nargs="+", metavar="LINK", help="of each [[drone]], as pymavlink has it")
    parser.add_argument(
        "--hover", type=float, metavar="S", help="before the agents fly, at least (default: 20, only PX4s: 5)"
    )
    parser.add_argument(
        "--without-gps", type=int, metavar="DRONE", help="this ArduCopter's simulated GPS is off for a minute"
    )
    parser.add_argument(
        "--speed",
        type=float,
        default=SPEED_M_S,
        metavar="M_S",
        help="of the leader that flies away (default: %(default)s)",
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
    above = {int(drone): -slot[2] for drone, slot in plan["slots"].items()}
    blind = arguments.without_gps
    if blind is not None and (blind not in pilots or pilots[blind].kind != ARDUPILOT):
        parser.error(f"--without-gps {blind}: expected an ArduCopter of {arguments.world}")
    team = Team(pilots, plan["leader"])
    input("all autopilots are there. Start swarmtrack sim, and press Enter when the agents see each other: ")
    hover_s = arguments.hover
    if hover_s is None:
        hover_s = max(HOVER_S[pilot.kind] for pilot in team.pilots)
    heights = {drone: plan["height_m"] + above.get(drone, 0.0) for drone in drones}
    climb(team, heights, hover_s, plan.get("judged_from_s", 0.0))
    lead(team, arguments.speed, None if blind is None else pilots[blind])


def climb(team: Team, heights: dict[int, float], hover_s: float, away_s: float) -> None:
    """away_s: after the take-off, at the earliest, the leader flies off."""
    say("all take off")
    team.climb(heights)
    for pilot in team.followers:
        pilot.change_mode("hold")
    team.fly(max(hover_s, team.took_off_at + away_s - BEFORE_S - time.monotonic()))


def lead(team: Team, speed: float, blind: Pilot | None) -> None:
    """blind: the one that loses its GPS for a minute."""
    say("the followers' agents fly")
    for pilot in team.followers:
        pilot.change_mode("fly")
    team.fly(STREAMS_S, leading=True)
    team.leader.change_mode("fly")
    for seconds, north, east in (*STILL, *SQUARE):
        team.fly(seconds, north, east, leading=True)
    on_again = time.monotonic() + WITHOUT_GPS_S
    if blind is not None:
        say(f"drone {blind.drone} has no GPS")
        blind.switch_gps(on=False)
        team.fly(BLIND_BEFORE_S, leading=True)
    say("the leader flies off")
    for seconds, north, east in AWAY:
        team.fly(seconds, speed * north, speed * east, leading=True)
    if blind is not None:
        team.fly(on_again - time.monotonic(), leading=True)
        say(f"drone {blind.drone} has its GPS again")
        blind.switch_gps(on=True)
        team.fly(SOUND_AGAIN_S, leading=True)
    say("all land")
    for pilot in team.followers:
        pilot.change_mode("hold")
    for pilot in team.pilots:
        pilot.change_mode("land")


def say(what: str) -> None:
    print(what, flush=True)


if __name__ == "__main__":
    main()
