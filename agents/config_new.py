"""`swarmtrack config new`: from a few answers to a commented config of a drone and of its team."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeVar

from swarmtrack.errors import ConfigError, SourceError, SwarmtrackError

USB_CAMERA = "v4l2:///dev/video0?width={width}&height={height}&fps=30"
FIRST_GUESS_DEG = 70.0  # of a webcam's lens, from left to right


class Wiring(NamedTuple):
    """How an autopilot is usually connected: its address, and what to set in it, as lines of a comment."""

    link: str
    notes: tuple[str, ...]


UART = "serial:/dev/ttyAMA0:921600"
BY_ID = "/dev/serial/by-id/… survives replugging"
PX4_UART = "PX4, once: MAV_1_CONFIG = TELEM 2, MAV_1_MODE = Onboard, SER_TEL2_BAUD = 921600"
ARDUPILOT_UART = (
    "ArduPilot, once: SERIAL2_PROTOCOL = 2, SERIAL2_BAUD = 921; rates are asked for, SR2_* stay as they are"
)
WIRINGS = {
    "px4-uart": Wiring(
        UART, (PX4_UART, "/dev/ttyAMA0 is the UART of a Raspberry Pi, /dev/ttyTHS1 that of a Jetson")
    ),
    "px4-usb": Wiring("serial:/dev/ttyACM0:921600", (BY_ID,)),
    "px4-udp": Wiring("udpin:0.0.0.0:14540", ("where PX4 sends to companions by default",)),
    "ardupilot-uart": Wiring(
        UART, (ARDUPILOT_UART, "/dev/ttyAMA0 is the UART of a Raspberry Pi, /dev/ttyTHS1 that of a Jetson")
    ),
    "ardupilot-usb": Wiring("serial:/dev/ttyACM0:921600", (BY_ID,)),
    "ardupilot-udp": Wiring("udpin:0.0.0.0:14550", ("where ArduPilot, or a router beside it, sends to",)),
    "none": Wiring("none", ("no autopilot: the camera is taken to be still",)),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Write drone-ID.toml, and team.toml where there is none. On a terminal, asks for what is not told."
    )
    tell = parser.add_argument
    tell("--id", type=_drone_id, metavar="N", help="the drone's ID, 1 … 65535, unique in the team")
    tell("--team", metavar="NAME", help="the team's name (default: that of team.toml, or swarm)")
    tell(
        "--camera",
        metavar="SOURCE",
        help="usb, or an address: v4l2:///dev/video2, rtsp://…, http://… (default: usb)",
    )
    tell(
        "--size",
        type=_size,
        metavar="WxH",
        help="of the images, where there is no calibration (default: 640x480)",
    )
    tell("--calibration", type=Path, metavar="FILE", help="Kalibr, ROS camera_info, OpenCV or EuRoC")
    tell(
        "--fov",
        type=_angle,
        metavar="DEG",
        help="the lens' angle from left to right, where there is no calibration",
    )
    tell("--autopilot", metavar="KIND", help=f"{', '.join(WIRINGS)}, or a link's address (default: px4-uart)")
    tell(
        "--start",
        nargs="+",
        metavar="S",
        help="NORTH EAST DOWN YAW in m and degrees; or gps, or local (default: 0 0 0 0)",
    )
    tell(
        "--origin",
        nargs=3,
        type=float,
        metavar=("LAT", "LON", "ALT"),
        help="of the team frame, for --start gps",
    )
    tell(
        "--peer",
        action="append",
        type=_peer,
        metavar="ID=HOST",
        help="address of a drone; one for each, this one too",
    )
    tell("--keys", metavar="DIR", help="folder of keys; {id} in it is drone.id")
    tell("--insecure", action="store_true", help="speak beyond this machine without keys")
    tell("--out", type=Path, default=Path(), metavar="DIR", help="where the files go (default: here)")
    tell("--force", action="store_true", help="overwrite what is there")


class Plan(NamedTuple):
    """All that the files say."""

    drone_id: int
    team: str
    camera: str
    lens: list[str]
    calibration: Path | None
    link: str
    notes: tuple[str, ...]
    start: str


def create(args: argparse.Namespace) -> None:
    """Ask, write, check; what does not pass the check is taken away again. Raises SwarmtrackError."""
    from swarmtrack.agents.vehicle import check

    ask = _asked if sys.stdin.isatty() and sys.stdout.isatty() else _not_asked
    drone_id = args.id if args.id is not None else ask("ID of the drone, 1 … 65535", None, _drone_id, "--id")
    team_file, drone_file = args.out / "team.toml", args.out / f"drone-{drone_id}.toml"
    if drone_file.exists() and not args.force:
        raise ConfigError([f"{drone_file}: is there already, expected another --id, --out or --force"])
    plan = _plan(args, drone_id, team_file, ask)
    texts = {drone_file: drone_text(plan)}
    if args.force or not team_file.exists():
        texts = {team_file: team_text(plan.team, args), **texts}
    if plan.calibration is not None:
        texts |= _beside(args.out, plan.calibration, args.force)
    before = {path: path.read_bytes() if path.exists() else None for path in texts}
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        for path, text in texts.items():
            path.write_text(text, encoding="utf-8")
        check(drone_file)
    except OSError as error:
        _restore(before)
        raise ConfigError(
            [f"--out: {args.out}: {error.strerror}, expected a folder for the files"]
        ) from error
    except SwarmtrackError as error:
        _restore(before)
        raise ConfigError([f"nothing was written, because it would not work:\n{error}"]) from error
    kept = "" if team_file in texts else f" ({team_file} is as it was)"
    print(f"written: {', '.join(map(str, texts))}{kept}")
    if plan.lens and plan.calibration is None:
        print(
            "the lens is guessed: `swarmtrack calibrate` measures it, and tracks and identities get better by it"
        )
    print(f"next: swarmtrack doctor --config {drone_file}")


def _beside(folder: Path, calibration: Path, force: bool) -> dict[Path, str]:
    """A copy of the calibration for the config's folder, which can then be carried to the drone as it is."""
    copy, text = folder / calibration.name, calibration.read_text(encoding="utf-8")
    if not copy.exists():
        return {copy: text}
    if copy.read_text(encoding="utf-8") == text:
        return {}
    if not force:
        raise ConfigError([f"{copy}: is there already and another one, expected another name, or --force"])
    return {copy: text}


