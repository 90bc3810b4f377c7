"""The configs of a local swarm: what the drones share, and one file for each, as a user would write them."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from swarmtrack.config.team import TeamOrigin
from swarmtrack.config.toml.layers import Table
from swarmtrack.geometry import rotation
from swarmtrack.lab.scenarios.scenario import Scenario
from swarmtrack.lab.world.star import TeamSlots

MAX_FRAME_AGE_S = 0.15  # beyond it a frame says more of where a drone was than of where it is


@dataclass(frozen=True, slots=True)
class Sources:
    """Where a drone finds its sensors: the values of camera.source and autopilot.link.

    camera: of the first one; more_cameras: of the others, in the order of the scenario. system_id: of its autopilot,
    None for whichever is heard. start: drone.start, None where the scenario tells it. max_frame_age_s: how late a frame
    may come.
    """

    camera: str
    autopilot: str
    system_id: int | None = None
    start: Table | None = None
    max_frame_age_s: float = MAX_FRAME_AGE_S
    more_cameras: tuple[str, ...] = ()

    @property
    def cameras(self) -> tuple[str, ...]:
        return (self.camera, *self.more_cameras)


@dataclass(frozen=True, slots=True)
class RadioEnds:
    """Zenoh endpoints of an agent with a radio of its own: `listen` on them, `connect` to teammates."""

    listen: tuple[str, ...]
    connect: tuple[str, ...]


def write_configs(
    folder: Path,
    scenario: Scenario,
    *,
    team: str,
    tracker: str,
    sources: Mapping[int, Sources],
    simulator: str,
    radio: Mapping[int, RadioEnds] | None = None,
    recordings: Path | None = None,
    origin: TeamOrigin | None = None,
    epoch_utc: float = 0.0,
    share: float = 1.0,
) -> dict[int, Path]:
    """team.toml and drone-N.toml; returns each drone's file.

    simulator: the command of a simulator for them, for whoever reads them later. radio: None for a swarm on this
    machine's loopback. recordings: the folder where every agent records. origin: of the team frame on the Earth.
    epoch_utc: world time 0, s since 1970. share: detector.share.
    """
    text = _team_file(scenario, team, tracker, simulator)
    if share < 1.0:
        text += f"\n[detector]\nshare = {share:.3f}                       # all drones share one machine\n"
    shared = []
    if origin is not None:
        place = f"lat_deg = {origin.lat_deg!r}, lon_deg = {origin.lon_deg!r}, alt_m = {origin.alt_m!r}"
        shared.append(f"origin = {{ {place} }}")
    if scenario.share_hz is not None:
        shared += ['share = "velocity"', f"share_hz = {scenario.share_hz:g}"]
    if not scenario.announces:
        shared.append("announce = false                    # nothing is sent, nothing requested")
    spans = {scenario.world.airframe(drone_id).span for drone_id in scenario.members}
    if len(spans) == 1:
        shared.append(f"airframe_span_m = {spans.pop():g}")
    if shared:
        text += "\n".join(["", "[team]", *shared, ""])
    if not scenario.announces:
        text += _silent_team(scenario, epoch_utc)
    if scenario.formation is not None:
        text += _formation(scenario.formation)
    if recordings is not None:
        text += f"\n[recording]\ndir = {_text(str(recordings))}\n"
    (folder / "team.toml").write_text(text, encoding="utf-8")
    files = {}
    for drone_id in scenario.members:
        files[drone_id] = folder / f"drone-{drone_id}.toml"
        ends = None if radio is None else radio[drone_id]
        files[drone_id].write_text(_drone_file(scenario, drone_id, sources[drone_id], ends), encoding="utf-8")
    return files


# mbm tells calm flight from agile by itself; the others have one model of motion, which had better fit.
GENTLY = "acceleration_psd = 3000.0           # px²/s³: these drones fly gently\n"


def _team_file(scenario: Scenario, team: str, tracker: str, simulator: str) -> str:
    return f"""\
# What all drones of this swarm share. A drone's own file begins with: extends = "team.toml"
#
# To fly again by hand, start
#     {simulator}
# and put the addresses that it prints into camera.source and autopilot.link of each drone's file; then, for each,
#     swarmtrack-agent --config drone-1.toml
# and `swarmtrack echo 'tracks/*' --team {team}` hears them.

[network]
team = {_text(team)}

