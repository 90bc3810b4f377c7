"""The text of a first config: of a drone, and of its team."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

NO_PEERS: Mapping[int, str] = MappingProxyType({})
BY_TAPE = """\
# Its pose at the start of its agent: [north, east, down] in the team frame (up is negative), the nose clockwise from
# north. position_sigma_m: 0.1 by a tape, 0.3 on a marked pad, 1 paced out. With from = "local" or "gps" instead, the
# agent may restart in the air."""
BY_AUTOPILOT = """\
# The pose comes from the autopilot, also after a restart in the air. position_sigma_m is how well its local origin
# is measured; GPS reports its own accuracy."""
NO_MOUNT = "{ rpy_deg = [0.0, 0.0, 0.0], position_m = [0.0, 0.0, 0.0] }"
MOUNT = """
# Where the camera sits: zero angles look along the nose, upright; pitch 20 looks 20 degrees up, yaw 90 to the right.
# position_m is [forward, right, down] from the autopilot.
body_from_camera = """


class DronePlan(NamedTuple):
    """Contents of drone-ID.toml. lens: lines of [camera], none for a simulation; mount: the value of body_from_camera;
    notes: on the link; start: the value of drone.start."""

    drone_id: int
    team: str
    camera: str
    lens: list[str]
    mount: str
    link: str
    notes: tuple[str, ...]
    start: str


class TeamPlan(NamedTuple):
    """Contents of team.toml. origin: latitude and longitude in degrees, height in m; peers: hosts by drone."""

    name: str
    origin: Sequence[float] | None = None
    peers: Mapping[int, str] = NO_PEERS
    keys: str | None = None
    insecure: bool = False


def calibrated_lens(file: str, camera: str | None = None) -> list[str]:
    """By a calibration file, relative to the config; camera: which one of several in it."""
    which = [] if camera is None else [f"calibration_camera = {as_toml(camera)}"]
    return [f"calibration = {as_toml(file)}", *which]


def known_lens(intrinsics: Mapping[str, Any], distortion: Mapping[str, Any] | None) -> list[str]:
    """By measured numbers."""
    bent = [] if distortion is None else [f"distortion = {as_toml(distortion)}"]
    return [f"intrinsics = {as_toml(intrinsics)}", *bent]


def guessed_lens(size: tuple[int, int], angle_deg: float) -> list[str]:
    """An undistorted one with square pixels; angle: from left to right."""
    width, height = size
    focal = round(0.5 * width / math.tan(math.radians(0.5 * angle_deg)), 1)
    numbers = f"fx = {focal}, fy = {focal}, cx = {(width - 1) / 2}, cy = {(height - 1) / 2}"
    return [
        f"# A guess by the lens' angle of {angle_deg:g} degrees. Measure it: swarmtrack calibrate intrinsics",
        f"intrinsics = {{ {numbers}, width = {width}, height = {height} }}",
    ]


def drone_text(plan: DronePlan) -> str:
    """drone-ID.toml."""
    lens = "\n".join(plan.lens) + MOUNT + plan.mount if plan.lens else "# A simulated camera is calibrated."
    notes = "".join(f"# {note}\n" for note in plan.notes)
    return f"""\
# Drone {plan.drone_id} of team {plan.team}. All keys: swarmtrack config reference
# Check it with: swarmtrack config check drone-{plan.drone_id}.toml

extends = "team.toml"               # what all drones share

[drone]
id = {plan.drone_id}
{BY_AUTOPILOT if "from" in plan.start else BY_TAPE}
start = {plan.start}

[camera]
source = {as_toml(plan.camera)}
{lens}

[autopilot]
{notes}link = {as_toml(plan.link)}
imu_rate_hz = 200                   # requested from the autopilot, and monitored
tell = ["status"]                   # what to send to the ground station through the autopilot

# [output]
# jsonl = "drone-{plan.drone_id}.jsonl"           # one line per frame, in the working directory
"""


def team_text(plan: TeamPlan) -> str:
    """team.toml. What is unknown is in it as a comment, to be filled in."""
    origin = "# [team]\n# origin = { lat_deg = 47.397742, lon_deg = 8.545594, alt_m = 488.0 }"
    if plan.origin:
        origin = "[team]\norigin = {{ lat_deg = {}, lon_deg = {}, alt_m = {} }}".format(*plan.origin)
    keys = f"keys = {as_toml(plan.keys)}" if plan.keys else '# keys = "keys/drone-{id}"'
    peers = ", ".join(f"{number} = {as_toml(host)}" for number, host in plan.peers.items())
    peers = f"peers = {{ {peers} }}" if peers else '# peers = { 1 = "10.0.0.11", 2 = "10.0.0.12" }'
    return f"""\
# What all drones of team {plan.name} share. Each drone has a copy.

# The origin of the team frame, for drones with start = {{ from = "gps" }}: a point of the field. alt_m is the height
# above mean sea level.
{origin}

[network]
team = {as_toml(plan.name)}
# Without keys and peers, drones find each other on one machine only.
# Made by `swarmtrack keys`, one folder per drone; {{id}} stands for drone.id:
{keys}
# HOST or HOST:PORT of every drone:
{peers}
# Without keys: anyone in radio range can listen and pretend.
{"" if plan.insecure else "# "}insecure = true

[detector]
model = "default"                   # the shipped one, or your own .onnx file

[tracker]
name = "mbm"                        # or jpdaf, gmphd, kalman
"""


def as_toml(value: Any) -> str:
    """A value, as TOML writes it: JSON does the same for all but tables."""
    if isinstance(value, Mapping):
        entries = ", ".join(f"{key} = {as_toml(one)}" for key, one in value.items())
        return f"{{ {entries} }}" if value else "{}"
    return json.dumps(value, ensure_ascii=False)