def _restore(before: dict[Path, bytes | None]) -> None:
    for path, content in before.items():
        if content is None:
            path.unlink(missing_ok=True)
        else:
            path.write_bytes(content)


# ── questions ────────────────────────────────────────────────────────────────────────────────────────────────────────

_T = TypeVar("_T")


def _asked(question: str, default: str | None, read: Callable[[str], _T], flag: str) -> _T:
    """Until the answer can be read; an empty one is the default."""
    while True:
        try:
            answer = input(f"{question}{f' [{default}]' if default else ''}: ").strip() or default
        except EOFError:
            raise ConfigError([f"{flag}: no answer, expected one or the flag"]) from None
        if answer is None:
            continue
        try:
            return read(answer)
        except (argparse.ArgumentTypeError, SwarmtrackError) as error:
            print(f"  {error}")


def _not_asked(question: str, default: str | None, read: Callable[[str], _T], flag: str) -> _T:
    if default is None:
        raise ConfigError([f"{flag}: missing, expected {question}"])
    return read(default)


Ask = Callable[[str, str | None, Callable[[str], _T], str], _T]


def _plan(args: argparse.Namespace, drone_id: int, team_file: Path, ask: Ask[object]) -> Plan:
    team = _team(args, team_file, ask)
    camera = (
        _camera(args.camera)
        if args.camera
        else str(ask("camera: usb, or an address", "usb", _camera, "--camera"))
    )
    lens, calibration, size = _lens(args, camera, ask)
    kinds = f"autopilot: {', '.join(WIRINGS)}, or an address"
    wiring = _wiring(args.autopilot) if args.autopilot else ask(kinds, "px4-uart", _wiring, "--autopilot")
    assert isinstance(wiring, Wiring)
    where = "start: NORTH EAST DOWN YAW in m and degrees, or gps, or local"
    start = (
        _start(args.start)
        if args.start
        else str(ask(where, "0 0 0 0", lambda s: _start(s.split()), "--start"))
    )
    return Plan(
        drone_id=drone_id,
        team=team,
        camera=camera.format(width=size[0], height=size[1]) if camera == USB_CAMERA else camera,
        lens=lens,
        calibration=calibration,
        link=wiring.link,
        notes=wiring.notes,
        start=start,
    )