[tracker]
name = {_text(tracker)}
p_detection = 0.9                   # that a teammate in view is detected in one frame
clutter_per_scan = 1.0              # false detections expected in one frame
{"" if tracker == "mbm" else GENTLY}
[autopilot]
imu_rate_hz = {scenario.imu_rate_hz:g}
{"" if scenario.feed == "none" else f"feed = {_text(scenario.feed)}"}
[output]
tracks_hz = {scenario.tracks_hz:g}
"""


def _silent_team(scenario: Scenario, epoch_utc: float) -> str:
    """Who starts where, for drones that do not say it."""
    lines = ["", "[team.drones]"]
    for drone_id in scenario.members:
        start = scenario.announced[drone_id]
        place = f"position_m = {_numbers(start.position_m)}, yaw_deg = {np.degrees(start.yaw):.3f}"
        lines.append(f"{drone_id} = {{ {place}, position_sigma_m = {start.position_sigma_m:g} }}")
    if scenario.codes_s:
        begins = (datetime.fromtimestamp(epoch_utc + begin, UTC) for begin in scenario.codes_s)
        lines += ["", "[team.code]", f"begins = [{', '.join(begin.isoformat() for begin in begins)}]"]
    return "\n".join([*lines, ""])


def _formation(formation: TeamSlots) -> str:
    """Who leads, everybody's slot, and what else is set."""
    settings: Table = {"enabled": True, **formation.settings}
    slots = [f"{drone_id} = {_numbers(formation.slots[drone_id])}" for drone_id in formation.followers]
    return "\n".join(
        [
            "",
            "[formation]",
            f"leader = {formation.leader}",
            f"height_m = {formation.height_m:g}",
            *(f"{name} = {_value(value)}" for name, value in settings.items()),
            "",
            "[formation.slots]                   # [north, east, down] from the leader, m",
            *slots,
            "",
        ]
    )


def _drone_file(scenario: Scenario, drone_id: int, sources: Sources, radio: RadioEnds | None) -> str:
    if sources.start is not None:
        start = _value(sources.start)
    else:
        announced = scenario.announced[drone_id]
        start = (
            f'{{ from = "local", offset_m = {_numbers(announced.position_m)}, '
            f"position_sigma_m = {announced.position_sigma_m:g} }}"
        )
    system = "" if sources.system_id is None else f"system_id = {sources.system_id}\n"
    several = len(scenario.cameras) > 1
    cameras = "\n".join(
        _camera_table(scenario, drone_id, number, source, sources.max_frame_age_s, several=several)
        for number, source in enumerate(sources.cameras)
    )
    network = ""
    if radio is not None:
        network = f"""
[network]
listen = {json.dumps(radio.listen)}
connect = {json.dumps(radio.connect)}
insecure = true                     # a radio that exists in this machine's memory only
"""
    return f"""\
# One drone of a simulated swarm. Its autopilot's local frame begins where the drone stood at the start.

extends = "team.toml"

[drone]
id = {drone_id}
# A pose that is right whenever the agent (re)starts: by the autopilot, from where the drone was measured to stand.
start = {start}

{cameras}
[autopilot]
link = {_text(sources.autopilot)}
{system}{network}"""


def _camera_table(
    scenario: Scenario, drone_id: int, number: int, source: str, max_age_s: float, *, several: bool
) -> str:
    """[camera], or of several one [[camera]]."""
    camera = scenario.cameras[number]
    lens, mount = camera.lens, scenario.told_mounting(drone_id, number)
    rpy = np.degrees(rotation.to_euler(mount.rotation @ rotation.BODY_FROM_FORWARD_CAMERA.T))
    intrinsics = ", ".join(
        f"{name} = {value:g}"
        for name, value in (
            ("fx", lens.fx), ("fy", lens.fy), ("cx", lens.cx), ("cy", lens.cy),
            ("width", lens.width), ("height", lens.height),
        )
    )  # fmt: skip
    distortion = ""
    if lens.distortion is not None:
        model = type(lens.distortion).__name__.lower()
        coefficients = _numbers(lens.distortion.coefficients, digits=9)
        distortion = f"\ndistortion = {{ model = {_text(model)}, coefficients = {coefficients} }}"
    sigma = ""
    if camera.mounting_sigma > 0.0:
        sigma = f"mounting_sigma_deg = {math.degrees(camera.mounting_sigma):g}\n"
    return f"""\
{"[[camera]]" if several else "[camera]"}
source = {_text(source)}
intrinsics = {{ {intrinsics} }}{distortion}
body_from_camera = {{ rpy_deg = {_numbers(rpy)}, position_m = {_numbers(mount.position)} }}
{sigma}max_age_s = {max_age_s}
"""


def _text(value: str) -> str:
    return json.dumps(value, ensure_ascii=False)  # of printable text, a TOML string as well


def _value(value: object) -> str:
    """A word, switch, number, or list or table of such, as TOML writes it in one line."""
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{key} = {_value(entry)}' for key, entry in value.items())} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    return _text(value) if isinstance(value, str) else repr(value)


def _numbers(values: Iterable[float], digits: int = 4) -> str:
    return json.dumps([round(float(value), digits) + 0.0 for value in values])
