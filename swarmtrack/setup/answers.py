"""How the answers to `swarmtrack config new` are read: each raises ValueError or SwarmtrackError with a sentence."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

from swarmtrack.errors import SourceError
from swarmtrack.setup.team_check import SAME_START_M


class Wiring(NamedTuple):
    """How an autopilot is usually connected: its address, and what is to know of it, as lines of a comment."""

    link: str
    notes: tuple[str, ...] = ()


# m: of a start that was measured by a tape; the config says so, and can be corrected.
TAPE_SIGMA_M = 0.1
MOST_AT_ONCE = 100  # drones: a larger range is a slip
MOST_SPACING_M = 100.0  # m between drones on the ground: more is a slip
UART = "serial:/dev/ttyAMA0:921600"
USB = "serial:/dev/ttyACM0:921600"
PX4_UART = "PX4, once: MAV_1_CONFIG = TELEM 2, MAV_1_MODE = Onboard, SER_TEL2_BAUD = 921600"
ARDUPILOT_UART = "ArduPilot, once: SERIAL2_PROTOCOL = 2, SERIAL2_BAUD = 921; SR2_* stay as they are"
DEVICES = "/dev/ttyAMA0 is the UART of a Raspberry Pi; a Jetson has /dev/ttyTHS1"
BY_ID = "Its name in /dev/serial/by-id survives replugging."
OUTSIDE = "An autopilot on a cable: our own address on it, and a signing_key (docs/security.md)."
WIRINGS = {
    "px4-uart": Wiring(UART, (PX4_UART, DEVICES)),
    "px4-usb": Wiring(USB, (BY_ID,)),
    "px4-udp": Wiring(
        "udpin:127.0.0.1:14540", ("PX4's port for companions, from a router on this computer.", OUTSIDE)
    ),
    "ardupilot-uart": Wiring(UART, (ARDUPILOT_UART, DEVICES)),
    "ardupilot-usb": Wiring(USB, (BY_ID,)),
    "ardupilot-udp": Wiring("udpin:127.0.0.1:14550", ("Let the router on this computer send here.", OUTSIDE)),
    "none": Wiring("none", ("No autopilot: the camera's turns are measured in its images.",)),
}


class CalibrationFile(NamedTuple):
    """A file that could be read, and the image size it is for."""

    file: Path
    size: tuple[int, int]


def drone_id(text: str) -> int:
    if not (text.isascii() and text.isdigit() and 1 <= int(text) <= 65535):
        raise ValueError(f"found {text}, expected a whole number, 1 … 65535")
    return int(text)


def drone_ids(text: str) -> list[int]:
    """`11-15`, `11,13` or both."""
    found: list[int] = []
    for part in text.split(","):
        first, dash, last = part.partition("-")
        low, high = drone_id(first), drone_id(last if dash else first)
        if not 0 <= high - low < MOST_AT_ONCE:
            raise ValueError(f"found {part}, expected FIRST-LAST, {MOST_AT_ONCE} drones at most")
        found += range(low, high + 1)
    if len(found) > MOST_AT_ONCE or len(set(found)) < len(found):
        raise ValueError(f"found {text}, expected {MOST_AT_ONCE} drones at most, each once")
    return found


def spacing(text: str) -> float:
    """m."""
    try:
        metres = float(text)
    except ValueError:
        metres = math.nan
    if not SAME_START_M < metres <= MOST_SPACING_M:
        raise ValueError(f"found {text}, expected metres, above {SAME_START_M} to {MOST_SPACING_M:g}")
    return metres


def peer(text: str) -> tuple[int, str]:
    number, _, host = text.partition("=")
    if not host:
        raise ValueError(f"found {text}, expected ID=HOST or ID=HOST:PORT")
    return drone_id(number), host


def size(text: str) -> tuple[int, int]:
    """(width, height) px."""
    width, _, height = text.lower().partition("x")
    if not all(side.isascii() and side.isdigit() and 0 < int(side) < 100_000 for side in (width, height)):
        raise ValueError(f"found {text}, expected WIDTHxHEIGHT such as 640x480")
    return int(width), int(height)


def angle(text: str) -> float:
    """Degrees."""
    try:
        degrees = float(text)
    except ValueError:
        degrees = math.nan
    if not 1.0 <= degrees <= 170.0:
        raise ValueError(f"found {text}, expected degrees, 1 … 170 (wider lenses need a calibration)")
    return degrees


def calibration(text: str) -> CalibrationFile | None:
    """None: there is none yet."""
    from swarmtrack.config.camera_files import load_calibration

    if text == "-":
        return None
    lens = load_calibration(Path(text), None).camera
    return CalibrationFile(Path(text), (lens.width, lens.height))


def camera(text: str) -> str:
    """`usb`, or an address that can be one."""
    from swarmtrack.camera_sources.address import parse_address

    if text != "usb":
        parse_address(text)
    return text


def wiring(text: str) -> Wiring:
    from swarmtrack.autopilot.address import parse_address

    if text in WIRINGS:
        return WIRINGS[text]
    if text == "sim":
        return Wiring("sim", ("The same simulation.",))
    try:
        return Wiring(str(parse_address(text)))
    except SourceError as error:
        raise ValueError(f"{error}; or one of {', '.join(WIRINGS)}") from error


class StartPlan(NamedTuple):
    """Where a drone starts: the whole value of drone.start, or a measured place [m] and heading [°] for it."""

    stated: str
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw_deg: float = 0.0

    @property
    def value(self) -> str:
        """The value of drone.start."""
        place = ", ".join(map(str, self.place))
        return self.stated or (
            f"{{ position_m = [{place}], yaw_deg = {self.yaw_deg}, position_sigma_m = {TAPE_SIGMA_M} }}"
        )

    def grid(self, drones: int, spacing_m: float) -> list[StartPlan]:
        """The starts of so many drones with the same heading: in rows to the right of the first and behind it."""
        columns = math.ceil(math.sqrt(drones))
        yaw, (north, east, down) = math.radians(self.yaw_deg), self.place
        starts = []
        for k in range(drones):
            row, column = divmod(k, columns)
            ahead, right = -row * spacing_m, column * spacing_m
            place = (
                round(north + ahead * math.cos(yaw) - right * math.sin(yaw), 3) + 0.0,
                round(east + ahead * math.sin(yaw) + right * math.cos(yaw), 3) + 0.0,
                down,
            )
            starts.append(self._replace(place=place))
        return starts


def start(text: str) -> StartPlan:
    """The value of drone.start."""
    words = text.split()
    if words == ["gps"]:
        return StartPlan('{ from = "gps" }')  # the receiver knows how good it is
    if words == ["local"]:
        return StartPlan(f'{{ from = "local", position_sigma_m = {TAPE_SIGMA_M} }}')
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != 4 or not all(map(math.isfinite, numbers)):
        raise ValueError(f"found {text}, expected NORTH EAST DOWN YAW, gps or local")
    north, east, down, yaw = numbers
    return StartPlan("", (north, east, down), yaw)