def _team(args: argparse.Namespace, team_file: Path, ask: Ask[object]) -> str:
    """The team's name. A file of the team that is there stays as it is, and must be of this team."""
    from swarmtrack.config import load_team_config

    if not team_file.exists() or args.force:
        name = args.team or ask("name of the team", "swarm", str, "--team")
        return str(name)
    there = load_team_config(team_file).network.team
    if args.team not in (None, there):
        raise ConfigError([f"--team: {args.team}, expected {there} as in {team_file}, or --force"])
    for flag in ("peer", "keys", "insecure", "origin"):
        if getattr(args, flag):
            raise ConfigError(
                [f"--{flag}: {team_file} is there already, expected that to be edited, or --force"]
            )
    return there


def _lens(
    args: argparse.Namespace, camera: str, ask: Ask[object]
) -> tuple[list[str], Path | None, tuple[int, int]]:
    """Lines of [camera] on the lens, the file it was read from, and the image's size."""
    if camera.startswith("sim:"):
        return [], None, (0, 0)
    file = args.calibration
    if file is None and args.fov is None:
        answer = str(ask("calibration file; - for none yet", "-", _calibration_answer, "--calibration"))
        file = None if answer == "-" else Path(answer)
    if file is not None:
        from swarmtrack.calibration import load_calibration

        lens = load_calibration(file, None).camera
        return [f"calibration = {_quoted(file.name)}"], file, (lens.width, lens.height)
    width, height = args.size or (640, 480)
    if args.size is None and camera == USB_CAMERA:
        width, height = ask("size of the images", "640x480", _size, "--size")  # type: ignore[misc]
    fov = args.fov or ask(
        "the lens' angle from left to right, degrees", f"{FIRST_GUESS_DEG:g}", _angle, "--fov"
    )
    assert isinstance(fov, float)
    focal = round(0.5 * width / math.tan(math.radians(0.5 * fov)), 1)
    numbers = f"fx = {focal}, fy = {focal}, cx = {(width - 1) / 2}, cy = {(height - 1) / 2}"
    return (
        [
            f"# A guess by the lens' angle of {fov:g} degrees. Measure it: swarmtrack calibrate",
            f"intrinsics = {{ {numbers}, width = {width}, height = {height} }}",
        ],
        None,
        (width, height),
    )


def _calibration_answer(text: str) -> str:
    if text != "-" and not Path(text).is_file():
        raise argparse.ArgumentTypeError(f"found {text}, expected a file that is there, or -")
    return text


def _drone_id(text: str) -> int:
    if not (text.isascii() and text.isdigit() and 1 <= int(text) <= 65535):
        raise argparse.ArgumentTypeError(f"found {text}, expected a whole number, 1 … 65535")
    return int(text)


def _peer(text: str) -> tuple[int, str]:
    number, _, host = text.partition("=")
    if not host:
        raise argparse.ArgumentTypeError(f"found {text}, expected ID=HOST or ID=HOST:PORT")
    return _drone_id(number), host


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not all(side.isascii() and side.isdigit() and 0 < int(side) < 100_000 for side in (width, height)):
        raise argparse.ArgumentTypeError(f"found {text}, expected WIDTHxHEIGHT such as 640x480")
    return int(width), int(height)


def _angle(text: str) -> float:
    try:
        angle = float(text)
    except ValueError:
        angle = math.nan
    if not 1.0 <= angle <= 170.0:
        raise argparse.ArgumentTypeError(
            f"found {text}, expected degrees, 1 … 170 (wider lenses need a calibration)"
        )
    return angle


def _camera(text: str) -> str:
    from swarmtrack.sensors.camera_address import parse_address

    if text == "usb":
        return USB_CAMERA
    parse_address(text)
    return text


def _wiring(text: str) -> Wiring:
    from swarmtrack.sensors.mavlink.address import parse_address

    if text in WIRINGS:
        return WIRINGS[text]
    if text == "sim":
        return Wiring("sim", ("of the camera's simulation",))
    try:
        return Wiring(str(parse_address(text)), ())
    except SourceError as error:
        raise ConfigError([f"{error}; or one of {', '.join(WIRINGS)}"]) from error


def _start(words: list[str]) -> str:
    """The value of drone.start."""
    if words in (["gps"], ["local"]):
        return f'{{ from = "{words[0]}" }}'
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != 4 or not all(map(math.isfinite, numbers)):
        raise ConfigError([f"--start: {' '.join(words)}, expected NORTH EAST DOWN YAW, gps or local"])
    return f"{{ position_m = [{', '.join(map(str, numbers[:3]))}], yaw_deg = {numbers[3]} }}"


# ── files ────────────────────────────────────────────────────────────────────────────────────────────────────────────


def _quoted(text: str) -> str:
    """As TOML writes a string: JSON does the same."""
    return json.dumps(text, ensure_ascii=False)


def drone_text(plan: Plan) -> str:
    """drone-ID.toml."""
    by_autopilot = "from" in plan.start
    where = (
        "Its place is its autopilot's to say, also after a restart in the air."
        if by_autopilot
        else "Where it stands when its agent starts: [north, east, down] in the team frame (up is negative), the nose\n"
        '# clockwise from north. from = "local" or "gps" instead survives a restart in the air.'
    )
    lens = "\n".join(plan.lens)
    notes = "".join(f"# {note}\n" for note in plan.notes)
    return f"""\
# Drone {plan.drone_id} of team {plan.team}. All keys: swarmtrack config reference
# Check it with: swarmtrack config check drone-{plan.drone_id}.toml

extends = "team.toml"               # what all drones share

[drone]
id = {plan.drone_id}
# {where}
start = {plan.start}

[camera]
source = {_quoted(plan.camera)}
{lens}{
        '''
# Where the camera sits: zero angles look along the nose, upright; pitch 20 looks 20 degrees up, yaw 90 to the right.
# position_m is [forward, right, down] from the autopilot. Both matter to whom a track is taken for.
body_from_camera = { rpy_deg = [0.0, 0.0, 0.0], position_m = [0.0, 0.0, 0.0] }'''
        if plan.lens
        else ""
    }

[autopilot]
{notes}link = {_quoted(plan.link)}
imu_rate_hz = 200                   # asked of the autopilot, and watched
tell = ["status"]                   # what a ground station hears by way of the autopilot; [] for nothing

# [output]
# jsonl = "drone-{plan.drone_id}.jsonl"           # a line for each frame, in the working directory
"""


def team_text(team: str, args: argparse.Namespace) -> str:
    """team.toml."""
    origin = "# origin = { lat_deg = 47.397742, lon_deg = 8.545594, alt_m = 488.0 }"
    if args.origin:
        origin = "origin = {{ lat_deg = {}, lon_deg = {}, alt_m = {} }}".format(*args.origin)
    head = "[team]" if args.origin else "# [team]"
    peers = ", ".join(f"{number} = {_quoted(host)}" for number, host in args.peer or ())
    lines = {
        "keys": f"keys = {_quoted(args.keys)}" if args.keys else '# keys = "keys/drone-{id}"',
        "peers": f"peers = {{ {peers} }}" if peers else '# peers = { 1 = "10.0.0.11", 2 = "10.0.0.12" }',
        "insecure": "insecure = true" if args.insecure else "# insecure = true",
    }
    return f"""\
# What all drones of team {team} share; a copy lies on each.

# Where on the Earth the team frame begins, for drones that start = {{ from = "gps" }}: a point of the field, above mean
# sea level.
{head}
{origin}

[network]
team = {_quoted(team)}
# Without the next two, drones find each other on one machine only.
{lines["keys"]}          # made by `swarmtrack keys`; {{id}} is drone.id
{lines["peers"]}         # HOST or HOST:PORT of every drone
{lines["insecure"]}                   # without keys: anyone in radio range can listen and pretend

[detector]
model = "default"                   # the one that is shipped, or your own .onnx file

[tracker]
name = "mbm"                        # or jpdaf, gmphd, kalman
"""
